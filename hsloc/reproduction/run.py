"""All experiments in one call."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from hsloc.reproduction import published
from hsloc.reproduction.convergence import run_convergence
from hsloc.reproduction.localisation import run_localisation
from hsloc.reproduction.mapping import run_mapping
from hsloc.reproduction.scan_match import run_scan_match
from hsloc.reproduction.windows import run_windows

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from hsloc.reproduction.convergence import Convergence
    from hsloc.reproduction.localisation import Drive
    from hsloc.reproduction.mapping import Mapped
    from hsloc.reproduction.material import Material
    from hsloc.reproduction.scan_match import ScanMatch
    from hsloc.reproduction.windows import Windows

    Progress = Callable[[str, float], None]

EXPERIMENTS = ("E1", "E2", "E3", "E4", "M1")
SEEDS = {"E1": 200, "E2": 50, "E3": 20, "E4": 20, "M1": 200}
"""Repetitions; of M1 it is the number of windows."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Something that ought to hold, and whether it does."""

    text: str
    met: bool


@dataclass(frozen=True, slots=True, eq=False)
class MaterialResults:
    """E1 to E4 on one material; empty or None where they were not asked for."""

    material: Material
    scan_match: tuple[ScanMatch, ...] = ()
    convergence: Convergence | None = None
    drives: tuple[Drive, ...] = ()
    mapped: tuple[Mapped, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Reproduction:
    """The results of all experiments that were run."""

    materials: tuple[MaterialResults, ...]
    windows: tuple[Windows, ...] = ()
    verdicts: tuple[Verdict, ...] = field(default=())

    def to_dict(self) -> dict[str, object]:
        """For JSON: wall times are in the keys `ms` and `seconds`, all else is repeatable."""
        return {
            "materials": [
                {
                    "name": results.material.name,
                    "title": results.material.title,
                    **({"E1": [row.to_dict() for row in results.scan_match]} if results.scan_match else {}),
                    **({"E2": results.convergence.to_dict()} if results.convergence else {}),
                    **({"E3": [drive.to_dict() for drive in results.drives]} if results.drives else {}),
                    **({"E4": [drive.to_dict() for drive in results.mapped]} if results.mapped else {}),
                }
                for results in self.materials
            ],
            **({"M1": [row.to_dict() for row in self.windows]} if self.windows else {}),
            "verdicts": [{"text": verdict.text, "met": verdict.met} for verdict in self.verdicts],
        }


def reproduce(
    materials: Sequence[Material],
    experiments: Sequence[str] = EXPERIMENTS,
    seeds: int | None = None,
    progress: Progress = lambda phase, share: None,
) -> Reproduction:
    """Run `experiments` (of `EXPERIMENTS`) on each material; M1 has a world of its own and runs once.

    `seeds` overrides `SEEDS` for all of them. `progress` is called with the experiment's name and its share of 1. The
    same arguments give the same result but for the times.
    """
    count = dict.fromkeys(SEEDS, seeds) if seeds is not None else SEEDS

    def run_for(name: str) -> int:
        return count[name] or SEEDS[name]

    results = []
    for material in materials:

        def report(name: str, material: Material = material) -> Callable[[float], None]:
            return lambda share: progress(f"{name} ({material.name})", share)

        results.append(
            MaterialResults(
                material,
                run_scan_match(material.scan, run_for("E1"), report("E1")) if "E1" in experiments else (),
                run_convergence(material.scan, run_for("E2"), report("E2")) if "E2" in experiments else None,
                run_localisation(material.world, run_for("E3"), report("E3")) if "E3" in experiments else (),
                run_mapping(material.world, run_for("E4"), report("E4")) if "E4" in experiments else (),
            )
        )
    windows = run_windows(run_for("M1"), lambda share: progress("M1", share)) if "M1" in experiments else ()
    return Reproduction(tuple(results), windows, (*_verdicts(results), *_window_verdicts(windows)))


def _verdicts(results: Sequence[MaterialResults]) -> list[Verdict]:
    verdicts = []
    for result in results:
        where = result.material.name
        for row in result.scan_match:
            if row.variant.label == "HIDE, default":
                text = f"E1 ({where}): HIDE within 2 cm and 0.5 deg in 100 % of the seeds: {100 * row.success:.1f} %"
                verdicts.append(Verdict(text, row.success == 1.0))
        ours = [drive for drive in result.drives if (drive.matcher, drive.preset) == ("HIDE", "default")]
        if ours:
            limits = published.E3_RMSE["HIDE"]
            worst = tuple(max(drive.rmse[axis] for drive in ours) for axis in range(3))
            text = (
                f"E3 ({where}): HIDE's RMSE below {limits[0]} m, {limits[1]} m, {limits[2]} rad on each axis in every "
                f"seed: worst {worst[0]:.4f}, {worst[1]:.4f}, {worst[2]:.4f}"
            )
            verdicts.append(Verdict(text, all(w < limit for w, limit in zip(worst, limits, strict=True))))
        verdicts += _mapping_verdicts(result)
    return verdicts


def _mapping_verdicts(result: MaterialResults) -> list[Verdict]:
    ours = [drive for drive in result.mapped if (drive.matcher, drive.preset) == ("HIDE", "default")]
    if not ours:
        return []
    limits = published.E4_RMSE
    worst = tuple(max(drive.rmse[axis] for drive in ours) for axis in range(3))
    text = (
        f"E4 ({result.material.name}): RMSE of the point mapper with HIDE below {limits[0]} m, {limits[1]} m, "
        f"{limits[2]} rad on each axis in every seed: worst {worst[0]:.4f}, {worst[1]:.4f}, {worst[2]:.4f}"
    )
    return [Verdict(text, all(value < limit for value, limit in zip(worst, limits, strict=True)))]


def _window_verdicts(windows: Sequence[Windows]) -> list[Verdict]:
    verdicts = []
    metres, degrees = published.M1_ERROR
    for row in windows:
        if row.sensor != "office lidar" or row.variant.label != "HIDE, default":
            continue
        error, angle = float(row.tally.metres.mean()), float(abs(row.tally.degrees).mean())
        text = (
            f"M1 (±{100 * row.uncertainty:.0f} cm): HIDE's success >= {published.M1_WANTED} and mean error <= "
            f"{100 * metres:.2f} cm, {degrees} deg: {row.success:.3f}, {100 * error:.2f} cm, {angle:.3f} deg"
        )
        verdicts.append(Verdict(text, row.success >= published.M1_WANTED and error <= metres and angle <= degrees))
    return verdicts
