"""Colours and marks of the reports.

The colours are those of M. Okabe and K. Ito, "Color Universal Design" (2008): they stay apart for colour-blind
readers. Width, dash and mark distinguish the lines as well, so that the report can be read in grey.
"""

from __future__ import annotations

BLUE, VERMILLION, GREEN, PURPLE, ORANGE = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00"

INK, MUTED, RULE, PAPER = "#1f2328", "#656d76", "#d8dee4", "#ffffff"
WALL, FREE, UNKNOWN = "#30363d", "#ffffff", "#eceff2"

TEXT, SMALL = 11.0, 9.5
"""Sizes of type in points: the picture is often shown at half its size."""

FONT = "DejaVu Sans"
"""Comes with matplotlib: the same picture on every machine."""

VERDICT: dict[str, str] = {"good": "#1a7f37", "check": "#8a5a00", "failed": "#b42318"}
"""Ground of a verdict's name, which is written in white: the contrast is 5 to 1 or more."""
