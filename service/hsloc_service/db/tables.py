"""The tables. Every row of a user belongs to a tenant, and no query of the repositories leaves the tenant out."""

from __future__ import annotations

from typing import Any, Literal

from sqlalchemy import JSON, BigInteger, Index, Integer, Text, UniqueConstraint, text
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

SCHEMA_VERSION = 8
"""Stored in the database; what leads from one to the next is in `migrations`."""

JobState = Literal["queued", "running", "cancelling", "succeeded", "failed", "crashed", "cancelled"]
ACTIVE: tuple[JobState, ...] = ("queued", "running", "cancelling")
ENDED: tuple[JobState, ...] = ("succeeded", "failed", "crashed", "cancelled")


LONG = BigInteger().with_variant(Integer, "sqlite")
"""64 bits; SQLite's integers always have them, and number rows by themselves only if they are called INTEGER."""


class Base(DeclarativeBase):
    """Base of the tables."""

    type_annotation_map = {dict[str, Any]: JSON, list[str]: JSON, int: LONG}  # noqa: RUF012


class TokenRow(Base):
    """A bearer token; the secret itself is not kept."""

    __tablename__ = "token"
    id: Mapped[str] = mapped_column(primary_key=True)
    tenant: Mapped[str]
    label: Mapped[str] = mapped_column(default="")
    scopes: Mapped[str]
    sha256: Mapped[str]
    created: Mapped[float]
    expires: Mapped[float | None]
    revoked: Mapped[float | None]


class FileRow(Base):
    """An upload: a log, or one of the two files of a map."""

    __tablename__ = "file"
    id: Mapped[str] = mapped_column(primary_key=True)
    tenant: Mapped[str] = mapped_column(index=True)
    name: Mapped[str]
    """What the client called it; only ever a label."""
    state: Mapped[str] = mapped_column(default="receiving")
    """receiving, complete"""
    size: Mapped[int | None]
    """Announced, or measured when complete."""
    received: Mapped[int] = mapped_column(default=0)
    """Bytes known to be on the disk."""
    sha256: Mapped[str | None]
    created: Mapped[float]
    expires: Mapped[float | None]
    __table_args__ = (
        Index("file_by_tenant", "tenant", "size", "received"),  # the quota
        Index("file_by_state", "state", "size", "received"),  # what was announced and has not come yet
    )


class JobRow(Base):
    """A job, and who runs it now."""

    __tablename__ = "job"
    seq: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    id: Mapped[str] = mapped_column(unique=True)
    tenant: Mapped[str] = mapped_column(index=True)
    file_id: Mapped[str] = mapped_column(index=True)
    log_name: Mapped[str]
    request: Mapped[dict[str, Any]]
    rerun_of: Mapped[str | None]
    resume_of: Mapped[str | None] = mapped_column(index=True)
    """The job whose map is extended."""
    state: Mapped[str] = mapped_column(default="queued")
    reason: Mapped[str | None]
    """Why it ended as it did, in a word: see the API's documentation."""
    message: Mapped[str | None]
    """The same in a sentence for a person."""
    created: Mapped[float]
    started: Mapped[float | None]
    ended: Mapped[float | None]
    attempt: Mapped[int] = mapped_column(default=0)
    """The fence: every write of a worker names the owner and the attempt."""
    owner: Mapped[str | None]
    lease_until: Mapped[float | None]
    cancel: Mapped[bool] = mapped_column(default=False)
    phase: Mapped[str | None]
    done: Mapped[float | None]
    total: Mapped[float | None]
    scans: Mapped[int | None]
    speed: Mapped[float | None]
    progressed: Mapped[float | None]
    heartbeat: Mapped[float | None]
    folder: Mapped[str | None]
    """Name of the folder with the results: of the attempt that won."""
    store: Mapped[str | None]
    """Where that folder is: the URL of an object store; None is the data folder."""
    summary: Mapped[dict[str, Any] | None]
    webhook: Mapped[str | None]
    tag: Mapped[str | None]
    """What a server or worker must be started with to run the job."""
    bytes: Mapped[int] = mapped_column(default=0)
    """What the results take, by their manifest."""
    priority: Mapped[int] = mapped_column(default=0, server_default="0")
    """Of a tenant's waiting jobs those with a higher one are begun first."""
    not_before: Mapped[float | None]
    """When the next attempt may begin, after one that failed."""
    sweep: Mapped[str | None] = mapped_column(index=True)
    """The sweep that the job is a run of."""
    title: Mapped[str | None]
    """What a person calls the job; None: by the name of its log."""
    labels: Mapped[str] = mapped_column(default=",", server_default=",")
    """Words by which a person finds it, each between commas: `,floor 2,rain,`."""
    notes: Mapped[str | None]
    """What a person wrote about it."""
    __table_args__ = (
        Index("job_by_state", "state", "seq"),
        Index("job_by_tenant", "tenant", "state", "bytes"),  # the quota, and how many wait: asked at every submission
        Index("job_by_start", "tenant", "started"),  # when a tenant was served last: asked at every claim
        Index("job_waiting", "tenant", "state", text("priority DESC"), "seq"),  # whose turn it is: asked at every claim
        Index("job_by_end", "ended", "seq"),  # the old ones: asked at every tidying
        Index("job_by_name", "tenant", text("lower(log_name)"), text("seq DESC")),  # a page of them in this order
    )


class AssetRow(Base):
    """One file of a result: the manifest."""

    __tablename__ = "asset"
    job_id: Mapped[str] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(primary_key=True)
    size: Mapped[int]
    sha256: Mapped[str]
    media_type: Mapped[str]


class ShareRow(Base):
    """A link by which whoever has it sees one job and its results; the secret itself is not kept."""

    __tablename__ = "share"
    id: Mapped[str] = mapped_column(primary_key=True)
    tenant: Mapped[str]
    job_id: Mapped[str] = mapped_column(index=True)
    sha256: Mapped[str] = mapped_column(unique=True)
    created: Mapped[float]
    expires: Mapped[float]


class RemovalRow(Base):
    """Results that no job has any more, and that are still to be removed from where they are."""

    __tablename__ = "removal"
    folder: Mapped[str] = mapped_column(primary_key=True)
    store: Mapped[str | None]
    created: Mapped[float]


class UploadDeletionRow(Base):
    """An upload that was deleted, and whose bytes are still to be removed from the disk."""

    __tablename__ = "upload_deletion"
    id: Mapped[str] = mapped_column(primary_key=True)
    created: Mapped[float]


class UploadPartRow(Base):
    """A block of an upload that is in an object store, under the name `<file_id>.<number>`."""

    __tablename__ = "upload_part"
    file_id: Mapped[str] = mapped_column(primary_key=True)
    start: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    size: Mapped[int]
    number: Mapped[int]


class WorkerRow(Base):
    """A server or worker that shares the database, and when it was last there."""

    __tablename__ = "worker"
    id: Mapped[str] = mapped_column(primary_key=True)
    """The owner in the leases of its jobs."""
    kind: Mapped[str]
    """server, worker"""
    host: Mapped[str]
    pid: Mapped[int]
    version: Mapped[str]
    slots: Mapped[int]
    draining: Mapped[bool]
    started: Mapped[float]
    heartbeat: Mapped[float]


class CounterRow(Base):
    """The last number that was given out under a name."""

    __tablename__ = "counter"
    name: Mapped[str] = mapped_column(primary_key=True)
    value: Mapped[int]


class EventRow(Base):
    """What happened to a job; the id is the cursor of the event stream."""

    __tablename__ = "event"
    id: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    tenant: Mapped[str]
    job_id: Mapped[str]
    at: Mapped[float]
    kind: Mapped[str]
    """state, progress, log"""
    data: Mapped[dict[str, Any]]
    __table_args__ = (Index("event_by_job", "job_id", "id"), {"sqlite_autoincrement": True})


class IdempotencyRow(Base):
    """A key that a client chose for a request, so that it can be sent again."""

    __tablename__ = "idempotency"
    tenant: Mapped[str] = mapped_column(primary_key=True)
    key: Mapped[str] = mapped_column(primary_key=True)
    sha256: Mapped[str]
    job_id: Mapped[str] = mapped_column(index=True)
    created: Mapped[float]


class DeliveryRow(Base):
    """A webhook to be delivered; written in the transaction that ends the job."""

    __tablename__ = "delivery"
    id: Mapped[str] = mapped_column(primary_key=True)
    tenant: Mapped[str]
    job_id: Mapped[str] = mapped_column(index=True)
    url: Mapped[str]
    body: Mapped[str] = mapped_column(Text)
    state: Mapped[str] = mapped_column(default="pending")
    """pending, delivered, given_up"""
    attempts: Mapped[int] = mapped_column(default=0)
    next_at: Mapped[float]
    last_status: Mapped[int | None]
    last_error: Mapped[str | None]
    created: Mapped[float]
    __table_args__ = (Index("delivery_by_state", "state", "next_at"),)  # what is due: asked every second


class SecretRow(Base):
    """The key that signs a tenant's webhooks."""

    __tablename__ = "secret"
    tenant: Mapped[str] = mapped_column(primary_key=True)
    webhook: Mapped[str]
    __table_args__ = (UniqueConstraint("tenant"),)


class SweepRow(Base):
    """Jobs that were submitted together: logs x configurations x seeds."""

    __tablename__ = "sweep"
    id: Mapped[str] = mapped_column(primary_key=True)
    tenant: Mapped[str] = mapped_column(index=True)
    name: Mapped[str]
    created: Mapped[float]
    runs: Mapped[dict[str, Any]]
    """For each job by its id: name of the run, log, configuration and seed, in the order of the table."""


class AuditRow(Base):
    """Who did something that cannot be undone, or gave or took access."""

    __tablename__ = "audit"
    id: Mapped[int] = mapped_column(primary_key=True, autoincrement=True)
    at: Mapped[float]
    tenant: Mapped[str]
    actor: Mapped[str]
    """Id of the token; `operator` for the command line, `retention` for the server itself, `` without tokens."""
    action: Mapped[str]
    target: Mapped[str]
    __table_args__ = (Index("audit_by_tenant", "tenant", "id"),)
