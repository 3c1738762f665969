"""A sweep in parts: each of N processes or machines does every N-th run, and their tables are merged into one."""

from __future__ import annotations

import hashlib
import json
import os
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from hsloc.atomic_write import write_text_atomically
from hsloc.errors import HslocError
from hsloc.sweep.remote import UrlFolder
from hsloc.sweep.runs import DONE, FAILED, SKIPPED, request_values
from hsloc.sweep.table import COLUMNS, rows

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from hsloc.sweep.runs import Outcome, SweepRun

_FILES = "sweep-shard-*-of-*.json"


@dataclass(frozen=True, slots=True)
class Shard:
    """Part `index` (from 0) of `count`. Raises ValueError for an index that is not in the range."""

    index: int
    count: int

    def __post_init__(self) -> None:
        if not 0 <= self.index < self.count:
            raise ValueError(
                f"shard {self.index} of {self.count} does not exist; the first is 0, the last {self.count - 1}"
            )

    def part(self, runs: Sequence[SweepRun]) -> list[SweepRun]:
        """The runs of this part: every `count`-th, so that a long log is spread over all parts."""
        return list(runs[self.index :: self.count])


def parse_shard(text: str, environment: Mapping[str, str] = os.environ) -> Shard:
    """`I/N`; or `auto`, `auto/N`: the index, and where it is known the count, of an array job.

    Known are Kubernetes' Indexed Jobs, which do not name the count, Slurm's job arrays, and AWS Batch's. Raises
    ValueError with a reason.
    """
    index, slash, count = text.partition("/")
    if index != "auto":
        if not index.isdecimal() or not count.isdecimal():
            raise ValueError(f"{text!r} is not I/N, such as 0/4, and not auto or auto/N")
        return Shard(int(index), int(count))
    found = _from_environment(environment)
    if slash:
        if not count.isdecimal():
            raise ValueError(f"{text!r} is not auto/N, such as auto/4")
        return Shard(found[0], int(count))
    if found[1] is None:
        raise ValueError("the environment names the index of the job, but not how many there are; give auto/N")
    return Shard(found[0], found[1])


def _from_environment(environment: Mapping[str, str]) -> tuple[int, int | None]:
    """Index from 0, and the count if it is named. Raises ValueError unless exactly one array job is found."""
    found: dict[str, tuple[int, int | None]] = {}

    def number(name: str, default: int | None = None) -> int:
        text = environment.get(name, "" if default is None else str(default))
        if not text.isdecimal():
            raise ValueError(f"{name} is {text!r}, which is not a number")
        return int(text)

    if "JOB_COMPLETION_INDEX" in environment:
        found["JOB_COMPLETION_INDEX"] = number("JOB_COMPLETION_INDEX"), None
    if "AWS_BATCH_JOB_ARRAY_INDEX" in environment:
        size = number("AWS_BATCH_JOB_ARRAY_SIZE") if "AWS_BATCH_JOB_ARRAY_SIZE" in environment else None
        found["AWS_BATCH_JOB_ARRAY_INDEX"] = number("AWS_BATCH_JOB_ARRAY_INDEX"), size
    if "SLURM_ARRAY_TASK_ID" in environment:
        # The array may begin anywhere, and have steps: --array=1-7:2.
        first, step = number("SLURM_ARRAY_TASK_MIN", 0), max(number("SLURM_ARRAY_TASK_STEP", 1), 1)
        size = number("SLURM_ARRAY_TASK_COUNT") if "SLURM_ARRAY_TASK_COUNT" in environment else None
        found["SLURM_ARRAY_TASK_ID"] = (number("SLURM_ARRAY_TASK_ID") - first) // step, size
    if len(found) != 1:
        names = "JOB_COMPLETION_INDEX, SLURM_ARRAY_TASK_ID, AWS_BATCH_JOB_ARRAY_INDEX"
        what = f"several of them are set: {', '.join(found)}" if found else "none of them is set"
        raise ValueError(f"auto takes the index from {names}, but {what}; give I/N")
    return next(iter(found.values()))


def plan_hash(runs: Sequence[SweepRun]) -> str:
    """Hash of what a sweep is: names and options of all its runs, without the bytes and the places of their logs."""
    values = [[item.name, {**request_values(item.request), "bare_names": False}] for item in runs]
    return hashlib.sha256(json.dumps(values, sort_keys=True, default=str).encode()).hexdigest()


def write_shard(
    folder: Path | UrlFolder, shard: Shard, runs: Sequence[SweepRun], outcomes: Sequence[Outcome]
) -> Path | UrlFolder:
    """Write the table of one part of a sweep of `runs`, whole or not at all; its path. Raises OutputError."""
    path = folder / f"sweep-shard-{shard.index}-of-{shard.count}.json"
    content = {
        "sweep": plan_hash(runs),
        "shard": shard.index,
        "of": shard.count,
        "runs": len(runs),
        "rows": rows(outcomes),
    }
    text = json.dumps(content, indent=2) + "\n"
    if isinstance(path, UrlFolder):
        path.write_text(text)
    else:
        write_text_atomically(path, text)
    return path


def merge(folders: Sequence[Path | UrlFolder]) -> list[dict[str, Any]]:
    """The rows of a whole sweep, in the order of its plan, from the tables of its parts in any of the folders.

    Where a part was done twice, a row that did not fail counts, then that of the folder named first. A run that was
    skipped because it was done before is done. Raises HslocError where parts are missing, or are not of one sweep.
    """
    parts = [(path, _read(path)) for folder in folders for path in _tables(folder)]
    names = ", ".join(map(str, folders))
    if not parts:
        raise HslocError(f"{names}: no tables of shards ({_FILES}); run hsloc sweep --shard I/N --out there first")
    first_path, first = parts[0]
    for path, part in parts:
        if any(part[name] != first[name] for name in ("sweep", "of", "runs")):
            raise HslocError(f"{path}: is of another sweep than {first_path}; remove the table that is not meant")
    missing = sorted(set(range(first["of"])) - {part["shard"] for _, part in parts})
    if missing:
        raise HslocError(f"{names}: shards {', '.join(map(str, missing))} of {first['of']} are missing; run them first")
    merged: dict[int, dict[str, Any]] = {}
    for _, part in parts:
        for k, row in enumerate(part["rows"]):
            index = part["shard"] + k * part["of"]
            if index not in merged or (merged[index]["state"] == FAILED and row["state"] != FAILED):
                merged[index] = row | {"state": DONE if row["state"] == SKIPPED else row["state"]}
    return [merged[index] for index in sorted(merged)]


def _tables(folder: Path | UrlFolder) -> list[Path | UrlFolder]:
    found = [(re.findall(r"\d+", path.name), path) for path in folder.glob(_FILES)]
    return [path for _, path in sorted(found, key=lambda each: ([int(text) for text in each[0]], str(each[1])))]


def _read(path: Path | UrlFolder) -> dict[str, Any]:
    """The table of a part. Raises HslocError for anything else."""
    try:
        part = json.loads(path.read_text(encoding="utf-8"))
        shard, total = Shard(part["shard"], part["of"]), int(part["runs"])
        good = len(part["rows"]) == len(range(shard.index, total, shard.count)) and isinstance(part["sweep"], str)
        good = good and all(set(row) == set(COLUMNS) for row in part["rows"])
    except OSError as error:
        raise HslocError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (ValueError, KeyError, TypeError):
        good = False
    if not good:
        raise HslocError(f"{path}: is not the table of a shard of this version of hsloc; run that shard again")
    found: dict[str, Any] = part
    return found
