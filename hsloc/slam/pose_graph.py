"""The pose graph: keyscans as nodes, measured relative poses as edges; `.g2o` in and out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hsloc.errors import LogFormatError, OutputError, not_read, not_written
from hsloc.kernels.normal_equations import Equations, add_edges
from hsloc.model.pose2 import pose_differences, relative_poses, wrap_angles
from hsloc.slam.sparse_solver import BlockSystem

if TYPE_CHECKING:
    from numpy.typing import NDArray

    F64 = NDArray[np.float64]
    I64 = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Edges:
    """Measured relative poses: `measured` (m, 3) of node pairs[:, 1] seen from node pairs[:, 0].

    `information` (m, 3, 3) is the inverse covariance in the frame of the first; `scale` (m,) is that of
    Cauchy's weight on chi, infinite where an edge is trusted.
    """

    pairs: I64
    measured: F64
    information: F64
    scale: F64

    def __len__(self) -> int:
        return len(self.pairs)

    def __getitem__(self, part: slice) -> Edges:
        return Edges(self.pairs[part], self.measured[part], self.information[part], self.scale[part])

    @staticmethod
    def none() -> Edges:
        """No edges."""
        return Edges(np.zeros((0, 2), dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0))

    @staticmethod
    def chain(measured: F64, covariances: F64, uncertain: NDArray[np.bool_] | None = None) -> Edges:
        """Edges from each node to the next: `measured` (n - 1, 3) with covariances (n - 1, 3, 3).

        They are trusted, but for those `uncertain` (n - 1,), which may tear (Cauchy's weight with scale 1).
        """
        first = np.arange(len(measured))
        information: F64 = np.asarray(np.linalg.inv(covariances), dtype=np.float64)
        scale = np.full(len(first), np.inf) if uncertain is None else np.where(uncertain, 1.0, np.inf)
        return Edges(np.column_stack((first, first + 1)), measured, information, scale)

    @staticmethod
    def concatenate(parts: list[Edges]) -> Edges:
        """Several sets as one."""
        return Edges(
            np.concatenate([part.pairs for part in parts]),
            np.concatenate([part.measured for part in parts]),
            np.concatenate([part.information for part in parts]),
            np.concatenate([part.scale for part in parts]),
        )


@dataclass(frozen=True, slots=True, eq=False)
class PoseGraph:
    """Nodes at `poses` (n, 3), stamped, and the edges between them."""

    stamps_ns: I64
    poses: F64
    edges: Edges

    def optimised(self, rounds: int = 20) -> PoseGraph:
        """The graph with its poses moved to where the edges agree best."""
        return PoseGraph(self.stamps_ns, solve_edges(self.poses, self.edges, rounds), self.edges)

    def write_g2o(self, path: str | Path) -> None:
        """Write `VERTEX_SE2`, `FIX` of the first, and `EDGE_SE2` lines. Raises OutputError.

        The information of a g2o edge is that of the second node seen from where it was measured: turned by that pose.
        """
        lines = [f"VERTEX_SE2 {k} {x!r} {y!r} {t!r}" for k, (x, y, t) in enumerate(self.poses.tolist())]
        lines.append("FIX 0")
        upper = np.triu_indices(3)
        information = _turned(self.edges.information, self.edges.measured[:, 2])[:, upper[0], upper[1]]
        numbers = np.concatenate((self.edges.measured, information), axis=1)
        form = "EDGE_SE2 %d %d %.9f %.9f %.12f" + " %.9g" * 6
        columns = (*self.edges.pairs.T.tolist(), *numbers.T.tolist())
        # Mapped over the columns: a line in a loop of its own takes twice as long, and edges are many.
        lines += map(form.__mod__, zip(*columns, strict=True))
        try:
            Path(path).write_text("\n".join(lines) + "\n", encoding="ascii")
        except OSError as error:
            raise OutputError(not_written(path, error)) from error

    @staticmethod
    def read_g2o(path: str | Path) -> PoseGraph:
        """Read a planar graph; nodes are numbered in the order of the file, stamps are zero, edges trusted.

        Lines other than VERTEX_SE2 and EDGE_SE2 are passed over. Raises LogFormatError that names the line.
        """
        path = Path(path)
        try:
            text = path.read_text(encoding="utf-8", errors="replace")
        except OSError as error:
            raise LogFormatError(not_read(path, error)) from error
        index: dict[str, int] = {}
        poses: list[list[float]] = []
        edges: list[tuple[str, str, list[float]]] = []
        for number, line in enumerate(text.splitlines(), 1):
            fields = line.split()
            try:
                if fields[:1] == ["VERTEX_SE2"]:
                    index[fields[1]] = len(poses)
                    poses.append(_numbers(fields[2:], 3))
                elif fields[:1] == ["EDGE_SE2"]:
                    edges.append((fields[1], fields[2], _numbers(fields[3:], 9)))
            except (ValueError, IndexError) as error:
                raise LogFormatError(f"{path}, line {number}: not a g2o line of SE2: {error}") from None
        unknown = [name for first, second, _ in edges for name in (first, second) if name not in index]
        if unknown or not poses:
            what = f"an edge names the vertex {unknown[0]}, which is not there" if unknown else "no VERTEX_SE2"
            raise LogFormatError(f"{path}: {what}")
        measured = np.array([numbers[:3] for _, _, numbers in edges]).reshape(-1, 3)
        information = np.zeros((len(edges), 3, 3))
        rows, columns = np.triu_indices(3)
        for k, (_, _, numbers) in enumerate(edges):
            information[k, rows, columns] = information[k, columns, rows] = numbers[3:]
        information = _turned(information, -measured[:, 2])
        pairs = np.array([(index[a], index[b]) for a, b, _ in edges], dtype=np.int64).reshape(-1, 2)
        trusted = np.full(len(edges), np.inf)
        stamps = np.zeros(len(poses), dtype=np.int64)
        return PoseGraph(stamps, np.array(poses), Edges(pairs, measured, information, trusted))


def solve_edges(
    poses: F64, edges: Edges, rounds: int = 20, still: float = 1e-5, widened: tuple[float, ...] = ()
) -> F64:
    """Gauss-Newton on a pose graph, robust weights recomputed in each round; the first pose stays.

    In the first rounds the scales of the robust weights are multiplied by `widened`, so that edges which are far off at
    the start pull at all (graduated non-convexity, Yang et al. 2020).

    Ends when no pose moves farther than `still` (m; rad).
    """
    if len(edges) == 0:
        return poses.copy()
    poses = poses.copy()
    system = BlockSystem(len(poses), edges.pairs[:, 0], edges.pairs[:, 1])
    blocks = np.empty((len(edges), 3, 3))
    for k in range(rounds):
        diagonal, right = np.zeros((len(poses), 3, 3)), np.zeros((len(poses), 3))
        scale = edges.scale * widened[k] if k < len(widened) else edges.scale
        equations = Equations(diagonal, blocks, right)
        add_edges(poses, edges.pairs, edges.measured, edges.information, scale, equations)
        step = solve_anchored(system, diagonal, blocks, right)
        poses = apply_increment(poses, step)
        if np.abs(step).max() < still and k >= len(widened):
            break
    return poses


def solve_anchored(system: BlockSystem, diagonal: F64, off_diagonal: F64, gradient: F64) -> F64:
    """The Gauss-Newton step (n, 3) that leaves the first pose where it is."""
    return -system.solve(anchored(diagonal), off_diagonal, gradient)


def anchored(diagonal: F64) -> F64:
    """The blocks on the diagonal (n, 3, 3) with the first pose held, and the others where nothing else holds them."""
    held = diagonal + 1e-3 * np.eye(3)
    held[0] += 1e9 * np.eye(3)
    return held


def apply_increment(poses: F64, step: F64) -> F64:
    """Poses after a step, both (n, 3), theta wrapped."""
    moved = poses + step
    moved[:, 2] = wrap_angles(moved[:, 2])
    return moved


def edge_errors(poses: F64, edges: Edges) -> tuple[F64, F64, F64]:
    """Of each edge: distance (m) and angle (rad) between what was measured and what is, and chi."""
    if len(edges) == 0:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    actual = relative_poses(poses[edges.pairs[:, 0]], poses[edges.pairs[:, 1]])
    error = pose_differences(actual, edges.measured)
    chi2 = np.einsum("mi,mij,mj->m", error, edges.information, error)
    return np.hypot(error[:, 0], error[:, 1]), np.abs(error[:, 2]), np.sqrt(np.maximum(chi2, 0.0))


def _turned(information: F64, angle: F64) -> F64:
    """Information (m, 3, 3) in frames that are turned by `angle` (m,)."""
    c, s, zero = np.cos(angle), np.sin(angle), np.zeros(len(angle))
    turn = np.stack((c, -s, zero, s, c, zero, zero, zero, zero + 1.0), axis=1).reshape(-1, 3, 3)
    turned: F64 = turn.transpose(0, 2, 1) @ information @ turn  # a third of what einsum takes for three factors
    return turned


def _numbers(fields: list[str], count: int) -> list[float]:
    numbers = [float(field) for field in fields]
    if len(numbers) != count or not all(np.isfinite(number) for number in numbers):
        raise ValueError(f"{count} finite numbers are wanted, {len(numbers)} stand there")
    return numbers


def compose_steps(steps: F64) -> F64:
    """Poses (n, 3) from the steps (n - 1, 3) between them; the first is the origin."""
    theta = np.concatenate(([0.0], np.cumsum(steps[:, 2])))
    c, s = np.cos(theta[:-1]), np.sin(theta[:-1])
    x = np.concatenate(([0.0], np.cumsum(c * steps[:, 0] - s * steps[:, 1])))
    y = np.concatenate(([0.0], np.cumsum(s * steps[:, 0] + c * steps[:, 1])))
    return np.column_stack((x, y, theta))
