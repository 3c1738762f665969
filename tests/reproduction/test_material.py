from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from paths import DATA

from hsloc.errors import ConfigError
from hsloc.reproduction import own_material, report_material
from hsloc.reproduction.scan_match import run_scan_match

if TYPE_CHECKING:
    from pathlib import Path

REPORT = DATA / "paper"


def test_report_material_reads_its_three_files(tmp_path: Path) -> None:
    (tmp_path / "scan1.csv").write_text("x_m,y_m\n1,2\n3,4\n")
    (tmp_path / "localisation_map.csv").write_text("x_m,y_m\n0,5\n5,5\n5,0\n")
    (tmp_path / "waypoints.csv").write_text("x_m,y_m\n0,0\n2,1\n")
    material = report_material(tmp_path)
    np.testing.assert_array_equal(material.scan, [(1, 2), (3, 4)])
    assert material.world.points is not None
    assert len(material.world.points) == 3
    assert material.world.start().theta == 0.0


@pytest.mark.parametrize("missing", ["scan1.csv", "localisation_map.csv", "waypoints.csv"])
def test_a_missing_file_is_named(tmp_path: Path, missing: str) -> None:
    for name in {"scan1.csv", "localisation_map.csv", "waypoints.csv"} - {missing}:
        (tmp_path / name).write_text("x_m,y_m\n0,0\n1,1\n")
    with pytest.raises(ConfigError, match=f"{missing}: no such file"):
        report_material(tmp_path)


def test_own_material_is_the_same_every_time() -> None:
    first, second = own_material(), own_material()
    np.testing.assert_array_equal(first.scan, second.scan)
    assert first.world.fingerprint() == second.world.fingerprint()
    assert len(first.scan) > 300


@pytest.mark.data
@pytest.mark.skipif(not REPORT.is_dir(), reason=f"no data of the report in {REPORT}")
def test_hide_matches_the_scan_of_the_report() -> None:
    material = report_material(REPORT)
    assert len(material.scan) == 349
    rows = {row.variant.label: row for row in run_scan_match(material.scan, 5, lambda _: None)}
    assert rows["HIDE, default"].success == 1.0
    # Measured over 200 seeds: at most 0.33 mm.
    assert rows["HIDE, default"].tally.metres.max() < 0.001
