"""states.csv: what is known of each pose of trajectory.tum, line by line in its order."""

from __future__ import annotations

import csv
from typing import TYPE_CHECKING

from hsloc.trajectory_io.tum import format_stamp

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from hsloc.localisation.states import StateRows

HEADER = ("t", "state", "probability", "sigma_x", "sigma_y", "sigma_theta", "fitness", "reason")


def write_states(path: Path, stamps_ns: NDArray[np.int64], rows: StateRows) -> None:
    """Write one line for each of the n stamps: seconds, metres and radians; nan where a figure is unknown."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(HEADER)
        columns = zip(
            stamps_ns.tolist(),
            rows.state,
            rows.probability.tolist(),
            rows.sigma.tolist(),
            rows.fitness.tolist(),
            rows.reason,
            strict=True,
        )
        for stamp_ns, state, probability, (x, y, theta), fitness, reason in columns:
            figures = (f"{probability:.4f}", f"{x:.4f}", f"{y:.4f}", f"{theta:.5f}", f"{fitness:.3f}")
            writer.writerow((format_stamp(stamp_ns), state.value, *figures, reason))
