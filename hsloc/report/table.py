"""The figures of a run: each has one name, value, unit and explanation, wherever it is shown."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import degrees, isfinite
from typing import TYPE_CHECKING, Any

import numpy as np

from hsloc.model import Status

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from hsloc.evaluation import PoseStatistics, Statistics
    from hsloc.model.verdict import VerdictReason
    from hsloc.run_metrics import MapMetrics, PlanMetrics, RunMetrics, ScanCounts

DASH = "–"
LENGTHS = ((0.00095, 1e3, "mm"), (0.9995, 1e2, "cm"), (1e3, 1.0, "m"), (np.inf, 1e-3, "km"))
"""Units of lengths: below which number of metres each is used, how many of it are a metre, its name."""
STATUS_WORDS: dict[str, str] = {
    Status.MATCHED: "matched",
    Status.RELOCALISED: "pose found by search",
    Status.PREDICTED: "skipped (robot had hardly moved)",
    Status.REJECTED: "rejected",
    Status.NO_RETURNS: "without returns",
    Status.SEARCHING: "during the pose search",
}
"""What a scan's status is called."""
MARK_WORDS: dict[str, str] = {
    Status.NO_RETURNS: "scan without returns",
    Status.REJECTED: "scan rejected",
    Status.RELOCALISED: "pose found by search",
}
"""What a scan that is marked on the map is called."""
_LISTED = 3
"""Times and places of a reason that are listed in words."""


@dataclass(frozen=True, slots=True)
class Row:
    """A figure under its name: one value, or two (translation and rotation)."""

    label: str
    values: tuple[str, ...]
    explanation: str = ""
    """What the figure is and what is usual, in a sentence or two."""
    sources: tuple[str, ...] = ()
    """Where metrics.json holds the numbers, as JSON pointers without the first slash: `ape/trans_part/rmse`."""
    numbers: tuple[float | None, ...] = ()
    """These numbers, in the units of metrics.json."""
    usual: str = ""
    """What is usual, in a few words to stand beside the value; empty where that depends on the run."""


def table_rows(metrics: RunMetrics) -> list[Row]:
    """The most important figures: those with two columns first, then those with one."""
    values = metrics.to_json()
    return [_with_numbers(row, values) for row in (*_error_rows(metrics), *_single_rows(metrics))]


def _with_numbers(row: Row, values: Mapping[str, Any]) -> Row:
    numbers = []
    for source in row.sources:
        found: Any = values
        for key in source.split("/"):
            found = found[key]
        numbers.append(found)
    return replace(row, numbers=tuple(numbers))


def format_length(metres: float | None) -> str:
    """Three figures, in the unit that suits: 0.4 mm, 1.23 cm, 12.3 m, 1.23 km."""
    if metres is None or not isfinite(metres):
        return DASH
    if metres == 0.0:
        return "0 m"
    for limit, factor, unit in LENGTHS:
        if abs(metres) < limit:
            return f"{_three_figures(metres * factor)} {unit}"
    return DASH


def format_angle(angle: float | None) -> str:
    """Three figures and the sign of degrees."""
    return DASH if angle is None or not isfinite(angle) else f"{_three_figures(angle)}°"


def format_share(share: float) -> str:
    """A part from 0 to 1 in per cent; what is less than all is never rounded to 100 %."""
    text = f"{100.0 * share:.1f}"
    return "> 99.9 %" if share < 1.0 and text == "100.0" else f"{text} %"


def format_probability(probability: float) -> str:
    """In whole per cent; what is small is never rounded to 0 %."""
    return "< 1 %" if probability < 0.01 else f"{100.0 * probability:.0f} %"


def format_duration(seconds: float) -> str:
    """12.3 s, 4 min 05 s, 2 h 03 min."""
    if seconds < 60.0:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def _three_figures(value: float) -> str:
    size = abs(value)
    decimals = 2 if size < 9.995 else 1 if size < 99.95 else 0
    return f"{value:.{decimals}f}"


def reason_texts(reasons: Sequence[VerdictReason]) -> list[str]:
    """The texts of the reasons; a remedy that several in a row share is given with the last of them alone."""
    after = (*(reason.remedy for reason in reasons[1:]), "")
    return [
        reason_text(reason if reason.remedy != following else replace(reason, remedy=""))
        for reason, following in zip(reasons, after, strict=False)
    ]


def reason_text(reason: VerdictReason) -> str:
    """What was found, when (in seconds since the first pose) and where (in the map frame), and what to do about it."""
    times = [f"{begin:.1f} to {end:.1f} s" for begin, end in reason.times[:_LISTED]]
    # z: no minus before a zero.
    places = [f"({x:z.1f}, {y:z.1f}) m" for x, y in reason.places[:_LISTED]]
    text = reason.text
    for words, listed, count in (("from", times, len(reason.times)), ("near", places, len(reason.places))):
        if listed:
            text += f", {words} {', '.join(listed)}" + (f" and {count - _LISTED} more" if count > _LISTED else "")
    return f"{text}; {reason.remedy}" if reason.remedy else text


def error_statistics(metrics: RunMetrics) -> list[tuple[str, str, Statistics]]:
    """(label, unit, statistics) of all errors that were measured, translation and rotation each."""
    found: list[tuple[str, PoseStatistics]] = []
    for label, errors in (
        ("", metrics.errors),
        (" where localised", metrics.localised_only),
        (" of odometry alone", metrics.odometry_alone),
    ):
        if errors is not None:
            found.append((f"APE{label}", errors.ape))
            found += [
                (f"RPE per {each.delta}{label}", each.statistics) for each in (errors.rpe, errors.rpe_1m, errors.rpe_1s)
            ]
    if metrics.relations is not None:
        found.append(("relations", metrics.relations.statistics))
    return [
        (f"{label}, {kind}", unit, values)
        for label, pose in found
        for kind, unit, values in (("translation", "m", pose.trans_part), ("rotation", "deg", pose.angle_deg))
    ]


def _error_rows(metrics: RunMetrics) -> list[Row]:
    rows = []

    def add(label: str, errors: PoseStatistics, where: str, explanation: str, name: str = "rmse") -> None:
        values = getattr(errors.trans_part, name), getattr(errors.angle_deg, name)
        if any(isfinite(value) for value in values):
            sources = (f"{where}/trans_part/{name}", f"{where}/angle_deg/{name}")
            rows.append(Row(label, (format_length(values[0]), format_angle(values[1])), explanation, sources))

    errors = metrics.errors
    if errors is not None:
        only = metrics.localised_only
        if only is not None:
            add("APE rmse where localised", only.ape, "localised_only/ape", _APE_LOCALISED)
        add("APE rmse", errors.ape, "ape", _APE if only is None else f"{_APE} {_APE_WITH_GUESSES}")
        add(
            "APE max", errors.ape, "ape", "Largest distance and angle between an estimated and a reference pose.", "max"
        )
        if metrics.odometry_alone is not None:
            add("APE rmse of odometry", metrics.odometry_alone.ape, "odometry_alone/ape", _APE_ODOMETRY)
        # A path that is shorter than a metre still has pieces of a second, or from frame to frame.
        each = (("rpe_1m", errors.rpe_1m), ("rpe_1s", errors.rpe_1s), ("rpe", errors.rpe))
        known = [(key, relative) for key, relative in each if relative.statistics.trans_part.count]
        for key, relative in known[:1]:
            add(f"RPE rmse per {relative.delta}", relative.statistics, key, _RPE)
    if metrics.relations is not None:
        for name in ("mean", "std"):
            add(f"relations, {name}", metrics.relations.statistics, "relations", _RELATIONS, name)
    return rows


_APE = (
    "Absolute pose error: root mean square distance and angle between the estimated and the reference poses at the "
    "same times."
)
_APE_WITH_GUESSES = "It counts the poses that are marked as unknown as well."
_APE_LOCALISED = (
    "Absolute pose error of the poses that the localiser calls known, without those that it marks as guesses. On a map "
    "that fits, usually less than a cell of the map."
)
_APE_ODOMETRY = (
    "The same error of the odometry alone, from the first known pose on: what there would be without scans. It should "
    "be much larger than the APE of the trajectory."
)
_RPE = (
    "Relative pose error: error of the motion over a piece of this length. It shows jumps and local distortion and is "
    "not affected by drift."
)
_RELATIONS = (
    "Error of the relative poses that the file of relations states, in the metric of Kuemmerle et al. (2009). It says "
    "whether a map is right between places that are near to each other."
)


def _single_rows(metrics: RunMetrics) -> list[Row]:
    rows = []
    if metrics.errors is not None:
        axes = metrics.errors.axis_rmse
        values = f"{format_length(axes.x)}, {format_length(axes.y)}, {format_angle(degrees(axes.theta))}"
        explanation = "Root mean square error in x, in y and in heading, in the frame of the reference."
        sources = tuple(f"axis_rmse/{axis}" for axis in ("x", "y", "theta"))
        rows.append(Row("rmse x, y, heading", (values,), explanation, sources))
    share = metrics.localised.share_of_poses
    if metrics.run.mode == "localise":
        rows.append(
            Row("localised", (f"{format_share(share)} of the poses",), _LOCALISED, ("localised/share_of_poses",))
        )
    rows += scan_rows(metrics.scans)
    if metrics.run.mode == "localise" and metrics.fitness.median is not None:
        values = f"{metrics.fitness.median:.3f}"
        rows.append(Row("fitness of the matches, median", (values,), _FITNESS, ("fitness/median",), usual="above 0.8"))
    return [*rows, *_map_rows(metrics.map)]


_LOCALISED = (
    "Part of the poses that are known. The others are guesses: the robot was lost, off the map, or several places fit. "
    "100 % is usual on a map that fits."
)
_FITNESS = (
    "How well the matched scans lie on the map, from 0 to 1: the mean score of the beams, which falls with the "
    "distance to the nearest wall. Above 0.8 is usual on a map that fits; what is not in the map lowers it."
)


def scan_rows(scans: ScanCounts) -> list[Row]:
    """How many scans were matched, and what became of the others: together they are all scans."""
    explanation = "Scans whose match was accepted, of all scans of the log."
    rows = [Row("scans matched", (f"{scans.used} of {scans.total}",), explanation, ("scans/used", "scans/total"))]
    known = [status.value for status in Status]
    names = [name for name in (*known, *sorted(set(scans.by_status) - set(known))) if scans.by_status.get(name)]
    unused = [name for name in names if name not in (Status.MATCHED, Status.RELOCALISED)]
    if unused:
        words = ", ".join(f"{scans.by_status[name]} {STATUS_WORDS.get(name, name)}" for name in unused)
        explanation = (
            "What became of the other scans. Skipped: the robot had hardly moved since the last match, so the scan "
            "was not needed (the motion gate); this is no fault. During the pose search: the pose was not known "
            "yet; once it is found, the poses before are computed backwards from there."
        )
        rows.append(
            Row(
                "scans not matched",
                (words,),
                explanation,
                tuple(f"scans/by_status/{name}" for name in unused if name in known),
            )
        )
    return rows


def _map_rows(found: MapMetrics) -> list[Row]:
    rows, residuals = [], found.residuals
    if residuals.within_15_cm is not None:
        values = format_share(residuals.within_15_cm)
        within = Row("points within 15 cm of a wall", (values,), _NEAR_WALL, ("map/residuals/within_0.15_m",))
        rows.append(replace(within, usual="above 95 %"))
    if residuals.p95 is not None:
        # The distance is that from cell to cell: a point in an occupied cell has no smaller distance.
        near = "less than a cell" if residuals.p95 == 0.0 else format_length(residuals.p95)
        distance = Row("scan to map, 95 % of points", (near,), _SCAN_TO_MAP, ("map/residuals/p95",))
        rows.append(replace(distance, usual="up to 10 cm"))
    if found.changes is not None and (found.changes.appeared or found.changes.vanished):
        values = f"{found.changes.appeared} things appeared, {found.changes.vanished} vanished"
        sources = ("map/changes/appeared", "map/changes/vanished")
        rows.append(Row("changes since the map was made", (values,), _CHANGES, sources))
    mapping = found.mapping
    if mapping is not None:
        loops = f"{mapping.loops} of {mapping.loops + mapping.loops_refused} candidates"
        rows.append(Row("loops closed", (loops,), _LOOPS, ("map/mapping/loops", "map/mapping/loops_refused")))
        explanation = "Scans that the map was made from: one for each part of a metre or of a turn."
        rows.append(Row("keyscans", (str(mapping.keyscans),), explanation, ("map/mapping/keyscans",)))
        if mapping.followed:
            explanation = "Scans that the map so far explained: they were localised on it and added nothing to it."
            rows.append(Row("scans on the known map", (str(mapping.followed),), explanation, ("map/mapping/followed",)))
        if isfinite(mapping.sigma_max):
            values = f"{format_length(mapping.sigma_median)}, {format_length(mapping.sigma_max)}"
            sources = ("map/mapping/sigma_median", "map/mapping/sigma_max")
            rows.append(Row("standard deviation, median, max", (values,), _SIGMA, sources))
        if isfinite(mapping.conflict):
            values = format_share(mapping.conflict)
            conflict = Row("wall points other scans see through", (values,), _CONFLICT, ("map/mapping/conflict",))
            rows.append(replace(conflict, usual="below 5 %"))
    if found.odometry is not None:
        errors = found.odometry
        way = f"{100.0 * errors.translation:+.1f} ± {100.0 * errors.translation_sigma:.1f} % of the way"
        turns = f"{100.0 * errors.rotation:+.1f} ± {100.0 * errors.rotation_sigma:.1f} % of turns"
        sources = ("map/odometry/translation", "map/odometry/rotation")
        rows.append(Row("added to the odometry", (f"{way}, {turns}",), _ODOMETRY_ERRORS, sources))
    if found.crispness is not None and isfinite(found.crispness.wall_thickness_median):
        values = format_length(found.crispness.wall_thickness_median)
        thickness = Row("wall thickness", (values,), _THICKNESS, ("map/crispness/wall_thickness_median",))
        rows.append(replace(thickness, usual="9 to 21 cm, 2 to 4 cells"))
    if found.plan is not None:
        rows += _plan_rows(found.plan)
    compared = found.comparison
    if compared is not None and isfinite(compared.precision):
        values = f"{format_share(compared.precision)}, {format_share(compared.recall)}"
        sources = ("map/comparison/precision", "map/comparison/recall")
        rows.append(Row("map precision, recall", (values,), _PRECISION, sources))
    return rows


def _plan_rows(plan: PlanMetrics) -> list[Row]:
    place, fitness = "nowhere", f"at most {plan.elsewhere:.2f}"
    if plan.pose is not None:
        x, y, yaw = plan.pose
        place = f"x {format_length(x)}, y {format_length(y)}, {format_angle(degrees(yaw))}"
        place = place if plan.certain else f"not certain; it fits best at {place}"
        fitness = f"{plan.fitness:.2f}, elsewhere {fitness}"
    sources = ("map/plan/fitness", "map/plan/elsewhere")
    rows = [
        Row("place on the floor plan", (place,), _PLACE),
        Row("fitness on the floor plan", (fitness,), _FIT, sources),
    ]
    if plan.walls_near is not None:
        values = f"{format_share(plan.walls_near)}, {format_length(plan.mean_distance)}"
        sources = ("map/plan/walls_near", "map/plan/mean_distance")
        rows.append(Row("walls within 15 cm of the plan, mean distance", (values,), _PLAN, sources))
    return rows


_PLACE = (
    "Where the robot's first pose is on the floor plan. Where that is certain, the map and the trajectory are in the "
    "plan's frame; else in their own."
)
_FIT = (
    "How well the map's walls lie on the plan there, from 0 to 1, and what is proven for all other places. Furniture "
    "and walls that the plan does not show lower it."
)
_PLAN = (
    "Part of the map's walls within 15 cm of a wall of the floor plan, and their mean distance. Furniture, and what "
    "was built since the plan was drawn, lower the one and raise the other."
)
_NEAR_WALL = (
    "Part of the scan points that lie within 15 cm of a wall of the map. Above 95 % is usual for a map that fits; "
    "people and furniture that are not in the map lower it."
)
_SCAN_TO_MAP = (
    "Distance to the nearest occupied cell of the map that 95 of 100 scan points stay below. One or two cells are "
    "usual, up to 10 cm on most maps."
)
_CHANGES = (
    "Things of 0.3 m and more that stand where the map is free, and things or pieces of wall of the map that are gone, "
    "by scans whose pose is known. changes.csv lists them with places and times."
)
_LOOPS = (
    "Places that were recognised when the robot came back, of all that were compared. A map without a loop keeps the "
    "drift of the odometry; refused candidates are usual."
)
_SIGMA = (
    "How well the positions of the scans are known relative to the first one, by the walls, steps and loops that hold "
    "them; wrong stamps and moved walls are not in it. covariances.csv has it for each pose."
)
_ODOMETRY_ERRORS = (
    "Parts of each translation and rotation by which the odometry was corrected, as the scans show: the size of the "
    "wheels and their distance."
)
_CONFLICT = (
    "Part of the points of the map's walls where another scan has a beam that goes through to something behind. "
    "Below 5 % is usual; more means that walls are doubled, or that things moved."
)
_THICKNESS = (
    "Median thickness of what is occupied in the built map. Right maps have 9 to 21 cm, 2 to 4 cells of 5 cm, as "
    "furniture and both faces of a wall count. More, or more than in another run of the same log, means that visits to "
    "a place do not lie on each other, or that the lidar is noisy. The verdict does not rest on it."
)
_PRECISION = (
    "Precision: part of the built walls that are in the true map. Recall: part of the seen walls of the true map that "
    "were built."
)
