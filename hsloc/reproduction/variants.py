"""The matchers that are compared, each with the three presets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hsloc.config import preset
from hsloc.matching import HarmonySearch, Hide, Icp
from hsloc.model.pose2 import wrap_angle
from hsloc.options import PRESETS

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from hsloc.matching import Match, Matcher
    from hsloc.model.pose2 import Pose2

    F64 = NDArray[np.float64]

NAMES = {"hide": "HIDE", "harmony_search": "HS", "icp": "ICP"}
"""What the papers call the matchers of `hsloc.config`."""


@dataclass(frozen=True, slots=True)
class Variant:
    """A matcher with a preset, and the field's sigma (m) that goes with it."""

    matcher: str
    preset: str
    search: Matcher
    sigma: float

    @property
    def label(self) -> str:
        """As a heading: HIDE, paper."""
        return self.matcher if self.matcher == "ICP" else f"{self.matcher}, {self.preset}"


def matching_variants() -> tuple[Variant, ...]:
    """HIDE and HS with each preset for scan matching ([P]: NI 250, (HRT, NFE) = (14, 220)), and ICP."""
    searches: dict[str, tuple[HarmonySearch, HarmonySearch]] = {
        "default": (Hide(), HarmonySearch()),
        "paper": (Hide.paper(), HarmonySearch.paper()),
        "paper-literal": (Hide.paper_literal(), HarmonySearch.paper_literal()),
    }
    variants = [
        Variant(matcher, name, search, preset(name).likelihood_field.sigma)
        for name in PRESETS
        for matcher, search in zip(("HIDE", "HS"), searches[name], strict=True)
    ]
    return (*variants, Variant("ICP", "default", Icp(), preset("default").likelihood_field.sigma))


@dataclass(frozen=True, slots=True, eq=False)
class Tally:
    """What n matches of known poses came to: arrays of length n. `xy_m` (n, 2) are signed, in the map frame."""

    xy_m: F64
    degrees: F64
    evaluations: NDArray[np.int64]
    ms: F64

    @staticmethod
    def of(matches: Iterable[tuple[Match, Pose2, float]]) -> Tally:
        """From (match, true pose, seconds)."""
        rows = [
            (
                match.pose.x - truth.x,
                match.pose.y - truth.y,
                np.degrees(wrap_angle(match.pose.theta - truth.theta)),
                match.evaluations,
                seconds * 1e3,
            )
            for match, truth, seconds in matches
        ]
        table = np.array(rows, dtype=np.float64).reshape(-1, 5)
        return Tally(table[:, :2], table[:, 2], table[:, 3].astype(np.int64), table[:, 4])

    @property
    def metres(self) -> F64:
        """Distance of each match from the truth."""
        return np.hypot(self.xy_m[:, 0], self.xy_m[:, 1])

    def success(self, metres: float, degrees: float) -> float:
        """Part of the matches that are nearer than both."""
        return float(((self.metres < metres) & (np.abs(self.degrees) < degrees)).mean())

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return {
            "error_m": spread(self.metres),
            "error_deg": spread(np.abs(self.degrees)),
            "evaluations": spread(self.evaluations.astype(np.float64)),
            "ms": spread(self.ms),
        }


def spread(values: F64) -> dict[str, float]:
    """Mean, median, 95th percentile and maximum."""
    return {
        "mean": float(values.mean()),
        "median": float(np.median(values)),
        "p95": float(np.percentile(values, 95)),
        "max": float(values.max()),
    }
