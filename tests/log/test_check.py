"""`hsloc check`: each kind of trouble is found where it is, once for each topic, with a remedy, and nothing else."""

from __future__ import annotations

import json
import tracemalloc
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from log_builders import MOUNTING, SECOND, START, chunk_data_at, chunks_of, flipped, make_scan, write_run
from paths import DATA

from hsloc.cli.main import main
from hsloc.log.checks.checker import check_log
from hsloc.log.checks.findings import Intervals, Place
from hsloc.log.messages import encode
from hsloc.log.reader import open_log
from hsloc.log.summary import ReadOptions
from hsloc.log.writer import LogWriter
from hsloc.model import Pose2

if TYPE_CHECKING:
    from pathlib import Path

ALL = ReadOptions(require_scan=False, require_odometry=False)
TENTH = SECOND // 10


class Run:
    """A sound log of 100 scans and as many odometry messages, made wrong in one place by a test."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.scans = [make_scan(START + k * TENTH, k) for k in range(100)]
        self.scan_delays = dict.fromkeys(range(100), 0)
        self.odometry = [(START + k * TENTH, Pose2(k / 100.0, 0.0, 0.0)) for k in range(100)]
        self.static: list[tuple[str, str, Pose2]] = [("base_link", "laser", MOUNTING)]
        self.links: list[tuple[int, str, str, Pose2]] = []

    def write(self) -> Path:
        with LogWriter(self.path) as log:
            if self.static:
                log.transforms(START, self.static, static=True, log_time_ns=START)
            for k, scan in enumerate(self.scans):
                log.scan(scan, log_time_ns=START + k * TENTH + self.scan_delays.get(k, 0))
            for k, (stamp, pose) in enumerate(self.odometry):
                log.odometry(stamp, pose, log_time_ns=START + k * TENTH)
            for k, (stamp, parent, child, pose) in enumerate(self.links):
                log.transforms(stamp, [(parent, child, pose)], log_time_ns=START + k)
        return self.path

    def moved(self, first: int, by_ns: int) -> None:
        """Stamps of all scans from one on."""
        for k in range(first, len(self.scans)):
            self.change(k, stamp_ns=self.scans[k].stamp_ns + by_ns)
            self.scan_delays[k] = by_ns

    def change(self, k: int, **values: Any) -> None:
        from dataclasses import replace

        self.scans[k] = replace(self.scans[k], **values)


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return Run(tmp_path / "run.mcap")


def found(path: Path) -> dict[str, tuple[str, str, int, int | None]]:
    """code: (severity, topic, count, number of the first message)."""
    report = check_log(open_log(path, ALL))
    assert all(finding.remedy and finding.text for finding in report.findings)
    return {
        f.code: (f.severity.value, f.topic, f.count, None if f.first is None else f.first.number)
        for f in report.findings
    }


def test_a_sound_log_has_no_findings(run: Run) -> None:
    assert found(run.write()) == {}


def test_stamps_that_run_backwards_or_repeat(run: Run) -> None:
    run.change(40, stamp_ns=run.scans[39].stamp_ns - 5)
    run.change(60, stamp_ns=run.scans[59].stamp_ns)
    result = found(run.write())
    assert result["stamp_backwards"] == ("error", "/scan", 1, 40)
    assert result["stamp_repeated"] == ("warning", "/scan", 1, 60)


@pytest.mark.parametrize(
    ("delay", "expected"),
    [(0.09, {}), (0.2, {"latency": ("warning", "/scan", 100, 0)}), (0.7, {"latency_high": ("error", "/scan", 100, 0)})],
)
def test_stamps_that_are_late(run: Run, delay: float, expected: dict[str, Any]) -> None:
    run.scan_delays = dict.fromkeys(range(100), round(delay * SECOND))
    assert found(run.write()) == expected


def test_scans_that_were_written_in_batches_are_not_late(run: Run) -> None:
    run.scan_delays = {k: -(k % 25) * TENTH for k in range(100)}
    assert found(run.write()) == {"log_time_repeated": ("warning", "/scan", 1, None)}


def test_stamps_of_another_clock_are_no_trouble(run: Run) -> None:
    for k in range(100):
        run.change(k, stamp_ns=36 * SECOND + k * TENTH)
    run.odometry = [(36 * SECOND + k * TENTH, Pose2(k / 100.0)) for k in range(100)]
    result = found(run.write())
    assert set(result) == {"other_clock"}
    assert result["other_clock"][0] == "info"


def test_messages_without_stamp(run: Run) -> None:
    for k in (7, 9):
        run.change(k, stamp_ns=0)
    assert found(run.write())["stamp_zero"] == ("warning", "/scan", 2, 7)


@pytest.mark.parametrize("at", [3, 80])
def test_a_gap_is_found_before_and_after_it_is_known_what_is_usual(run: Run, at: int) -> None:
    run.moved(at, 4 * TENTH)
    result = found(run.write())
    assert result["gap"] == ("warning", "/scan", 1, at)


def test_scans_that_overlap_in_time(run: Run) -> None:
    for k in range(100):
        run.change(k, time_increment=0.15 / 7)
    assert found(run.write())["scans_overlap"] == ("warning", "/scan", 99, 1)


@pytest.mark.parametrize("increment", [-0.01, 1.0, float("nan"), float("inf")])
def test_times_of_beams_that_cannot_be(run: Run, increment: float) -> None:
    run.change(10, time_increment=increment)
    assert found(run.write()) == {"time_increment": ("warning", "/scan", 1, 10)}


def test_scans_that_repeat_or_see_nothing(run: Run) -> None:
    run.change(30, ranges=run.scans[29].ranges)
    for k in (50, 51):
        run.change(k, ranges=np.full(8, np.inf, dtype=np.float32))
    result = found(run.write())
    assert result["scans_identical"] == ("warning", "/scan", 1, 30)
    assert result["no_hits"] == ("warning", "/scan", 2, 50)


def test_the_number_of_beams(run: Run) -> None:
    run.change(20, ranges=np.arange(1.0, 5.0, dtype=np.float32))
    result = found(run.write())
    assert result["beams_change"] == ("warning", "/scan", 2, 20)
    for k in range(100):
        run.change(k, ranges=np.full(100 + k % 2, 1.0 + k / 100, dtype=np.float32))
    assert found(run.write())["beams_vary"][:3] == ("info", "/scan", 99)


@pytest.mark.parametrize(
    "changes",
    [
        {"angle_increment": 0.0},
        {"angle_increment": float("nan")},
        {"range_max": 0.0},
        {"range_max": float("nan")},
        {"ranges": np.zeros(0, dtype=np.float32)},
    ],
    ids=str,
)
def test_scans_without_geometry(run: Run, changes: dict[str, Any]) -> None:
    run.change(10, **changes)
    assert found(run.write())["scan_unusable"] == ("error", "/scan", 1, 10)


def test_two_topics_with_one_frame_and_two_frames_on_one_topic(run: Run) -> None:
    run.change(10, frame_id="other")
    path = run.write()
    second = path.with_name("second.mcap")
    with LogWriter(second) as log:
        for k in range(100):
            log.scan(make_scan(START + k * TENTH, k), topic="/rear")
    report = check_log(open_log([path, second], ALL))
    codes = {f.code: (f.severity.value, f.topic, f.count) for f in report.findings}
    assert codes["frame_shared"] == ("warning", "/scan, /rear", 1)
    assert codes["frame_changes"] == ("warning", "/scan", 2)
    assert codes["scan_ambiguous"][0] == "warning"


def test_odometry_that_jumps_or_is_not_finite(run: Run) -> None:
    run.odometry = [(stamp, Pose2(pose.x + 3.0 * (k >= 55))) for k, (stamp, pose) in enumerate(run.odometry)]
    run.odometry[70] = (run.odometry[70][0], Pose2(float("nan")))
    result = found(run.write())
    assert result["odometry_jumps"] == ("warning", "/odom", 1, 55)
    assert result["not_finite"] == ("error", "/odom", 1, 70)


def test_orientations_that_are_no_rotations(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(encode, "_pose", lambda pose: encode._POSE.pack(pose.x, pose.y, 0.0, 0.0, 0.0, 0.0, 0.5))
    report = check_log(open_log(run.write(), ALL))
    assert report.has_errors
    assert {f.topic for f in report.findings if f.code == "quaternion"} == {"/odom", "/tf_static"}


def test_transforms_with_two_parents_backwards_and_from_a_localiser(run: Run) -> None:
    run.links = [
        (START + 5, "odom", "base_link", Pose2()),
        (START + 3, "odom", "base_link", Pose2()),
        (START + 6, "map", "base_link", Pose2()),
        (START + 7, "map", "odom", Pose2()),
    ]
    result = found(run.write())
    assert result["two_parents"] == ("error", "/tf", 1, 3)  # after the static one and two of its own
    assert result["stamp_backwards"] == ("warning", "/tf", 1, 2)
    assert result["map_to_odom"][0] == "info"


def test_odometry_and_transforms_with_different_frames(run: Run) -> None:
    run.links = [(START + 5, "odom", "base_footprint", Pose2())]
    assert found(run.write())["odometry_frames"][:2] == ("warning", "/odom")


def test_what_is_missing(run: Run, tmp_path: Path) -> None:
    run.static = []
    assert found(run.write())["no_extrinsic"] == ("warning", "/scan", 1, None)
    with LogWriter(tmp_path / "bare.mcap") as log:
        log.pose(START, Pose2())
    assert found(tmp_path / "bare.mcap")["no_scan"][0] == "error"
    assert found(tmp_path / "bare.mcap")["no_odometry"][0] == "warning"


def test_odometry_that_begins_late(run: Run) -> None:
    run.odometry = run.odometry[20:]
    assert found(run.write())["odometry_short"][:2] == ("warning", "/scan")


def test_usual_is_the_median_even_of_short_topics() -> None:
    intervals = Intervals()
    place = Place("/scan", 0, 0, 0)
    assert [intervals.add(n, place) for n in (5, 1, 9, 7)] == [[], [], [], []]
    assert intervals.settle() == []
    assert [intervals.add(n * 1_000_000, place) for n in (5, 1, 90, 7, 6)] == [[]] * 5
    assert len(intervals.settle()) == 5
    assert intervals.usual_ns == 6_000_000
    assert intervals.to_dict()["histogram"] == [[0.001, 5], [0.005, 1], [0.01, 2], [0.1, 1]]


def command(capsys: pytest.CaptureFixture[str], *argv: object) -> tuple[int, str]:
    code = main(["check", *(str(word) for word in argv)])
    out, err = capsys.readouterr()
    assert err == ""
    return code, out


def test_exit_codes_of_the_command(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    path = run.write()
    code, out = command(capsys, path)
    assert (code, out.splitlines()[-1]) == (0, "201 messages checked: nothing wrong")
    assert "/scan scans: every 0.100 s" in out
    run.change(40, stamp_ns=run.scans[39].stamp_ns - 5)
    code, out = command(capsys, run.write(), "-q")
    assert code == 1
    assert out.splitlines() == [
        "error: /scan: stamps of the scans run backwards, first at 4.000 s (message 40)",
        "  remedy: look for two publishers on the topic, or a clock that was set while recording",
    ]
    whole = write_run(path, scans=200).read_bytes()
    path.write_bytes(flipped(whole, chunk_data_at(whole, chunks_of(whole)[9]) + 30))
    code, out = command(capsys, path)
    assert code == 3
    assert out.startswith("damage: 1 damaged chunk was skipped")
    code, out = command(capsys, path, "--json")
    report = json.loads(out)
    assert (code, report["data_lost"], report["ok"]) == (3, True, False)
    assert report["findings"][0]["severity"] == "damage"


def test_as_json(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    run.moved(80, 4 * TENTH)
    code, out = command(capsys, run.write(), "--json")
    report = json.loads(out)
    assert (code, report["ok"], report["messages"]) == (0, True, 201)
    gap = next(finding for finding in report["findings"] if finding["code"] == "gap")
    assert gap["first"]["message"] == 80
    assert gap["first"]["seconds"] == pytest.approx(8.4)
    assert report["intervals"]["/scan scans"]["usual_s"] == pytest.approx(0.1)


@pytest.mark.unmeasured
def test_memory_does_not_grow_with_the_log(tmp_path: Path) -> None:
    peaks = []
    for scans in (1000, 4000):
        log = open_log(write_run(tmp_path / f"{scans}.mcap", scans=scans, chunk_size=1 << 16), ALL)
        tracemalloc.start()
        check_log(log)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0]


def test_real_logs() -> None:
    if not DATA.is_dir():
        pytest.skip("no real logs; set HSLOC_DATA")
    intel = found(DATA / "intel" / "intel.clf.gz")
    assert intel["stamp_backwards"][0] == "error"
    assert "no_extrinsic" in intel
    turtlebot = check_log(open_log(DATA / "turtlebot4" / "mcap_zstd", ALL))
    assert not turtlebot.has_errors
