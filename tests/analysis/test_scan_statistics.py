"""What is counted over the scans of a run."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest

from hsloc.analysis.scan_statistics import CoverageCounter
from hsloc.model import OccupancyGrid, Pose2, Scan


def test_each_scan_counts_once_in_each_cell_up_to_its_hits() -> None:
    """Two scans of two beams along the rows of a map that is turned by 90 deg."""
    counter = CoverageCounter(OccupancyGrid(np.zeros((20, 40), dtype=np.int8), 0.05, Pose2(1.0, 2.0, pi / 2)))
    beams = np.array([0.8, 0.8, np.inf], dtype=np.float32)
    scan = Scan(0, beams, 0.0, 1e-3, 0.1, 10.0, T_base_laser=Pose2(0.1, 0.0, 0.0))
    for moved in (0.0, 0.5):  # along the rows of the map, which point to +y
        counter.add(scan, scan.points_base(), Pose2(0.9, 2.05 + moved, pi / 2))
    found = counter.coverage()
    assert (found.side, found.T_map_corner) == (0.25, Pose2(1.0, 2.0, pi / 2))
    # Row 0 is the lower edge of the map; the lasers stand at 0.15 and 0.65 m along it, the hits are 0.8 m on.
    assert found.counts.tolist() == [[1, 1, 2, 2, 1, 1, 0, 0], *([[0] * 8] * 3)]


@pytest.mark.parametrize(("cells", "side"), [(100, 0.25), (20_480, 4.0)])
def test_cells_of_the_coverage_are_bounded(cells: int, side: float) -> None:
    counter = CoverageCounter(OccupancyGrid(np.zeros((1, cells), dtype=np.int8), 0.05, Pose2()))
    assert counter.coverage().side == side
    assert counter.coverage().counts.shape == (1, round(cells * 0.05 / side))
