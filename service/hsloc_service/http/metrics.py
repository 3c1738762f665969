"""Prometheus metrics of this process."""

from __future__ import annotations

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram

REGISTRY = CollectorRegistry()
REQUESTS = Counter("hsloc_requests", "Requests answered", ["method", "route", "status"], registry=REGISTRY)
LATENCY = Histogram(
    "hsloc_request_seconds",
    "Time to answer",
    ["route"],
    buckets=(0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 5.0, 30.0),
    registry=REGISTRY,
)
UPLOADED = Counter("hsloc_uploaded_bytes", "Bytes of completed uploads", registry=REGISTRY)
ENDED = Counter("hsloc_jobs_ended", "Attempts at jobs by how they ended", ["state"], registry=REGISTRY)
JOBS = Gauge("hsloc_jobs", "Jobs by state", ["state"], registry=REGISTRY)
BUSY = Gauge("hsloc_slots_busy", "Slots that run a job", registry=REGISTRY)
SLOTS = Gauge("hsloc_slots", "Slots", registry=REGISTRY)
FREE = Gauge("hsloc_disk_free_bytes", "Free bytes of the data folder's disk", registry=REGISTRY)
OLDEST = Gauge("hsloc_oldest_queued_seconds", "Age of the oldest job that waits", registry=REGISTRY)
DELIVERIES = Gauge("hsloc_webhooks_pending", "Webhooks that wait for delivery", registry=REGISTRY)
STORE_ERRORS = Counter("hsloc_store_errors", "Calls to the store of results that failed", registry=REGISTRY)
