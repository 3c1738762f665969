"""What was measured, and what the project promises."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

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
