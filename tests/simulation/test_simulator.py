"""The drive as a whole: order, rates, truth, kidnapping, repeatability."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from hsloc.errors import ConfigError
from hsloc.model import Odometry, Scan, Truth
from hsloc.simulation.built_in import built_in
from hsloc.simulation.odometer import OdometryNoise, Slip
from hsloc.simulation.presets import SCENARIOS, preset
from hsloc.simulation.scenario import Kidnap, Scenario
from hsloc.simulation.sensors import Lidar
from hsloc.simulation.simulator import Tick, events, simulate

SHORT = replace(SCENARIOS["office"], duration_s=6.0, sensor=replace(SCENARIOS["office"].sensor, beams=72))
OFFICE = built_in("office")


def split(scenario: Scenario, world: Any = OFFICE) -> tuple[list[Tick], list[Scan]]:
    items = list(simulate(scenario, world))
    return [item for item in items if not isinstance(item, Scan)], [item for item in items if isinstance(item, Scan)]


def test_ticks_and_scans_come_at_their_rates_in_order_of_stamps() -> None:
    scenario = replace(SHORT, scan_offset_s=0.013)
    ticks, scans = split(scenario)
    start = scenario.start_stamp_ns
    assert [tick.stamp_ns - start for tick in ticks] == [20_000_000 * i for i in range(301)]
    assert [scan.stamp_ns - start for scan in scans] == [13_000_000 + 100_000_000 * i for i in range(60 + 1)]
    stamps = [item.stamp_ns for item in simulate(scenario, OFFICE)]
    assert stamps == sorted(stamps)


def test_odometry_without_noise_is_the_truth_seen_from_the_start() -> None:
    ticks, _ = split(replace(SHORT, odometry=OdometryNoise(0, 0, 0, 0)))
    for tick in ticks:
        assert (OFFICE.start() @ tick.T_odom_base).distance(tick.T_map_base) < 1e-4


def test_hits_lie_on_the_walls_seen_from_the_truth() -> None:
    ticks, scans = split(replace(SHORT, sensor=replace(SHORT.sensor, range_noise=0.0)))  # type: ignore[arg-type]
    truth = {tick.stamp_ns: tick.T_map_base for tick in ticks}
    for scan in scans:
        assert OFFICE.distance_to_walls(truth[scan.stamp_ns] @ scan.points_base()).max() < 1.5e-3


def test_distorted_scans_straighten_when_each_beam_is_put_where_it_was_measured() -> None:
    sensor = replace(SHORT.sensor, range_noise=0.0, motion_distortion=True, range_max=30.0)  # type: ignore[arg-type]
    ticks, scans = split(replace(SHORT, sensor=sensor, duration_s=12.0))
    stamps = np.array([tick.stamp_ns for tick in ticks])
    straight, bent = [], []
    for scan in scans[10:100:3]:
        at = scan.stamp_ns + 1e9 * scan.time_increment * np.arange(len(scan.ranges))
        index = np.clip(np.searchsorted(stamps, at, side="right") - 1, 0, len(ticks) - 2)
        fraction = (at - stamps[index]) / 20e6
        poses = [
            ticks[i].T_map_base.interpolate(ticks[i + 1].T_map_base, f) for i, f in zip(index, fraction, strict=True)
        ]
        angles, points = scan.angles(), scan.points_base()
        assert len(points) == len(angles)
        straight.append(OFFICE.distance_to_walls(np.array([p @ q for p, q in zip(poses, points, strict=True)])).max())
        bent.append(OFFICE.distance_to_walls(poses[0] @ points).max())
    assert max(straight) < 1.5e-3
    assert max(bent) > 0.05


def test_kidnapped_robot_jumps_in_the_world_and_its_odometry_does_not_notice() -> None:
    scenario = replace(SHORT, odometry=OdometryNoise(0, 0, 0, 0), kidnaps=(Kidnap(at_s=3.0, skip_s=4.0),))
    ticks, _ = split(scenario)
    plain, _ = split(replace(SHORT, odometry=OdometryNoise(0, 0, 0, 0), duration_s=12.0))
    assert len(ticks) == 301
    jumps = [b.T_map_base.distance(a.T_map_base) for a, b in pairwise(ticks)]
    steps = [b.T_odom_base.distance(a.T_odom_base) for a, b in pairwise(ticks)]
    assert np.argmax(jumps) == 149
    assert jumps[149] > 0.5
    assert max(steps) < 0.03
    assert max(jumps[:149] + jumps[150:]) < 0.03
    assert ticks[150].T_map_base == plain[150 + 200].T_map_base  # where it would have been 4 s later
    assert ticks[149].T_map_base == plain[149].T_map_base


def test_slip_bends_the_odometry_alone() -> None:
    slipping, _ = split(replace(SHORT, slips=(Slip(at_s=3.0, duration_s=1.0, factor=2.0),)))
    plain, _ = split(SHORT)
    assert [t.T_map_base for t in slipping] == [t.T_map_base for t in plain]
    assert [t.T_odom_base for t in slipping[:150]] == [t.T_odom_base for t in plain[:150]]
    assert slipping[-1].T_odom_base.distance(plain[-1].T_odom_base) > 0.5


def test_same_seed_same_numbers_and_another_seed_others() -> None:
    (ticks, scans), (again, scans_again) = split(SHORT), split(SHORT)
    other, other_scans = split(replace(SHORT, seed=1))
    assert [t.T_odom_base for t in ticks] == [t.T_odom_base for t in again]
    assert [s.ranges.tobytes() for s in scans] == [s.ranges.tobytes() for s in scans_again]
    assert ticks[-1].T_odom_base != other[-1].T_odom_base
    assert scans[0].ranges.tobytes() != other_scans[0].ranges.tobytes()
    assert [t.T_map_base for t in ticks] == [t.T_map_base for t in other]  # the drive itself is not noisy


def test_one_noise_does_not_shift_another() -> None:
    ticks, scans = split(SHORT)
    more_people, crowded = split(replace(SHORT, people=3))
    louder, noisy = split(replace(SHORT, odometry=OdometryNoise(alpha3=0.1)))
    assert [t.T_odom_base for t in ticks] == [t.T_odom_base for t in more_people]
    assert [s.ranges.tobytes() for s in scans] == [s.ranges.tobytes() for s in noisy]
    assert louder[-1].T_odom_base != ticks[-1].T_odom_base
    changed = np.mean([np.mean(a.ranges != b.ranges) for a, b in zip(scans, crowded, strict=True)])
    assert 0.0 < changed < 0.2


def test_events_are_what_a_log_would_give() -> None:
    kinds = [type(event) for event in events(replace(SHORT, duration_s=0.1), OFFICE)]
    assert kinds == [Truth, Odometry, Scan] + [Truth, Odometry] * 5 + [Scan]


def test_the_recording_ends_with_the_way_or_with_the_duration() -> None:
    ticks, _ = split(replace(SHORT, duration_s=None, laps=0.1))
    path = OFFICE.path(0.1)
    assert np.hypot(ticks[-1].T_map_base.x - path[-1, 0], ticks[-1].T_map_base.y - path[-1, 1]) < 0.05
    long, _ = split(replace(SHORT, duration_s=200.0, sensor=Lidar(beams=1)))
    assert len(long) == 10_001  # longer than a lap: it goes round again


@pytest.mark.parametrize("name", SCENARIOS)
def test_scenarios_survive_json(name: str) -> None:
    scenario = preset(name)
    assert Scenario.from_dict(json.loads(json.dumps(scenario.to_dict()))) == scenario


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"world": "office", "colour": 1}, "Scenario has no 'colour'"),
        ({"world": "office", "sensor": {"kind": "Sonar"}}, "kind 'Sonar' is unknown"),
        ({"world": "office", "sensor": {"kind": "Lidar", "beam": 3}}, "Lidar has no 'beam'"),
        ({"world": "office", "scan_rate_hz": 0}, "scan_rate_hz is 0; it must be from 0.01 to 10000"),
        ({"world": "office", "duration_s": float("nan")}, "duration_s is nan"),
        ({"world": "office", "laps": float("inf")}, "laps is inf"),
        ({"world": "office", "kidnaps": [{"at_s": 1, "skip_s": -1}]}, "Kidnap.skip_s is -1"),
        ({"world": "office", "seed": -1}, "seed is -1; it must be from 0"),
        (
            {"world": "office", "robot": {"kind": "DifferentialDrive", "acceleration": 0}},
            "acceleration is 0; it must be",
        ),
        ({"world": "office", "sensor": {"kind": "Lidar", "range_step": float("nan")}}, r"Lidar\.range_step is nan"),
        ({"world": "office", "odometry": {"kind": "OdometryNoise", "alpha1": -1}}, r"OdometryNoise\.alpha1 is -1"),
    ],
)
def test_scenarios_that_make_no_sense_are_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Scenario.from_dict(values)


def test_an_unknown_preset_names_the_choice() -> None:
    with pytest.raises(ConfigError, match=r"'x' is unknown; choose from office"):
        preset("x")
