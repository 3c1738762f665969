"""A trajectory: stamped poses in one frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from hsloc.errors import HslocError
from hsloc.model.pose2 import Pose2, wrap_angles

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Trajectory:
    """Stamped poses of the robot base: `stamps_ns` int64 (n,), `poses` float64 (n, 3) of x, y, theta.

    The stamps are those of the log, in the order of the log: they may repeat and even run backwards, where the
    log's do. `sorted()` gives them in order of time.
    """

    stamps_ns: NDArray[np.int64]
    poses: NDArray[np.float64]

    def __post_init__(self) -> None:
        if self.stamps_ns.ndim != 1 or self.poses.shape != (len(self.stamps_ns), 3):
            raise ValueError(f"stamps {self.stamps_ns.shape} and poses {self.poses.shape} do not belong together")

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __repr__(self) -> str:
        span = float(self.stamps_ns.max() - self.stamps_ns.min()) / 1e9 if len(self) else 0.0
        return f"<Trajectory: {len(self)} poses, {self.length():.2f} m, {span:.2f} s>"

    @staticmethod
    def from_pairs(pairs: Iterable[tuple[int, Pose2]]) -> Trajectory:
        """From (stamp_ns, pose) pairs."""
        rows = [(stamp, pose.x, pose.y, pose.theta) for stamp, pose in pairs]
        stamps = np.array([row[0] for row in rows], dtype=np.int64)
        return Trajectory(stamps, np.array([row[1:] for row in rows], dtype=np.float64).reshape(-1, 3))

    def sorted(self) -> Trajectory:
        """In order of time; poses with the same stamp stay in their order."""
        order = np.argsort(self.stamps_ns, kind="stable")
        return Trajectory(self.stamps_ns[order], self.poses[order])

    def interpolated(self, stamps_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Poses at other stamps, linear between neighbours and held at the ends, shape (m, 3).

        Of several poses with one stamp, the last counts.
        """
        ordered = self.sorted()
        keep = np.append(np.diff(ordered.stamps_ns) > 0, True)
        times, poses = ordered.stamps_ns[keep], ordered.poses[keep]
        after = np.clip(np.searchsorted(times, stamps_ns, side="left"), 1, max(len(times) - 1, 1))
        before, after = (after - 1, after) if len(times) > 1 else (after * 0, after * 0)
        span = np.maximum(times[after] - times[before], 1)
        fraction = np.clip((stamps_ns - times[before]) / span, 0.0, 1.0)[:, None]
        delta = poses[after] - poses[before]
        delta[:, 2] = wrap_angles(delta[:, 2])
        result: NDArray[np.float64] = poses[before] + fraction * delta
        result[:, 2] = wrap_angles(result[:, 2])
        return result

    def to_frame(self) -> Any:
        """A pandas.DataFrame with the columns stamp_ns, x, y (m) and theta (rad), a row for each pose.

        Raises HslocError where pandas is not installed; hsloc itself does not need it.
        """
        try:
            import pandas as pd
        except ImportError as error:
            raise HslocError("to_frame needs pandas; install it, or use stamps_ns and poses") from error
        x, y, theta = self.poses.T
        return pd.DataFrame({"stamp_ns": self.stamps_ns, "x": x, "y": y, "theta": theta})

    def length(self) -> float:
        """Length of the path in metres."""
        return float(np.hypot(*np.diff(self.poses[:, :2], axis=0).T).sum())
