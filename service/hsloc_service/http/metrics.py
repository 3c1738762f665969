"""Prometheus metrics of this process: those of a machine that runs jobs, and those of a server besides."""

from __future__ import annotations

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, ProcessCollector

from hsloc.version import __version__

MACHINE = CollectorRegistry()
"""What a worker has, too."""
REGISTRY = CollectorRegistry()
"""All of a server."""
REQUESTS = Counter("hsloc_requests", "Requests answered", ["method", "route", "status"], registry=REGISTRY)
LATENCY = Histogram(
    "hsloc_request_seconds",
    "Time to answer",
    ["route"],
    buckets=(0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 5.0, 30.0),
    registry=REGISTRY,
)
UPLOADED = Counter("hsloc_uploaded_bytes", "Bytes of completed uploads", registry=REGISTRY)
ENDED = Counter("hsloc_jobs_ended", "Attempts at jobs by how they ended", ["state"], registry=MACHINE)
JOBS = Gauge("hsloc_jobs", "Jobs by state", ["state"], registry=REGISTRY)
SECONDS = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0, 10000.0)
DURATION = Histogram("hsloc_job_seconds", "Time that an attempt took", ["state"], buckets=SECONDS, registry=MACHINE)
WAIT = Histogram("hsloc_job_wait_seconds", "Time that a job waited for a slot", buckets=SECONDS, registry=MACHINE)
BUILD = Gauge("hsloc_build_info", "Always 1; the version is in its label", ["version"], registry=MACHINE)
BUILD.labels(__version__).set(1)
ProcessCollector(registry=MACHINE)
BUSY = Gauge("hsloc_slots_busy", "Slots that run a job", registry=MACHINE)
SLOTS = Gauge("hsloc_slots", "Slots", registry=MACHINE)
WORKERS = Gauge("hsloc_workers", "Servers and workers of the database that are alive", ["kind"], registry=REGISTRY)
FLEET_SLOTS = Gauge("hsloc_fleet_slots", "Slots of all that are alive", registry=REGISTRY)
FREE = Gauge("hsloc_disk_free_bytes", "Free bytes of the data folder's disk", registry=MACHINE)
OLDEST = Gauge("hsloc_oldest_queued_seconds", "Age of the oldest job that waits", registry=REGISTRY)
DELIVERIES = Gauge("hsloc_webhooks_pending", "Webhooks that wait for delivery", registry=REGISTRY)
STORE_ERRORS = Counter("hsloc_store_errors", "Calls to the store of results that failed", registry=MACHINE)
REGISTRY.register(MACHINE)


def attempt_ended(state: str, seconds: float, waited_s: float) -> None:
    """Count an attempt that ended in a state, after `seconds`, and after its job waited `waited_s` for a slot."""
    ENDED.labels(state).inc()
    DURATION.labels(state).observe(seconds)
    WAIT.observe(waited_s)
