"""Logs as public reports describe them, the given ones and one more of each kind, through the command line.

    python benchmarks/reported_logs.py --cases ../shared/cases [--only S16]

The cases are logs of one drive (their README says which), made wrong in one way each; `drive_variants` makes the others
of the same drive. Each is localised with its defaults, and once more with the flag that a warning names where it needs
one. A line has the error against the truth (APE rmse), the verdict, and the codes of the warnings, or the error.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
import tempfile
from functools import partial
from math import atan2, cos, degrees, nan, sin
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "support"))

import drive_variants as variants
from drive_variants import Cases

from hsloc.cli.main import main as hsloc

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

START = ["--initial-pose", "2.6,8.1,1.5708"]


def localised(own: Cases, log: list[str]) -> str:
    """The outcome of `hsloc replay` with the log and its flags."""
    given = [] if "--map" in log else ["--map", str(own.cases / "map/office.yaml")]
    given += [] if "--no-start" in log else START
    log = [each for each in log if each != "--no-start"]
    with tempfile.TemporaryDirectory() as out:
        code, error = quietly(["replay", *log, *given, "--reference", str(own.cases / "truth.tum"), "--out", out])
        metrics = Path(out) / "metrics.json"
        return outcome(metrics) if metrics.is_file() else f"exit code {code}: {error}"


def built(own: Cases, log: list[str]) -> str:
    """The outcome of `hsloc map`."""
    with tempfile.TemporaryDirectory() as out:
        code, error = quietly(["map", *log, "--reference", str(own.cases / "truth.tum"), "--out", out])
        metrics = Path(out) / "metrics.json"
        return outcome(metrics) if metrics.is_file() else f"exit code {code}: {error}"


def outcome(metrics: Path) -> str:
    """Error, verdict and warnings of a run."""
    values = json.loads(metrics.read_text())
    codes = [warning["code"] for warning in values["warnings"]]
    return (
        f"{100 * values['ape']['trans_part']['rmse']:.2f} cm, {values['verdict']}; {', '.join(codes) or 'no warning'}"
    )


def compared(own: Cases, files: list[str]) -> str:
    """The outcome of `hsloc eval` of an estimate against a file of poses."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = hsloc(["eval", files[0], str(own.cases / "V01-trajectory-files/est.tum"), "--json"])
    said = " ".join(err.getvalue().replace(str(own.folder), "").replace(str(own.cases), "").split())
    if code:
        return f"exit code {code}: {said}"
    (found,) = json.loads(out.getvalue())["estimates"]
    return f"{100 * found['ape']['trans_part']['rmse']:.2f} cm of {found['matched']} pairs; {said or 'no warning'}"


def milliseconds(own: Cases) -> list[str]:
    """Poses with stamps in milliseconds and headings in degrees, as a header says."""
    lines = ["# timestamp_ms x y yaw_deg"]
    for line in (own.cases / "truth.tum").read_text().splitlines():
        if line and not line.startswith("#"):
            t, x, y, _, _, _, z, w = map(float, line.split())
            lines.append(f"{1000 * t:.1f} {x} {y} {degrees(2 * atan2(z, w))}")
    (own.folder / "poses.txt").write_text("\n".join(lines))
    return [str(own.folder / "poses.txt")]


def cut_stamps(own: Cases) -> list[str]:
    """Poses with stamps of three decimals too few: whole tens of seconds."""
    rows = [line.split(maxsplit=1) for line in (own.cases / "truth.tum").read_text().splitlines() if line[:1].isdigit()]
    (own.folder / "tens.tum").write_text("\n".join(f"{float(t) // 10 * 10:.0f} {rest}" for t, rest in rows))
    return [str(own.folder / "tens.tum")]


def quietly(arguments: list[str]) -> tuple[int, str]:
    """Exit code of a command, and the first line of what it says of an error, else of a warning."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = hsloc(arguments)
    lines = [
        line for line in err.getvalue().splitlines() if line.startswith("hsloc: error")
    ] or err.getvalue().splitlines()
    return code, (lines or [""])[0].removeprefix("hsloc: ")


def given(own: Cases, path: str, *flags: str) -> list[str]:
    """A log of the cases."""
    return [str(own.cases / path), *flags]


def rows(own: Cases) -> Iterator[tuple[str, str, Callable[[], str]]]:
    """Case, what is run, and how; logs are made when they are needed."""

    def at(name: str, what: str, make: Callable[[], list[str]], *flags: str) -> tuple[str, str, Callable[[], str]]:
        return name, what, lambda: localised(own, [*make(), *flags])

    for path, *flags in GIVEN:
        run = built if "build" in flags else localised
        flags = [each for each in flags if each != "build"]
        name = path.partition("-")[0]
        yield name, " ".join((path.partition("/")[2], *flags)), partial(run, own, given(own, path, *flags))
    yield "D20", "`run #3.db3`", lambda: localised(own, variants.odd_names(own))
    for yaml in ("abs", "dot"):
        files = ["plain.mcap", "--map", str(own.cases / f"M02-image-path-of-another-machine/{yaml}.yaml")]
        yield "M02", f"{yaml}.yaml", partial(localised, own, given(own, *files))
    for case, file in POSES:
        yield case, file, partial(compared, own, given(own, file))
    for case, make, *flags in MADE:
        yield at(f"{case}, own", " ".join((make.__doc__ or "").split()), partial(make, own), *flags)
    odometry_nan = partial(variants.quaternions, own, "nan", lambda half: nan, lambda half: nan)
    yield at("O08, own", "Orientations of NaN.", odometry_nan)
    doubled = partial(variants.quaternions, own, "doubled", lambda half: 2 * sin(half), lambda half: 2 * cos(half))
    yield at("O08, own", "Quaternions of length 2.", doubled)
    apart = partial(variants.late, own, "apart", "/scan", 30.0)
    yield at("O12b, own", "Clocks 30 s apart.", apart)
    yield at("O12b, own", "The same.", apart, "--time-offset", "auto")
    step = partial(variants.late, own, "step", "/scan", 3.0, 12.0)
    yield at("O12b, own", "The clock of the lidar is set forward by 3 s at 12 s.", step)
    yield at("O12b, own", "The same.", step, "--stamps", "log")
    early = partial(variants.late, own, "early", "/scan", -0.12)
    yield at("O13, own", "Scans stamped 0.12 s early.", early)
    for name, what, change, fix in FIELDS:
        scans = partial(edited, own, name, change)
        yield at(f"{name}, own", what, scans)
        yield at(f"{name}, own", f"The same, {fix}.", scans, *fix.split())
    for case, poses in (("V01", milliseconds), ("V02", cut_stamps)):
        yield f"{case}, own", poses.__doc__ or "", partial(compared_made, own, poses)


def edited(own: Cases, name: str, change: Callable[[Any], None]) -> list[str]:
    """A log whose scans were changed; beams that were measured one after the other are in the case of S05."""
    source = own.cases / "S05-scan-time-thousandth/scan.mcap" if name == "S05" else None
    return [str(own.scans(f"{name}.mcap", change, source))]


def compared_made(own: Cases, make: Callable[[Cases], list[str]]) -> str:
    """The outcome of `hsloc eval` with a file that is made."""
    return compared(own, make(own))


def no_range_max(scan: Any) -> None:
    """A limit that was never filled."""
    scan.range_max = 0.0


def longer_beams(scan: Any) -> None:
    """Times between beams in microseconds, as milliseconds."""
    scan.time_increment = 1000.0 * 0.1 / 360
    scan.scan_time = 0.1


def doubled_increment(scan: Any) -> None:
    """A step twice as large as angle_max allows."""
    scan.angle_increment *= 2.0


GIVEN = (
    ("D01-db3-with-wal/copied/run_0.db3",),
    ("D02-message-compression/bag-mcap/bag-mcap.mcap",),
    ("D06-file-compression-by-hand/run.mcap.gz",),
    ("D07-bag-active/RUN.BAG",),
    ("D07-bag-active/noext",),
    ("D10-rollover-log-times/rollover.mcap",),
    ("D13-schema-holds-only-the-type-name/name-only.mcap",),
    ("D16-json-ros-messages/json.mcap",),
    ("D18-cdr-headers/xcdr2.mcap",),
    ("F01-namespaced-tf/robot1.mcap",),
    ("F01-namespaced-tf/robot1-tf-only.mcap", "--odom-topic", "/robot1/tf"),
    ("F04-static-odom-base/static.mcap",),
    ("F04-static-odom-base/static.mcap", "build"),
    ("F12-two-statics-for-one-laser/two-statics.mcap",),
    ("G01-local-costmap-only/local.mcap", "build"),
    ("G05-initialpose-in-odom-frame/ip.mcap", "--no-start"),
    ("O08-zero-quaternions-first/odom-all.mcap",),
    ("O12b-clocks-seconds-apart/rplidar0.4s.mcap",),
    ("O12b-clocks-seconds-apart/rplidar3.2s.mcap",),
    ("O12b-clocks-seconds-apart/rplidar3.2s.mcap", "--stamps", "log"),
    ("O13-stamp-at-end-of-scan/late.mcap",),
    ("P01-point-clouds-only/cloud.mcap",),
    ("P01-point-clouds-only/cloud.mcap", "--slice", "-0.1,0.5"),
    ("S02-ranges-beyond-range-max/scan-2.0.mcap",),
    ("S02-ranges-beyond-range-max/scan-2.0.mcap", "--scan-fix", "range_max=12"),
    ("S05-scan-time-thousandth/scan.mcap", "--deskew"),
    ("S06-thirty-degree-segments/segments-30deg.mcap",),
    ("S09-multi-echo/echoes-only.mcap",),
    ("S09-multi-echo/echoes-only.mcap", "build"),
    ("S16-increment-against-angle-max/degrees.mcap",),
    ("S16-increment-against-angle-max/degrees.mcap", "--scan-fix", "angles=degrees"),
    ("S16-increment-against-angle-max/mirrored.mcap",),
    ("S16-increment-against-angle-max/mirrored.mcap", "--scan-fix", "increment=negate"),
)
POSES = (
    ("V01", "V01-trajectory-files/euroc.csv"),
    ("V01", "V01-trajectory-files/us.txt"),
    ("V01", "V01-trajectory-files/wxyz-comment.txt"),
    ("V02", "V02-stamps-cut-to-seconds/cut.tum"),
    ("V02", "V02-stamps-cut-to-seconds/e9.tum"),
)
MADE: tuple[tuple[Any, ...], ...] = (
    ("D01", variants.packed_wal),
    ("D02", variants.one_message_file),
    ("D06", variants.packed_folder),
    ("D07", variants.damaged_bag),
    ("D10", variants.bad_log_times),
    ("D13", variants.definition_without_parts),
    ("D16", variants.ros1_json),
    ("D18", variants.parameter_list),
    ("F01", variants.prefixed),
    ("F04", variants.frozen),
    ("F12", variants.two_parents),
    ("G01", variants.rolling_map),
    ("G05", variants.start_on_base, "--no-start"),
    ("M02", variants.windows_path),
    ("P01", variants.big_endian_cloud),
    ("S06", variants.quarters),
    ("S09", variants.three_echoes),
)
FIELDS = (
    ("S02", "range_max is 0.", no_range_max, "--scan-fix range_max=12"),
    ("S05", "time_increment is 1,000 times too large.", longer_beams, "--deskew"),
    ("S16", "The increment is twice too large.", doubled_increment, "--scan-fix increment=angles"),
)


def main() -> None:
    """Print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=Path, required=True)
    parser.add_argument("--only", default="", help="the beginning of a case's name")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for name, what, run in rows(Cases(arguments.cases, Path(folder))):
            if not name.startswith(arguments.only):
                continue
            print(f"| {name} | {what} | {run()} |", flush=True)


if __name__ == "__main__":
    main()
