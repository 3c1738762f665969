from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from hsloc.benchmark import memory as memory_module
from hsloc.benchmark.clock import Timing, measure
from hsloc.benchmark.kernel import EVALUATIONS, time_kernel, time_matches
from hsloc.benchmark.memory import Memory, measure_memory
from hsloc.benchmark.results import Target
from hsloc.benchmark.run import machine
from hsloc.benchmark.scene import office_scene
from hsloc.benchmark.sub_cell import measure_sub_cell
from hsloc.errors import HslocError

if TYPE_CHECKING:
    from pathlib import Path


def test_measure_warms_up_and_counts_every_repeat() -> None:
    calls: list[int] = []
    timing = measure(lambda: calls.append(1), 5)
    assert len(calls) == 6
    assert timing.repeats == 5
    assert 0.0 <= timing.best <= timing.median


def test_timing_has_best_and_median() -> None:
    assert Timing.of([3.0, 1.0, 2.0]).to_dict(10.0) == {"best": 10.0, "median": 20.0, "repeats": 3}


def test_machine_is_known() -> None:
    values = machine()
    assert values["cpu"]
    assert values["numpy"] == np.__version__


def test_scene_has_360_hits_that_lie_on_the_map() -> None:
    scene = office_scene()
    assert scene.points.shape == (360, 2)
    assert scene.field.fitness(scene.points, scene.truth) > 0.8


def test_kernel_and_match_are_timed_on_the_case_they_name() -> None:
    scene = office_scene()
    kernel = time_kernel(scene, 2)
    assert kernel.points * kernel.poses == 360 * 2000
    assert 0.0 < kernel.near.best <= kernel.near.median
    matches = time_matches(scene, 3)
    assert (matches[0].beams, matches[0].evaluations) == (360, EVALUATIONS)
    assert all(match.timing.best > 0.0 for match in matches)


def test_no_bias_of_half_a_cell() -> None:
    centred, _, beside, turned = measure_sub_cell(8)
    assert centred.mean_m < 1e-5
    assert max(map(abs, centred.bias_m)) < 1e-5
    # The map itself is drawn a third of a cell beside the walls: the match must find the map, no more, no less.
    assert beside.bias_m == pytest.approx((-0.05 / 3.0, -0.05 / 3.0), abs=1e-4)
    assert turned.mean_m < 0.005


def test_memory_of_two_replays_is_measured_separately(tmp_path: Path) -> None:
    # Long enough for the first comparison with the whole map, which needs 30 MB once.
    memory = measure_memory(tmp_path, 8.0)
    assert memory.long_seconds == pytest.approx(10 * memory.seconds, rel=0.02)
    # A stamp and three numbers for each of 50 poses a second, in three trajectories.
    assert memory.trajectory == pytest.approx(8 * 50 * 32 * 3, rel=0.05)
    assert memory.long_trajectory > 9 * memory.trajectory
    assert 50e6 < memory.peak < 600e6
    assert abs(memory.growth_but_trajectory) < 0.10


def test_growth_leaves_the_trajectory_out() -> None:
    memory = Memory(1.0, 110, 10, 10.0, 205, 100)
    assert memory.growth == pytest.approx(205 / 110 - 1.0)
    assert memory.growth_but_trajectory == pytest.approx(0.05)


def test_a_replay_that_fails_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory_module, "_CHILD", "raise SystemExit('no memory left')")
    with pytest.raises(HslocError, match=r"short\.mcap.*no memory left$"):
        measure_memory(tmp_path, 1.0)


def test_targets_have_a_side() -> None:
    assert Target("a time", 3.0, 4.0, "ns").met
    assert not Target("a time", 5.0, 4.0, "ns").met
    assert Target("a speed", 301.0, 300.0, "x", at_least=True).met
    assert not Target("a speed", 299.0, 300.0, "x", at_least=True).met
