"""What all tests share: where the real logs and the fixtures are."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hsloc.trajectory_io.tum import write_tum

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def recordings() -> Path:
    return ROOT / "recordings"


@pytest.fixture(scope="session")
def data() -> Path:
    """Real logs; a test that needs them skips where they are missing."""
    folder = Path(os.environ.get("HSLOC_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real logs: {folder} is missing; set HSLOC_DATA")
    return folder


@pytest.fixture(scope="session")
def evo(tmp_path_factory):
    """evo's Python API. It is GPL and a judge in tests only: hsloc itself never imports it.

    On import evo writes its settings under $HOME, and its dependencies warn; neither is to reach us.
    """
    home = tmp_path_factory.mktemp("home")
    before = os.environ.get("HOME")
    os.environ["HOME"] = str(home)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            from evo.core import metrics, sync, units
            from evo.core.sync_method import SyncMethod
            from evo.main_ape import ape
            from evo.main_rpe import rpe
            from evo.tools import file_interface
    finally:
        if before is None:
            del os.environ["HOME"]
        else:
            os.environ["HOME"] = before
    return SimpleNamespace(
        ape=ape,
        rpe=rpe,
        read=file_interface.read_tum_trajectory_file,
        associate=sync.associate_trajectories,
        NothingMatches=sync.SyncException,
        methods={"nearest": SyncMethod.nearest_time, "interpolation": SyncMethod.interpolation},
        relations={
            "trans_part": metrics.PoseRelation.translation_part,
            "angle_deg": metrics.PoseRelation.rotation_angle_deg,
        },
        units={"frames": units.Unit.frames, "m": units.Unit.meters},
        home=home,
    )


@pytest.fixture
def as_evo(evo, tmp_path):
    """A trajectory as evo reads it from our file."""

    def convert(trajectory, name="trajectory"):
        write_tum(tmp_path / f"{name}.tum", trajectory)
        return evo.read(str(tmp_path / f"{name}.tum"))

    return convert


@pytest.fixture
def rng():
    """A generator with a fixed seed."""
    return np.random.default_rng(7)
