"""The OpenAPI description: what FastAPI cannot know about the routes."""

from __future__ import annotations

import asyncio
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


def describe(app: FastAPI) -> dict[str, Any]:
    """The description, with the routes that need a token, the schema of `config`, and no nullable parameter."""
    schema = get_openapi(title=app.title, version=app.version, summary=app.summary, routes=app.routes)
    parts = schema.setdefault("components", {})
    parts["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer"}}
    _add_request_models(parts["schemas"])
    for path, operations in schema["paths"].items():
        for operation in operations.values():
            if path not in PUBLIC and not path.startswith(PUBLIC_PREFIX):
                operation["security"] = [{"token": []}]
            for parameter in operation.get("parameters", ()):
                _not_null(parameter["schema"])
    return schema


def _add_request_models(models: dict[str, Any]) -> None:
    models["Config"] = deepcopy(config_schema.options()["config_schema"])
    models["RunRequest"] = RunRequest.model_json_schema(ref_template="#/components/schemas/{model}")
    models["RunRequest"].pop("$defs")  # FastAPI has put them among the others
    for name in ("RunRequest", "JobRequest", "RerunRequest"):
        models[name]["properties"]["config"]["anyOf"][0] = {"$ref": "#/components/schemas/Config"}


def _not_null(schema: dict[str, Any]) -> None:
    """Drop null from a parameter's schema: one that is left out is None here, but `null` on the wire is a text."""
    kinds = [kind for kind in schema.get("anyOf", ()) if kind != {"type": "null"}]
    if len(kinds) == 1:
        del schema["anyOf"]
        schema |= kinds[0]
