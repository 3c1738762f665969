"""What the web page draws of a result: the view of report.html, as a value and the picture of the map."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from hsloc.report.view import view_of

if TYPE_CHECKING:
    from pathlib import Path

    from hsloc.report.data import ReportParts


def write_viewer(parts: ReportParts, folder: Path) -> None:
    """Write `viewer.json` and, where the map has a known cell, its picture `viewer-map.png`."""
    view, png = view_of(parts)
    if png is not None:
        view["map"]["image"] = "viewer-map.png"
        (folder / "viewer-map.png").write_bytes(png)
    text = json.dumps(view, separators=(",", ":"), allow_nan=False)
    (folder / "viewer.json").write_text(text, encoding="utf-8")
