"""Noise of a reference, from sample to sample: no estimate can have a smaller error against it.

    python benchmarks/reference_noise.py results/run [--t-offset S]

`results/run` is a folder with `trajectory.tum`, `odometry.tum` and `reference.tum`. Over a second odometry errs by
millimetres: it is fitted to the reference in short windows, without the sample in their middle, and what that sample is
off is the reference's noise, and a little of the odometry's. `--t-offset` is added to the reference's stamps; without
it the offset is searched for at which they agree best.

Then the errors of trajectory and odometry are parted, each fitted to the reference as a whole: a mean over 1.5 s is the
slow part, the rest the fast. The odometry knows nothing of the scans: where the fast parts of both are the same motion
(correlation near 1), it is the reference's, and no trajectory can have less than its rms.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hsloc.trajectory_io.reader import read_trajectory

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hsloc.model import Trajectory

    F64 = NDArray[np.float64]

OFFSETS_S = np.arange(-0.3, 0.305, 0.01)
SLOW_S = 1.5
"""Width (s) of the mean that parts slow from fast: odometry errs by millimetres within it."""


def fitted(source: F64, target: F64, point: F64) -> F64:
    """A point (2,) moved as `source` (n, 2) fits `target` (n, 2) best: rotation and translation, least squares."""
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    angle = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b))
    c, s = np.cos(angle), np.sin(angle)
    moved: F64 = np.array(((c, -s), (s, c))) @ (point - source.mean(axis=0)) + target.mean(axis=0)
    return moved


def residuals(odometry: F64, reference: F64, half: int) -> F64:
    """Distances (m) of the samples in the middle of windows of `2 half + 1` samples."""
    found = []
    for k in range(half, len(reference) - half):
        others = np.r_[k - half : k, k + 1 : k + half + 1]
        found.append(fitted(odometry[others], reference[others], odometry[k]) - reference[k])
    return np.hypot(*np.array(found).T)


def parted(errors: F64, stamps_s: F64) -> tuple[F64, F64]:
    """Slow and fast part of errors (n, 2) at stamps (n,)."""
    slow = np.array([errors[np.abs(stamps_s - t) <= 0.5 * SLOW_S].mean(axis=0) for t in stamps_s])
    return slow, errors - slow


def rms_mm(errors: F64) -> float:
    """Root of the mean square of the lengths of errors (n, 2), in mm."""
    return float(1000.0 * np.sqrt(np.mean(np.sum(errors**2, axis=1))))


def main() -> None:
    """Print the noise in windows of several lengths, and the parts of the errors."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path)
    parser.add_argument("--t-offset", type=float)
    arguments = parser.parse_args()
    trajectory, odometry, reference = (
        read_trajectory(arguments.results / f"{name}.tum").trajectory
        for name in ("trajectory", "odometry", "reference")
    )
    t_reference = reference.stamps_ns / 1e9

    def sampled(source: Trajectory, offset_s: float) -> tuple[F64, F64, F64]:
        """Positions of a trajectory and of the reference (n, 2) at the reference's stamps (n,)."""
        at, t = t_reference + offset_s, source.stamps_ns / 1e9
        inside = (at >= max(odometry.stamps_ns[0], trajectory.stamps_ns[0]) / 1e9) & (
            at <= min(odometry.stamps_ns[-1], trajectory.stamps_ns[-1]) / 1e9
        )
        both = [np.interp(at[inside], t, source.poses[:, k]) for k in (0, 1)]
        return np.column_stack(both), reference.poses[inside, :2], at[inside]

    offset = arguments.t_offset
    if offset is None:
        offset = min(
            OFFSETS_S.tolist(), key=lambda each: float(np.mean(residuals(*sampled(odometry, each)[:2], 16) ** 2))
        )
    print(f"offset {offset:+.2f} s, {len(reference)} samples, one in {np.median(np.diff(t_reference)):.3f} s")
    for half in (4, 8, 16):
        apart = residuals(*sampled(odometry, offset)[:2], half)
        rms = float(np.sqrt(np.mean(apart**2)))
        # Of n samples that are as noisy the fit of three numbers leaves a noise of its own.
        noise = rms / np.sqrt(1.0 + 1.5 / (2 * half))
        print(f"windows of {2 * half + 1:>2} samples: off by {1000 * rms:.1f} mm rms, noise {1000 * noise:.1f} mm")
    fast_parts: list[F64] = []
    for name, source in (("trajectory", trajectory), ("odometry", odometry)):
        points, truth, stamps = sampled(source, offset)
        errors = np.array([fitted(points, truth, point) for point in points]) - truth
        slow, fast = parted(errors, stamps)
        fast_parts.append(fast)
        print(f"{name}: off by {rms_mm(errors):.1f} mm rms, slow part {rms_mm(slow):.1f}, fast {rms_mm(fast):.1f} mm")
    ours, raw = fast_parts
    correlation = float(np.corrcoef(ours.ravel(), raw.ravel())[0, 1])
    print(f"fast parts of both: correlation {correlation:.3f}, {rms_mm(ours - raw):.1f} mm rms apart")


if __name__ == "__main__":
    main()
