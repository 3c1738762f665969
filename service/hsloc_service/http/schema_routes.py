"""JSON Schemas of what a job's results hold, for programs that read them."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

from fastapi import APIRouter

from hsloc_service.errors import not_found
from hsloc_service.http.context import Reader, problems

if TYPE_CHECKING:
    from collections.abc import Callable

router = APIRouter(prefix="/v1/schemas", tags=["system"])


@router.get("", responses=problems())
def schemas(who: Reader) -> list[str]:
    """Names of the schemas."""
    del who
    return sorted(_SCHEMAS)


@router.get("/{name}", responses=problems(404))
def schema(name: str, who: Reader) -> dict[str, Any]:
    """The JSON Schema (draft 2020-12) of a file of the results: `run-metrics` of metrics.json."""
    del who
    if name not in _SCHEMAS:
        raise not_found("schema", name)
    return _SCHEMAS[name]()


@functools.cache
def _run_metrics() -> dict[str, Any]:
    from hsloc.run_metrics import schema

    return schema()


_SCHEMAS: dict[str, Callable[[], dict[str, Any]]] = {"run-metrics": _run_metrics}
