"""What a command imports: each package costs processor time in every run, whether it is used or not."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from imports import need_no_import
from paths import RECORDINGS

if TYPE_CHECKING:
    from pathlib import Path

OTHER_COMMANDS = {f"hsloc.cli.{name}" for name in ("merge", "sweep", "convert", "bench", "serve", "submit", "work")}
OTHER_WORK = {
    "hsloc.benchmark",
    "hsloc.calibration",
    "hsloc.client",
    "hsloc.log.convert",
    "hsloc.log.ros_bags",
    "hsloc.replay.map_merge",
    "hsloc.reproduction",
    "hsloc.simulation",
    "hsloc.sweep",
}
PACKAGES = {"http.client", "matplotlib.pyplot", "rosbags", "scipy.optimize", "scipy.spatial"}
"""Not scipy.linalg: where kernels have to be compiled first, their compiler needs it."""
MAPPER = {"hsloc.slam.mapper", "hsloc.slam.back_end", "hsloc.slam.loop_closer", "hsloc.slam.submaps"}


@pytest.mark.parametrize(("command", "more"), [("replay", MAPPER), ("map", {"hsloc.localisation.localiser"})])
def test_a_run_imports_what_it_uses(command: str, more: set[str], tmp_path: Path) -> None:
    words = [command, str(RECORDINGS / "office.mcap"), "--end=4", f"--out={tmp_path / 'out'}", "-q"]
    statement = f"from hsloc.cli.main import main; assert main({words}) in (0, 3)"
    need_no_import(statement, OTHER_COMMANDS | OTHER_WORK | PACKAGES | more)
