"""Localisation under ordinary conditions of real hardware: wrong poses called localised, right ones that are not.

    python benchmarks/hardware.py [--seeds N ...] [--shapes SHAPE ...] [--starts START ...] [--rows FILE] [KIND ...]

Worlds and drives are those of `confusion.py`; each is written as a log with a map, as `hsloc replay` gets them. A line
for each run: the share of all poses that are wrong (by more than 0.25 m or 5 deg) and called localised, that of right
poses called anything else, the share of right ones, the verdict with the codes of its reasons, and other warnings.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import hardware_drives as drives
import hardware_surfaces as surfaces
import numpy as np
from confusion import SENSORS, SHAPES, drive_of, half, world_of
from false_certainty import mirrored
from PIL import Image
from scipy.ndimage import binary_dilation, map_coordinates

from hsloc import run
from hsloc.analysis.analyse import analyse
from hsloc.log import LogWriter, Transform3
from hsloc.maps import save_map
from hsloc.model import OccupancyGrid, Odometry, Pose2, Scan, wrap_angles
from hsloc.simulation import presets
from hsloc.simulation.scenario import Scenario

Change = Callable[[OccupancyGrid, np.random.Generator], OccupancyGrid]


def thick(grid: OccupancyGrid, rng: np.random.Generator) -> OccupancyGrid:
    """Walls 2 to 4 cells thick with ragged edges, and unknown within where they are thick."""
    walls = grid.cells >= grid.occupied_threshold
    near, next_to = binary_dilation(walls), binary_dilation(walls, iterations=2)
    noise = rng.random(walls.shape)
    drawn = walls | (near & (noise < 0.7)) | (next_to & (noise < 0.15))
    cells = np.where(drawn, 100, grid.cells).astype(np.int8)
    cells[walls & (rng.random(walls.shape) < 0.3)] = -1
    return replace(grid, cells=cells)


def speckled(grid: OccupancyGrid, rng: np.random.Generator) -> OccupancyGrid:
    """Ghosts of people: single occupied cells in open ground, and trails of them."""
    cells = grid.cells.copy()
    v, u = np.nonzero(grid.free())
    single = rng.choice(len(v), len(v) // 150, replace=False)
    cells[v[single], u[single]] = 100
    for k in rng.choice(len(v), 12):
        way = np.cumsum(rng.normal(0.0, 1.0, (60, 2)) + rng.normal(0.0, 2.0, 2), axis=0).astype(int)
        rows, columns = v[k] + way[:, 0], u[k] + way[:, 1]
        inside = (rows >= 0) & (columns >= 0) & (rows < cells.shape[0]) & (columns < cells.shape[1])
        cells[rows[inside], columns[inside]] = 100
    return replace(grid, cells=cells)


def edited(grid: OccupancyGrid, rng: np.random.Generator) -> OccupancyGrid:
    """Four rectangles are erased to unknown, and eight keep-out lines drawn black."""
    cells = grid.cells.copy()
    height, width = cells.shape
    for _ in range(4):
        v, u = rng.integers(height), rng.integers(width)
        cells[v : v + round(3.0 / grid.resolution), u : u + round(4.0 / grid.resolution)] = -1
    v, u = np.nonzero(grid.free())
    for k in rng.choice(len(v), 8):
        angle, along = rng.uniform(-np.pi, np.pi), np.arange(0.0, rng.uniform(1.0, 4.0) / grid.resolution, 0.5)
        rows, columns = (v[k] + along * np.sin(angle)).astype(int), (u[k] + along * np.cos(angle)).astype(int)
        inside = (rows >= 0) & (columns >= 0) & (rows < height) & (columns < width)
        cells[rows[inside], columns[inside]] = 100
    return replace(grid, cells=cells)


def bent(by: float) -> Change:
    """Parts of the map are beside their place, smoothly over some metres."""

    def change(grid: OccupancyGrid, rng: np.random.Generator) -> OccupancyGrid:
        v, u = np.indices(grid.cells.shape) * grid.resolution
        phase, length = rng.uniform(0.0, 2.0 * np.pi, 4), rng.uniform(9.0, 14.0, 4)
        rows = by * np.sin(2 * np.pi * u / length[0] + phase[0]) + 0.5 * by * np.sin(
            2 * np.pi * v / length[1] + phase[1]
        )
        columns = by * np.sin(2 * np.pi * v / length[2] + phase[2]) + 0.5 * by * np.sin(
            2 * np.pi * u / length[3] + phase[3]
        )
        at = np.array(((v + rows) / grid.resolution, (u + columns) / grid.resolution))
        cells = map_coordinates(grid.cells, at, order=0, mode="constant", cval=-1)
        return replace(grid, cells=cells)

    return change


def same(grid: OccupancyGrid, _: np.random.Generator) -> OccupancyGrid:
    return grid


def saved(grid: OccupancyGrid, style: str, folder: Path) -> Path:
    """The map as files: as hsloc writes it, with negate, or in shades of grey as cartographer draws it."""
    path = save_map(grid, folder / "map.yaml")
    if not style:
        return path
    image = np.asarray(Image.open(folder / "map.pgm")).copy()
    text = path.read_text()
    if style == "negate":
        image = np.where(image == 205, 205, 255 - image).astype(np.uint8)
        image[image == 205] = 128
        text = text.replace("negate: 0", "negate: 1")
        text = text.replace("free_thresh: 0.196", "free_thresh: 0.25")
    else:  # probabilities that are not certain: free 0.2 to 0.35, occupied 0.6 to 0.9
        rng = np.random.default_rng(0)
        image = np.where(image == 0, rng.integers(25, 100, image.shape), image)
        image = np.where(image == 254, rng.integers(210, 254, image.shape), image).astype(np.uint8)
        text = text.replace("mode: trinary", "mode: scale")
    Image.fromarray(image).save(folder / "map.pgm")
    path.write_text(text)
    return path


@dataclass(frozen=True)
class Kind:
    """What is changed in a run."""

    drive: Callable[[drives.Drive], drives.Drive] = lambda d: d
    change: Change = same
    cell: float = 0.05
    style: str = ""
    is_wrong: bool = False
    """Whether the map is that of another building, or mirrored: no pose on it is right."""


KINDS: dict[str, Kind] = {
    "none": Kind(),
    "posts": Kind(drives.posts),
    "sector 60": Kind(drives.blocked(np.radians(60.0))),
    "sector 140": Kind(drives.blocked(np.radians(140.0))),
    "followed": Kind(drives.followed),
    "queue": Kind(drives.queue),
    "noise 1 %": Kind(drives.noisy(0.01)),
    "noise 2.5 %": Kind(drives.noisy(0.025)),
    "30 % missing": Kind(drives.missing(0.3, np.nan)),
    "30 % missing, inf": Kind(drives.missing(0.3, np.inf)),
    "bias 5 cm": Kind(drives.biased(0.05)),
    "bias -4 cm": Kind(drives.biased(-0.04)),
    "mixed pixels": Kind(drives.mixed),
    "low cost": Kind(drives.low_cost),
    "turns x 1.3": Kind(drives.steps(1.3, 1.0)),
    "turns x 1.5": Kind(drives.steps(1.5, 1.0)),
    "turns x 0.6": Kind(drives.steps(0.6, 1.0)),
    "way x 1.1": Kind(drives.steps(1.0, 1.1)),
    "way x 1.05": Kind(drives.steps(1.0, 1.05)),
    "way x 0.8": Kind(drives.steps(1.0, 0.8)),
    "skid steer": Kind(drives.steps(1.35, 1.08)),
    "misses 3 deg a metre": Kind(drives.turning(np.radians(3.0))),
    "backwards": Kind(drives.misled(25.0, 33.0, 1.0, -1.0)),
    "turned the wrong way": Kind(drives.misled(25.0, 30.0, -1.0, 1.0)),
    "turns unseen": Kind(drives.misled(25.0, 30.0, 0.0, 1.0)),
    "spinning wheels": Kind(drives.misled(25.0, 33.0, 1.0, 3.0)),
    "pushed": Kind(drives.misled(25.0, 33.0, 1.0, 0.0)),
    "odometry 5 Hz": Kind(drives.at_rate(10)),
    "odometry 2 Hz": Kind(drives.at_rate(25)),
    "jitter": Kind(drives.jittered),
    "freezes": Kind(drives.freezing(1.5)),
    "freezes 0.5 s": Kind(drives.freezing(0.5)),
    "freezes 2.9 s": Kind(drives.freezing(2.9)),
    "late": Kind(drives.late),
    "jumps": Kind(drives.jumping),
    "reset": Kind(drives.reset),
    "bursts": Kind(drives.bursts),
    "paused, driven": Kind(drives.paused(True)),
    "paused, carried": Kind(drives.paused(False)),
    "begins carried": Kind(drives.carried(0.0, 8.0)),
    "ends carried": Kind(drives.carried(50.0, 99.0)),
    "carried": Kind(drives.carried(25.0, 35.0)),
    "glass": Kind(surfaces.glass(0.25)),
    "mirrors": Kind(surfaces.mirrors(0.1)),
    "dark walls": Kind(surfaces.dark(0.4)),
    "pitches": Kind(surfaces.pitching(np.radians(3.0))),
    "knocked": Kind(surfaces.knocked(30.0, np.radians(5.0))),
    "knocked twice": Kind(
        lambda d: surfaces.knocked(40.0, np.radians(4.0))(surfaces.knocked(20.0, np.radians(-4.0))(d))
    ),
    "gives way": Kind(surfaces.giving_way(20.0, 45.0, np.radians(6.0))),
    "shakes": Kind(surfaces.shaking(np.radians(0.7))),
    "covered half way": Kind(surfaces.from_then_on(30.0, drives.blocked(np.radians(140.0)))),
    "worn half way": Kind(surfaces.from_then_on(30.0, drives.low_cost)),
    "odometry ends": Kind(surfaces.without_odometry_from(30.0)),
    "odometry stands": Kind(drives.misled(30.0, 1e9, 0.0, 0.0)),
    "turns x 1.3 half way": Kind(drives.misled(30.0, 1e9, 1.3, 1.0)),
    "way x 0.8 half way": Kind(drives.misled(30.0, 1e9, 1.0, 0.8)),
    "rearranged": Kind(surfaces.rearranged),
    "thick walls": Kind(change=thick),
    "cells 0.1": Kind(cell=0.1),
    "cells 0.02": Kind(cell=0.02),
    "speckles": Kind(change=speckled),
    "edited": Kind(change=edited),
    "bent 5 cm": Kind(change=bent(0.05)),
    "bent 10 cm": Kind(change=bent(0.1)),
    "scale mode": Kind(style="scale"),
    "negate": Kind(style="negate"),
    "stands 60 s": Kind(lambda d: d.preceded(60.0, 0.0)),
    "spins": Kind(lambda d: d.preceded(25.0, 0.8)),
    "low cost, wrong": Kind(drives.low_cost, is_wrong=True),
    "low cost, mirrored": Kind(drives.low_cost, lambda grid, _: mirrored(grid), is_wrong=True),
    "low cost, half": Kind(drives.low_cost, lambda grid, _: half(grid)),
    "low cost robot": Kind(lambda d: drives.low_cost(drives.steps(1.2, 1.05)(drives.at_rate(5)(d))), thick),
}


def written(kind: Kind, shape: str, seed: int, folder: Path) -> tuple[Path, drives.Drive]:
    """The log of a drive, and the drive."""
    world = world_of(shape, seed)
    scenario = Scenario(
        world.name, seed, robot=presets.BRISK, sensor=SENSORS[shape], scan_rate_hz=5.0, duration_s=drives.SECONDS
    )
    rng = np.random.default_rng((seed, 41))
    drive = kind.drive(drives.Drive(list(drive_of(scenario, shape, seed)), world, scenario, rng))
    path = folder / "run.mcap"
    with LogWriter(path) as writer:
        mounting = Transform3.from_pose2(scenario.sensor.mounting)
        writer.transforms(drive.events[0].stamp_ns, [("base_link", "laser", mounting)], static=True)
        for event in drive.events:
            if isinstance(event, Scan):
                writer.scan(event, log_time_ns=event.stamp_ns)
            elif isinstance(event, Odometry):
                writer.odometry(event.stamp_ns, event.T_odom_base, covariance=event.covariance)
    return path, drive


def judged(kind: Kind, shape: str, seed: int, start: str, folder: Path) -> dict[str, Any]:
    """One run, as `hsloc replay` makes it."""
    path, drive = written(kind, shape, seed, folder)
    world, rng = drive.world, drive.rng
    of_map = world_of(shape, seed + 1000) if kind.is_wrong and kind.change is same else world
    grid = kind.change(of_map.occupancy_grid(kind.cell), rng)
    truth = drive.truth()
    options: dict[str, Any] = {"unknown_start": True}
    if start == "given":
        options = {"initial_pose": of_map.start() if of_map is not world else Pose2.from_array(truth.poses[0])}
    result = run(path, map=saved(grid, kind.style, folder), **options)
    metrics = analyse(result).metrics
    true = truth.interpolated(result.trajectory.stamps_ns)
    off = result.trajectory.poses - true
    turned = np.abs(wrap_angles(off[:, 2]))
    wrong = (np.hypot(off[:, 0], off[:, 1]) > 0.25) | (turned > np.radians(5.0)) | kind.is_wrong
    claimed = result.localised
    squared = np.square(off[claimed & ~wrong, :2]).sum(axis=1)
    states: dict[str, float] = {}
    if result.states is not None:
        for k in np.flatnonzero(~wrong & ~claimed).tolist():
            states[result.states.state[k].value] = states.get(result.states.state[k].value, 0.0) + 1.0 / len(wrong)
    reasons = [reason.code for reason in metrics.verdict_reasons]
    return {
        "wrong": float((wrong & claimed).mean()),
        "doubted": float((~wrong & ~claimed).sum() / max((~wrong).sum(), 1)),
        "right": float((~wrong).mean()),
        "error": float(np.sqrt(np.mean(squared))) if len(squared) else float("nan"),
        "verdict": metrics.verdict.value,
        "reasons": reasons,
        "warnings": [w.code for w in metrics.warnings if w.code not in reasons],
        "doubts": {state: round(share, 3) for state, share in states.items()},
    }


def line(row: dict[str, Any]) -> str:
    """A run, marked where it is wrong (!) or doubts right poses (?)."""
    mark = "!" if row["wrong"] > 0.005 else "?" if row["doubted"] > 0.05 else " "
    run_name = f"{mark}{row['kind']:18s} {row['shape']:5s} {row['seed']} {row['start']:7s}"
    shares = (
        f"{100 * row['wrong']:5.1f} {100 * row['doubted']:5.1f} {100 * row['right']:5.1f} {100 * row['error']:4.1f}"
    )
    reasons, warnings = " ".join(row["reasons"]), " ".join(row["warnings"])
    return f"{run_name} {shares} {row['verdict']:6s} {reasons} | {warnings} {row['doubts'] or ''}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--shapes", nargs="+", default=["rooms", "ring", "hall"], choices=SHAPES)
    parser.add_argument("--starts", nargs="+", default=["given", "unknown"], choices=("given", "unknown"))
    parser.add_argument("--rows", type=Path, help="a file to which a line of JSON is added for each run")
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"of {'; '.join(KINDS)}".replace("%", "%%"))
    arguments = parser.parse_args()
    print("kind, shape, seed, start: wrong and localised, right and not localised, right (%), error (cm), verdict")
    rows: list[dict[str, Any]] = []
    names = arguments.kinds or KINDS
    for seed, shape, name, start in product(arguments.seeds, arguments.shapes, names, arguments.starts):
        with tempfile.TemporaryDirectory() as folder:
            row = judged(KINDS[name], shape, seed, start, Path(folder))
        rows.append({"kind": name, "shape": shape, "seed": seed, "start": start} | row)
        print(line(rows[-1]), flush=True)
        if arguments.rows:
            with arguments.rows.open("a") as file:
                file.write(json.dumps(rows[-1]) + "\n")
    print("kind: wrong and localised, mean and largest (%); right and not localised, mean and largest; verdicts")
    for name in names:
        found = [row for row in rows if row["kind"] == name]
        wrong, doubted = [np.array([100.0 * row[key] for row in found]) for key in ("wrong", "doubted")]
        verdicts = Counter(row["verdict"] for row in found)
        shares = f"{wrong.mean():5.1f} {wrong.max():5.1f} {doubted.mean():5.1f} {doubted.max():5.1f}"
        print(f"{name:18s} {shares}  {', '.join(f'{count} {verdict}' for verdict, count in verdicts.items())}")


if __name__ == "__main__":
    main()
