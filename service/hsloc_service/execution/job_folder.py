"""The folder of one attempt: what the job's process finds there."""

from __future__ import annotations

import hashlib
import json
from typing import TYPE_CHECKING, Any

from hsloc_service.execution.processes import linked_files
from hsloc_service.results.store import BLOCK
from hsloc_service.storage import safe_name
from hsloc_service.stored_request import MAP_STATE, UPLOADS, logs_of

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from hsloc_service.execution.sandbox import Sandbox
    from hsloc_service.jobs.leases import Claim, Source
    from hsloc_service.results.store import ResultStore
    from hsloc_service.settings import Settings
    from hsloc_service.storage import Storage


def prepare(
    folder: Path, claim: Claim, files: Mapping[str, Path], storage: Storage, settings: Settings, sandbox: Sandbox
) -> None:
    """`job.json`, the input under its own names (read-only), and an empty folder for temporary files.

    The logs are in `input`, `input-2`, and so on, because two parts of a run may have the same name. The saved map of a
    job that is extended belongs beside `job.json`: see `download`. `files` are the uploads by their ids.
    """
    storage.remove_work(folder)
    for name in ("map", "tmp"):
        (folder / name).mkdir(parents=True, mode=0o700)
    request = claim.request

    def link(place: str, file_id: str, default: str) -> str:
        name = safe_name(claim.names.get(file_id, ""), default)
        (folder / place).mkdir(exist_ok=True, mode=0o700)
        (folder / place / name).symlink_to(files[file_id].absolute())
        return name

    places = [("input" if k == 0 else f"input-{k + 1}", ident) for k, ident in enumerate(logs_of(request))]
    logs = [f"{place}/{link(place, ident, 'log')}" for place, ident in places]
    job: dict[str, Any] = {
        "request": request,
        "log": logs[0].partition("/")[2],
        "logs": logs,
        "limits": {
            "memory_bytes": settings.job_memory_bytes,
            "cpu_s": settings.job_cpu_s,
            "output_bytes": settings.job_output_bytes,
            "open_files": settings.job_open_files,
        },
    }
    if request.get("map") is not None:
        job["map"] = link("map", request["map"]["yaml"], "map.yaml")
        # A name that no YAML can ask for; the worker links the name that this YAML does ask for.
        (folder / "map" / ".image").symlink_to(files[request["map"]["image"]].absolute())
        job["map_image"] = ".image"
    job |= {name: link(name, request[name], name) for name in UPLOADS if request.get(name) is not None}
    if claim.source is not None:
        job["resume"] = MAP_STATE
    job["limits"]["landlock"] = sandbox.landlock(folder.absolute(), linked_files(folder))
    (folder / "job.json").write_text(json.dumps(job), encoding="utf-8")


def download(store: ResultStore, source: Source, folder: Path) -> None:
    """Copy the saved map of an earlier job into the folder. Raises OSError if it is not what its manifest says."""
    digest = hashlib.sha256()
    with (folder / MAP_STATE).open("wb") as file:
        for start in range(0, source.size, BLOCK):
            block = store.read(source.folder, MAP_STATE, start, min(BLOCK, source.size - start))
            digest.update(block)
            file.write(block)
    if digest.hexdigest() != source.sha256:
        raise OSError(f"{MAP_STATE} of {source.folder} is not what was stored")
