"""The OpenAPI description: what FastAPI cannot know about the routes, in terms that generators of clients understand.

The served description is meant for generated clients. The complete one has two things more, which generators cannot
use: the conditions between the fields of a request, and the operations of tus, a protocol that has clients of its own.
"""

from __future__ import annotations

import asyncio
import json
from copy import deepcopy
from typing import TYPE_CHECKING, Any

from anyio import to_thread
from fastapi.openapi.utils import get_openapi
from fastapi.responses import JSONResponse

from hsloc_service import config_schema
from hsloc_service.http.guard import PUBLIC, PUBLIC_PREFIX
from hsloc_service.http.schemas import RunRequest

if TYPE_CHECKING:
    from fastapi import FastAPI


TUS = "/v1/tus"
REQUESTS = (
    "Config",
    "RunRequest",
    "JobRequest",
    "RerunRequest",
    "ReadRequest",
    "MapFiles",
    "SweepRequest",
    "SweepOptions",
)
"""Models of what a client sends."""
CONDITIONS = ("oneOf", "if", "then", "else", "dependentRequired")
DESCRIPTION = f"""\
Upload a log by `POST /v1/files`, submit a job by `POST /v1/jobs`, follow it by `GET /v1/jobs/{{job_id}}`, and get its
results by `GET /v1/jobs/{{job_id}}/results`. Uploads that resume after a broken connection use the protocol
[tus](https://tus.io) 1.0.0 at `{TUS}`; take one of its own clients. A field of a request that is left out has
the default that its description names.
"""


def add_openapi(app: FastAPI) -> None:
    """Describe the application, and serve the description at `/openapi.json`."""

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            app.openapi_schema = describe(app)
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]
    making = asyncio.Lock()

    @app.get("/openapi.json", include_in_schema=False)
    async def description() -> JSONResponse:
        """Built at the first request, which takes seconds: in one thread, so that other requests go on."""
        async with making:
            if app.openapi_schema is None:
                await to_thread.run_sync(app.openapi)
        return JSONResponse(app.openapi())


def describe(app: FastAPI, *, complete: bool = False) -> dict[str, Any]:
    """The description, with the routes that need a token, the schema of `config`, and no nullable parameter."""
    schema = get_openapi(
        title=app.title, version=app.version, summary=app.summary, description=DESCRIPTION, routes=app.routes
    )
    parts = schema.setdefault("components", {})
    parts["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer"}}
    _add_request_models(parts["schemas"])
    for path, operations in schema["paths"].items():
        for operation in operations.values():
            if path not in PUBLIC and not path.startswith(PUBLIC_PREFIX):
                operation["security"] = [{"token": []}]
            for parameter in operation.get("parameters", ()):
                _not_null(parameter["schema"])
    if not complete:
        for path in [path for path in schema["paths"] if path.startswith(TUS)]:
            del schema["paths"][path]
        for name in REQUESTS:
            _simplify(parts["schemas"][name])
    return schema


def _add_request_models(models: dict[str, Any]) -> None:
    models["Config"] = deepcopy(config_schema.options()["config_schema"])
    models["RunRequest"] = RunRequest.model_json_schema(ref_template="#/components/schemas/{model}")
    models["RunRequest"].pop("$defs")  # FastAPI has put them among the others
    for name in ("RunRequest", "JobRequest", "RerunRequest", "SweepOptions"):
        models[name]["properties"]["config"]["anyOf"][0] = {"$ref": "#/components/schemas/Config"}


def _not_null(schema: dict[str, Any]) -> None:
    """Drop null from a parameter's schema: one that is left out is None here, but `null` on the wire is a text."""
    kinds = [kind for kind in schema.get("anyOf", ()) if kind != {"type": "null"}]
    if len(kinds) == 1:
        del schema["anyOf"]
        schema |= kinds[0]


def _simplify(schema: Any) -> None:
    """Drop conditions between fields, and defaults, which generators take for fields that a request must have."""
    if isinstance(schema, list):
        for each in schema:
            _simplify(each)
    if not isinstance(schema, dict):
        return
    for name in CONDITIONS:
        schema.pop(name, None)
    if "patternProperties" in schema:  # generators know no patterns
        (schema["additionalProperties"],) = schema.pop("patternProperties").values()
    default = schema.pop("default", None)
    if default is not None and not isinstance(default, dict):
        described = f"{schema['description']}; " if "description" in schema else ""
        schema["description"] = f"{described}default: {json.dumps(default)}"
    for key, each in schema.items():
        if key == "properties":
            for field in each.values():
                _simplify(field)
        elif key in ("items", "anyOf", "allOf"):
            _simplify(each)
