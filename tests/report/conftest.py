"""One run for the picture and the page."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from evaluation_paths import diagnostics_of, drive, estimate_of, odometry_of, office
from sample_metrics import sample_metrics

from hsloc.evaluation.metrics import compare


@pytest.fixture(scope="module")
def run() -> dict[str, Any]:
    rng = np.random.default_rng(3)
    truth = drive([(-10, -4), (-10, 0), (0, 0), (0, 4), (0, 0), (8, 0)], rate_hz=20.0)
    estimate = estimate_of(rng, truth)
    comparison = compare(estimate, truth)
    odometry, grid = odometry_of(rng, truth), office(rng)
    diagnostics = diagnostics_of(rng, truth, lost=((10.0, 15.0),), rejected=0.03)
    return {
        "trajectory": estimate,
        "odometry": odometry,
        "reference": truth,
        "grid": grid,
        "diagnostics": diagnostics,
        "metrics": sample_metrics(comparison, diagnostics),
        "comparison": comparison,
    }
