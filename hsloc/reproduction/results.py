"""The results of `hsloc reproduce` on disk: report.md with its tables, results.json and the figures."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

import numpy as np

from hsloc.atomic_write import is_there, whole_folder, write_text_atomically
from hsloc.errors import OutputError
from hsloc.evaluation.metrics import write_json
from hsloc.reproduction import published
from hsloc.reproduction.convergence import COUNTS
from hsloc.reproduction.figures import draw_figures
from hsloc.reproduction.localisation import INITIAL
from hsloc.reproduction.mapping import NEAR, NOISE, RANGE
from hsloc.reproduction.scan_match import SUCCESS as E1_SUCCESS
from hsloc.reproduction.windows import SUCCESS as M1_SUCCESS
from hsloc.reproduction.windows import UNCERTAINTIES
from hsloc.text_table import DASH, table

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from hsloc.reproduction.convergence import Convergence
    from hsloc.reproduction.localisation import Drive
    from hsloc.reproduction.mapping import Mapped
    from hsloc.reproduction.run import MaterialResults, Reproduction
    from hsloc.reproduction.scan_match import ScanMatch
    from hsloc.reproduction.windows import Windows


D = TypeVar("D", "Drive", "Mapped")


def write_results(
    reproduction: Reproduction, folder: Path, notes: Sequence[str] = (), *, overwrite: bool = False
) -> str:
    """Write everything into `folder`, whole or not at all; returns the text of report.md.

    Raises OutputError where the folder is there already (unless `overwrite`), or cannot be written.
    """
    if is_there(folder) and not overwrite and (not folder.is_dir() or any(folder.iterdir())):
        raise OutputError(f"{folder}: exists already; choose another --out, or pass --overwrite")
    text = markdown(reproduction, notes)
    with whole_folder(folder) as partial:
        figures = [path for results in reproduction.materials for path in draw_figures(results, partial)]
        pictures = "".join(f"\n![{path.stem}]({path.name})\n" for path in figures)
        write_text_atomically(partial / "report.md", text + pictures)
        write_json(partial / "results.json", {**reproduction.to_dict(), "notes": list(notes)})
    return text


def markdown(reproduction: Reproduction, notes: Sequence[str] = ()) -> str:
    """The whole report."""
    lines = ["# The papers' experiments, run again", ""]
    lines += [
        (
            "[P]: the course report this project began with. [M]: Mirkhani et al., Robotics and Autonomous Systems "
            "61(9), 2013. Presets: `default` is ours (relative bandwidth, restarts until two agree, polish); `paper` "
            "reads the bandwidth of [M] in proportion to the window; `paper-literal` takes it in metres and radians, "
            "as [P] prints it. Evaluations are true counts, the initial ones included. Times are of one core of "
            "this machine."
        ),
        "",
    ]
    for note in notes:
        lines += [f"Note: {note}", ""]
    for results in reproduction.materials:
        lines += _of_material(results)
    if reproduction.windows:
        lines += _m1(reproduction.windows)
    if reproduction.verdicts:
        lines += ["## What ought to hold", ""]
        lines += [f"- {'yes' if verdict.met else 'NO '}  {verdict.text}" for verdict in reproduction.verdicts]
        lines.append("")
    return "\n".join(lines)


def _of_material(results: MaterialResults) -> list[str]:
    lines = []
    if results.material.name != "report":
        lines += [f"The published figures beside those on {results.material.title} belong to the report's data.", ""]
    if results.scan_match:
        lines += _e1(results.scan_match, results.material.title)
    if results.convergence is not None:
        lines += _e2(results.convergence, results.material.title)
    if results.drives:
        lines += _e3(results.drives, results.material.title)
    if results.mapped:
        lines += _e4(results.mapped, results.material.title)
    return lines


def _e1(rows: Sequence[ScanMatch], title: str) -> list[str]:
    metres, degrees = E1_SUCCESS
    lines = [
        f"## E1: match one scan, on {title}",
        "",
        (
            f"{len(rows[0].poses)} seeds; success: within {100 * metres:g} cm and {degrees:g} deg (ours: [P] prints no "
            "number). Box ±(0.5 m, 0.5 m, 15 deg), the truth 0.40 m and 12 deg off its centre."
        ),
        "",
    ]
    cells = []
    for row in rows:
        tally = row.tally
        angle = np.abs(tally.degrees)
        matcher = row.variant.matcher
        seconds = published.E1_SECONDS.get(matcher)
        cells.append(
            (
                row.variant.label,
                published.E1.get(matcher, DASH),
                f"{100 * row.success:.1f} %",
                f"{1e3 * np.median(tally.metres):.2f}",
                f"{1e3 * tally.metres.max():.2f}",
                f"{np.median(angle):.3f}",
                f"{angle.max():.3f}",
                f"{np.median(tally.evaluations):.0f}",
                f"{np.median(tally.ms):.2f}",
                DASH if seconds is None else f"{1e3 * seconds:.0f}",
            )
        )
    head = (
        "matcher, preset", "published", "success", "median mm", "max mm", "median deg", "max deg",
        "evaluations", "median ms", "published ms",
    )  # fmt: skip
    lines += table(head, cells)
    lines += ["ICP is helped here: the scan's points are the map's points, so that each has an exact partner.", ""]
    return lines


def _e2(convergence: Convergence, title: str) -> list[str]:
    lines = [
        f"## E2: best fitness against iteration, on {title}",
        "",
        (
            f"Mean of {len(convergence.curves[0].fitness)} seeds, sigma 1 m. The interpolated field gives "
            f"{convergence.fitness_at_truth:.3f} at the true pose where the exact distance gives 1."
        ),
        "",
    ]
    cells = [
        (
            f"{curve.matcher}, {curve.preset}",
            f"{counts}",
            published.E2[curve.matcher] if counts == "improvisations" else DASH,
            *(f"{curve.mean[k - 1]:.3f}" for k in (50, 100, 200, 500, 1000)),
            DASH if curve.first() is None else str(curve.first()),
        )
        for counts in COUNTS
        for curve in convergence.curves
        if curve.counts == counts
    ]
    head = ("matcher, preset", "an iteration is", "published", "at 50", "at 100", "at 200", "at 500", "at 1000")
    lines += table((*head, "first at 0.99"), cells)
    return lines


def _by_matcher(drives: Sequence[D]) -> Iterator[tuple[str, str, list[D]]]:
    """Matcher, preset, and the drives of the two."""
    for preset in dict.fromkeys(drive.preset for drive in drives):
        for matcher in ("HIDE", "HS"):
            yield matcher, preset, [drive for drive in drives if (drive.matcher, drive.preset) == (matcher, preset)]


def _rmse_cells(drives: Sequence[Drive] | Sequence[Mapped]) -> list[str]:
    """Of each axis the median and, in brackets, the worst of the seeds."""
    rmse = np.array([drive.rmse for drive in drives])
    median, worst = np.median(rmse, axis=0), rmse.max(axis=0)
    return [f"{median[axis]:.4f} ({worst[axis]:.4f})" for axis in range(3)]


def _e3(drives: Sequence[Drive], title: str) -> list[str]:
    first = drives[0]
    seeds = len({drive.seed for drive in drives})
    lines = [
        f"## E3: localisation along the waypoints, on {title}",
        "",
        (
            f"{seeds} seeds; {first.length_m:.1f} m in {first.duration_s:.1f} s, {first.scans} scans (the report: "
            f"{published.E3_PATH[0]:.0f} m, {published.E3_PATH[1]} s). RMSE over all odometry stamps: median and, in "
            "brackets, worst of the seeds. Theta is wrapped; the report prints 0.467 rad (HS) and 0.362 rad (HIDE) "
            "because it did not wrap the difference. Most of theta's RMSE is the odometry's between two scans. "
            f"The start is known to {INITIAL[0]:.2f} m and {np.degrees(INITIAL[1]):.1f} deg (P0 read as a covariance)."
        ),
        "",
    ]
    cells = []
    for matcher, preset, chosen in _by_matcher(drives):
        cells.append(
            (
                f"{matcher}, {preset}",
                " / ".join(f"{value:g}" for value in published.E3_RMSE[matcher]),
                *_rmse_cells(chosen),
                f"{min(drive.matched for drive in chosen)}",
                f"{np.median([drive.seconds for drive in chosen]):.2f}",
                f"{published.E3_SECONDS[matcher]:.0f}",
            )
        )
    head = (
        "matcher, preset", "published x / y / theta", "x m", "y m", "theta rad", "least scans matched", "seconds",
        "published s",
    )  # fmt: skip
    lines += table(head, cells)
    lines += ["Seed by seed (x m, y m, theta rad):", ""]
    by_seed = []
    for seed in sorted({drive.seed for drive in drives}):
        row = [str(seed)]
        for matcher, preset in (
            ("HIDE", "default"),
            ("HS", "default"),
            ("HIDE", "paper-literal"),
            ("HS", "paper-literal"),
        ):
            (drive,) = (d for d in drives if (d.matcher, d.preset, d.seed) == (matcher, preset, seed))
            row.append(" ".join(f"{value:.4f}" for value in drive.rmse))
        by_seed.append(row)
    lines += table(("seed", "HIDE, default", "HS, default", "HIDE, paper-literal", "HS, paper-literal"), by_seed)
    return lines


def _e4(mapped: Sequence[Mapped], title: str) -> list[str]:
    first = mapped[0]
    seeds = len({drive.seed for drive in mapped})
    lines = [
        f"## E4: SLAM along the waypoints, on {title}",
        "",
        (
            f"{seeds} seeds, {first.scans} scans; the point mapper, which knows no map and the start alone; range "
            f"{RANGE:g} m, noise {NOISE.speed:g} m/s and {np.degrees(NOISE.steering):g} deg. RMSE over all stamps, "
            "each with the pose that is known once the scan that bears it is taken in: median and, in brackets, worst "
            "of the seeds. Most of theta's RMSE is the odometry's between two scans. Complete: the part of the world's "
            f"points with a point of the map within {NEAR:g} m (the report: {published.E4_MAP})."
        ),
        "",
    ]
    cells = []
    for matcher, preset, chosen in _by_matcher(mapped):
        cells.append(
            (
                f"{matcher}, {preset}",
                " / ".join(f"{value:g}" for value in published.E4_RMSE) if matcher == "HS" else DASH,
                *_rmse_cells(chosen),
                f"{np.median([drive.points for drive in chosen]):.0f}",
                f"{100 * np.median([drive.complete for drive in chosen]):.0f} %",
                f"{np.median([drive.distance for drive in chosen]):.3f}",
                f"{np.median([drive.seconds for drive in chosen]):.2f}",
            )
        )
    head = (
        "matcher, preset", "published x / y / theta", "x m", "y m", "theta rad", "points", "complete", "points off m",
        "seconds",
    )  # fmt: skip
    return [*lines, *table(head, cells)]


def _m1(rows: Sequence[Windows]) -> list[str]:
    metres, degrees = M1_SUCCESS
    lines = [
        "## M1: windows of a simulated indoor scan",
        "",
        (
            f"{len(rows[0].tally.ms)} scans of the built-in office with 1 cm of range noise, on its map of 5 cm cells, "
            f"window ±(x, x, 10 deg). Success: within {100 * metres:g} cm (a cell) and {degrees:g} deg of the truth "
            "(ours: [M] does not say in the table what it counts). The means are over all windows, failures too."
        ),
        "",
    ]
    cells = []
    for row in rows:
        matcher = row.variant.matcher
        cells.append(
            (
                row.sensor,
                f"{100 * row.uncertainty:.0f} cm",
                row.variant.label,
                f"{published.M1_SUCCESS[matcher][UNCERTAINTIES.index(row.uncertainty)]:.2f}",
                f"{row.success:.3f}",
                f"{100 * published.M1_ERROR[0]:.2f} / {published.M1_ERROR[1]:.2f}",
                f"{100 * row.tally.metres.mean():.2f} / {np.abs(row.tally.degrees).mean():.2f}",
                f"{100 * row.tally.metres.max():.2f} / {np.abs(row.tally.degrees).max():.2f}",
                f"{np.median(row.tally.evaluations):.0f}",
                f"{np.median(row.tally.ms):.2f}",
            )
        )
    head = (
        "sensor", "window", "matcher, preset", "published success", "success", "published cm / deg", "mean cm / deg",
        "max cm / deg", "evaluations", "median ms",
    )  # fmt: skip
    return [*lines, *table(head, cells), *_m1_ratio(rows)]


def _m1_ratio(rows: Sequence[Windows]) -> list[str]:
    """[M] says that HIDE is faster."""

    def total(matcher: str) -> float:
        chosen = (row for row in rows if row.variant.label == f"{matcher}, paper")
        return sum(float(np.median(row.tally.ms)) for row in chosen)

    return [
        (
            f"HIDE needs {total('HIDE') / total('HS'):.2f} times the milliseconds of HS with the preset `paper` "
            f"(its budget is 220, that of HS 250); published: {published.M1_TIME:.2f}."
        ),
        "",
    ]
