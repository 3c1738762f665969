"""(a) One look-up in the interpolated field, and (b) one match with a fixed number of evaluations."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import radians
from typing import TYPE_CHECKING

import numpy as np

from hsloc.benchmark.clock import Timing, measure
from hsloc.kernels.fitness import fitness_many
from hsloc.matching import HarmonySearch, Hide, Window
from hsloc.model import Pose2

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.benchmark.scene import Scene

EVALUATIONS = 280
"""Of the match that is timed: what [M] spends on one, and a third on top."""
WINDOW = (0.3, 0.3, radians(10.0))
POSES = 2000


@dataclass(frozen=True, slots=True)
class KernelTiming:
    """Nanoseconds per point and evaluation, every point of every pose looked up (no pose is given up early).

    `near` poses lie in one window, as those of a search do; `far` ones anywhere on the map, so that the field is
    not in the cache.
    """

    points: int
    poses: int
    near: Timing
    far: Timing

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        factor = 1e9 / (self.points * self.poses)
        return {
            "points": self.points,
            "poses": self.poses,
            "ns_per_point": self.near.to_dict(factor),
            "ns_per_point_anywhere": self.far.to_dict(factor),
        }


def time_kernel(scene: Scene, repeats: int) -> KernelTiming:
    """Time the compiled kernel, called once for `POSES` poses."""
    rng = np.random.default_rng(0)
    field, scaled = scene.field, scene.field.scale(scene.points)
    half = np.array(WINDOW) / (field.resolution, field.resolution, 1.0)
    near = field.to_cells(scene.truth) + rng.uniform(-1.0, 1.0, (POSES, 3)) * half
    height, width = field.packed.shape[:2]
    far = rng.uniform((0.0, 0.0, -np.pi), (width, height, np.pi), (POSES, 3))

    def run(poses: NDArray[np.float64]) -> Timing:
        return measure(lambda: fitness_many(field.packed, scaled, poses), repeats)

    return KernelTiming(len(scaled), POSES, run(near), run(far))


@dataclass(frozen=True, slots=True)
class MatchTiming:
    """Milliseconds of one match of the scene, through the public interface."""

    name: str
    beams: int
    evaluations: int
    timing: Timing

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return {
            "name": self.name,
            "beams": self.beams,
            "evaluations": self.evaluations,
            "ms": self.timing.to_dict(1e3),
        }


def time_matches(scene: Scene, repeats: int) -> tuple[MatchTiming, ...]:
    """HIDE with exactly `EVALUATIONS` evaluations on all beams, and both matchers with their defaults.

    Each repeat has another seed, the same for all three.
    """
    truth = scene.truth
    window = Window(Pose2(truth.x + 0.1, truth.y - 0.15, truth.theta + 0.08), *WINDOW)
    # The last of them is the look at all points that ends every match.
    plain = replace(Hide.paper(), budget=EVALUATIONS - 1)
    searches = (
        (f"HIDE, {EVALUATIONS} evaluations", plain),
        ("HIDE, default", Hide()),
        ("HS, default", HarmonySearch()),
    )
    return tuple(_time_match(name, search, scene, window, repeats) for name, search in searches)


def _time_match(name: str, search: HarmonySearch, scene: Scene, window: Window, repeats: int) -> MatchTiming:
    spent: list[int] = []

    def match() -> None:
        rng = np.random.default_rng(len(spent))
        spent.append(search.match(scene.points, scene.field, window, rng).evaluations)

    timing = measure(match, repeats)
    return MatchTiming(name, len(scene.points), int(np.median(spent)), timing)
