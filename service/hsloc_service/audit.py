"""Who gave or took access, and who deleted what: kept for a year, longer than what it is about."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sqlalchemy import delete, select

from hsloc_service.db.database import clock
from hsloc_service.db.tables import AuditRow

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sqlalchemy.orm import Session

    from hsloc_service.db.database import Database

OPERATOR = "operator"
"""Actor: the command line of the server's machine."""
RETENTION = "retention"
"""Actor: the server itself, by `HSLOC_RETENTION_S`."""
KEPT_S = 366 * 86400.0


def note(session: Session, tenant: str, actor: str | None, action: str, *targets: str) -> None:
    """Record an action on each target, in the transaction that does it. Without a token the actor is empty."""
    now = clock(session)
    session.add_all(
        AuditRow(at=now, tenant=tenant, actor=actor or "", action=action, target=target) for target in targets
    )


def entries(database: Database, tenant: str | None, before: int | None, limit: int) -> Sequence[AuditRow]:
    """What was recorded of a tenant, or of all, newest first; `before` is the id of the last one seen."""
    query = select(AuditRow).order_by(AuditRow.id.desc()).limit(limit)
    if tenant is not None:
        query = query.where(AuditRow.tenant == tenant)
    if before is not None:
        query = query.where(AuditRow.id < before)
    with database.read() as session:
        return session.scalars(query).all()


def forget(session: Session, now: float) -> None:
    """Remove what is older than KEPT_S."""
    session.execute(delete(AuditRow).where(AuditRow.at < now - KEPT_S))
