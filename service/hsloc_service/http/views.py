"""Rows as what goes over the wire."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, cast

from hsloc.replay.progress import COMPILING
from hsloc_service.http.schemas import (
    DeliveryView,
    FileView,
    JobView,
    ProgressView,
    known_moment,
    moment,
)
from hsloc_service.jobs.repository import split_labels

if TYPE_CHECKING:
    from hsloc_service.db.tables import DeliveryRow, FileRow, JobRow
    from hsloc_service.http.schemas import State


def file_view(row: FileRow) -> FileView:
    """An upload."""
    return FileView(
        id=row.id,
        name=row.name,
        state="complete" if row.state == "complete" else "receiving",
        size=row.size,
        received=row.received,
        sha256=row.sha256,
        created=known_moment(row.created),
        expires=moment(row.expires),
    )


def job_view(row: JobRow) -> JobView:
    """A job, with ages as of now."""
    now = time.time()
    progress = None
    if row.state in ("running", "cancelling") and row.phase is not None and row.progressed is not None:
        total, done = row.total or 0.0, row.done or 0.0
        progress = ProgressView(
            phase=row.phase,
            text=COMPILING if row.phase == "compile" else row.phase,
            done=done,
            total=total,
            fraction=min(max(done / total, 0.0), 1.0) if total > 0.0 else 0.0,
            speed=row.speed,
            scans=row.scans,
            age_s=max(now - row.progressed, 0.0),
        )
    running = row.state in ("running", "cancelling") and row.heartbeat is not None
    return JobView(
        id=row.id,
        seq=row.seq,
        state=cast("State", row.state),
        reason=row.reason,
        message=row.message,
        log=row.log_name,
        title=row.title,
        labels=split_labels(row.labels),
        notes=row.notes,
        request=row.request,
        rerun_of=row.rerun_of,
        attempt=row.attempt,
        created=known_moment(row.created),
        started=moment(row.started),
        ended=moment(row.ended),
        progress=progress,
        heartbeat_age_s=max(now - (row.heartbeat or now), 0.0) if running else None,
        outcome=(row.summary or {}).get("outcome"),
        summary=row.summary,
    )


def brief_view(row: JobRow) -> JobView:
    """A job for a list: what was chosen of the request, and the key figures of the summary."""
    view = job_view(row)
    request = {key: value for key, value in view.request.items() if value is not None}
    summary = view.summary
    if summary is not None:
        metrics, names = summary.get("metrics", {}), summary.get("key_figures", [])
        summary = {
            "verdict": metrics.get("verdict"),
            "mode": metrics.get("run", {}).get("mode"),
            "duration_s": metrics.get("log", {}).get("duration_s"),
            "headline": summary.get("headline"),
            "thumbnail": summary.get("thumbnail"),
            "key_figures": [each for name in names for each in summary.get("figures", []) if each["name"] == name],
        }
    return view.model_copy(update={"request": request, "summary": summary})


def shared_view(row: JobRow) -> JobView:
    """A job for whoever came by a link: without what its owner noted, and without where its end is reported."""
    request = {key: value for key, value in row.request.items() if key != "webhook"}
    return job_view(row).model_copy(update={"request": request, "labels": [], "notes": None})


def delivery_view(row: DeliveryRow) -> DeliveryView:
    """A webhook."""
    return DeliveryView(
        event_id=row.id,
        url=row.url,
        state=cast("Any", row.state),
        attempts=row.attempts,
        last_status=row.last_status,
        last_error=row.last_error,
    )
