"""Links by which a job and its results are seen without a token: read-only, until they expire or are revoked."""

from __future__ import annotations

import secrets
import uuid
from dataclasses import dataclass
from typing import TYPE_CHECKING

from sqlalchemy import delete, select

from hsloc_service.audit import note
from hsloc_service.auth import sha256_of
from hsloc_service.db.database import clock
from hsloc_service.db.tables import ShareRow
from hsloc_service.errors import busy, not_found
from hsloc_service.jobs.repository import job_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sqlalchemy import Select

    from hsloc_service.auth import Principal
    from hsloc_service.db.database import Database

MAX_SHARES = 50
"""Links of a job that are valid at the same time."""


@dataclass(frozen=True, slots=True)
class Shares:
    """The links of all tenants; the methods with a principal see those of its jobs only."""

    database: Database

    def issue(self, who: Principal, job_id: str, valid_s: float) -> tuple[ShareRow, str]:
        """A new link and its secret of 256 random bits, which is shown this once. Raises ServiceError 404 and 429."""
        secret = f"hss_{secrets.token_urlsafe(32)}"
        with self.database.write() as session:
            now = clock(session)
            job_of(session, who, job_id, lock=True)
            session.execute(delete(ShareRow).where(ShareRow.job_id == job_id, ShareRow.expires <= now))
            if len(session.scalars(_of(who, job_id)).all()) >= MAX_SHARES:
                raise busy(f"the job has {MAX_SHARES} links, which is the limit; revoke one", 60.0)
            row = ShareRow(
                id=str(uuid.uuid4()),
                tenant=who.tenant,
                job_id=job_id,
                sha256=sha256_of(secret),
                created=now,
                expires=now + valid_s,
            )
            session.add(row)
            note(session, who.tenant, who.token, "share.issue", f"{job_id}/{row.id}")
        return row, secret

    def rows(self, who: Principal, job_id: str) -> Sequence[ShareRow]:
        """The links of a job that are valid, oldest first."""
        with self.database.read() as session:
            job_of(session, who, job_id)
            return session.scalars(_of(who, job_id).where(ShareRow.expires > clock(session))).all()

    def revoke(self, who: Principal, job_id: str, ident: str) -> None:
        """End a link. Raises ServiceError 404."""
        with self.database.write() as session:
            row = session.scalar(_of(who, job_id).where(ShareRow.id == ident))
            if row is None:
                raise not_found("link", ident)
            session.delete(row)
            note(session, who.tenant, who.token, "share.revoke", f"{job_id}/{ident}")

    def find(self, secret: str) -> ShareRow | None:
        """The link of a secret; None if it is unknown, revoked or expired."""
        with self.database.read() as session:
            return session.scalar(
                select(ShareRow).where(ShareRow.sha256 == sha256_of(secret), ShareRow.expires > clock(session))
            )


def _of(who: Principal, job_id: str) -> Select[ShareRow]:
    query = select(ShareRow).where(ShareRow.job_id == job_id, ShareRow.tenant == who.tenant)
    return query.order_by(ShareRow.created)
