from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pytest
from evaluation_paths import disturb, make_path
from hypothesis import given, settings
from hypothesis import strategies as st

from hsloc.errors import EvaluationError
from hsloc.evaluation.association import associate
from hsloc.evaluation.metrics import compare, evaluate, format_json, write_json
from hsloc.evaluation.rpe import Delta, pieces
from hsloc.evaluation.statistics import Statistics
from hsloc.model import Pose2, Trajectory
from hsloc.model.pose2 import compose_poses
from hsloc.trajectory_io.tum import write_tum

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import SimpleNamespace

    from evo.core.result import Result

NAMES = ("rmse", "mean", "median", "std", "min", "max", "sse")


def moved(path: Trajectory, pose: Pose2) -> Trajectory:
    return Trajectory(path.stamps_ns, compose_poses(pose.to_array(), path.poses))


def line(n: int = 11, step: float = 1.0, period_s: float = 1.0) -> Trajectory:
    """A robot that goes straight ahead."""
    poses = np.zeros((n, 3))
    poses[:, 0] = step * np.arange(n)
    return Trajectory((np.arange(n) * period_s * 1e9).astype(np.int64), poses)


def check(ours: Statistics, theirs: Result) -> None:
    for name in NAMES:
        assert getattr(ours, name) == pytest.approx(theirs.stats[name], abs=1e-6, rel=1e-9), name
    assert ours.count == len(theirs.np_arrays["error_array"])


@pytest.mark.parametrize("relation", ["trans_part", "angle_deg"])
@pytest.mark.parametrize("alignment", ["none", "origin", "se2"])
@pytest.mark.parametrize("every", [1, 4])
def test_ape_equals_evo(
    evo: SimpleNamespace,
    as_evo: Callable[..., Any],
    rng: np.random.Generator,
    relation: str,
    alignment: str,
    every: int,
) -> None:
    reference = make_path(rng, 300)
    estimate = moved(disturb(rng, reference, every=every, shift_ns=1_000_000), Pose2(0.3, -0.2, 0.15))
    ours = evaluate(estimate, reference, alignment=alignment)
    pair = evo.associate(as_evo(reference, "a"), as_evo(estimate, "b"))
    theirs = evo.ape(*pair, evo.relations[relation], align=alignment == "se2", align_origin=alignment == "origin")
    check(getattr(ours.ape, relation), theirs)


@pytest.mark.parametrize("relation", ["trans_part", "angle_deg"])
@pytest.mark.parametrize("all_pairs", [False, True])
@pytest.mark.parametrize(("value", "unit"), [(1, "frames"), (10, "frames"), (1.0, "m"), (0.37, "m"), (5.0, "m")])
def test_rpe_equals_evo(
    evo: SimpleNamespace,
    as_evo: Callable[..., Any],
    rng: np.random.Generator,
    relation: str,
    all_pairs: bool,
    value: float,
    unit: Literal["frames", "m", "s"],
) -> None:
    reference = make_path(rng, 300)
    estimate = disturb(rng, reference, every=2)
    # Let the robot stand for a while: many poses then share one length of path.
    estimate.poses[40:60] = estimate.poses[40]
    ours = evaluate(estimate, reference, deltas=(Delta(value, unit, all_pairs),)).rpe[0].statistics
    pair = evo.associate(as_evo(reference, "a"), as_evo(estimate, "b"))
    theirs = evo.rpe(*pair, evo.relations[relation], delta=value, delta_unit=evo.units[unit], all_pairs=all_pairs)
    check(getattr(ours, relation), theirs)


@pytest.mark.parametrize("command", ["evo_ape", "evo_rpe"])
def test_equals_the_commands_that_users_run(
    evo: SimpleNamespace, tmp_path: Path, rng: np.random.Generator, command: str
) -> None:
    """The real programs on the real files, as the documentation prints them."""
    reference = make_path(rng, 200, jitter_ns=1_000_000)
    estimate = disturb(rng, reference, every=2, shift_ns=2_000_000)
    write_tum(tmp_path / "reference.tum", reference)
    write_tum(tmp_path / "trajectory.tum", estimate)
    program = Path(sys.executable).with_name(command)
    done = subprocess.run(
        [program, "tum", "reference.tum", "trajectory.tum"],
        cwd=tmp_path, env={"HOME": str(evo.home), "PATH": "/usr/bin:/bin"}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    printed = {name: float(value) for name, value in re.findall(r"(\w+)\t([\d.]+)", done.stdout)}
    result = evaluate(estimate, reference)
    ours = result.ape if command == "evo_ape" else result.rpe[0].statistics
    assert set(printed) == set(NAMES)
    for name, value in printed.items():
        assert getattr(ours.trans_part, name) == pytest.approx(value, abs=1e-6)


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.sampled_from(["none", "origin", "se2"]))
def test_a_path_is_no_different_from_itself(seed: Any, alignment: Any) -> None:
    path = make_path(np.random.default_rng(seed), 60)
    result = evaluate(path, path, alignment=alignment, deltas=(Delta(1, "frames"), Delta(0.5, "m"), Delta(0.2, "s")))
    for statistics in (result.ape, *(error.statistics for error in result.rpe)):
        assert statistics.trans_part.max == pytest.approx(0.0, abs=1e-9)
        assert statistics.angle_deg.max == pytest.approx(0.0, abs=1e-9)
    assert result.matched == 60
    assert (result.unmatched_reference, result.unmatched_estimate) == (0, 0)


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.floats(-50, 50), st.floats(-50, 50), st.floats(-3, 3))
def test_aligned_ape_and_rpe_do_not_see_a_rigid_motion(seed: Any, x: Any, y: Any, theta: Any) -> None:
    rng = np.random.default_rng(seed)
    reference = make_path(rng, 60)
    estimate = disturb(rng, reference)
    far = moved(estimate, Pose2(x, y, theta))
    near, same = (evaluate(one, reference, alignment="se2") for one in (estimate, far))
    assert same.ape.trans_part.rmse == pytest.approx(near.ape.trans_part.rmse, abs=1e-7)
    assert same.ape.angle_deg.rmse == pytest.approx(near.ape.angle_deg.rmse, abs=1e-5)
    assert same.rpe[0].statistics.trans_part.rmse == pytest.approx(near.rpe[0].statistics.trans_part.rmse, abs=1e-7)
    # Least squares: no other motion does better, not even none at all.
    assert near.ape.trans_part.rmse <= evaluate(estimate, reference).ape.trans_part.rmse + 1e-12


def test_a_constant_shift_by_hand() -> None:
    path = line()
    shifted = Trajectory(path.stamps_ns, path.poses + np.array((0.3, -0.4, np.pi / 2)))
    result = evaluate(shifted, path)
    trans = result.ape.trans_part
    assert (trans.rmse, trans.mean, trans.median, trans.std) == pytest.approx((0.5, 0.5, 0.5, 0.0))
    assert trans.sse == pytest.approx(11 * 0.25)
    assert result.ape.angle_deg.max == pytest.approx(90.0)
    assert result.axis_rmse == pytest.approx((0.3, 0.4, np.pi / 2))
    assert (result.length_reference, result.length_estimate) == pytest.approx((10.0, 10.0))


def test_an_error_that_is_one_motion_of_the_whole_is_reported_with_that_motion(rng: np.random.Generator) -> None:
    path = line()
    noise = rng.normal(0.0, 0.01, path.poses.shape)
    moved = compose_poses(np.array((3.0, -1.0, np.pi / 2)), path.poses) + noise
    found = compare(Trajectory(path.stamps_ns, moved), path).displaced()
    assert found is not None
    assert found.code == "reference_displaced"
    # The motion is that of the estimate onto the reference: back by the inverse.
    assert "x 1.0" in found.text
    assert "y 3.0" in found.text
    assert "-90" in found.text
    bent = path.poses + np.column_stack(
        (np.zeros((len(path), 1)), np.linspace(-1.0, 1.0, len(path)) ** 2 * 4, noise[:, 2])
    )
    for other in (path.poses + np.array((0.2, 0.0, 0.0)), bent):
        assert compare(Trajectory(path.stamps_ns, other), path).displaced() is None
    assert compare(Trajectory(path.stamps_ns, moved), path, alignment="se2").displaced() is None


def test_theta_is_wrapped_before_it_is_squared() -> None:
    path = line()
    a, b = (Trajectory(path.stamps_ns, path.poses + np.array((0, 0, theta))) for theta in (3.1, -3.1))
    assert evaluate(a, b).axis_rmse[2] == pytest.approx(2 * np.pi - 6.2)


@pytest.mark.parametrize(
    ("delta", "expected"),
    [
        (Delta(3, "frames"), [(0, 3), (3, 6), (6, 9)]),
        (Delta(9, "frames", all_pairs=True), [(0, 9), (1, 10)]),
        (Delta(4.0, "m"), [(0, 4), (4, 8)]),
        (Delta(3.5, "m"), [(0, 4), (4, 8)]),
        (Delta(1.0, "s"), [(0, 2), (2, 4), (4, 6), (6, 8), (8, 10)]),
        (Delta(4.5, "s", all_pairs=True), [(0, 9), (1, 10)]),
        (Delta(11, "m"), []),
        (Delta(11, "frames"), []),
    ],
)
def test_pieces_by_hand(delta: Delta, expected: list[tuple[int, int]]) -> None:
    pairs = associate(line(period_s=0.5), line(period_s=0.5))
    starts, ends = pieces(pairs, delta)
    assert list(zip(starts.tolist(), ends.tolist(), strict=True)) == expected


def test_seconds_are_cut_in_the_order_of_time() -> None:
    path = line(n=5)
    order = [0, 2, 1, 3, 4]
    mixed = Trajectory(path.stamps_ns[order], path.poses[order])
    starts, ends = pieces(associate(mixed, mixed), Delta(2.0, "s"))
    assert list(zip(mixed.poses[starts, 0], mixed.poses[ends, 0], strict=True)) == [(0, 2), (2, 4)]


def test_a_path_shorter_than_a_piece_has_no_rpe() -> None:
    short = line(n=2, step=0.1)
    relative = evaluate(short, short).to_dict()["rpe_1m"]
    assert relative["trans_part"]["count"] == 0
    assert relative["trans_part"]["rmse"] is None


@pytest.mark.parametrize(("value", "unit"), [(0, "m"), (-1, "s"), (1.5, "frames"), (np.nan, "m"), (1, "miles")])
def test_bad_deltas(value: float, unit: str) -> None:
    with pytest.raises(EvaluationError):
        Delta(value, unit)  # type: ignore[arg-type]


def test_statistics_by_hand() -> None:
    statistics = Statistics.of(np.array([3.0, 4.0, 0.0, 1.0]))
    assert statistics == Statistics(
        rmse=pytest.approx(6.5**0.5), mean=2.0, median=2.0, std=pytest.approx(2.5**0.5), min=0.0, max=4.0, sse=26.0,  # type: ignore[arg-type]
        count=4,
    )  # fmt: skip


def test_json_is_strict_and_the_same_every_time(tmp_path: Path, rng: np.random.Generator) -> None:
    path = make_path(rng, 50)
    document = evaluate(disturb(rng, path), path).to_dict()
    assert set(document) >= {"alignment", "t_max_diff", "matched", "ape", "rpe", "rpe_1m", "rpe_1s", "axis_rmse"}
    assert document["rpe"]["delta_unit"] == "frames"
    write_json(tmp_path / "metrics.json", document)
    text = (tmp_path / "metrics.json").read_text()
    assert text == format_json(document)
    assert json.loads(text)["ape"]["trans_part"]["rmse"] == document["ape"]["trans_part"]["rmse"]
    odd = {"nan": np.nan, "array": np.array([1.0, np.inf]), "n": np.int64(3), "b": np.bool_(True), "t": (1, "ü", None)}
    assert json.loads(format_json(odd)) == {
        "nan": None, "array": [1.0, None], "n": 3, "b": True, "t": [1, "ü", None],
    }  # fmt: skip
    with pytest.raises(EvaluationError, match="has no form in JSON"):
        format_json({"x": object()})
