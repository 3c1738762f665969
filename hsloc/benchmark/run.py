"""All parts of the benchmark in one call, and the machine that they ran on."""

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
from hsloc.benchmark.results import Bench
from hsloc.benchmark.scene import office_scene
from hsloc.benchmark.sub_cell import measure_sub_cell
from hsloc.benchmark.whole_map import AREAS, measure_whole_map
from hsloc.simulation.presets import OFFICE
from hsloc.simulation.recorder import record
from hsloc.version import __version__

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from hsloc.benchmark.cases import CaseResult

    Progress = Callable[[str, float], None]

PARTS = ("kernel", "match", "replay", "memory", "sub-cell", "cases", "certificates", "whole-map")


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


PACKAGES = ("numpy", "numba", "scipy", "mealpy", "small-gicp")


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
