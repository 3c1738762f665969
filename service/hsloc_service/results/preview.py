"""What the web page draws of a result: the view of report.html, as a value and the picture of the map."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    from hsloc.report.view import ReportView

_PICTURE = "viewer-map.png"


def write_viewer(view: ReportView, folder: Path) -> None:
    """Write `viewer.json` and, where the map has a known cell, its picture `viewer-map.png`."""
    if view.map_png is not None:
        (folder / _PICTURE).write_bytes(view.map_png)
    text = json.dumps(view.with_picture(_PICTURE), separators=(",", ":"), allow_nan=False)
    (folder / "viewer.json").write_text(text, encoding="utf-8")
