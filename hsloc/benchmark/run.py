"""All parts of the benchmark in one call, the machine that they ran on, and what the project promises."""

from __future__ import annotations

import os
import platform
import tempfile
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

from hsloc.benchmark.cases import read_cases, run_method
from hsloc.benchmark.certificates import measure_certificates
from hsloc.benchmark.kernel import time_kernel, time_matches
from hsloc.benchmark.memory import measure_memory
from hsloc.benchmark.methods import our_methods, peers
from hsloc.benchmark.replaying import fixture, time_replay
from hsloc.benchmark.scene import office_scene
from hsloc.benchmark.sub_cell import measure_sub_cell
from hsloc.benchmark.whole_map import AREAS, measure_whole_map
from hsloc.simulation.presets import OFFICE
from hsloc.simulation.recorder import record
from hsloc.version import __version__

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from hsloc.benchmark.cases import CaseResult
    from hsloc.benchmark.certificates import CertificateResult
    from hsloc.benchmark.kernel import KernelTiming, MatchTiming
    from hsloc.benchmark.memory import Memory
    from hsloc.benchmark.replaying import ReplayTiming
    from hsloc.benchmark.sub_cell import SubCell
    from hsloc.benchmark.whole_map import WholeMapTiming

    Progress = Callable[[str, float], None]

CASES = {"track": (1.0, None), "small": (1.0, 1.0), "large": (0.99, 4.0)}
"""Least success of HIDE, and most milliseconds (median)."""

CERTIFICATES = {"small": (0.98, 5.0, 100.0), "large": (0.98, 20.0, 100.0)}
"""Least share of gaps closed, most milliseconds: median and 95th percentile."""
WHOLE_MAP = {2_000.0: 0.3, 10_000.0: 1.0, 40_000.0: 4.0}
"""Greatest time for one scan [s] by the area of the floor [m2]."""

PARTS = ("kernel", "match", "replay", "memory", "sub-cell", "cases", "certificates", "whole-map")
PACKAGES = ("numpy", "numba", "scipy", "mealpy", "small-gicp")


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


@dataclass(frozen=True, slots=True)
class Sizes:
    """How much is measured."""

    kernel_repeats: int = 30
    match_repeats: int = 200
    replay_repeats: int = 7
    replay_seconds: float | None = None
    """Of the log; None: the whole fixture."""
    memory_seconds: float | None = None
    """Of the short log; None: a lap of the office, 113 s."""
    sub_cell_matches: int = 100
    cases: int = 10**9
    floor_areas: tuple[float, ...] = AREAS
    floor_scans: int = 20


QUICK = Sizes(
    kernel_repeats=5,
    match_repeats=20,
    replay_repeats=2,
    replay_seconds=8.0,
    memory_seconds=3.0,
    sub_cell_matches=10,
    cases=10,
    floor_areas=(300.0,),
    floor_scans=3,
)
"""A look at whether all works; the figures mean little."""


def run_bench(
    parts: Sequence[str] = PARTS,
    cases: Path | None = None,
    *,
    quick: bool = False,
    progress: Progress = lambda phase, share: None,
) -> Bench:
    """Run `parts` (of `PARTS`) in turn on one core; "cases" and "certificates" only where `cases` names a file.

    Raises ConfigError for a file of cases that cannot be used.
    """
    sizes = QUICK if quick else Sizes()
    bench = Bench(machine=machine(), load_after=None, quick=quick)
    # First of all: a wrong file is reported before minutes of work.
    given = (
        None if cases is None or not {"cases", "certificates"} & set(parts) else read_cases(cases).first(sizes.cases)
    )
    if "kernel" in parts or "match" in parts:
        progress("kernel", 0.0)
        scene = office_scene()
        if "kernel" in parts:
            bench = replace(bench, kernel=time_kernel(scene, sizes.kernel_repeats))
        if "match" in parts:
            bench = replace(bench, matches=time_matches(scene, sizes.match_repeats))
    with tempfile.TemporaryDirectory(prefix="hsloc-bench-") as folder:
        if "replay" in parts:
            progress("replay", 0.0)
            bench = replace(bench, replay=time_replay(_log(Path(folder), sizes), sizes.replay_repeats))
        if "memory" in parts:
            progress("memory", 0.0)
            bench = replace(bench, memory=measure_memory(Path(folder), sizes.memory_seconds))
    if "sub-cell" in parts:
        progress("sub-cell", 0.0)
        bench = replace(bench, sub_cell=measure_sub_cell(sizes.sub_cell_matches))
    if given is not None and "certificates" in parts:
        proofs = measure_certificates(given, lambda share: progress("certificates", share))
        bench = replace(bench, cases_name=given.name, certificates=proofs)
    if "whole-map" in parts:
        searches = measure_whole_map(sizes.floor_areas, sizes.floor_scans, lambda share: progress("whole-map", share))
        bench = replace(bench, whole_map=searches)
    if given is not None and "cases" in parts:
        methods, notes = peers(given.grid)
        methods = our_methods(given.grid) + methods
        rows: list[CaseResult] = []
        for index, method in enumerate(methods):

            def report(share: float, index: int = index) -> None:
                progress("cases", (index + share) / len(methods))

            rows += run_method(method, given, report)
        bench = replace(bench, cases_name=given.name, cases=tuple(rows), notes=tuple(notes))
    return replace(bench, load_after=load())


def _log(folder: Path, sizes: Sizes) -> Path:
    """The fixture where there is one, else the same, recorded again; or a short one."""
    found = fixture()
    if found is not None and sizes.replay_seconds is None:
        return found
    path = folder / "office.mcap"
    record(replace(OFFICE, seed=1, duration_s=sizes.replay_seconds), path)
    return path


def machine() -> dict[str, object]:
    """Processor, cores, load and versions; a package that is missing is None."""
    return {
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "load_average": load(),
        "platform": platform.platform(),
        "python": platform.python_version(),
        "hsloc": __version__,
        **{name: _version(name) for name in PACKAGES},
    }


def load() -> tuple[float, ...] | None:
    """Load over 1, 5 and 15 minutes: above 0 before a benchmark somebody else is at work."""
    return tuple(round(value, 2) for value in os.getloadavg()) if hasattr(os, "getloadavg") else None


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None
