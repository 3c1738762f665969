"""What the benchmark measured, what the project promises, and both as Markdown."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from hsloc.benchmark.cases import LEVELS, SUCCESS
from hsloc.text_table import DASH, table

if TYPE_CHECKING:
    from collections.abc import Iterator

    from hsloc.benchmark.cases import CaseResult
    from hsloc.benchmark.certificates import CertificateResult
    from hsloc.benchmark.kernel import KernelTiming, MatchTiming
    from hsloc.benchmark.memory import Memory
    from hsloc.benchmark.replaying import ReplayTiming
    from hsloc.benchmark.sub_cell import SubCell
    from hsloc.benchmark.whole_map import WholeMapTiming


CASES = {"track": (1.0, None), "small": (1.0, 1.0), "large": (0.99, 4.0)}
"""Least success of HIDE, and most milliseconds (median)."""

CERTIFICATES = {"small": (0.98, 5.0, 100.0), "large": (0.98, 20.0, 100.0)}
"""Least share of gaps closed, most milliseconds: median and 95th percentile."""
WHOLE_MAP = {2_000.0: 0.3, 10_000.0: 1.0, 40_000.0: 4.0}
"""Greatest time for one scan [s] by the area of the floor [m2]."""


@dataclass(frozen=True, slots=True)
class Target:
    """A figure, its limit, and whether it is kept; `at_least`: the limit is a minimum."""

    text: str
    measured: float
    limit: float
    unit: str
    at_least: bool = False

    @property
    def met(self) -> bool:
        """Whether it is kept."""
        return self.measured >= self.limit if self.at_least else self.measured <= self.limit

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return {
            "text": self.text,
            "measured": self.measured,
            "limit": self.limit,
            "unit": self.unit,
            "at_least": self.at_least,
            "met": self.met,
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Bench:
    """What was measured; None or empty where it was not asked for."""

    machine: dict[str, object]
    load_after: tuple[float, ...] | None
    quick: bool
    kernel: KernelTiming | None = None
    matches: tuple[MatchTiming, ...] = ()
    replay: ReplayTiming | None = None
    memory: Memory | None = None
    sub_cell: tuple[SubCell, ...] = ()
    cases_name: str = ""
    cases: tuple[CaseResult, ...] = ()
    certificates: tuple[CertificateResult, ...] = ()
    whole_map: tuple[WholeMapTiming, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def targets(self) -> tuple[Target, ...]:
        """What the project promises, and whether it was kept."""
        return targets(self)

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return {
            "machine": self.machine | {"load_average_after": self.load_after},
            "quick": self.quick,
            **({"kernel": self.kernel.to_dict()} if self.kernel else {}),
            **({"match": [match.to_dict() for match in self.matches]} if self.matches else {}),
            **({"replay": self.replay.to_dict()} if self.replay else {}),
            **({"memory": self.memory.to_dict()} if self.memory else {}),
            **({"sub_cell": [row.to_dict() for row in self.sub_cell]} if self.sub_cell else {}),
            **(
                {"cases": {"name": self.cases_name, "results": [row.to_dict() for row in self.cases]}}
                if self.cases
                else {}
            ),
            **({"certificates": [row.to_dict() for row in self.certificates]} if self.certificates else {}),
            **({"whole_map": [row.to_dict() for row in self.whole_map]} if self.whole_map else {}),
            "targets": [target.to_dict() for target in self.targets],
            "notes": list(self.notes),
        }


def targets(bench: Bench) -> tuple[Target, ...]:
    """Those of the parts that were run. Of repeats of one work the best counts, of different matches the median."""
    return tuple(_targets(bench))


def _targets(bench: Bench) -> Iterator[Target]:
    if bench.kernel is not None:
        factor = 1e9 / (bench.kernel.points * bench.kernel.poses)
        yield Target("look-up, per point and evaluation", bench.kernel.near.best * factor, 4.0, "ns")
    if bench.matches:
        first = bench.matches[0]
        yield Target(f"{first.name}, {first.beams} beams, median", first.timing.median * 1e3, 0.6, "ms")
    if bench.replay is not None:
        yield Target(f"replay of {bench.replay.log}", bench.replay.times_real_time, 300.0, "x real time", True)
    if bench.memory is not None:
        growth = 100.0 * bench.memory.growth_but_trajectory
        yield Target("more memory for a log 10 times as long, but for the trajectory", growth, 10.0, "%")
    if bench.sub_cell:
        first_room = bench.sub_cell[0]
        yield Target(f"mean error of a match, {first_room.room}", 1e3 * first_room.mean_m, 5.0, "mm")
    for row in bench.cases:
        if row.method == "HIDE":
            success, milliseconds = CASES[row.level]
            yield Target(f"HIDE on {bench.cases_name} {row.level}", 100.0 * row.success, 100.0 * success, "%", True)
            if milliseconds is not None:
                yield Target(f"HIDE on {bench.cases_name} {row.level}, median", row.median_ms, milliseconds, "ms")
    for certified in bench.certificates:
        if certified.seed == "HIDE" and certified.level in CERTIFICATES:
            optimal, median, p95 = CERTIFICATES[certified.level]
            what = f"certificates of {bench.cases_name} {certified.level}"
            yield Target(f"{what}, gap closed", 100.0 * certified.optimal, 100.0 * optimal, "%", True)
            yield Target(f"{what}, median", certified.median_ms, median, "ms")
            yield Target(f"{what}, 95 %", certified.p95_ms, p95, "ms")
    for timing in bench.whole_map:
        if timing.blocked == 0.0 and timing.area in WHOLE_MAP:
            limit = WHOLE_MAP[timing.area]
            yield Target(f"one scan on {timing.area:,.0f} m2, median", timing.median_s, limit, "s")


def markdown(bench: Bench) -> str:
    """The whole report."""
    m = bench.machine
    lines = ["# hsloc bench", ""]
    versions = ", ".join(f"{name} {m[name]}" for name in ("hsloc", "python", "numpy", "numba", "scipy"))
    lines += [f"{m['cpu']}, {m['cores']} cores; {versions}.", ""]
    lines += [
        (
            f"Load average before {_load(m['load_average'])}, after {_load(bench.load_after)}. Wall times of one core "
            "after warm-up. Where the machine is shared, times grow by a third and more: best of the repeats is given "
            "beside the median, and between methods of one run the ratio counts, not the time."
        ),
        "",
    ]
    if bench.quick:
        lines += ["Quick: few repeats on small inputs. These figures show that it works, not how fast it is.", ""]
    lines += [*_kernel(bench), *_matches(bench)]
    if bench.replay is not None:
        lines += _replay(bench.replay)
    if bench.memory is not None:
        lines += _memory(bench.memory)
    lines += [*_sub_cell(bench), *_cases(bench), *_certificates(bench), *_whole_map(bench)]
    for note in bench.notes:
        lines += [f"Note: {note}.", ""]
    if bench.targets:
        lines += ["## Promised and measured", ""]
        rows = [
            (
                target.text,
                f"{'>=' if target.at_least else '<='} {target.limit:g} {target.unit}",
                f"{target.measured:.3g} {target.unit}",
                "yes" if target.met else "NO",
            )
            for target in bench.targets
        ]
        lines += table(("what", "promised", "measured", "kept"), rows)
    return "\n".join(lines)


def _load(values: object) -> str:
    return " ".join(f"{value:.2f}" for value in values) if isinstance(values, tuple) else "unknown"


def _kernel(bench: Bench) -> list[str]:
    if bench.kernel is None:
        return []
    kernel = bench.kernel
    factor = 1e9 / (kernel.points * kernel.poses)
    rows = [
        (name, f"{timing.best * factor:.2f}", f"{timing.median * factor:.2f}")
        for name, timing in (("poses of one window", kernel.near), ("poses anywhere on the map", kernel.far))
    ]
    return [
        "## Look-up in the interpolated field",
        "",
        f"{kernel.points} points, {kernel.poses} poses a call, no pose given up early; {kernel.near.repeats} repeats.",
        "",
        *table(("", "best, ns per point and evaluation", "median"), rows),
    ]


def _matches(bench: Bench) -> list[str]:
    if not bench.matches:
        return []
    rows = [
        (
            match.name,
            f"{match.beams}",
            f"{match.evaluations}",
            f"{match.timing.best * 1e3:.3f}",
            f"{match.timing.median * 1e3:.3f}",
        )
        for match in bench.matches
    ]
    head = ("", "beams", "evaluations (median)", "best ms", "median ms")
    return [
        "## One match",
        "",
        f"Window ±(0.3 m, 0.3 m, 10 deg), {bench.matches[0].timing.repeats} seeds.",
        "",
        *table(head, rows),
    ]


def _replay(replay: ReplayTiming) -> list[str]:
    total = sum(replay.parts.values())
    parts = ", ".join(f"{name} {seconds:.3f} s ({seconds / total:.0%})" for name, seconds in replay.parts.items())
    return [
        f"## Replay of {replay.log}",
        "",
        (
            f"{replay.log_seconds:.1f} s of log, {replay.matched} of {replay.scans} scans matched; "
            f"{replay.replay.repeats} repeats after one to warm up. Best {replay.replay.best:.3f} s, "
            f"{replay.times_real_time:.0f}x real time; median {replay.replay.median:.3f} s, "
            f"{replay.log_seconds / replay.replay.median:.0f}x; with opening the log and making the field (best) "
            f"{replay.whole.best:.3f} s, {replay.log_seconds / replay.whole.best:.0f}x."
        ),
        "",
        f"One run taken to pieces: {parts}.",
        "",
    ]


def _memory(memory: Memory) -> list[str]:
    mib = 1.0 / 2**20
    rows = [
        (f"{seconds:.0f} s", f"{peak * mib:.1f}", f"{kept * mib:.1f}")
        for seconds, peak, kept in (
            (memory.seconds, memory.peak, memory.trajectory),
            (memory.long_seconds, memory.long_peak, memory.long_trajectory),
        )
    ]
    return [
        "## Peak memory of a replay",
        "",
        *table(("log", "peak MiB", "of which trajectories MiB"), rows),
        f"Growth {memory.growth:.1%}, without the trajectories {memory.growth_but_trajectory:.1%}.",
        "",
    ]


def _sub_cell(bench: Bench) -> list[str]:
    if not bench.sub_cell:
        return []
    rows = [
        (
            row.room,
            f"{1e3 * row.mean_m:.4f}",
            f"{1e3 * row.max_m:.4f}",
            f"{1e3 * row.bias_m[0]:+.4f} {1e3 * row.bias_m[1]:+.4f}",
            f"{row.mean_deg:.5f}",
        )
        for row in bench.sub_cell
    ]
    return [
        "## Sub-cell accuracy",
        "",
        f"{bench.sub_cell[0].matches} matches without noise in an L-shaped room on a map of 5 cm cells.",
        "",
        *table(("", "mean mm", "max mm", "mean signed x y mm", "mean deg"), rows),
        (
            "The map is all that a match knows. A wall on a border occupies the cells on both sides: within a wall two "
            "cells thick every place fits alike. A room whose walls all lie a third of a cell (16.7 mm) beside the "
            "centres is drawn that much beside itself, and is found there: 16.7 mm in x and in y are the map's."
        ),
        "",
    ]


def _cases(bench: Bench) -> list[str]:
    if not bench.cases:
        return []
    by_method: dict[str, dict[str, CaseResult]] = {}
    for row in bench.cases:
        by_method.setdefault(row.method, {})[row.level] = row
    rows = []
    for method, levels in by_method.items():
        cells = [method]
        for level in LEVELS:
            row = levels[level]
            spent = DASH if row.median_evaluations is None else f"{row.median_evaluations:.0f}"
            cells += [f"{100 * row.success:.1f} %", f"{row.median_ms:.2f} / {row.p95_ms:.2f}", spent]
        rows.append(cells)
    head = ["method"]
    for level in LEVELS:
        head += [level, "ms", "evaluations"]
    return [
        f"## Matching cases: {bench.cases_name}",
        "",
        (
            f"{bench.cases[0].cases} cases a level, each matched once; ms: median / 95th percentile. Success: within "
            f"{SUCCESS[0]:.2f} m and {SUCCESS[1]:g} deg. The window of a level (track ±0.1 m, 5 deg; small ±0.5 m, "
            "20 deg; large ±2 m, 45 deg) is given to all but small_gicp, which starts from its centre; the "
            "preparation of the map is not counted."
        ),
        "",
        *table(head, rows),
    ]


def _certificates(bench: Bench) -> list[str]:
    rows = [
        (
            row.level,
            row.seed,
            f"{100 * row.optimal:.1f} %",
            f"{100 * row.distinct:.1f} %",
            f"{100 * row.corrected:.1f} %",
            f"{row.median_ms:.2f} / {row.p95_ms:.2f}",
            f"{row.median_boxes:.0f}",
        )
        for row in bench.certificates
    ]
    if not rows:
        return []
    head = ("level", "starts from", "gap closed", "no other place", "corrected", "ms", "boxes")
    return [
        f"## Certificates of matches: {bench.cases_name}",
        "",
        (
            f"{bench.certificates[0].cases} cases a level. Gap closed: no pose of the window is fitter than the one "
            "returned by more than 0.01. No other place: every pose farther than 0.3 m or 3 deg from it is worse by "
            "0.05. Corrected: the start was worse than the best by more than 0.01. ms: processor time of both proofs, "
            "median / 95th percentile; the search before them is not counted."
        ),
        "",
        *table(head, rows),
    ]


def _whole_map(bench: Bench) -> list[str]:
    rows = [
        (
            f"{row.area:,.0f}",
            f"{100 * row.blocked:.0f} %",
            f"{100 * row.right:.0f} %",
            f"{100 * row.unique:.0f} %",
            f"{100 * row.wrong:.0f} %",
            f"{row.median_s:.2f} / {row.p95_s:.2f} / {row.worst_s:.2f}",
            f"{row.prepare_s:.2f}",
        )
        for row in bench.whole_map
    ]
    if not rows:
        return []
    head = ("floor, m2", "beams blocked", "right", "proven unique", "of these wrong", "s", "preparation, s")
    return [
        "## One scan on a whole floor",
        "",
        (
            f"{bench.whole_map[0].scans} scans of 360 beams (1 cm noise, 25 m) from random poses, 5 cm cells. Right: "
            "the true pose is among the modes within 0.05 of the best, to 0.3 m and 3 deg. s: processor time, "
            "median / 95th percentile / worst."
        ),
        "",
        *table(head, rows),
    ]
