"""What a job's request names, as it is kept in the job's row: plain data of a `JobRequest`, also of an older hsloc."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping

MAP_STATE = "map.npz"
"""The asset of a mapping run that a later run extends."""
LATER = ("log", "logs", "relations", "resume")
"""Keys that are left out where they are None: an Idempotency-Key from before they were there still fits its request."""


def plain(request: Mapping[str, Any]) -> dict[str, Any]:
    """The request as it is kept."""
    return {key: value for key, value in request.items() if key not in LATER or value is not None}


def logs_of(request: Mapping[str, Any]) -> list[str]:
    """Ids of the logs, which are parts of one run."""
    return list(request.get("logs") or [request["log"]])


def files_of(request: Mapping[str, Any]) -> list[str]:
    """Ids of all uploads that the job reads."""
    chart = request.get("map") or {}
    relations = request.get("relations")
    return [*logs_of(request), *chart.values(), *([] if relations is None else [relations])]
