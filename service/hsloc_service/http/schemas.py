"""What goes over the wire. Strict: `false` is not a number, an unknown key is an error."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from pydantic import (
    AwareDatetime,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    FiniteFloat,
    ValidationError,
    create_model,
    model_validator,
)
from pydantic_core import PydanticCustomError

from hsloc.options import offered
from hsloc_service.config_schema import whole
from hsloc_service.errors import ServiceError
from hsloc_service.http.validation import EXAMPLE_ID, TAG_PATTERN, URL_PATTERN, UUID_PATTERN, WORD_PATTERN, in_words

if TYPE_CHECKING:
    from collections.abc import Iterable

    from hsloc.options import Option

Ident = Annotated[str, Field(pattern=UUID_PATTERN, examples=[EXAMPLE_ID])]
PoseList = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3, examples=[[1.0, 2.0, 0.0]])]
MAX_LOGS = 64
UNIQUE: dict[str, Any] = {"uniqueItems": True}
Label = Annotated[str, Field(max_length=255)]
Config = dict[str, Any]
"""Parameters; `hsloc_service.config_schema` knows their schema, which the application puts into the OpenAPI."""


class Strict(BaseModel):
    """No conversions, no unknown keys."""

    model_config = ConfigDict(strict=True, extra="forbid")


class Problem(BaseModel):
    """Every answer that is not a success."""

    code: str = Field(description="a word for programs", examples=["not_found"])
    message: str = Field(description="a sentence for people", examples=["there is no job '…'"])
    details: list[dict[str, Any]] | None = Field(default=None, description="where a request did not fit the schema")


class FileView(BaseModel):
    """An upload: a log, or a file of a map."""

    id: Ident
    name: str
    state: Literal["receiving", "complete"]
    size: int | None = Field(description="bytes; null while not known")
    received: int = Field(description="bytes that are safe on the server's disk")
    sha256: str | None
    created: AwareDatetime
    expires: AwareDatetime | None = Field(description="an unfinished upload is removed then")


class FileList(BaseModel):
    """Uploads, newest first; pass `next` as `before` for more."""

    files: list[FileView]
    next: Ident | None


class MapFiles(Strict):
    """The two uploads of a map as nav2 writes it."""

    yaml: Ident
    image: Ident


def _type(option: Option) -> Any:
    """The type of an option on the wire."""
    match option.kind:
        case "choice":
            return Literal[option.choices]
        case "number":
            return Annotated[FiniteFloat, Field(ge=option.least, le=option.most)]
        case "whole":
            return Annotated[int, Field(ge=0, le=option.most or 2**53 - 1), BeforeValidator(whole)]
        case "pose":
            return PoseList
        case "switch":
            return bool
        case _ if option.name == "config":
            return Config
        case _ if option.is_map:
            return MapFiles
        case _:
            return Ident if option.kind == "path" or option.is_upload else Label


def _fields(options: Iterable[Option], *, optional: bool = False) -> dict[str, Any]:
    """Fields of a model. What is optional, or has no default, may be null."""
    found: dict[str, Any] = {}
    for option in options:
        nullable = optional or option.default is None
        kind = _type(option) | None if nullable else _type(option)
        default = None if nullable else option.default
        found[option.name] = (kind, Field(default=default, description=option.http or option.help))
    return found


_HTTP = tuple(offered("http"))
Model: Any = create_model  # Its overloads do not take fields that are made.
ReadRequest = Model(
    "ReadRequest",
    __base__=Strict,
    __doc__="How to read the log; what is left out is found out.",
    **_fields(option for option in _HTTP if option.place == "read"),
)
_Run = Model(
    "RunOptions",
    __base__=Strict,
    **_fields(option for option in _HTTP if option.place != "read" and not (option.is_upload or option.is_map)),
)


class _Common(Strict):
    """What is no option of `hsloc replay`, of a job and of one that is run again."""

    read: ReadRequest | None = None  # type: ignore[valid-type]
    webhook: Annotated[str, Field(max_length=2000, pattern=URL_PATTERN)] | None = Field(
        default=None, description="URL that is called when the job has ended"
    )
    tag: Annotated[str, Field(pattern=TAG_PATTERN)] | None = Field(
        default=None,
        description="run only where servers or workers were started with this tag",
        examples=["big-memory"],
    )
    priority: Annotated[int, Field(ge=-100, le=100), BeforeValidator(whole)] | None = Field(
        default=None, description="of your waiting jobs those with a higher one are begun first; 0 by default"
    )


class RunRequest(_Run, _Common):  # type: ignore[misc, valid-type]
    """How to run: the options of `hsloc replay`."""


_Job = Model(
    "JobOptions", __base__=RunRequest, **_fields(option for option in _HTTP if option.is_upload or option.is_map)
)


ALIGNED: dict[str, Any] = {
    "mode": {"enum": ["auto", "slam"]},
    "mapper": {"enum": ["graph", None]},
    "config": {"properties": {"mapper": {"enum": ["graph"]}}},
    "resume": {"type": "null"},
}
"""What other fields may be beside `align_to`, as JSON Schema."""


class JobRequest(_Job):  # type: ignore[misc, valid-type]
    """What to run, and how. Either `log` or `logs`."""

    model_config = ConfigDict(
        json_schema_extra={
            "oneOf": [
                {"required": ["log"], "properties": {"log": {"type": "string"}}},
                {"required": ["logs"], "properties": {"logs": {"type": "array"}}},
            ],
            "if": {"required": ["resume"], "properties": {"resume": {"type": "string"}}},
            "then": {
                "properties": {
                    "map": {"type": "null"},
                    "align_to": {"type": "null"},
                    "mapper": {"enum": ["graph", None]},
                }
            },
            "else": {
                "if": {"required": ["align_to"], "properties": {"align_to": {"type": "object"}}},
                "then": {"properties": ALIGNED},
            },
            "examples": [
                {"log": "3f0c1a52-8f5d-4c3b-9a51-0d6f0c1d2e3f", "seed": 7},
                {
                    "logs": ["3f0c1a52-8f5d-4c3b-9a51-0d6f0c1d2e3f", "9b1f2c8e-4a0d-4f7e-8a55-2c7d9e0f1a2b"],
                    "relations": "5d2e8b90-1c3f-4b6a-9d77-e4f5a6b7c8d9",
                    "resume": "c7a1d3e5-6f80-4912-b3c4-d5e6f7a8b9c0",
                    "mode": "slam",
                },
                {
                    "log": "3f0c1a52-8f5d-4c3b-9a51-0d6f0c1d2e3f",
                    "align_to": {
                        "yaml": "5d2e8b90-1c3f-4b6a-9d77-e4f5a6b7c8d9",
                        "image": "9b1f2c8e-4a0d-4f7e-8a55-2c7d9e0f1a2b",
                    },
                },
            ],
        }
    )

    log: Ident | None = Field(default=None, description="id of the uploaded log")
    logs: Annotated[list[Ident], Field(min_length=1, max_length=MAX_LOGS, json_schema_extra=UNIQUE)] | None = Field(
        default=None, description="ids of several uploaded logs that are parts of one run, as `hsloc replay a b`"
    )

    @model_validator(mode="after")
    def _one_way(self) -> JobRequest:
        """What contradicts itself is refused before it is queued."""
        if (self.log is None) == (self.logs is None):
            raise PydanticCustomError("logs", "give either `log`, or `logs` for several parts of one run")
        if self.logs is not None and len(set(self.logs)) < len(self.logs):
            raise PydanticCustomError("logs", "logs: a log is named twice; several logs must be parts of one run")
        if self.resume is not None and self.map is not None:
            raise PydanticCustomError(
                "resume", "the map is either that of files (`map`) or that of a job (`resume`); leave out one of them"
            )
        if self.resume is not None and self.mapper == "point":
            raise PydanticCustomError("resume", "a map is extended by the graph mapper; leave out `resume` or `mapper`")
        if self.align_to is None:
            return self
        point = "point" in (self.mapper, (self.config or {}).get("mapper"))
        if point or self.resume is not None or self.mode == "localise":
            raise PydanticCustomError(
                "align_to",
                "a map that the graph mapper builds is aligned to a plan; leave out `align_to`, or `resume`, mode "
                "`localise` and mapper `point`",
            )
        return self


_Rerun = Model(
    "RerunOptions", __base__=Strict, **_fields((each for each in _HTTP if each.place != "read"), optional=True)
)


class RerunRequest(_Rerun, _Common):  # type: ignore[misc, valid-type]
    """What to change in a job that is run again; its logs, and all that is left out, stay, in `read` as well."""


Verdict = Literal["good", "check", "failed"]
State = Literal["queued", "running", "cancelling", "succeeded", "failed", "crashed", "cancelled"]


Word = Annotated[str, Field(pattern=WORD_PATTERN)]


class JobDescription(Strict):
    """What a person calls a job and notes about it; what is left out stays, null or nothing removes it."""

    title: Annotated[str, Field(max_length=200)] | None = Field(default=None, description="instead of the log's name")
    labels: Annotated[list[Word], Field(max_length=20)] | None = Field(
        default=None, description="words without commas, by which jobs are found", examples=[["floor 2", "rain"]]
    )
    notes: Annotated[str, Field(max_length=4000)] | None = None


class LabelList(BaseModel):
    """All labels of your jobs."""

    labels: list[str]


class ProgressView(BaseModel):
    """How far a running job is."""

    phase: str = Field(description="fetch, open, prepare, compile, replay, refine, write, store", examples=["replay"])
    text: str = Field(
        description="the phase in words: compile is the compilation of the search kernels, once on each machine",
        examples=["replay"],
    )
    done: float = Field(
        description="seconds of the log (replay), kernels compiled (compile), or the part of the work from 0 to 1"
    )
    total: float = Field(description="of `done`; 0 where it is not known (compile)")
    fraction: float = Field(ge=0.0, le=1.0)
    speed: float | None = Field(description="done per second of wall time since the attempt began")
    scans: int | None
    age_s: float = Field(description="seconds since the job's process said so")


class QueueView(BaseModel):
    """Where a waiting job is in the queue of its tenant."""

    ahead: int = Field(ge=0, description="jobs of yours that are begun before it")
    wait_s: float | None = Field(
        description="seconds until it begins, about, by how long your last jobs ran; null: none ran"
    )


class JobView(BaseModel):
    """A job.

    `reason` of a failed job: invalid_input, out_of_memory, cpu_limit, wall_limit, output_limit, disk_full, store (the
    map to extend is in a store that this server is not set to), fault_injection; of a crashed one: signal, exit,
    internal_error, protocol, attempts.
    """

    id: Ident
    seq: int = Field(description="number of the job on this server; the cursor of the list")
    state: State
    reason: str | None
    message: str | None
    log: str = Field(description="what the client called the log")
    title: str | None = Field(description="what a person calls the job")
    labels: list[str]
    notes: str | None
    request: dict[str, Any]
    rerun_of: str | None
    attempt: int
    created: AwareDatetime
    started: AwareDatetime | None
    ended: AwareDatetime | None
    progress: ProgressView | None
    queue: QueueView | None = Field(default=None, description="of a waiting job that is asked for by its id")
    heartbeat_age_s: float | None = Field(description="seconds since the job's supervisor said that it lives")
    outcome: Literal["ok", "below_threshold"] | None = Field(
        description="of a job that succeeded: below_threshold if its result does not keep a limit of the request, such "
        "as min_localised; `summary.limits` names them"
    )
    summary: dict[str, Any] | None


class JobList(BaseModel):
    """Jobs, newest first; pass `next` as `before` for more."""

    jobs: list[JobView]
    next: int | None
    total: int | None = Field(default=None, description="how many jobs the filter leaves, where `brief` was asked for")


class AssetView(BaseModel):
    """A file of the results."""

    name: str
    size: int
    sha256: str
    media_type: str
    href: str


class Manifest(BaseModel):
    """All files of the results of a job."""

    job: Ident
    assets: list[AssetView]


class DeliveryView(BaseModel):
    """A webhook and what became of it."""

    event_id: str
    url: str
    state: Literal["pending", "delivered", "given_up"]
    attempts: int
    last_status: int | None
    last_error: str | None


class DeliveryList(BaseModel):
    """The webhooks of a job."""

    deliveries: list[DeliveryView]


class SecretView(BaseModel):
    """The key of the webhooks' HMAC-SHA256."""

    secret: str


Request = TypeVar("Request", bound=RunRequest)


def checked(kind: type[Request], values: Any) -> Request:
    """A request that did not come as the body. Raises ServiceError 422 with the place of what is wrong."""
    try:
        found: Request = kind.model_validate(values)
        return found
    except ValidationError as error:
        where, what = in_words(error.errors()[0])
        raise ServiceError(422, "invalid", f"{'.'.join(('request', *where))}: {what}") from error


def moment(seconds: float | None) -> datetime | None:
    """Seconds since 1970 as a moment in UTC."""
    return None if seconds is None else datetime.fromtimestamp(seconds, UTC)


def known_moment(seconds: float) -> datetime:
    """The same for a time that is there."""
    return datetime.fromtimestamp(seconds, UTC)
