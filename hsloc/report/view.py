"""What report.html and the web page draw of a run: map, paths, scans, loops, events and curves, as one JSON value.

hsloc/report/viewer/view.js draws it. Lengths are in metres and times in seconds since the first pose; columns have a
bounded length, however long the run was.
"""

from __future__ import annotations

import hashlib
from base64 import b64encode
from dataclasses import replace
from io import BytesIO
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from PIL import Image

from hsloc.model import Status
from hsloc.report import rounding
from hsloc.report.changes import change_marks
from hsloc.report.charts import convergence_charts, run_charts
from hsloc.report.data import peak_rows, prepare, since, status_counts
from hsloc.report.map_image import grey_levels, picture_of, shown_extent
from hsloc.report.summary import ResultSummary
from hsloc.report.table import MARK_WORDS, STATUS_WORDS, format_probability

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.analysis.scan_statistics import Coverage
    from hsloc.model import OccupancyGrid
    from hsloc.report.charts import Chart
    from hsloc.report.data import Errors, Provenance, ReportData, ReportParts, Scans
    from hsloc.run_metrics import RunMetrics
    from hsloc.slam.pose_graph import PoseGraph
    from hsloc.slam.result import MappingResult

    Floats = NDArray[np.float64]
    Rows = NDArray[np.intp]

MOST_POSES = 6000
"""Poses of the trajectory that are drawn, about; of other paths half as many."""
MOST_POINTS = 1500
"""Points of a curve, about; no peak is left out."""
MOST_MARKS = 1000
"""Scans of one status that are marked."""
MOST_ELLIPSES = 300
MOST_EDGES = 4000
"""Edges of the pose graph that are drawn."""
MOST_PIXELS = 4000
"""Longest side of the map's picture."""
_LEVELS = 16
"""Steps of a count for each doubling."""
_CM = 100.0
_MOST_CM = 32767
"""Largest coordinate of a scan's point: 327 m."""


class ReportView(NamedTuple):
    """The value for view.js, in which `map` lacks its picture, and this picture as PNG; None where nothing is known."""

    values: dict[str, Any]
    map_png: bytes | None

    def with_picture(self, address: str) -> dict[str, Any]:
        """The value with the address of the map's picture, where there is one."""
        return {**self.values, "map": {**self.values["map"], "image": address}} if self.map_png else self.values


def view_of(parts: ReportParts, data: ReportData | None = None) -> ReportView:
    """What the reports draw of a run; `data` is what `prepare(parts)` gave, where it is known already."""
    data = prepare(parts) if data is None else data
    frame, png = _map(parts.grid)
    extent = shown_extent(data, parts.grid, parts.points)
    summary = None if parts.metrics is None else ResultSummary.of(parts.metrics)
    scans, ambiguities = data.scans, _ambiguities(data)
    loops = None if parts.mapping is None else _loops(parts.mapping, data.start_ns)
    values = {
        "title": parts.title,
        "summary": None if summary is None else summary.to_json(),
        "run": None if parts.metrics is None else _run(parts.metrics, parts.provenance),
        "map": frame,
        "extent": [rounding.rounded(value) for value in (extent.x0, extent.y0, extent.x1, extent.y1)],
        "end": rounding.rounded(_end(data)),
        "trajectory": _trajectory(parts, data),
        "odometry": _path(data.odometry, None),
        "reference": _path(data.reference, data.reference_jumps),
        "points": None if parts.points is None else rounding.columns(x=parts.points[:, 0], y=parts.points[:, 1]),
        "lost": [[rounding.rounded(begin), rounding.rounded(end)] for begin, end in data.lost],
        "scans": _scans(parts, data),
        "coverage": None if parts.coverage is None else _coverage(parts.coverage),
        "marks": [
            *([] if scans is None else _marks(scans)),
            *change_marks(parts.map_changes, data.start_ns, MOST_MARKS),
            *_places_to_check(parts.metrics),
        ],
        "loops": loops,
        "graph": None if parts.mapping is None else graph_view(parts.mapping.graph),
        "ellipses": _ellipses(parts, data.start_ns),
        "ambiguities": ambiguities,
        "events": _events(parts, data, loops, ambiguities),
        "status": [] if scans is None else _status_rows(scans),
        "charts": [_chart(chart) for chart in (*run_charts(data), *convergence_charts(parts.convergence))],
    }
    return ReportView(values, png)


def _run(metrics: RunMetrics, provenance: Provenance) -> dict[str, Any]:
    """The seed of the run, and a hash of all else that decides its result: log, options and configuration."""
    identity = (replace(metrics.run, seed=0), dict(provenance.options), provenance.config)
    return {"seed": metrics.run.seed, "group": hashlib.sha256(repr(identity).encode()).hexdigest()[:16]}


def _end(data: ReportData) -> float:
    return max(data.duration_s, 0.0 if data.scans is None else float(data.scans.seconds.max(initial=0.0)))


def data_url(png: bytes) -> str:
    """A picture as text, for a page that loads nothing."""
    return f"data:image/png;base64,{b64encode(png).decode('ascii')}"


def _map(grid: OccupancyGrid | None) -> tuple[dict[str, Any] | None, bytes | None]:
    """Side of a pixel [m], size in pixels, and pose of the lower left corner in the map frame; and the picture."""
    picture = None if grid is None else picture_of(grid, MOST_PIXELS)
    if picture is None:
        return None, None
    corner, (height, width) = picture.T_map_corner, picture.values.shape
    # Grey and clear, the top row first. As places of a palette: two thirds of the bytes, in a third of the time.
    greys = grey_levels()[:, 0]
    clear = len(greys) - 1
    places = np.minimum(picture.values[::-1].astype(np.uint8), clear)  # -1 is 255 then
    image = Image.frombytes("P", (width, height), places.tobytes())
    image.putpalette(np.repeat(greys, 3).tobytes())
    stream = BytesIO()
    image.save(stream, format="PNG", transparency=clear)
    frame = {"side": picture.side, "width": width, "height": height, "corner": [corner.x, corner.y, corner.theta]}
    return frame, stream.getvalue()


def _every(n: int, most: int) -> slice:
    """At most `most` of n rows: every k-th."""
    return slice(None, None, max(-(-n // most), 1))


def _thinned(jumps: NDArray[np.bool_] | None, n: int, most: int) -> Rows:
    """At most about `most` of n rows: every k-th, the ends, and both sides of each jump."""
    rows = np.arange(n)[_every(n, most)]
    extra = np.zeros(0, dtype=np.intp) if jumps is None else np.flatnonzero(jumps)[:most]
    return np.union1d(rows, np.concatenate((extra, extra - 1, [n - 1]))) if n else rows


def _trajectory(parts: ReportParts, data: ReportData) -> dict[str, Any]:
    poses, n = parts.trajectory.poses, len(parts.trajectory)
    order = np.argsort(data.seconds, kind="stable")
    # The path is in the order of the log; its jumps are at rows of that order.
    in_order = (order == np.arange(n)).all()
    rows = _thinned(data.jumps, n, MOST_POSES) if in_order else order[_thinned(None, n, MOST_POSES)]
    states = parts.states or tuple("localised" if known else "lost" for known in data.localised)
    names = list(dict.fromkeys(states))
    codes = {name: code for code, name in enumerate(names)}
    result: dict[str, Any] = rounding.columns(
        t=data.seconds[rows], x=poses[rows, 0], y=poses[rows, 1], theta=poses[rows, 2], decimals=3
    )
    result |= {"states": [str(name) for name in names], "state": [codes[states[row]] for row in rows]}
    result["breaks"] = np.flatnonzero(data.jumps[rows]).tolist()
    if parts.covariances is not None and np.isfinite(parts.covariances).any():
        result["sigma"] = rounding.numbers(np.sqrt(parts.covariances[rows, 0, 0] + parts.covariances[rows, 1, 1]), 4)
    if data.errors is not None:
        result["error"] = rounding.numbers(_at(data.errors, data.seconds[rows]), 4)
    return result


def _at(errors: Errors, seconds: Floats) -> Floats:
    """The error of the pair nearest in time (n,); NaN where there is none within twice the usual distance of pairs."""
    times, values = errors.translation_m.seconds, errors.translation_m.values
    after = np.clip(np.searchsorted(times, seconds), 1, max(len(times) - 1, 1))
    if len(times) < 2:
        return np.full(len(seconds), np.nan)
    nearest = np.where(seconds - times[after - 1] < times[after] - seconds, after - 1, after)
    near = np.abs(times[nearest] - seconds) <= 2.0 * float(np.median(np.diff(times))) + 1e-9
    return np.where(near, values[nearest], np.nan)


def _path(xy: Floats | None, jumps: NDArray[np.bool_] | None) -> dict[str, Any] | None:
    if xy is None or len(xy) < 2:
        return None
    rows = _thinned(jumps, len(xy), MOST_POSES // 2)
    breaks = [] if jumps is None else np.flatnonzero(jumps[rows]).tolist()
    return {**rounding.columns(x=xy[rows, 0], y=xy[rows, 1], decimals=3), "breaks": breaks}


def _scans(parts: ReportParts, data: ReportData) -> dict[str, Any] | None:
    """Scans with points: poses, status, and all points as centimetres in the base frame (int16), distances as bytes."""
    overlay = parts.overlay
    if overlay is None or not len(overlay.rows):
        return None
    rows = overlay.rows[np.argsort(overlay.stamps_ns[overlay.rows], kind="stable")]
    place = {int(row): k for k, row in enumerate(overlay.rows)}
    clouds = [overlay.points[place[int(row)]] for row in rows]
    near = np.concatenate([overlay.distances[place[int(row)]] for row in rows])
    points = np.clip(np.round(np.concatenate(clouds) * _CM), -_MOST_CM, _MOST_CM).astype("<i2")
    bytes_of_distances = np.clip(np.round(near * _CM), 0, 255).astype(np.uint8)
    status: dict[int, tuple[str, str]] = {}
    if parts.diagnostics is not None:
        diagnostics = parts.diagnostics
        stamps = diagnostics.stamps_ns
        # A pose that is known at a scan that was searching became so when the search had ended.
        at = np.searchsorted(data.seconds, since(stamps, data.start_ns))
        later = data.localised[np.minimum(at, len(data.localised) - 1)] if len(data.localised) else at < 0
        found = zip(stamps.tolist(), diagnostics.status, diagnostics.reason, later.tolist(), strict=True)
        for stamp, name, reason, is_known in found:
            after = ", and placed once it had ended" if is_known and name == Status.SEARCHING else ""
            status[stamp] = f"{STATUS_WORDS.get(name, name)}{after}", reason
    words = [status.get(stamp, ("", "")) for stamp in overlay.stamps_ns[rows].tolist()]
    poses = overlay.poses[rows]
    return {
        **rounding.columns(t=since(overlay.stamps_ns[rows], data.start_ns), x=poses[:, 0], y=poses[:, 1], decimals=3),
        **rounding.columns(theta=poses[:, 2], far=overlay.far[rows], decimals=4),
        "count": [len(cloud) for cloud in clouds],
        "status": [f"{name}: {reason}" if reason and reason not in name else name for name, reason in words],
        "points": b64encode(points.tobytes()).decode("ascii"),
        "distances": b64encode(bytes_of_distances.tobytes()).decode("ascii"),
    }


def _coverage(coverage: Coverage) -> dict[str, Any] | None:
    """Side of a cell [m], size in cells, pose of the lower left corner, and 16 log2(1 + scans) as bytes, top row first.

    None where no place was seen. A byte holds 65,000 scans, to 4 %.
    """
    if not coverage.counts.any():
        return None
    levels = np.round(_LEVELS * np.log2(1.0 + coverage.counts[::-1]))
    corner, (height, width) = coverage.T_map_corner, levels.shape
    text = b64encode(np.minimum(levels, 255).astype(np.uint8).tobytes()).decode("ascii")
    frame = {"side": coverage.side, "width": width, "height": height, "corner": [corner.x, corner.y, corner.theta]}
    return {**frame, "levels": text, "most": int(coverage.counts.max())}


def _marks(scans: Scans | None) -> list[dict[str, Any]]:
    """Scans that were refused or without returns, and those at which the pose was found, on the map."""
    found: list[dict[str, Any]] = []
    if scans is None:
        return found
    for status in (Status.NO_RETURNS, Status.REJECTED, Status.RELOCALISED):
        rows = np.flatnonzero(scans.where(status) & np.isfinite(scans.xy).all(axis=1))
        rows = rows[_every(len(rows), MOST_MARKS)]
        marks = rounding.columns(t=scans.seconds[rows], x=scans.xy[rows, 0], y=scans.xy[rows, 1], decimals=3)
        if len(rows):
            reasons = [scans.reason[row] for row in rows]
            found.append({"status": str(status), "label": MARK_WORDS[status], **marks, "reason": reasons})
    return found


def _places_to_check(metrics: RunMetrics | None) -> list[dict[str, Any]]:
    """Where the reasons of the verdict were found."""
    reasons = [] if metrics is None else metrics.verdict_reasons
    found = [(*place, reason.text) for reason in reasons for place in reason.places]
    found = found[_every(len(found), MOST_MARKS)]
    if not found:
        return []
    x, y, texts = zip(*found, strict=True)
    columns = rounding.columns(x=np.array(x), y=np.array(y))
    return [{"status": "to_check", "label": "places to check", "t": [None] * len(x), **columns, "reason": list(texts)}]


def _loops(mapping: MappingResult, start_ns: int) -> dict[str, Any]:
    """Both ends of all loops that were searched for, when the second was seen, and why the others were refused."""
    loops, ends = mapping.loops, mapping.loop_ends()
    first, second = (mapping.keyscan_poses[ends[:, k]] for k in (0, 1))
    seconds = since(mapping.keyscan_stamps_ns[ends[:, 1]], start_ns)
    return {
        **rounding.columns(t=seconds, x0=first[:, 0], y0=first[:, 1], x1=second[:, 0], y1=second[:, 1], decimals=3),
        "accepted": [bool(loop.accepted) for loop in loops],
        "reason": [loop.reason for loop in loops],
    }


def graph_view(graph: PoseGraph) -> dict[str, Any] | None:
    """Nodes and the edges between them; of many edges the longest, which say most, and how many there are."""
    poses, pairs = graph.poses, graph.edges.pairs
    if not len(pairs):
        return None
    length = np.hypot(*(poses[pairs[:, 0], :2] - poses[pairs[:, 1], :2]).T)
    rows = np.sort(np.argsort(-length, kind="stable")[:MOST_EDGES])
    nodes, ends = np.unique(pairs[rows], return_inverse=True)
    columns = rounding.columns(x=poses[nodes, 0], y=poses[nodes, 1], decimals=3)
    return {**columns, "edges": ends.reshape(-1, 2).tolist(), "total": len(pairs)}


def _ellipses(parts: ReportParts, start_ns: int) -> dict[str, Any] | None:
    """Position and covariance of some poses spread over the run."""
    covariances, trajectory = parts.covariances, parts.trajectory
    if covariances is None:
        return None
    rows = np.flatnonzero(np.isfinite(covariances[:, :2, :2]).all(axis=(1, 2)))
    rows = rows[_every(len(rows), MOST_ELLIPSES)]
    if not len(rows):
        return None
    seconds, poses, c = since(trajectory.stamps_ns[rows], start_ns), trajectory.poses[rows], covariances[rows]
    columns = rounding.columns(t=seconds, x=poses[:, 0], y=poses[:, 1], decimals=3)
    return columns | rounding.columns(xx=c[:, 0, 0], xy=c[:, 0, 1], yy=c[:, 1, 1], decimals=7)


def _ambiguities(data: ReportData) -> list[dict[str, Any]]:
    """When several places of the map fit, and the most probable of them, T_map_base, as known at the time `t`."""
    found = []
    for each, labels in zip(data.ambiguities, data.place_labels, strict=True):
        begin, end, t = since(np.array([each.begin_ns, each.end_ns, each.stamp_ns]), data.start_ns).tolist()
        poses = np.array([place.pose.to_array() for place in each.places])
        columns = rounding.columns(x=poses[:, 0], y=poses[:, 1], theta=poses[:, 2])
        columns |= {"p": [rounding.rounded(place.probability) for place in each.places], "labels": labels}
        found.append(
            {"begin": rounding.rounded(begin), "end": rounding.rounded(end), "at": rounding.rounded(t), **columns}
        )
    return found


def _events(
    parts: ReportParts, data: ReportData, loops: dict[str, Any] | None, ambiguities: list[dict[str, Any]]
) -> list[dict[str, Any]]:
    """What to jump to, in order of time: reasons of the verdict, losses and what ended them, loops, refused scans."""
    found: list[tuple[float, str, str]] = []
    if parts.metrics is not None:
        found += [
            (begin, "warning", f"{reason.text} (from {begin:.1f} to {end:.1f} s)")
            for reason in parts.metrics.verdict_reasons
            for begin, end in reason.times
        ]
    for begin, end in data.lost:
        found += [(begin, "loss", f"the pose is not known until {end:.1f} s"), (end, "loss", "the pose is known again")]
    for each in ambiguities:
        triples = zip(each["p"], each["x"], each["y"], strict=True)
        places = ", ".join(f"x {x:.1f} m, y {y:.1f} m ({format_probability(p)})" for p, x, y in triples)
        found.append((each["begin"], "ambiguous", f"several places fit until {each['end']:.1f} s: {places}"))
    if loops is not None:
        found += [(t, "loop", "a loop is closed") for t, ok in zip(loops["t"], loops["accepted"], strict=True) if ok]
    if data.scans is not None:
        rows = np.flatnonzero(data.scans.where(Status.REJECTED))
        rows = rows[_every(len(rows), MOST_MARKS)]
        found += [(float(data.scans.seconds[row]), "rejected", data.scans.reason[row]) for row in rows]
    return [{"t": rounding.rounded(t), "kind": kind, "text": text} for t, kind, text in sorted(found)]


def _status_rows(scans: Scans) -> list[dict[str, Any]]:
    """For each status its name, how many scans had it, and when: runs [begin, end]."""
    spacing = float(np.median(np.diff(scans.seconds))) if len(scans.seconds) > 1 else 1.0
    rows = []
    for name, count in status_counts(scans).items():
        spans = runs(scans.seconds[scans.where(name)], 2.0 * spacing)
        spans = spans[_every(len(spans), MOST_MARKS)]
        times = [[rounding.rounded(begin), rounding.rounded(end + spacing)] for begin, end in spans]
        rows.append({"status": name, "label": STATUS_WORDS.get(name, name), "count": count, "runs": times})
    return rows


def runs(seconds: Floats, gap: float) -> list[tuple[float, float]]:
    """First and last of each group of sorted seconds that are at most `gap` apart."""
    if len(seconds) == 0:
        return []
    breaks = np.flatnonzero(np.diff(seconds) > gap)
    firsts = seconds[np.concatenate(((0,), breaks + 1))]
    lasts = seconds[np.concatenate((breaks, (len(seconds) - 1,)))]
    return list(zip(firsts.tolist(), lasts.tolist(), strict=True))


def _chart(chart: Chart) -> dict[str, Any]:
    rows = peak_rows(chart.curve.values, MOST_POINTS)
    values: dict[str, Any] = {
        "name": chart.name, "title": chart.title, "unit": chart.unit, "explanation": chart.explanation,
        "log": chart.is_logarithmic, "top": chart.top, "time": chart.over_time,
        "t": rounding.numbers(chart.curve.seconds[rows], 3), "v": rounding.significant(chart.curve.values[rows]),
    }  # fmt: skip
    if chart.marks is not None and len(chart.marks.seconds):
        kept = _every(len(chart.marks.seconds), MOST_MARKS)
        values["marks"] = {
            "t": rounding.numbers(chart.marks.seconds[kept], 3),
            "v": rounding.significant(chart.marks.values[kept]),
        }
    return values
