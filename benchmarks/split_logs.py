"""Real logs that are split: a map is built from one part, the robot localised in another from an unknown start.

    python benchmarks/split_logs.py [--data FOLDER] [--cache FOLDER] [--rows FILE] [--splits N ...] [LOG ...]

The reference is the trajectory of the map of the whole log, aligned with that of the part that is mapped. A claim is a
pose that is called localised; it is false where the pose is off by more than 2 m or 20 deg. A pose is on mapped ground
where its cell on the map of the part is free. From outside, a robot may see mapped walls and be localised by right: a
claim off mapped ground is unfounded where it is false, or where most beams of the scan end where nothing is mapped. A
line for each run: how much of it is on mapped ground, the share of its poses that is claimed, of the claims those that
are false, of the poses off mapped ground those that are claimed and those of which the claim is unfounded, the 95 %
quantile of the errors of the claims there (m), of the poses on mapped ground those that are not claimed, and the first
claim (s).
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.ndimage import binary_dilation

from hsloc import RunRequest, run
from hsloc.evaluation.alignment import align
from hsloc.log import ReadOptions, open_log
from hsloc.maps import load_map, save_map
from hsloc.model import OccupancyGrid, Pose2, Scan, Trajectory, wrap_angles
from hsloc.model.pose2 import compose_poses

if TYPE_CHECKING:
    from numpy.typing import NDArray

FALSE_M, FALSE_RAD = 2.0, np.radians(20.0)
BESIDE_M = 0.25
"""A beam ends where something is mapped if that is so within this distance (m): what is behind a wall is not mapped,
and two maps of a log differ by some cells."""


@dataclass(frozen=True)
class Recording:
    """A log, and where its laser is on the base."""

    path: str
    laser_pose: Pose2 | None = None


LOGS = {
    "intel": Recording("intel/intel.clf.gz"),
    "fr079": Recording("fr079/fr079.clf.gz", Pose2(-0.04, 0.0, 0.0)),
    "aces": Recording("aces/aces.clf.gz"),
    "seattle": Recording("seattle/seattle.clf.gz"),
    "orebro": Recording("orebro/orebro.clf.gz"),
}
Part = tuple[float, float]
SPLITS: tuple[tuple[Part, Part], ...] = (
    ((0.0, 0.5), (0.5, 1.0)),
    ((0.5, 1.0), (0.0, 0.5)),
    ((0.0, 0.3), (0.3, 0.6)),
    ((0.3, 0.6), (0.6, 0.9)),
    ((0.6, 0.9), (0.0, 0.3)),
    ((0.25, 0.75), (0.0, 0.5)),
    ((0.0, 0.7), (0.7, 1.0)),
    ((0.1, 0.3), (0.3, 0.9)),
)
"""Shares of the time of a log: what is mapped, and where the robot is localised."""


def lies_in(mask: NDArray[np.bool_], grid: OccupancyGrid, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which of the points (n, 2) of the map are in cells of a mask."""
    cells = np.floor((grid.origin.inverse() @ points) / grid.resolution).astype(np.int64)
    height, width = mask.shape
    inside = (cells >= 0).all(axis=1) & (cells < (width, height)).all(axis=1)
    result = np.zeros(len(points), dtype=np.bool_)
    result[inside] = mask[cells[inside, 1], cells[inside, 0]]
    return result


class SplitLog:
    """A log, whose maps are kept in a folder."""

    def __init__(self, name: str, data: Path, cache: Path) -> None:
        self._path = data / LOGS[name].path
        self._read = ReadOptions(laser_pose=LOGS[name].laser_pose)
        self._cache = cache / name
        self._seconds = open_log(self._path, self._read).summary.duration_s
        self.reference = self._mapped((0.0, 1.0))[1]

    def _request(self, part: Part, **others: Any) -> RunRequest:
        read = replace(self._read, start_s=part[0] * self._seconds, end_s=part[1] * self._seconds)
        return RunRequest(logs=(self._path,), read=self._read if part == (0.0, 1.0) else read, **others)

    def _mapped(self, part: Part) -> tuple[Path, Trajectory]:
        folder = self._cache / f"{part[0]:.2f}-{part[1]:.2f}"
        if not (folder / "trajectory.npz").exists():
            folder.mkdir(parents=True, exist_ok=True)
            built = run(self._request(part, mode="slam"))
            save_map(built.grid, folder)
            np.savez(folder / "trajectory.npz", stamps=built.trajectory.stamps_ns, poses=built.trajectory.poses)
        with np.load(folder / "trajectory.npz") as file:
            return folder / "map.yaml", Trajectory(file["stamps"], file["poses"])

    def measure(self, mapped: Part, part: Part, seed: int = 0) -> dict[str, Any]:
        """Localise in a part on the map of another."""
        path, trajectory = self._mapped(mapped)
        T_map_reference = align(trajectory.poses, self.reference.interpolated(trajectory.stamps_ns), "se2")
        found = run(self._request(part, map_path=path, unknown_start=True, seed=seed))
        truth = compose_poses(T_map_reference.to_array(), self.reference.interpolated(found.trajectory.stamps_ns))
        off = found.trajectory.poses - truth
        is_false = (np.hypot(off[:, 0], off[:, 1]) > FALSE_M) | (np.abs(wrap_angles(off[:, 2])) > FALSE_RAD)
        grid = load_map(path)
        mapped_ground = lies_in(grid.free(), grid, truth[:, :2])
        unseen = self._unmapped(part, grid, Trajectory(found.trajectory.stamps_ns, truth)) > 0.5
        claimed = found.localised
        off_map = ~mapped_ground
        off_claims = claimed & off_map
        unfounded = off_claims & (is_false | unseen)
        seconds = (found.trajectory.stamps_ns - found.trajectory.stamps_ns[0]) * 1e-9
        return {
            "mapped": mapped,
            "part": part,
            "poses": len(claimed),
            "on_map": float(mapped_ground.mean()),
            "claimed": float(claimed.mean()),
            "false": float((claimed & is_false).sum()) / max(int(claimed.sum()), 1),
            "claimed_off_map": float(off_claims.sum()) / max(int(off_map.sum()), 1),
            "unfounded_off_map": float(unfounded.sum()) / max(int(off_map.sum()), 1),
            "off_map_error": float(np.percentile(np.hypot(*off[off_claims, :2].T), 95.0)) if off_claims.any() else 0.0,
            "not_claimed_on_map": float((~claimed & mapped_ground).sum()) / max(int(mapped_ground.sum()), 1),
            "first_claim_s": float(seconds[claimed][0]) if claimed.any() else float("nan"),
            "claims": int(claimed.sum()),
            "false_claims": int((claimed & is_false).sum()),
            "off_map_claims": int(off_claims.sum()),
            "unfounded_claims": int(unfounded.sum()),
            "off_map_poses": int(off_map.sum()),
        }

    def _unmapped(self, part: Part, grid: OccupancyGrid, truth: Trajectory) -> NDArray[np.float64]:
        """Of the scan nearest in time to each pose, at its place: the share of beams ending where nothing is mapped."""
        mapped = binary_dilation(grid.cells >= 0, iterations=round(BESIDE_M / grid.resolution))
        scans = [each for each in open_log(self._path, self._request(part).read).events() if isinstance(each, Scan)]
        scans.sort(key=lambda scan: scan.stamp_ns)
        stamps, shares = np.array([scan.stamp_ns for scan in scans]), np.ones(len(scans))
        for k, (scan, pose) in enumerate(zip(scans, truth.interpolated(stamps), strict=True)):
            ends = Pose2.from_array(pose) @ scan.points_base()
            shares[k] = 1.0 - lies_in(mapped, grid, ends).mean() if len(ends) else 1.0
        after = np.clip(np.searchsorted(stamps, truth.stamps_ns), 1, len(stamps) - 1)
        apart = np.abs(stamps[[after - 1, after]] - truth.stamps_ns)
        nearest: NDArray[np.float64] = shares[after - (apart[0] < apart[1])]
        return nearest


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--cache", type=Path, default=Path("build/split_logs"), help="folder that maps are kept in")
    parser.add_argument("--splits", type=int, nargs="+", default=list(range(len(SPLITS))), help="of SPLITS, from 0")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rows", type=Path, help="a file to which a line of JSON is added for each run")
    parser.add_argument("logs", nargs="*", metavar="LOG", help=f"of {', '.join(LOGS)}")
    arguments = parser.parse_args()
    print("log, mapped, localised in; on mapped ground, claimed, claims false, off the map claimed, and unfounded,")
    print("not claimed on the map (all in %), first claim (s), error of the claims off the map (m)")
    rows = []
    for name in arguments.logs or LOGS:
        log = SplitLog(name, arguments.data, arguments.cache)
        for k in arguments.splits:
            row = {"log": name, **log.measure(*SPLITS[k], seed=arguments.seed)}
            rows.append(row)
            off_map = ("claimed_off_map", "unfounded_off_map")
            shares = (row[key] for key in ("on_map", "claimed", "false", *off_map, "not_claimed_on_map"))
            (a, b), (c, d) = SPLITS[k]
            text = " ".join(f"{100.0 * share:6.1f}" for share in shares)
            print(f"{name:8s} {a:.2f}-{b:.2f} {c:.2f}-{d:.2f} {text} ", end="")
            print(f"{row['first_claim_s']:7.1f} {row['off_map_error']:5.2f}", flush=True)
            if arguments.rows:
                with arguments.rows.open("a") as file:
                    file.write(json.dumps(row) + "\n")
    claims, off = sum(row["claims"] for row in rows), sum(row["off_map_poses"] for row in rows)
    false = sum(row["false_claims"] for row in rows)
    print(f"all: {len(rows)} runs, {claims} claims, {100.0 * false / max(claims, 1):.2f} % false; ", end="")
    of_off = [100.0 * sum(row[key] for row in rows) / max(off, 1) for key in ("off_map_claims", "unfounded_claims")]
    print(f"of the poses off the map {of_off[0]:.2f} % claimed, {of_off[1]:.2f} % unfounded")


if __name__ == "__main__":
    main()
