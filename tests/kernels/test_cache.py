"""Where compiled kernels are kept: a writable place is found, or one warning reports that there is none."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import warnings
from typing import TYPE_CHECKING

import numba
import pytest
from numba.core import config
from numba.core.dispatcher import Dispatcher

from hsloc.kernels import cache

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="nothing is compiled")


@pytest.fixture
def nowhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """numba finds no place of its own; what is changed for good is restored."""

    def refuse(_: object) -> None:
        if not config.CACHE_DIR:  # type: ignore[attr-defined]
            raise RuntimeError("cannot cache function: no locator available")

    monkeypatch.setattr(config, "CACHE_DIR", "")
    monkeypatch.setattr(Dispatcher, "enable_caching", refuse)


@pytest.mark.usefixtures("nowhere")
def test_the_cache_falls_back_to_a_private_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache.tempfile, "gettempdir", lambda: str(tmp_path))  # type: ignore[attr-defined]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cache.choose_cache()
    (folder,) = tmp_path.iterdir()
    assert str(folder) == config.CACHE_DIR  # type: ignore[attr-defined]
    assert folder.stat().st_mode & 0o777 == 0o700


@pytest.mark.usefixtures("nowhere")
def test_a_folder_that_others_may_write_to_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is loaded from the cache is executed."""
    monkeypatch.setattr(cache, "_PARENTS", (str(tmp_path),))
    monkeypatch.setattr(cache.tempfile, "gettempdir", lambda: str(tmp_path))  # type: ignore[attr-defined]
    folder = tmp_path / f"hsloc-kernels-{os.getuid()}"
    folder.mkdir()
    folder.chmod(0o777)
    with pytest.warns(RuntimeWarning, match="compiled in every process"):
        cache.choose_cache()
    assert not config.CACHE_DIR  # type: ignore[attr-defined]
    numba.njit(cache=True)(lambda: 0)  # no longer raises


def test_a_kernel_is_compiled_again_when_one_that_it_calls_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cache, "_SOURCES", tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    head = "import numba\n@numba.njit(cache=True)\n"
    (tmp_path / "outer_kernel.py").write_text(
        f"from inner_kernel import inner\n{head}def outer():\n    return inner()\n"
    )
    found = []
    for value in (1, 20):  # of different lengths: Python's own cache looks at the size
        (tmp_path / "inner_kernel.py").write_text(f"{head}def inner():\n    return {value}\n")
        cache._digest.cache_clear()
        for name in ("inner_kernel", "outer_kernel"):
            monkeypatch.delitem(sys.modules, name, raising=False)
        importlib.invalidate_caches()
        found.append(importlib.import_module("outer_kernel").outer())
    cache._digest.cache_clear()
    assert found == [1, 20]


def test_kernels_from_the_cache_are_loaded_without_the_compiler() -> None:
    """What a replay calls imports SciPy's linear algebra neither by numba's declarations nor by its functions."""
    code = (
        "import sys, numpy as np\n"
        "from hsloc.kernels.fitness import range_noise, score_with_noise\n"
        "from hsloc.matching import Hide, LikelihoodField, Window\n"
        "from hsloc.model import OccupancyGrid, Pose2\n"
        "cells = np.zeros((40, 40), dtype=np.int8)\n"
        "cells[5, 5:30] = cells[5:30, 5] = 100\n"
        "points, window = np.argwhere(cells) * 0.05, Window(Pose2(), 0.1, 0.1, 0.1)\n"
        "field = LikelihoodField.from_grid(OccupancyGrid(cells, 0.05))\n"
        "match = Hide().match(points, field, window, np.random.default_rng(0))\n"
        "ranges = np.linspace(1.0, 2.0, 99, dtype=np.float32)\n"
        "score_with_noise(ranges, 0.1, 9.0, 0.01, 0.1), range_noise(ranges, 0.1, 9.0, 0.01, np.empty(99))\n"
        "print(f'{match.fitness:.9f}', 'scipy.linalg' in sys.modules)\n"
    )
    first, second = (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
        for _ in range(2)
    )
    assert second == [first[0], "False"]


def test_compilation_is_reported_and_cached_kernels_are_not() -> None:
    counts: list[int] = []
    kernel = numba.njit(lambda x: x + 1)
    with cache.compilation_reported(counts.append):
        kernel(1)
        kernel(2)
    assert counts == [0, 1]


def test_a_user_without_a_home_gets_no_traceback(tmp_path: Path) -> None:
    code = "import hsloc.kernels.fitness"
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    environment |= {"HOME": "/nonexistent", "TMPDIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
