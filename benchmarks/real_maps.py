"""Maps of real logs without a map, as they are and worsened: error and verdict of each.

    python benchmarks/real_maps.py [--data FOLDER] [--degrade SCRIPT] [--seeds N] [--kinds KIND ...] [LOG ...]

Each log is mapped by `hsloc map` with the default configuration, as it is with each of the seeds, and as each kind of
`degrade.py` (a script that is called with a log, the log to write and the kind) leaves it, with seed 0. `no-odom` is
the log as it is, mapped with `--no-odom`. The error is the mean of the relations (m) or, where a log has none, the rmse
of the APE (m). Wrong is an error of more than three times that of the log as it is, and more than 0.15 m where the
reference is another mapper's poses. A line for each run, then the number of those that are wrong, of those that are
wrong and `good`, and of those that are right and `failed`.
"""

from __future__ import annotations

import argparse
import gzip
import json
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

KINDS = ("no-odom", "fov90", "range8", "range4", "thin2", "thin4", "outl10", "odo3", "dt0.2")
GOOD_TO_M = 0.15
"""Errors below are within those of poses that another mapper computed."""


@dataclass(frozen=True)
class RealLog:
    """A log, its reference and options, with the error (m) that three times makes a map wrong."""

    path: str
    reference: tuple[str, str]
    options: tuple[str, ...]
    clean_m: float


LOGS = {
    "intel": RealLog("intel/intel.clf.gz", ("--relations", "intel/intel.relations"), (), 0.0215),
    "fr079": RealLog(
        "fr079/fr079.clf.gz", ("--relations", "fr079/fr079.relations"), ("--laser-pose=-0.04,0,0",), 0.036
    ),
    "aces": RealLog("aces/aces.clf.gz", ("--reference", "aces/aces.rbpf.txt"), (), 0.12),
    "seattle": RealLog("seattle/seattle.clf.gz", ("--reference", "seattle/seattle.gfs.ref.txt"), (), 0.10),
    "orebro": RealLog("orebro/orebro.clf.gz", ("--reference", "orebro/orebro.gfs.ref.txt"), (), 0.20),
}


def degraded(path: Path, kind: str, degrade: Path, folder: Path) -> Path:
    plain = folder / "plain.clf"
    plain.write_bytes(gzip.decompress(path.read_bytes()))
    written = folder / f"{kind}.clf"
    subprocess.run([sys.executable, degrade, plain, written, kind], check=True)
    return written


def measure(name: str, kind: str, seed: int, data: Path, degrade: Path) -> dict[str, object]:
    """Map a log."""
    log = LOGS[name]
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        path = data / log.path
        if kind not in ("", "no-odom"):
            path = degraded(path, kind, degrade, folder)
        command = ["hsloc", "map", str(path), *log.options, log.reference[0], str(data / log.reference[1])]
        command += ["--seed", str(seed), "--out", str(folder / "run"), "-q"]
        if kind == "no-odom":
            command.append("--no-odom")
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        metrics = json.loads((folder / "run" / "metrics.json").read_text())
    if log.reference[0] == "--relations":
        error = metrics["relations"]["trans_part"]["mean"]
    else:
        error = metrics["ape"]["trans_part"]["rmse"]
    return {
        "log": name,
        "kind": kind,
        "seed": seed,
        "error_m": error,
        "wrong": error > max(3.0 * log.clean_m, 0.0 if log.reference[0] == "--relations" else GOOD_TO_M),
        "verdict": metrics["verdict"],
        "reasons": [reason["code"] for reason in metrics["verdict_reasons"]],
        "warnings": [warning["code"] for warning in metrics["warnings"]],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--degrade", type=Path, default=Path("../shared/tools/degrade.py"))
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--kinds", nargs="*", default=list(KINDS))
    parser.add_argument("--rows", type=Path, help="a file to which a line of JSON is added for each run")
    parser.add_argument("logs", nargs="*", metavar="LOG", help=f"of {', '.join(LOGS)}")
    arguments = parser.parse_args()
    rows = []
    for name in arguments.logs or LOGS:
        runs = [("", seed) for seed in range(arguments.seeds)] + [(kind, 0) for kind in arguments.kinds]
        for kind, seed in runs:
            row = measure(name, kind, seed, arguments.data, arguments.degrade)
            rows.append(row)
            mark = "wrong" if row["wrong"] else ""
            what = kind or f"seed {seed}"
            print(
                f"{name:8s} {what:8s} {row['error_m']:8.4f} {mark:6s} {row['verdict']:7s}", row["reasons"], flush=True
            )
            if arguments.rows:
                with arguments.rows.open("a") as file:
                    file.write(json.dumps(row) + "\n")
    wrong = [row for row in rows if row["wrong"]]
    good = sum(row["verdict"] == "good" for row in wrong)
    failed = sum(not row["wrong"] and row["verdict"] == "failed" for row in rows)
    print(f"{len(rows)} maps, {len(wrong)} wrong, {good} wrong and good, {failed} right and failed")


if __name__ == "__main__":
    main()
