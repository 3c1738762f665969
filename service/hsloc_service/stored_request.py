"""What a job's request names, as it is kept in the job's row: plain data of a `JobRequest`, also of an older hsloc."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from hsloc.options import BY_NAME, OPTIONS

if TYPE_CHECKING:
    from collections.abc import Mapping

MAP_STATE = "map.npz"
"""The asset of a mapping run that a later run extends."""
MAPS = tuple(each.name for each in OPTIONS if each.is_map)
"""Options that name the two uploads of a map."""
UPLOADS = tuple(each.name for each in OPTIONS if each.is_upload)
"""Options that name an upload."""
ALWAYS = (
    "mode", "matcher", "mapper", "preset", "seed", "initial_pose", "unknown_start", "no_odometry", "alignment", "read",
    "config", "map", "webhook",
)  # fmt: skip
ALWAYS_READ = (
    "scan_topic", "odom_topic", "truth_topic", "base_frame", "laser_pose", "start_s", "end_s", "deskew",
)  # fmt: skip
"""Keys that are kept where they are None, as in version 0.1: an Idempotency-Key from then still fits its request."""


def plain(request: Mapping[str, Any]) -> dict[str, Any]:
    """The request as it is kept. What is as usual is left out, but for the keys that version 0.1 had."""
    kept = {key: value for key, value in request.items() if key in ALWAYS or not _is_usual(key, value)}
    if isinstance(kept.get("read"), dict):
        read = kept["read"].items()
        kept["read"] = {key: value for key, value in read if key in ALWAYS_READ or not _is_usual(key, value)}
    return kept


def _is_usual(key: str, value: Any) -> bool:
    return value is None or (key in BY_NAME and value == BY_NAME[key].default)


def logs_of(request: Mapping[str, Any]) -> list[str]:
    """Ids of the logs, which are parts of one run."""
    return list(request.get("logs") or [request["log"]])


def files_of(request: Mapping[str, Any]) -> list[str]:
    """Ids of all uploads that the job reads."""
    maps = [ident for name in MAPS for ident in (request.get(name) or {}).values()]
    more = [request[name] for name in UPLOADS if request.get(name) is not None]
    return [*logs_of(request), *maps, *more]
