"""Where the fixture recordings and the real logs are."""

from __future__ import annotations

import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
RECORDINGS = ROOT / "recordings"
DATA = Path(os.environ.get("HSLOC_DATA", ROOT.parent / "shared" / "data"))
