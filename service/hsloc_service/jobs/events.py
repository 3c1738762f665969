"""The history of a job: states are kept, of progress only the newest, of the log's lines a bounded number."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sqlalchemy import delete

from hsloc_service.db.database import clock, notify
from hsloc_service.db.tables import EventRow

if TYPE_CHECKING:
    from sqlalchemy.orm import Session

    from hsloc_service.db.tables import JobRow


def record(session: Session, job: JobRow, kind: str, data: dict[str, Any]) -> None:
    """Append an event; an older event of progress is replaced by a newer one."""
    if kind == "progress":
        session.execute(delete(EventRow).where(EventRow.job_id == job.id, EventRow.kind == "progress"))
    if kind == "state" and data["state"] in ("queued", "cancelling"):
        # A hint for slots elsewhere; who misses it finds the row within a second, or at the next heartbeat.
        notify(session, "queued" if data["state"] == "queued" else f"cancelling {job.id}")
    session.add(EventRow(tenant=job.tenant, job_id=job.id, at=clock(session), kind=kind, data=data))
