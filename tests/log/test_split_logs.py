"""Several files are one run only if they can be: parts that follow each other, or topics recorded side by side."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING

import log_formats
import pytest
from log_builders import SECOND, START, describe, make_scan, write_run
from mcap.reader import make_reader
from mcap.writer import Writer
from paths import RECORDINGS

from hsloc.cli.main import main
from hsloc.errors import LogError
from hsloc.log.reader import open_log
from hsloc.log.summary import ReadOptions
from hsloc.log.writer import LogWriter
from hsloc.model import Pose2

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


def copy(
    source: Path, target: Path, keep: Callable[[str, int], bool] = lambda topic, seconds: True, later_s: int = 0
) -> Path:
    """Messages for which `keep(topic, seconds of the log)` is true, recorded `later_s` later; header stamps stay."""
    with source.open("rb") as stream, target.open("wb") as out:
        reader = make_reader(stream)
        messages = list(reader.iter_messages())
        start = messages[0][2].log_time
        writer = Writer(out)
        writer.start(profile="ros2", library="test")
        channels: dict[int, int] = {}
        for schema, channel, message in messages:
            if not keep(channel.topic, (message.log_time - start) / SECOND):  # type: ignore[arg-type]
                continue
            if channel.id not in channels:
                assert schema is not None
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, number)
            log_time = int(message.log_time) + later_s * SECOND
            writer.add_message(channels[channel.id], log_time, message.data, log_time)
        writer.finish()  # type: ignore[no-untyped-call]
    return target


@pytest.mark.parametrize("command", ["replay", "info", "check"])
def test_two_drives_are_refused_in_one_line_that_names_the_remedy(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    logs = [str(RECORDINGS / "hall.mcap"), str(RECORDINGS / "office.mcap")]
    out = ["--out", str(tmp_path / "out")] if command == "replay" else []
    assert main([command, *logs, *out]) == 1
    captured = capsys.readouterr()
    (line,) = captured.err.splitlines()
    assert f"{logs[0]} and {logs[1]}: both hold /odom of the same 99.3 s" in line
    assert f"`hsloc sweep {logs[0]} {logs[1]}`" in line
    assert captured.out == ""
    assert not (tmp_path / "out").exists()


def test_parts_of_one_recording_are_one_run_in_any_order(tmp_path: Path) -> None:
    source = RECORDINGS / "hall.mcap"
    folder = log_formats.split(source, tmp_path / "parts", 3)
    log = open_log(sorted(folder.iterdir(), reverse=True))
    assert log.summary.warnings == open_log(source).summary.warnings
    assert [part.path.name for part in log.summary.parts] == ["run_0.mcap", "run_1.mcap", "run_2.mcap"]
    assert [describe(event) for event in log.events()] == [describe(event) for event in open_log(source).events()]


def test_scans_in_one_file_and_odometry_in_the_other_are_one_run(tmp_path: Path) -> None:
    source = RECORDINGS / "hall.mcap"
    scans = copy(source, tmp_path / "scans.mcap", lambda topic, seconds: topic == "/scan")
    others = copy(source, tmp_path / "others.mcap", lambda topic, seconds: topic != "/scan")
    log = open_log([scans, others])
    assert log.summary.warnings == ()
    assert [describe(event) for event in log.events()] == [describe(event) for event in open_log(source).events()]


def test_the_edges_of_parts_may_overlap_but_little_more(tmp_path: Path) -> None:
    source = RECORDINGS / "hall.mcap"
    early = copy(source, tmp_path / "early.mcap", lambda topic, seconds: seconds < 20.0)
    late = copy(source, tmp_path / "late.mcap", lambda topic, seconds: 19.0 <= seconds < 40.0)
    assert open_log([early, late]).summary.warnings == ()
    late = copy(source, tmp_path / "late.mcap", lambda topic, seconds: 15.0 <= seconds < 40.0)
    with pytest.raises(LogError, match=r"early\.mcap and .*late\.mcap: both hold /odom of the same 5\.0 s"):
        open_log([early, late])
    brief = copy(source, tmp_path / "brief.mcap", lambda topic, seconds: 10.0 <= seconds < 11.0)
    with pytest.raises(LogError, match=r"both hold /odom of the same 1\.0 s"):
        open_log([early, brief])


def test_a_last_part_that_is_hardly_more_than_an_edge_is_one(tmp_path: Path) -> None:
    source = RECORDINGS / "hall.mcap"
    early = copy(source, tmp_path / "early.mcap", lambda topic, seconds: seconds < 20.0)
    last = copy(source, tmp_path / "last.mcap", lambda topic, seconds: 19.6 <= seconds < 20.1)
    assert open_log([last, early]).summary.warnings == ()


def test_without_odometry_the_scans_decide(tmp_path: Path) -> None:
    only_scans = [
        copy(RECORDINGS / f"{name}.mcap", tmp_path / f"{name}.mcap", lambda topic, seconds: topic == "/scan")
        for name in ("hall", "office")
    ]
    with pytest.raises(LogError, match=r"both hold /scan of the same 99\.3 s"):
        open_log(only_scans, ReadOptions(require_odometry=False))


def test_a_gap_of_hours_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = RECORDINGS / "hall.mcap"
    early = copy(source, tmp_path / "early.mcap", lambda topic, seconds: seconds < 20.0)
    late = copy(source, tmp_path / "late.mcap", lambda topic, seconds: 20.0 <= seconds < 40.0, later_s=7500)
    assert main(["info", str(early), str(late)]) == 0
    text = capsys.readouterr().out
    assert f"{late} begins 2 h 05 min after {early} ends; if that is another run, replay each file by itself" in text
    assert f"part:      7520.000 to 7539.960 s: {late}" in text
    assert main(["info", str(early), str(late), "--json"]) == 0
    parts = json.loads(capsys.readouterr().out)["parts"]
    assert [part["path"] for part in parts] == [str(early), str(late)]
    assert parts[1]["start_ns"] - parts[0]["end_ns"] == round(7500.04 * SECOND)


@pytest.mark.parametrize("odometry", ["topic", "tf"])
@pytest.mark.parametrize(
    ("x", "gap_s", "expected"),
    [
        (3.0, 0.1, None),
        (100.0, 0.1, "refused"),
        (100.0, 30.0, "the odometry is 97.1 m away when .* goes on, 30.0 s from the end of"),
        (4.5, 0.1, "the odometry is 1.6 m away"),
        (0.0, 10.0, "the odometry starts again from zero with .*late.mcap"),
        (8.0, 10.0, None),
    ],
)
def test_odometry_that_is_elsewhere(
    tmp_path: Path, odometry: str, x: float, gap_s: float, expected: str | None
) -> None:
    """A drive of 3 s at 1 m/s from x = 0, and one that begins at `x`, `gap_s` later."""

    def write(path: Path, start: int, x: float) -> Path:
        with LogWriter(path) as log:
            for number in range(30):
                stamp = start + number * SECOND // 10
                pose = Pose2(x + number / 10.0, 0.0, 0.0)
                if odometry == "topic":
                    log.odometry(stamp, pose)
                else:
                    log.transforms(stamp, [("odom", "base_link", pose), ("base_link", "wheel", Pose2(1e3, 0.0, 0.0))])
                log.scan(make_scan(stamp, number))
        return path

    early = write(tmp_path / "early.mcap", START, 0.0)
    late = write(tmp_path / "late.mcap", START + round((2.9 + gap_s) * SECOND), x)
    if expected == "refused":
        with pytest.raises(LogError, match=r"the odometry is 97\.1 m away .* so they are not parts of one run"):
            open_log([early, late])
        return
    warnings = [str(each) for each in open_log([early, late]).summary.warnings if "odometry" in each.code]
    if expected is None:
        assert warnings == []
    else:
        (line,) = warnings
        assert re.search(expected, line)


def test_latched_topics_that_are_repeated_in_each_part_do_not_give_its_time(tmp_path: Path) -> None:
    early = write_run(tmp_path / "early.mcap")
    late = write_run(tmp_path / "late.mcap", first=40)  # its /tf_static has the stamp of the beginning
    log = open_log([late, early])
    assert log.summary.warnings == ()
    assert [part.path for part in log.summary.parts] == [early, late]


def test_odometry_that_is_reset_far_away_is_a_driver_that_was_restarted(tmp_path: Path) -> None:
    parts = []
    for number, begin in enumerate((50.0, 0.0)):
        parts.append(tmp_path / f"{number}.mcap")
        with LogWriter(parts[-1]) as log:
            for n in range(30):
                stamp = START + (30 * number + n) * SECOND // 10
                log.odometry(stamp, Pose2(begin + n / 10.0, 0.0, 0.0))
                log.scan(make_scan(stamp, n))
    warnings = open_log(parts).summary.warnings
    assert [str(each) for each in warnings if "odometry" in each.code] == [
        f"the odometry starts again from zero with {parts[1]}; if that is another run, replay each file by itself"
    ]
