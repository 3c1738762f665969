"""The table that a replay ends with."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

_COLUMNS = ("rmse", "mean", "median", "std", "min", "max")


def print_summary(metrics: Mapping[str, Any], timings: Mapping[str, Any], folder: Path) -> None:
    """Errors against the truth if there is one, what was used, how fast it was, and where the results are."""
    for line in summary_lines(metrics, timings, folder):
        print(line)


def summary_lines(metrics: Mapping[str, Any], timings: Mapping[str, Any], folder: Path) -> list[str]:
    """The lines of `print_summary`."""
    lines: list[str] = []
    if "ape" in metrics:
        head = f"{'':<16}" + "".join(f"{name:>10}" for name in _COLUMNS)
        lines += [f"errors against the truth ({metrics['matched']} poses, alignment: {metrics['alignment']})", head]
        for label, key in (("APE", "ape"), ("RPE per 1 m", "rpe_1m")):
            if key in metrics:
                lines += [
                    _row(f"{label} [m]", metrics[key]["trans_part"]),
                    _row(f"{label} [deg]", metrics[key]["angle_deg"]),
                ]
    elif "evaluation_error" in metrics:
        lines.append(f"no comparison with the truth: {metrics['evaluation_error']}")
    if "relations" in metrics:
        relations = metrics["relations"]
        translation, angle = relations["trans_part"], relations["angle_deg"]
        lines.append(
            f"relations ({relations['matched']}): {translation['mean']:.4f} +- {translation['std']:.4f} m, "
            f"{angle['mean']:.3f} +- {angle['std']:.3f} deg"
        )
    scans, log = metrics["scans"], metrics["log"]
    others = ", ".join(
        f"{n} {name}" for name, n in scans["by_status"].items() if name not in ("matched", "relocalised")
    )
    residuals = metrics["map"]["residuals"]
    lines.append(f"path {log['path_length_m']:.1f} m in {log['duration_s']:.1f} s")
    lines.append(f"scans: {scans['used']} of {scans['total']} matched" + (f" ({others})" if others else ""))
    if residuals["points"]:
        lines.append(
            f"scan to map: median {_distance(residuals['median'])}, 95 % {_distance(residuals['p95'], 'below ')}, "
            f"{100 * residuals['within_0.15_m']:.1f} % of the points within 0.15 m of a wall"
        )
    if "mapping" in metrics["map"]:
        quality = metrics["map"]["mapping"]
        lines.append(f"map drawn from {quality['keyscans']} scans, {quality['loops']} loops closed")
    share = metrics["localised"]["share_of_poses"]
    if share < 1.0:
        lines.append(f"localised: {100 * share:.1f} % of the poses; the others are guesses")
    speed = timings["times_real_time"]
    if speed:
        seconds = timings["seconds"]["replay"] + timings["seconds"].get("finish", 0.0)
        lines.append(f"replay: {seconds:.2f} s, {speed:.0f}x real time")
    lines.append(f"results: {folder}")
    return lines


def _row(label: str, statistics: Mapping[str, Any]) -> str:
    cells = "".join(f"{'-':>10}" if statistics[name] is None else f"{statistics[name]:>10.4f}" for name in _COLUMNS)
    return f"{label:<16}{cells}"


def _distance(metres: float, before: str = "") -> str:
    """A distance of returns from the nearest occupied cell; none is what lies in one."""
    return "in the wall's cell" if metres == 0.0 else f"{before}{metres:.3f} m"
