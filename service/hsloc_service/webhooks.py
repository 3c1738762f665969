"""Webhooks: their bodies, an outbox in the database, signed and retried delivery to public addresses.

A receiver checks `Hsloc-Signature: t=<seconds>,v1=<hex>`: the HMAC-SHA256 of `<seconds>.<body>` with the tenant's key,
and ignores an `event_id` that it has seen: a delivery whose answer was lost is repeated.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import http.client
import ipaddress
import json
import secrets
import socket
import ssl
import threading
import time
import uuid
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from sqlalchemy import select

from hsloc_service.db.database import clock
from hsloc_service.db.tables import DeliveryRow, SecretRow
from hsloc_service.logs import log
from hsloc_service.storage import safe_name

if TYPE_CHECKING:
    from sqlalchemy.orm import Session

    from hsloc_service.db.database import Database
    from hsloc_service.db.tables import JobRow
    from hsloc_service.settings import Settings

TIMEOUT_S = 5.0
WITHIN_S = 15.0
"""Time limit for one delivery, however slowly the receiver answers [s]."""
LONGEST_WAIT_S = 3600.0
Address = ipaddress.IPv4Address | ipaddress.IPv6Address
_RESERVED = [ipaddress.ip_network(text) for text in ("192.0.0.0/24", "64:ff9b:1::/48", "::ffff:0:0:0/96", "fec0::/10")]
"""Not public by IANA's registries, whatever `is_global` of an older Python says: protocol assignments, NAT64 for local
use, IPv4 translated, site-local."""
_EMBEDDING = [ipaddress.IPv6Network(text) for text in ("64:ff9b::/96", "::/96")]


class ForbiddenAddress(OSError):
    """The host name resolves to an address that is not public."""


def queue_webhook(session: Session, job: JobRow, event: str) -> None:
    """Put an event of a job into the outbox, in the transaction that caused it; nothing if the job has no webhook.

    A further event is one more call of this, with a name of its own. The body is the job's state at this moment.
    """
    if job.webhook is None:
        return
    ident, now = str(uuid.uuid4()), clock(session)
    body = {
        "event": event,
        "event_id": ident,
        "job": job.id,
        "state": job.state,
        "reason": job.reason,
        "message": job.message,
        "log": safe_name(job.log_name, "log"),
        "ended": job.ended,
    }
    row = DeliveryRow(id=ident, tenant=job.tenant, job_id=job.id, url=job.webhook, created=now, next_at=now, attempts=0)
    row.body, row.state = json.dumps(body, separators=(",", ":")), "pending"
    session.add(row)


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


class WebhookSender:
    """A thread that delivers what is in the outbox."""

    def __init__(self, database: Database, settings: Settings) -> None:
        self._database, self._settings = database, settings
        self._stop = threading.Event()
        self._last = ""
        """The tenant of the last delivery."""
        self._thread = threading.Thread(target=self._run, name="webhooks", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """End; what is in the outbox is kept."""
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
        """Try the next delivery that is due, tenants in turn; False if none is.

        A thousand webhooks of one tenant, whose receiver does not answer, would else hold up everybody's for hours.
        """
        with self._database.read() as session:
            now = self._database.now(session)
            is_due = (DeliveryRow.state == "pending", DeliveryRow.next_at <= now)
            tenants = session.scalars(select(DeliveryRow.tenant).where(*is_due).distinct()).all()
        if not tenants:
            return False
        self._last = min((each for each in tenants if each > self._last), default=min(tenants))
        query = select(DeliveryRow).where(*is_due, DeliveryRow.tenant == self._last).order_by(DeliveryRow.next_at)
        with self._database.write() as session:
            due = session.scalar(query.limit(1).with_for_update(skip_locked=True))
            if due is None:
                return True  # another server has it; there may be more
            self._database.lock(session, f"secret {due.tenant}")
            secret = secret_of(session, due.tenant)
            if self._database.shared:
                due.next_at = now + 2.0 * WITHIN_S  # then another server tries it, if this one died
        status, error = self._post(due, secret)
        with self._database.write() as session:
            row = session.get(DeliveryRow, due.id, with_for_update=True)
            if row is not None and row.attempts == due.attempts:
                self._note(row, status, error, clock(session))
        return True

    def _note(self, row: DeliveryRow, status: int | None, error: str | None, now: float) -> None:
        row.attempts += 1
        row.last_status, row.last_error = status, error
        if status is not None and 200 <= status < 300:
            row.state = "delivered"
        elif row.attempts >= self._settings.webhook_attempts or status == 410:
            row.state = "given_up"
        else:
            wait = min(self._settings.webhook_backoff_s * 2.0 ** (row.attempts - 1), LONGEST_WAIT_S)
            row.next_at = now + wait
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


def post(url: str, body: bytes, headers: dict[str, str], private: bool, within_s: float = WITHIN_S) -> int:
    """POST to a public address; the status. Redirects are not followed: they would lead round the check.

    The address is resolved once and connected to, so that a second answer of the name server cannot change it. A
    receiver that answers a byte now and then is cut off after `within_s`: others wait for their webhooks.
    """
    parts = urlsplit(url)
    if parts.scheme not in ("http", "https") or not parts.hostname or parts.username is not None:
        raise ValueError("not an http(s) URL without user name")
    port = parts.port or (443 if parts.scheme == "https" else 80)
    address = _resolve(parts.hostname, port, private)
    lines = [socket.create_connection(address, TIMEOUT_S)]
    late = threading.Timer(within_s, lambda: _cut_off(lines[-1]))
    late.daemon = True
    late.start()
    kind = http.client.HTTPSConnection if parts.scheme == "https" else http.client.HTTPConnection
    try:
        with contextlib.closing(kind(parts.hostname, port, timeout=TIMEOUT_S)) as connection:
            if parts.scheme == "https":
                context = ssl.create_default_context()
                tls = context.wrap_socket(lines[0], server_hostname=parts.hostname, do_handshake_on_connect=False)
                lines.append(tls)
                tls.do_handshake()
            connection.sock = lines[-1]
            path = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
            connection.request("POST", path, body=body, headers=headers)
            with connection.getresponse() as response:
                response.read(1024)
                return response.status
    finally:
        late.cancel()
        for line in lines:
            line.close()


def _cut_off(line: socket.socket) -> None:
    """End a connection that another thread waits for; past TLS, which would wait for the other side's good-bye."""
    with contextlib.suppress(OSError):
        socket.socket.shutdown(line, socket.SHUT_RDWR)


def _resolve(host: str, port: int, private: bool) -> tuple[str, int]:
    """The first address; raises ForbiddenAddress if any is not public."""
    found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    addresses = [str(each[4][0]) for each in found]
    for text in addresses:
        if not private and not all(_is_public(each) for each in _meant(ipaddress.ip_address(text.split("%")[0]))):
            # Not which one: the error is shown to the tenant, and the names of our network are none of his business.
            raise ForbiddenAddress(f"{host} leads to an address that is not public")
    return addresses[0], port


def _is_public(address: Address) -> bool:
    return address.is_global and not address.is_multicast and not any(address in network for network in _RESERVED)


def _meant(address: Address) -> list[Address]:
    """The address, and the IPv4 address that a gateway may make of it: mapped, 6to4, NAT64, IPv4-compatible."""
    if isinstance(address, ipaddress.IPv4Address):
        return [address]
    if address.ipv4_mapped is not None:
        return [address.ipv4_mapped]
    if address.sixtofour is not None:
        return [address, address.sixtofour]
    if any(address in network for network in _EMBEDDING):
        return [address, ipaddress.IPv4Address(int(address) & 0xFFFFFFFF)]
    return [address]
