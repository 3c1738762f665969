"""Maps of two drives through one building become one; maps of two buildings do not."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import pytest
from paths import RECORDINGS

from hsloc.cli.main import main
from hsloc.errors import MapError
from hsloc.log import open_log
from hsloc.model import Truth
from hsloc.model.pose2 import compose_poses
from hsloc.model.trajectory import Trajectory
from hsloc.replay.map_merge import merge_maps
from hsloc.replay.run import run
from hsloc.slam.map_state import STATE_FILE, read_state, write_state

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("maps")
    for name, log, start_s, end_s in (
        ("a", "office", 0.0, 30.0),
        ("b", "office", 20.0, 45.0),
        ("hall", "hall", 0.0, 4.0),
    ):
        found = run(RECORDINGS / f"{log}.mcap", mode="slam", start_s=start_s, end_s=end_s)
        assert found.mapping is not None
        assert found.mapping.state is not None
        (folder / name).mkdir()
        write_state(found.mapping.state, folder / name / STATE_FILE)
    return folder


def test_two_drives_through_one_building_become_one_map(
    maps: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "both"
    assert main(["merge", str(maps / "a"), str(maps / "b"), "--out", str(out), "--json", "--no-progress"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((out / "merge.json").read_text())
    assert printed["verdict"] == "good"
    assert printed["maps"][0] == {"map": str(maps / "a"), "x": 0.0, "y": 0.0, "yaw": 0.0, "loops": 0}
    assert printed["maps"][1]["loops"] >= 2
    state = read_state(out / STATE_FILE)
    truths = [event for event in open_log(RECORDINGS / "office.mcap").events() if isinstance(event, Truth)]
    truth = Trajectory.from_pairs([(event.stamp_ns, event.T_map_base) for event in truths])
    known = truth.interpolated(state.stamps_ns)
    ours = compose_poses(known[0], state.poses)
    assert np.hypot(*(ours - known)[:, :2].T).max() < 0.1, "both drives, moved by the first pose alone"
    assert (out / "map.yaml").exists()
    assert main(["merge", str(maps / "a"), str(maps / "b"), "--out", str(out)]) == 1
    assert "exists already" in capsys.readouterr().err


def test_maps_that_do_not_belong_together_are_refused(maps: Path, tmp_path: Path) -> None:
    with pytest.raises(MapError, match="not merged"):
        merge_maps([maps / "a", maps / "hall"])
    with pytest.raises(MapError, match="name two"):
        merge_maps([maps / "a"])
    with pytest.raises(MapError, match=r"no map\.npz there"):
        merge_maps([maps / "a", tmp_path])
