"""Structured logs: one JSON object a line on stderr, with the ids of the job and of the request."""

from __future__ import annotations

import json
import logging
import sys
import time
from contextvars import ContextVar
from typing import Any

request_id: ContextVar[str | None] = ContextVar("request_id", default=None)
_logger = logging.getLogger("hsloc.service")


def log(event: str, level: int = logging.INFO, **fields: Any) -> None:
    """Log an event in a word with its fields; never a token, never the content of an upload."""
    _logger.log(level, event, extra={"fields": fields})


class JsonFormatter(logging.Formatter):
    """A record as one line of JSON: line breaks in what clients send cannot forge lines."""

    def format(self, record: logging.LogRecord) -> str:
        """The line."""
        values: dict[str, Any] = {
            "at": time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created)) + f".{int(record.msecs):03d}Z",
            "level": record.levelname.lower(),
            "event": record.getMessage(),
        }
        if (ident := request_id.get()) is not None:
            values["request"] = ident
        values |= getattr(record, "fields", {})
        if record.exc_info is not None:
            values["error"] = self.formatException(record.exc_info)
        return json.dumps(values, default=str)


def configure(level: str = "INFO") -> None:
    """Send the service's and uvicorn's logs to stderr as JSON."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter())
    for name in ("hsloc.service", "uvicorn", "uvicorn.error"):
        logger = logging.getLogger(name)
        logger.handlers = [handler]
        logger.setLevel(level)
        logger.propagate = False
