"""What a reader of report.html must know besides the figures: what was read of the log, warnings, and what was lost."""

from __future__ import annotations

from html import escape
from math import degrees
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping


def text_of(metrics: Mapping[str, object], *keys: str) -> str:
    """The text under nested keys, empty where there is none."""
    value: object = metrics
    for key in keys:
        value = value.get(key) if isinstance(value, dict) else None
    return value if isinstance(value, str) else ""


def remarks_html(metrics: Mapping[str, object]) -> str:
    """A section with what was read, and one with warnings and losses; nothing where `metrics` tell nothing."""
    log = metrics.get("log")
    rows = _rows(log, metrics) if isinstance(log, dict) and "lasers" in log else []
    table = "".join(
        f'<tr><th scope="row">{escape(name)}</th><td class="words">{escape(value)}</td></tr>' for name, value in rows
    )
    read = f'<section><h2>What was read</h2><div class="scroll"><table>{table}</table></div></section>' if table else ""
    lines = _lines(metrics)
    items = "".join(f"<li>{escape(line)}</li>" for line in lines)
    return read + (f'<section class="remarks"><h2>Remarks</h2><ul>{items}</ul></section>' if lines else "")


def _rows(log: dict[str, object], metrics: Mapping[str, object]) -> list[tuple[str, str]]:
    rows = []
    lasers = log["lasers"]
    for laser in lasers if isinstance(lasers, list) else []:
        where = f"x {laser['x']:.3f} m, y {laser['y']:.3f} m, yaw {degrees(laser['yaw']):.1f}°"
        upside_down = ", upside-down" if laser["upside_down"] else ""
        source = "assumed" if laser["extrinsics"] == "identity" else f"from {laser['extrinsics']}"
        rows.append(("scans", f"{laser['topic']}, laser at {where}{upside_down} ({source})"))
    rows.append(("odometry", str(log.get("odometry") or "none")))
    rows.append(("reference", str(log.get("reference") or "none")))
    run = metrics.get("run")
    if isinstance(run, dict):
        rows.append(("algorithm", f"{run.get('matcher')}, preset {run.get('preset')}, seed {run.get('seed')}"))
    return rows


def _lines(metrics: Mapping[str, object]) -> list[str]:
    warnings, losses = metrics.get("warnings"), metrics.get("losses")
    lines = [str(line) for line in warnings] if isinstance(warnings, list) else []
    if isinstance(losses, dict) and isinstance(losses.get("notes"), list):
        lines += [f"log: {line}" for line in losses["notes"]]
    if isinstance(error := metrics.get("evaluation_error"), str):
        lines.append(f"no comparison with the reference: {error}")
    return lines
