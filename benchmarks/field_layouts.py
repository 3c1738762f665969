"""Why the field is packed: four coefficients side by side against four nodes in two rows of the grid.

    python benchmarks/field_layouts.py

Both are bilinear and give the same score; the same scan, the same poses, the kernel of hsloc/kernels/fitness.py against
a twin of it that reads the nodes. Times of one core, best of 30; run it where nothing else runs.
"""

from __future__ import annotations

from math import cos, radians, sin

import numpy as np
from numba import njit
from scipy.ndimage import distance_transform_edt

from hsloc.benchmark.clock import measure
from hsloc.benchmark.scene import office_scene
from hsloc.kernels.fitness import fitness_many
from hsloc.simulation.built_in import built_in

POSES = 2000


@njit
def fitness_of_nodes(nodes: np.ndarray, points: np.ndarray, poses: np.ndarray) -> np.ndarray:
    result = np.empty(len(poses), dtype=np.float64)
    limit_u, limit_v = np.float32(nodes.shape[1] - 1), np.float32(nodes.shape[0] - 1)
    for k in range(len(poses)):
        x, y = np.float32(poses[k, 0]), np.float32(poses[k, 1])
        c, s = np.float32(cos(poses[k, 2])), np.float32(sin(poses[k, 2]))
        total = 0.0
        for i in range(len(points)):
            u = x + c * points[i, 0] - s * points[i, 1]
            v = y + s * points[i, 0] + c * points[i, 1]
            if u >= np.float32(0.0) and u < limit_u and v >= np.float32(0.0) and v < limit_v:
                iu, iv = np.uint32(u), np.uint32(v)
                fu, fv = u - np.float32(iu), v - np.float32(iv)
                a, b = nodes[iv, iu], nodes[iv, iu + np.uint32(1)]
                d, e = nodes[iv + np.uint32(1), iu], nodes[iv + np.uint32(1), iu + np.uint32(1)]
                below, above = a + fu * (b - a), d + fu * (e - d)
                total += np.float64(below + fv * (above - below))
        result[k] = total / len(points)
    return result


def main() -> None:
    scene = office_scene()
    field = scene.field
    grid = built_in("office").occupancy_grid(0.05)
    pad = round((grid.origin.x - field.T_map_field.x) / grid.resolution + 0.5)
    distance = distance_transform_edt(~np.pad(grid.occupied(), pad)) * grid.resolution
    nodes = np.exp(-distance / field.sigma).astype(np.float32)
    points = field.scale(scene.points)
    half = np.array((0.3 / field.resolution, 0.3 / field.resolution, radians(10.0)))
    poses = field.to_cells(scene.truth) + np.random.default_rng(0).uniform(-1.0, 1.0, (POSES, 3)) * half
    np.testing.assert_allclose(
        fitness_of_nodes(nodes, points, poses), fitness_many(field.packed, points, poses), atol=1e-5
    )
    factor = 1e9 / (len(points) * POSES)
    for name, work, size in (
        ("packed coefficients", lambda: fitness_many(field.packed, points, poses), field.packed.nbytes),
        ("four nodes", lambda: fitness_of_nodes(nodes, points, poses), nodes.nbytes),
    ):
        timing = measure(work, 30)
        best, median = timing.best * factor, timing.median * factor
        print(f"{name:<20} best {best:.2f} ns, median {median:.2f} ns a point; {size / 2**20:.1f} MiB")


if __name__ == "__main__":
    main()
