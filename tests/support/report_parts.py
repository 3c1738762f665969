"""Parts of a report, prepared; and what a page draws, read back from it."""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np

from hsloc.model import Trajectory
from hsloc.report.data import ReportParts, prepare

NOTHING = Trajectory(np.zeros(0, np.int64), np.zeros((0, 3)))


def parts(trajectory: Trajectory, **others: Any) -> Any:
    return prepare(ReportParts(title="", trajectory=trajectory, **others))


def view_in(text: str) -> Any:
    """The value in the page, of which there is one."""
    (source,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', text, flags=re.S)
    return json.loads(source)
