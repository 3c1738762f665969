"""Webhooks: an outbox in the database, signed, retried, and kept away from what is not public.

A receiver checks `Hsloc-Signature: t=<seconds>,v1=<hex>`: the HMAC-SHA256 of `<seconds>.<body>` with the tenant's key,
and drops an `event_id` that it has seen: a delivery whose answer was lost comes again.
"""

from __future__ import annotations

import hashlib
import hmac
import http.client
import ipaddress
import secrets
import socket
import ssl
import threading
import time
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from sqlalchemy import select

from service.logs import log
from service.tables import DeliveryRow, SecretRow

if TYPE_CHECKING:
    from sqlalchemy.orm import Session

    from service.database import Database
    from service.settings import Settings

TIMEOUT_S = 5.0
LONGEST_WAIT_S = 3600.0


class ForbiddenAddress(OSError):
    """The name leads to a private address."""


def secret_of(session: Session, tenant: str) -> str:
    """The tenant's key, made when there is none. Needs a writing session."""
    row = session.get(SecretRow, tenant)
    if row is None:
        row = SecretRow(tenant=tenant, webhook=secrets.token_urlsafe(32))
        session.add(row)
    return row.webhook


def sign(secret: str, stamp: int, body: bytes) -> str:
    """The value of Hsloc-Signature."""
    mac = hmac.new(secret.encode(), f"{stamp}.".encode() + body, hashlib.sha256)
    return f"t={stamp},v1={mac.hexdigest()}"


class Deliverer:
    """A thread that empties the outbox."""

    def __init__(self, database: Database, settings: Settings) -> None:
        self._database, self._settings = database, settings
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="webhooks", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """End; what is in the outbox stays there."""
        self._stop.set()
        self._thread.join(TIMEOUT_S + 1.0)

    def _run(self) -> None:
        while not self._stop.wait(0.5):
            try:
                while not self._stop.is_set() and self.deliver_next():
                    pass
            except Exception as error:
                log("webhook.error", error=f"{type(error).__name__}: {error}")

    def deliver_next(self) -> bool:
        """Try the next delivery that is due; False if none is."""
        now = time.time()
        with self._database.read() as session:
            due = session.scalar(
                select(DeliveryRow)
                .where(DeliveryRow.state == "pending", DeliveryRow.next_at <= now)
                .order_by(DeliveryRow.next_at)
                .limit(1)
            )
        if due is None:
            return False
        with self._database.write() as session:
            secret = secret_of(session, due.tenant)
        status, error = self._post(due, secret)
        with self._database.write() as session:
            row = session.get(DeliveryRow, due.id)
            if row is not None:
                self._note(row, status, error)
        return True

    def _note(self, row: DeliveryRow, status: int | None, error: str | None) -> None:
        row.attempts += 1
        row.last_status, row.last_error = status, error
        if status is not None and 200 <= status < 300:
            row.state = "delivered"
        elif row.attempts >= self._settings.webhook_attempts or status == 410:
            row.state = "given_up"
        else:
            wait = min(self._settings.webhook_backoff_s * 2.0 ** (row.attempts - 1), LONGEST_WAIT_S)
            row.next_at = time.time() + wait
        log("webhook", job=row.job_id, event_id=row.id, state=row.state, status=status, error=error)

    def _post(self, row: DeliveryRow, secret: str) -> tuple[int | None, str | None]:
        body = row.body.encode()
        headers = {
            "Content-Type": "application/json",
            "User-Agent": "hsloc-webhook/1",
            "Hsloc-Event-Id": row.id,
            "Hsloc-Signature": sign(secret, int(time.time()), body),
            "Connection": "close",
        }
        try:
            return post(row.url, body, headers, self._settings.webhook_private), None
        except (OSError, http.client.HTTPException, ValueError) as error:
            return None, f"{type(error).__name__}: {error}"[:300]


def post(url: str, body: bytes, headers: dict[str, str], private: bool) -> int:
    """POST to a public address; the status. Redirects are not followed: they would lead round the check.

    The address is resolved once and connected to, so that a second answer of the name server cannot change it.
    """
    parts = urlsplit(url)
    if parts.scheme not in ("http", "https") or not parts.hostname or parts.username is not None:
        raise ValueError("not an http(s) URL without user name")
    port = parts.port or (443 if parts.scheme == "https" else 80)
    address = _resolve(parts.hostname, port, private)
    plain = socket.create_connection(address, TIMEOUT_S)
    kind = http.client.HTTPSConnection if parts.scheme == "https" else http.client.HTTPConnection
    connection = kind(parts.hostname, port, timeout=TIMEOUT_S)
    connection.sock = (
        ssl.create_default_context().wrap_socket(plain, server_hostname=parts.hostname)
        if parts.scheme == "https"
        else plain
    )
    try:
        path = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
        connection.request("POST", path, body=body, headers=headers)
        with connection.getresponse() as response:
            response.read(1024)
            return response.status
    finally:
        connection.close()
        plain.close()


def _resolve(host: str, port: int, private: bool) -> tuple[str, int]:
    """The first address; raises ForbiddenAddress if any is not public."""
    found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    addresses = [str(each[4][0]) for each in found]
    for text in addresses:
        address = ipaddress.ip_address(text.split("%")[0])
        mapped = getattr(address, "ipv4_mapped", None) or address
        if not private and (not mapped.is_global or mapped.is_multicast):
            raise ForbiddenAddress(f"{host} leads to {text}, which is not a public address")
    return addresses[0], port
