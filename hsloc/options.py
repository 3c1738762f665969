"""The options of a run, each described once.

The command lines of replay, map, sweep and submit, the HTTP schema of a job, `GET /v1/options`, the page's form and the
line "run it again with" are made from `OPTIONS`. A new option is an entry here, a field of `RunRequest` (or of
`ReadOptions`) with the same name, and the code that uses it.

Only the standard library is imported: `hsloc --help` and the server, which needs none of the algorithms, read this.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

Kind = Literal["choice", "number", "whole", "pose", "switch", "text", "topics", "path", "settings"]
"""Type of an option: one of its choices, a float, an integer of 0 or more, x,y,yaw, yes or no, a text, texts (several
or with commas), a file or folder, or KEY=VALUE (repeatable)."""
Place = Literal["run", "read", "config", "check"]
"""What an option belongs to: the request itself, its `read`, its `config`, or the limits that a result must keep."""
Interface = Literal["replay", "map", "sweep", "submit", "http"]
"""What offers an option."""

COMMANDS: frozenset[Interface] = frozenset({"replay", "map", "sweep", "submit"})
EVERYWHERE: frozenset[Interface] = COMMANDS | {"http"}
ONE_RUN: frozenset[Interface] = EVERYWHERE - {"sweep"}

MODES = ("auto", "localise", "slam")
MATCHERS = ("hide", "harmony_search", "icp", "exact")
MATCHER_ALIASES = {"hs": "harmony_search"}
MAPPERS = ("graph", "point")
PRESETS = ("default", "paper", "paper-literal")
ALIGNMENTS = ("none", "origin", "se2")
STAMPS = ("header", "log")
AUTO = "auto"
"""Value of `time_offset` that has it estimated."""
VERDICTS = ("check", "failed")


@dataclass(frozen=True, slots=True, kw_only=True)
class Option:
    """One option of a run.

    `name` is that of the field and of the HTTP request, `flag` that of the command line. `help` is a sentence with the
    unit; `http` is the help where HTTP takes something else. `default` None means that the run finds out, or does
    without. `field` is the name in the dataclass where it is another one. Options with the same `instead_of` exclude
    each other. `varied` options may be given several times to a sweep, which then does all combinations. `least` and
    `most` bound a number.
    """

    name: str
    flag: str
    kind: Kind
    help: str
    place: Place = "run"
    group: str = ""
    interfaces: frozenset[Interface] = EVERYWHERE
    default: Any = None
    metavar: str | None = None
    choices: tuple[str, ...] = ()
    field: str = ""
    http: str = ""
    instead_of: str = ""
    varied: bool = False
    least: float | None = None
    most: float | None = None

    @property
    def target(self) -> str:
        """Name of the field of `RunRequest` or `ReadOptions`."""
        return self.field or self.name

    @property
    def is_map(self) -> bool:
        """Whether HTTP takes the ids of two uploaded files, the YAML and the image of a map."""
        return self.name in ("map", "align_to")

    @property
    def is_upload(self) -> bool:
        """Whether HTTP takes the id of one uploaded file."""
        return "http" in self.interfaces and self.name in ("relations", "reference", "calibration")


_READING, _ALGORITHMS, _LIMITS = "reading the log", "algorithms", "limits for unattended use (exit code 4)"

OPTIONS: tuple[Option, ...] = (
    Option(
        name="mode", flag="--mode", kind="choice", choices=MODES, default="auto",
        help="Localise on a map, or build one (slam); auto localises if there is a map (default: auto).",
    ),
    Option(
        name="map", flag="--map", kind="path", metavar="MAP", field="map_path",
        help="Map to localise on: a YAML of nav2, or the folder or map.npz of a mapping run (default: the log's).",
        http="Ids of the two uploaded files of a map to localise on, its YAML and its image (default: the log's).",
    ),
    Option(
        name="resume", flag="--resume", kind="path", metavar="MAP", interfaces=ONE_RUN,
        help="Earlier mapping run whose map is extended: its folder or map.npz; with submit the id of its job.",
        http="Id of a job of yours that built a map, which is extended: the new one is in its frame. With mode "
        "localise the robot is localised on it.",
    ),
    Option(
        name="align_to", flag="--align-to", kind="path", metavar="PLAN",
        help="Floor plan, or another map, whose frame a built map is brought into: a YAML of nav2 with its image, or "
        "what --map takes. Its place is searched for on the whole plan.",
        http="Ids of the two uploaded files of a floor plan, or of another map, its YAML and its image: a map that the "
        "graph mapper builds is brought into its frame.",
    ),
    Option(
        name="assert_loop", flag="--assert-loop", kind="topics", metavar="T1,T2", interfaces=ONE_RUN,
        help="When mapping: the robot was at one place at these two times [s after the beginning of the log] "
        "(repeatable).",
        http="Times of one place when mapping, `t1,t2` in seconds after the beginning of the log; several with commas.",
    ),
    Option(
        name="forbid_loop", flag="--forbid-loop", kind="topics", metavar="T1,T2", interfaces=ONE_RUN,
        help="When mapping: the robot was at two places at these two times, however alike they look (repeatable).",
        http="Times of two places that look alike, `t1,t2` in seconds after the beginning of the log; several with "
        "commas.",
    ),
    Option(
        name="no_odometry", flag="--no-odom", kind="switch", default=False,
        help="Estimate motion from the scans alone, without reading the log's odometry; localise with --map or "
        "--mode localise, else build a map.",
    ),
    Option(
        name="initial_pose", flag="--initial-pose", kind="pose", instead_of="start",
        help="Pose of the robot at the first event, in the map frame: x, y [m], yaw [rad] (default: from the log).",
    ),
    Option(
        name="unknown_start", flag="--unknown-start", kind="switch", default=False, instead_of="start",
        help="Search the whole map for the start, even if the log states one.",
    ),
    Option(
        name="alignment", flag="--alignment", kind="choice", choices=ALIGNMENTS,
        help="Move the trajectory onto the reference before errors are computed (default: none on a given map, "
        "se2 on a built one).",
    ),
    Option(
        name="reference", flag="--reference", kind="text", metavar="POSES",
        help="Poses to compare with: a TUM or CSV file, LOG, LOG:TOPIC, TOPIC or /tf:map.base_link (default: "
        "reference poses in the log).",
        http="Id of an uploaded file with poses to compare with: TUM, CSV, or a log.",
    ),
    Option(
        name="relations", flag="--relations", kind="path", metavar="FILE",
        help="File of relative poses to evaluate against, one `t1 t2 x y z roll pitch yaw` a line.",
        http="Id of an uploaded file of relative poses to evaluate against: `t1 t2 x y z roll pitch yaw`.",
    ),
    Option(
        name="scan_topic", flag="--scan-topic", kind="topics", metavar="TOPIC", place="read", group=_READING,
        help="Topic of the laser scans; several, or with commas, are merged (default: the only one).",
    ),
    Option(
        name="odom_topic", flag="--odom-topic", kind="text", metavar="TOPIC", place="read", group=_READING,
        help="Topic of the odometry (default: the only one).",
    ),
    Option(
        name="wheels", flag="--wheels", kind="text", metavar="RADIUS,TRACK", place="read", group=_READING,
        help="Make odometry of joint states: radius of the wheels and distance between them [m].",
    ),
    Option(
        name="truth_topic", flag="--truth-topic", kind="text", metavar="TOPIC", place="read", group=_READING,
        help="Topic of reference poses in the log, or tf for map -> base in /tf.",
    ),
    Option(
        name="base_frame", flag="--base-frame", kind="text", metavar="FRAME", place="read", group=_READING,
        help="Frame of the robot's base (default: the child frame of the odometry).",
    ),
    Option(
        name="laser_pose", flag="--laser-pose", kind="pose", place="read", group=_READING,
        help="Pose of the laser in the base frame, instead of the log's: x, y [m], yaw [rad].",
    ),
    Option(
        name="calibration", flag="--calibration", kind="path", metavar="FILE", group=_READING,
        help="Calibration that corrects odometry, mounting and stamps: a YAML file of `hsloc calibrate`.",
        http="Id of an uploaded calibration, a YAML file of `hsloc calibrate`.",
    ),
    Option(
        name="deskew", flag="--deskew", kind="switch", default=False, place="read", group=_READING,
        help="Move each beam to where the robot was when it was measured.",
    ),
    Option(
        name="scan_fix", flag="--scan-fix", kind="topics", metavar="FIELD=VALUE", place="read", group=_READING,
        help="Override a field of the scans: increment=RAD, increment=angles or negate, angles=degrees or negate, "
        "time_increment=S, interval or reverse, range_min=M, range_max=M, ranges=millimetres or centimetres, "
        "echo=strongest; several, or with commas.",
    ),
    Option(
        name="slice", flag="--slice", kind="text", metavar="LOW,HIGH", place="read", group=_READING,
        help="Read point clouds as scans: the nearest point of each direction between two heights above the base [m].",
    ),
    Option(
        name="time_offset", flag="--time-offset", kind="topics", metavar="TOPIC=S", place="read", group=_READING,
        help="Add seconds to the stamps of a topic [s]; several, or with commas; auto estimates them from the data.",
    ),
    Option(
        name="stamps", flag="--stamps", kind="choice", choices=STAMPS, default="header", place="read", group=_READING,
        help="Take times from the messages' headers, or from when the log received them (default: header).",
    ),
    Option(
        name="start_s", flag="--start", kind="number", metavar="S", place="read", group=_READING,
        help="Begin this many seconds into the log [s].",
    ),
    Option(
        name="end_s", flag="--end", kind="number", metavar="S", place="read", group=_READING, instead_of="end",
        help="End this many seconds into the log [s].",
    ),
    Option(
        name="duration_s", flag="--duration", kind="number", metavar="S", place="read", group=_READING,
        interfaces=COMMANDS, instead_of="end",
        help="End this many seconds after --start [s].",
    ),
    Option(
        name="preset", flag="--preset", kind="choice", choices=PRESETS, default="default", group=_ALGORITHMS,
        varied=True, help="Set of parameters to begin with (default: default).",
    ),
    Option(
        name="config", flag="--config", kind="path", metavar="FILE", place="config", group=_ALGORITHMS, varied=True,
        help="Parameters on top of the preset: a YAML file, also of a ROS 2 node.",
        http="Parameters on top of the preset; see /v1/options for their schema.",
    ),
    Option(
        name="matcher", flag="--matcher", kind="choice", choices=(*MATCHERS, *MATCHER_ALIASES), place="config",
        group=_ALGORITHMS, varied=True,
        help="Scan matcher; hs is short for harmony_search (default: hide).",
    ),
    Option(
        name="certify", flag="--certify", kind="switch", default=False, place="config", group=_ALGORITHMS,
        help="Prove of each match on a map that no pose of its window is fitter: localiser.certify.",
    ),
    Option(
        name="mapper", flag="--mapper", kind="choice", choices=MAPPERS, place="config", group=_ALGORITHMS, varied=True,
        help="SLAM with loop closure (graph), or the point map of the course report (point) (default: graph).",
    ),
    Option(
        name="set", flag="--set", kind="settings", metavar="KEY=VALUE", place="config", group=_ALGORITHMS,
        interfaces=COMMANDS,
        help="Set one parameter, such as hide.budget=400; matcher.budget is that of the chosen matcher; repeatable.",
    ),
    Option(
        name="seed", flag="--seed", kind="whole", default=0, metavar="N", group=_ALGORITHMS, interfaces=ONE_RUN,
        most=2**53 - 1, help="Seed of all random numbers, a whole number up to 2^53 - 1 (default: 0).",
    ),
    Option(
        name="min_localised", flag="--min-localised", kind="number", metavar="SHARE", place="check", group=_LIMITS,
        least=0.0, most=1.0, help="Fail if a smaller share of the poses is localised [0 to 1].",
    ),
    Option(
        name="max_ape", flag="--max-ape", kind="number", metavar="M", place="check", group=_LIMITS, least=0.0,
        help="Fail if the RMSE of the absolute position error is larger, or cannot be computed [m].",
    ),
    Option(
        name="max_warnings", flag="--max-warnings", kind="whole", metavar="N", place="check", group=_LIMITS,
        help="Fail if the run has more warnings.",
    ),
    Option(
        name="fail_if", flag="--fail-if", kind="choice", choices=VERDICTS, place="check", group=_LIMITS,
        help="Fail if the verdict is `failed`, or with check also if it is `check`.",
    ),
)  # fmt: skip
"""In the order in which they are listed and written."""
BY_NAME: dict[str, Option] = {option.name: option for option in OPTIONS}


def offered(interface: Interface) -> Iterator[Option]:
    """The options that an interface offers."""
    return (option for option in OPTIONS if interface in option.interfaces)


def describe() -> list[dict[str, Any]]:
    """The options that HTTP offers as plain data, for a form."""
    return [
        {
            "name": option.name if option.place != "read" else f"read.{option.name}",
            "kind": option.kind,
            "group": option.group,
            "help": option.http or option.help,
            "choices": list(option.choices),
            "default": option.default,
        }
        for option in offered("http")
    ]


def written(option: Option, value: Any) -> list[str]:
    """The words of a command line that give an option this value; none for its default."""
    if value is None or value == option.default:
        return []
    if option.kind == "switch":
        return [option.flag]
    if option.kind == "pose":
        value = ",".join(repr(float(number)) for number in value)
    values = value if option.kind == "settings" else [value]
    return [f"{option.flag}={each}" for each in values]


def merged(values: Mapping[str, Any]) -> dict[str, Any]:
    """The same without `duration_s`, which becomes `end_s`."""
    found = dict(values)
    duration = found.pop("duration_s", None)
    if duration is not None:
        found["end_s"] = (found.get("start_s") or 0.0) + duration
    return found
