"""What a request can be refused for."""

from __future__ import annotations

import sqlite3
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sqlalchemy.exc import OperationalError


class ServiceError(Exception):
    """An answer other than success: HTTP status, a word for programs, a sentence for people."""

    def __init__(self, status: int, code: str, message: str, headers: dict[str, str] | None = None) -> None:
        super().__init__(message)
        self.status, self.code, self.message, self.headers = status, code, message, headers or {}


def not_found(what: str, ident: str) -> ServiceError:
    """Also the answer for what belongs to another tenant."""
    return ServiceError(404, "not_found", f"there is no {what} {ident[:64]!r}")


def conflict(code: str, message: str) -> ServiceError:
    """The state of the thing does not allow it."""
    return ServiceError(409, code, message)


def busy(message: str, retry_after_s: float) -> ServiceError:
    """Too much at once; the client may try again."""
    return ServiceError(429, "too_many", message, {"Retry-After": str(max(1, round(retry_after_s)))})


def no_space(message: str) -> ServiceError:
    """The disk, or the tenant's part of it, is full."""
    return ServiceError(507, "no_space", message, {"Retry-After": "60"})


def empty_file() -> ServiceError:
    """No bytes came, or are to come."""
    return ServiceError(400, "empty", "the file is empty (0 bytes); copy it again, and send its bytes as the body")


def is_disk_full(error: OperationalError) -> bool:
    """Whether SQLite or PostgreSQL failed because its disk is full, by its error code and not by its words."""
    full = getattr(error.orig, "sqlite_errorcode", None) == sqlite3.SQLITE_FULL
    return full or getattr(error.orig, "sqlstate", None) == "53100"


class BrokenAnswer(Exception):
    """An answer that had begun cannot be sent to its end; the connection has to be broken off."""


class StoreError(Exception):
    """The store does not answer, or not as it must; the same may work later."""
