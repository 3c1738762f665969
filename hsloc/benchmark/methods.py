"""What is put side by side on the matching cases: our matchers, and peers that are installed.

The peers that search get the same compiled fitness over all points of the scan and the same window, and begin with
candidates of their own: given the prediction among them they do a little worse. What is compared is the search.
small_gicp pairs points and knows no window.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np

from hsloc.errors import install_hint
from hsloc.kernels.fitness import fitness_many, score_sum
from hsloc.matching import HarmonySearch, Hide, LikelihoodField
from hsloc.model import Pose2
from hsloc.model.pose2 import wrap_angle

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from hsloc.matching import Window
    from hsloc.model import OccupancyGrid

    F64 = NDArray[np.float64]

BUDGET = 2000
"""Fitness evaluations of the peers that search, about."""


class Method(Protocol):
    """Matches a scan; made once for a map, which is not timed."""

    @property
    def name(self) -> str:
        """In the table."""
        ...

    def match(self, points: F64, window: Window, seed: int) -> tuple[Pose2, int]:
        """The pose, and the fitness evaluations (0: does not count any)."""
        ...


def our_methods(grid: OccupancyGrid) -> list[Method]:
    """HIDE and Harmony Search with the default preset, HIDE with [M]'s parameters read in proportion."""
    field = LikelihoodField.from_grid(grid)
    return [Ours("HIDE", Hide(), field), Ours("HS", HarmonySearch(), field), Ours("HIDE, paper", Hide.paper(), field)]


def peers(grid: OccupancyGrid) -> tuple[list[Method], list[str]]:
    """Those that are installed, and a line for each that is not."""
    field = LikelihoodField.from_grid(grid)
    methods: list[Method] = [
        ScipyEvolution("scipy DE, 2000 evaluations", field, is_fixed=True),
        ScipyEvolution("scipy DE, its defaults", field, is_fixed=False),
    ]
    missing = []
    makers: tuple[tuple[str, Callable[[Any], list[Method]]], ...] = (
        ("mealpy", lambda module: [MealpyHarmonySearch(module, field)]),
        ("small_gicp", lambda module: [SmallGicp(module, kind, grid) for kind in ("ICP", "PLANE_ICP")]),
    )
    for name, make in makers:
        try:
            module = importlib.import_module(name)
        except ImportError:
            missing.append(f"{name} is not installed and was left out; {install_hint('bench')} brings it")
        else:
            methods += make(module)
    return methods, missing


class Ours:
    """A matcher of ours."""

    def __init__(self, name: str, matcher: HarmonySearch, field: LikelihoodField) -> None:
        self.name, self._matcher, self._field = name, matcher, field

    def match(self, points: F64, window: Window, seed: int) -> tuple[Pose2, int]:
        """See `Method`."""
        match = self._matcher.match(points, self._field, window, np.random.default_rng(seed))
        return match.pose, match.evaluations


class _Objective:
    """Minus the fitness as a function of how far a pose is from the window's centre (m, m, rad); counts its calls."""

    def __init__(self, field: LikelihoodField, points: F64, window: Window) -> None:
        self._packed, self._scaled, self._scale = field.packed, field.scale(points), field.resolution
        self._x, self._y, self._theta = field.to_cells(window.centre).tolist()
        self._count = max(len(points), 1)
        self.calls = 0

    def __call__(self, offset: F64) -> float:
        self.calls += 1
        # Plain floats: with numpy's own scalars the call would cost the peer half as much again.
        x, y, theta = offset.tolist()
        x, y, theta = self._x + x / self._scale, self._y + y / self._scale, self._theta + theta
        return -score_sum(self._packed, self._scaled, x, y, theta, -2.0) / self._count

    def many(self, offsets: F64) -> F64:
        """Of offsets (3, k) at once, shape (k,)."""
        self.calls += offsets.shape[1]
        scale = np.array((1.0 / self._scale, 1.0 / self._scale, 1.0))
        poses = offsets.T * scale + (self._x, self._y, self._theta)
        return -fitness_many(self._packed, self._scaled, poses)


def _moved(window: Window, offset: F64) -> Pose2:
    centre = window.centre
    return Pose2(centre.x + float(offset[0]), centre.y + float(offset[1]), wrap_angle(centre.theta + float(offset[2])))


class ScipyEvolution:
    """scipy.optimize.differential_evolution: as it comes, or in its fastest form with a fixed number of evaluations.

    The fastest form evaluates a whole generation of 45 rows in one call; it takes a third of the time.
    """

    _FIXED: ClassVar = {
        "popsize": 15, "maxiter": BUDGET // 45 - 1, "tol": 0.0, "polish": False, "vectorized": True,
        "updating": "deferred",
    }  # fmt: skip

    def __init__(self, name: str, field: LikelihoodField, *, is_fixed: bool) -> None:
        from scipy.optimize import differential_evolution

        self.name, self._field, self._is_fixed = name, field, is_fixed
        self._solve: Any = differential_evolution

    def match(self, points: F64, window: Window, seed: int) -> tuple[Pose2, int]:
        """See `Method`."""
        objective = _Objective(self._field, points, window)
        half = window.half_widths()
        bounds = list(zip(-half, half, strict=True))
        rng = np.random.default_rng(seed)
        if self._is_fixed:
            found = self._solve(objective.many, bounds, rng=rng, **self._FIXED)
        else:
            found = self._solve(objective, bounds, rng=rng)
        return _moved(window, found.x), objective.calls


class MealpyHarmonySearch:
    """mealpy's OriginalHS, with 30 rows and the rates of [M], with which it does better than with its own.

    PAR is constant there: the middle of 0.55 -> 0.98.
    """

    name = "mealpy OriginalHS, 2000 evaluations"

    def __init__(self, module: Any, field: LikelihoodField) -> None:
        self._module, self._field = module, field
        self._search: Any = module.HS.OriginalHS

    def match(self, points: F64, window: Window, seed: int) -> tuple[Pose2, int]:
        """See `Method`."""
        objective = _Objective(self._field, points, window)
        half = window.half_widths()
        # The bounds lie about zero: OriginalHS samples the pitch around their middle.
        problem = {
            "obj_func": objective,
            "bounds": self._module.FloatVar(lb=tuple(-half), ub=tuple(half)),
            "minmax": "min",
            "log_to": None,
        }
        model = self._search(epoch=BUDGET // 30, pop_size=30, c_r=0.88, pa_r=0.765)
        best = model.solve(problem, seed=seed)
        return _moved(window, best.solution), objective.calls


class SmallGicp:
    """small_gicp on the map's occupied cells, one thread; starts at the window's centre."""

    def __init__(self, module: Any, kind: str, grid: OccupancyGrid) -> None:
        self.name = f"small_gicp {kind}"
        self._module, self._kind = module, kind
        walls = grid.centres(grid.occupied())
        # In a plane of points every normal is upright: for normals in the plane the walls need some height.
        heights = (0.0,) if kind == "ICP" else (-2.0 * grid.resolution, 0.0, 2.0 * grid.resolution)
        self._target = module.PointCloud(np.vstack([_at_height(walls, height) for height in heights]))
        self._tree = module.KdTree(self._target)
        if kind != "ICP":
            module.estimate_normals_covariances(self._target, self._tree, num_neighbors=12)

    def match(self, points: F64, window: Window, seed: int) -> tuple[Pose2, int]:
        """See `Method`."""
        source = self._module.PointCloud(_at_height(points, 0.0))
        pose = window.centre
        c, s = np.cos(pose.theta), np.sin(pose.theta)
        start = np.array(((c, -s, 0.0, pose.x), (s, c, 0.0, pose.y), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
        found = self._module.align(
            self._target,
            source,
            self._tree,
            start,
            registration_type=self._kind,
            max_correspondence_distance=max(1.0, window.half_x),
            max_iterations=100,
        ).T_target_source
        return Pose2(float(found[0, 3]), float(found[1, 3]), float(np.arctan2(found[1, 0], found[0, 0]))), 0


def _at_height(points: F64, height: float) -> F64:
    return np.column_stack((points, np.full(len(points), height)))
