"""What all tests share: where the real logs and the fixtures are."""

from __future__ import annotations

import gc
import importlib
import os
import pkgutil
import warnings
from functools import cache
from itertools import zip_longest
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from coverage import Coverage
from hypothesis import HealthCheck, settings
from paths import DATA, RECORDINGS, ROOT

# Before anything imports numba or matplotlib. The jobs of a service that has just been installed compile all kernels,
# and so would those of every test that starts one.
os.environ.setdefault("NUMBA_CACHE_DIR", str(ROOT / "build" / "numba"))
os.environ.setdefault("MPLCONFIGDIR", str(ROOT / "build" / "matplotlib"))

import hsloc
import hsloc_service
from hsloc.trajectory_io.tum import write_tum

# To look for garbage among all that is imported takes a quarter of the time of tests that compute; `hsloc` itself looks
# even less often.
gc.set_threshold(20_000, 20, 20)

# How long an example takes depends on how busy the machine is.
settings.register_profile("hsloc", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("hsloc")

if TYPE_CHECKING:
    from collections.abc import Callable, Generator
    from pathlib import Path


_LONGEST_FIRST = ("docs", "system", "sweep", "analysis", "slam", "localisation", "reproduction")
"""Folders whose files take longest: begun last, they would leave one core with nothing to do at the end."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest files first, and between them those of the service; a file's tests stay together and in order.

    Tests of the service wait for more than half of their time: side by side they would leave the cores idle.
    """
    files = list(dict.fromkeys(item.path for item in items))
    waiting = [file for file in files if file.parent.name == "service"]
    ranks = {name: rank for rank, name in enumerate(_LONGEST_FIRST)}
    computing = sorted(set(files) - set(waiting), key=lambda file: (ranks.get(file.parent.name, len(ranks)), file))
    mixed = [file for pair in zip_longest(computing, waiting) for file in pair if file is not None]
    places = {file: place for place, file in enumerate(mixed)}
    items.sort(key=lambda item: places[item.path])


def pytest_collection_finish() -> None:
    """Tests, modules and what they hold stay to the end: the collection of garbage need not look at them."""
    gc.collect()
    gc.freeze()


@cache
def _import_every_module() -> None:
    """One that a test without coverage imports first would not count."""
    for package in (hsloc, hsloc_service):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if not module.name.startswith("hsloc_service.db.scripts."):  # Alembic's: run, never imported
                importlib.import_module(module.name)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Measure no coverage of an `unmeasured` test with its fixtures, nor in the processes that they start."""
    measured = Coverage.current()
    if measured is None or item.get_closest_marker("unmeasured") is None:
        return (yield)
    _import_every_module()
    of_processes = os.environ.pop("COVERAGE_PROCESS_CONFIG", None)
    measured.stop()
    try:
        return (yield)
    finally:
        measured.start()
        if of_processes is not None:
            os.environ["COVERAGE_PROCESS_CONFIG"] = of_processes


@pytest.fixture(scope="session")
def recordings() -> Path:
    return RECORDINGS


@pytest.fixture(scope="session")
def data() -> Path:
    """Real logs; a test that needs them skips where they are missing."""
    folder = DATA
    if not folder.is_dir():
        pytest.skip(f"no real logs: {folder} is missing; set HSLOC_DATA")
    return folder


@pytest.fixture(scope="session")
def evo(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
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
def as_evo(evo: SimpleNamespace, tmp_path: Path) -> Callable[..., Any]:
    """A trajectory as evo reads it from our file."""

    def convert(trajectory: Any, name: str = "trajectory") -> Any:
        write_tum(tmp_path / f"{name}.tum", trajectory)
        return evo.read(str(tmp_path / f"{name}.tum"))

    return convert


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator with a fixed seed."""
    return np.random.default_rng(7)
