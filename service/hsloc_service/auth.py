"""Principals, and the bearer tokens that identify them."""

from __future__ import annotations

import hashlib
import hmac
import secrets
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from sqlalchemy import select

from hsloc_service.audit import OPERATOR, note
from hsloc_service.db.tables import TokenRow
from hsloc_service.errors import ServiceError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from hsloc_service.db.database import Database

SCOPES = ("read", "write", "admin")
"""read: look and download; write: upload, submit, cancel, delete; admin: metrics of all tenants."""


@dataclass(frozen=True, slots=True)
class Principal:
    """A tenant and what it may do."""

    tenant: str
    scopes: frozenset[str]
    token: str | None = None
    job_id: str | None = None
    """Of whoever came by a link: the job that it shows, and nothing else."""

    def need(self, scope: str) -> None:
        """Raises ServiceError 403 unless the scope is there."""
        if scope not in self.scopes:
            raise ServiceError(403, "scope", f"this token lacks the scope {scope!r}")


OPERATORS = "operator's"
"""Label of the token of HSLOC_TOKEN."""

ANYBODY = Principal("local", frozenset(SCOPES))
"""The principal where no token is required: a server on loopback."""


class Tokens:
    """Tokens: 256 random bits, of which only the SHA-256 is kept (a random secret needs no slow hash)."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def issue(
        self,
        tenant: str,
        scopes: tuple[str, ...] = SCOPES,
        *,
        label: str = "",
        expires: float | None = None,
        secret: str | None = None,
    ) -> str:
        """A new token; shown this once. `expires` in seconds since 1970."""
        for scope in scopes:
            if scope not in SCOPES:
                raise ValueError(f"scope {scope!r} is none of {', '.join(SCOPES)}")
        ident = secrets.token_hex(4)
        token = secret or f"hsl_{ident}_{secrets.token_urlsafe(32)}"
        row = TokenRow(
            id=ident,
            tenant=tenant,
            label=label,
            scopes=" ".join(scopes),
            sha256=sha256_of(token),
            created=time.time(),
            expires=expires,
        )
        with self._database.write() as session:
            known = session.scalar(select(TokenRow).where(TokenRow.sha256 == row.sha256))
            if known is None:
                session.add(row)
                note(session, tenant, OPERATOR, "token.issue", ident)
        return token

    def issue_operators(self, tenant: str, secret: str) -> None:
        """Accept the token that the operator chose, and revoke the one that the operator chose before."""
        self.issue(tenant, label=OPERATORS, secret=secret)
        digest = sha256_of(secret)
        with self._database.write() as session:
            older = (TokenRow.label == OPERATORS, TokenRow.sha256 != digest, TokenRow.revoked.is_(None))
            for row in session.scalars(select(TokenRow).where(*older)):
                row.revoked = time.time()
                note(session, row.tenant, OPERATOR, "token.revoke", row.id)

    def revoke(self, ident: str) -> bool:
        """Revoke a token; whether there was one with this id."""
        with self._database.write() as session:
            row = session.get(TokenRow, ident)
            if row is not None:
                row.revoked = time.time()
                note(session, row.tenant, OPERATOR, "token.revoke", row.id)
            return row is not None

    def rows(self) -> Sequence[TokenRow]:
        """All tokens, oldest first; the secrets themselves are not stored."""
        with self._database.read() as session:
            return session.scalars(select(TokenRow).order_by(TokenRow.created)).all()

    def any(self) -> bool:
        """Whether a token was ever issued."""
        with self._database.read() as session:
            return session.scalar(select(TokenRow.id).limit(1)) is not None

    def principal(self, token: str) -> Principal | None:
        """The principal of a token; None if it is unknown, revoked or expired."""
        digest = sha256_of(token)
        with self._database.read() as session:
            row = session.scalar(select(TokenRow).where(TokenRow.sha256 == digest))
        if row is None or not hmac.compare_digest(row.sha256, digest) or row.revoked is not None:
            return None
        if row.expires is not None and row.expires <= time.time():
            return None
        return Principal(row.tenant, frozenset(row.scopes.split()), row.id)


def sha256_of(token: str) -> str:
    """What is kept of a secret."""
    return hashlib.sha256(token.encode("utf-8", "surrogateescape")).hexdigest()
