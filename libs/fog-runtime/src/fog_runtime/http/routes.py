"""Routes whose signatures declare body, response, role and headers; behaviour and OpenAPI follow from them.

routes = Routes(app, "zones")
routes.raises(BusyError, [MapProblem.BUSY], lambda error: ProblemError(MapProblem.BUSY, str(error)))

@routes.put("/api/v1/zones/{zone_id}", raises=[BusyError], problems=[MapProblem.NO_ZONE])
async def put_zone(zone_id: str, body: Body[ZoneBody], caller: Operator, if_match: IfMatch = None) -> Answer[Zone]:
...
"""

# The types of bodies and answers are read from annotations at run time, so they can't be typed more closely here.
# ruff: noqa: ANN401

import functools
import inspect
import re
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Final,
    Generic,
    NamedTuple,
    TypeVar,
    get_args,
    get_origin,
    get_type_hints,
)

import msgspec
from fastapi import Depends, FastAPI, Header, Request, Response
from starlette.routing import compile_path

from fog_runtime.http.problems import PROBLEM, RETRY_AFTER, HttpProblem, Problem, ProblemCode, ProblemError
from fog_runtime.http.tokens import Caller

if TYPE_CHECKING:
    from fog_runtime.http.link import CoreLink

T = TypeVar("T")
E = TypeVar("E", bound=Exception)
Handler = TypeVar("Handler", bound=Callable[..., Awaitable[object]])

_ANSWERS: Final = {201: "The new record", 204: "Done", 503: "The answer while something is missing"}
_SCHEMAS: Final = "#/components/schemas/{name}"
ALWAYS_SERVED: Final = frozenset({"/healthz", "/readyz", "/leads", "/metrics"})
"""Routes that are served however many others are open."""


class _BodyMarker:
    """Marks the parameter of a route that receives the decoded body."""


Body = Annotated[T, _BodyMarker()]
"""A parameter that receives the JSON body, decoded and validated as this msgspec type."""

MERGE_PATCH: Final = "application/merge-patch+json"


@dataclass(frozen=True, slots=True)
class PatchOf(_BodyMarker):
    """Marks the parameter that receives a JSON merge patch (RFC 7396) of a body of this type, to be `patched`."""

    kind: type[msgspec.Struct]


Patch = dict[str, Any]
"""A parameter with `PatchOf` gets this: the fields to be replaced, null for those to be left out."""


IfMatch = Annotated[
    str | None,
    Header(alias="If-Match", description="The ETag that was read: refuse the request if the record has changed since"),
]


def _client_host(request: Request) -> str:
    return request.client.host if request.client else ""


ClientHost = Annotated[str, Depends(_client_host)]
"""A parameter that receives the client's address, empty if it is not known."""


@dataclass(frozen=True, slots=True)
class Answer(Generic[T]):
    """An answer with headers, and with another of the route's statuses than the usual one."""

    value: T
    headers: Mapping[str, str] = field(default_factory=dict)
    status: int | None = None


@dataclass(frozen=True, slots=True)
class Encoded(Generic[T]):
    """An answer that was encoded before, as JSON."""

    data: bytes


def etag(version: int | str) -> dict[str, str]:
    """Return the header with a record's version, or with what else names its state."""
    return {"ETag": f'"{version}"'}


def expected_tag(if_match: str | None) -> str | None:
    """Return the tag in an If-Match header without its quotes: None when any is accepted.

    An invalid header gives what is no record's tag.
    """
    if if_match is None or if_match.strip() == "*":
        return None
    tag = re.fullmatch(r'"([\x21\x23-\x7e]+)"', if_match.strip())
    return tag[1] if tag else '"'


def expected_version(if_match: str | None) -> int | None:
    """Return the version in an If-Match header: None when any version is accepted, -1 for an invalid one."""
    tag = expected_tag(if_match)
    if tag is None:
        return None
    return int(tag) if re.fullmatch(r"[0-9]{1,16}", tag) else -1


class Routes:
    """Adds routes to an app, all under one tag.

    A route is an async function. `Body[T]` declares the type of its body, `Viewer` or `Operator` the role of its
    callers, and the return type its response: a msgspec type, an `Answer` or `Encoded` of one, None for 204, or a ready
    `Response`.
    The first `status` is the usual one; those of a route that may create something are (200, 201), for example.
    `raises` lists exceptions that become problem documents as registered by `Routes.raises`; `problems` lists further
    documents. In a service, FastAPI runs in another process than the handlers (`fog_runtime.http.http_process`), and
    their arguments, which must be of types that msgspec knows, are passed on by name.
    """

    def __init__(self, app: FastAPI, tag: str) -> None:
        self._app = app
        self._tag = tag
        self._raised: dict[type[Exception], Sequence[ProblemCode]] = {}

    def raises(self, kind: type[E], problems: Sequence[ProblemCode], convert: Callable[[E], ProblemError]) -> None:
        """Answer exceptions of this type with the problem that `convert` returns, one of `problems`."""
        self._raised[kind] = problems
        handle = self._app.exception_handlers[ProblemError]

        async def answer(request: Request, error: Exception) -> Response:
            assert isinstance(error, kind)
            response: Response = await handle(request, convert(error))  # type: ignore[misc]  # Starlette's loose type
            return response

        self._app.add_exception_handler(kind, answer)

    def urgent(self, path: str) -> None:
        """Give requests to this path places of their own, which no other requests take (`fog_runtime.http.app`)."""
        self._app.state.urgent[path] = compile_path(path)[0]

    def lasting(self, path: str) -> None:
        """Let requests to this path last for as long as they like: they take no places, their route counts them."""
        self._app.state.lasting.add(path)

    def get(self, path: str, **options: Any) -> Callable[[Handler], Handler]:
        """Add a route that reads."""
        return self._route("GET", path, **options)

    def post(self, path: str, **options: Any) -> Callable[[Handler], Handler]:
        """Add a route that creates something, or queries with a body."""
        return self._route("POST", path, **options)

    def put(self, path: str, **options: Any) -> Callable[[Handler], Handler]:
        """Add a route that writes."""
        return self._route("PUT", path, **options)

    def patch(self, path: str, **options: Any) -> Callable[[Handler], Handler]:
        """Add a route that changes fields of a record."""
        return self._route("PATCH", path, **options)

    def delete(self, path: str, **options: Any) -> Callable[[Handler], Handler]:
        """Add a route that deletes."""
        return self._route("DELETE", path, **options)

    def _route(
        self,
        method: str,
        path: str,
        *,
        status: int | tuple[int, ...] = 200,
        media_type: str = "",
        raises: Sequence[type[Exception]] = (),
        problems: Sequence[ProblemCode] = (),
    ) -> Callable[[Handler], Handler]:
        def add(handler: Handler) -> Handler:
            signature = _Signature(handler)
            statuses = (status,) if isinstance(status, int) else status
            if signature.answer is type(None):
                statuses = (204,)
            own = [*problems, *(code for kind in raises for code in self._raised[kind])]
            standby: Callable[[], str] = str
            if signature.needs_token and method != "GET":
                standby = self._app.state.standby
                own.append(HttpProblem.STANDS_BY)
            route = f"{method} {path}"
            run = _handling(handler, statuses[0], standby)
            self._app.state.endpoints[route] = Endpoint(method, path, signature.arguments, run)
            self._app.add_api_route(
                path,
                _endpoint(handler, run, signature, route, self._app),
                methods=[method],
                tags=[self._tag],
                status_code=statuses[0],
                response_model=None,
                response_class=Response,
                responses=self._responses(method, path, signature, statuses, media_type, own),
                openapi_extra=self._body(signature),
            )
            return handler

        return add

    def _body(self, signature: "_Signature") -> dict[str, Any] | None:
        if signature.body is None:
            return None
        if signature.patched is None:
            content = {"application/json": {"schema": schema(self._app, signature.body[1])}}
        else:
            described = {"schema": _patch_schema(self._app, signature.patched)}
            content = {MERGE_PATCH: described, "application/json": described}
        return {"requestBody": {"required": True, "content": content}}

    def _responses(
        self,
        method: str,
        path: str,
        signature: "_Signature",
        statuses: Sequence[int],
        media_type: str,
        own: Sequence[ProblemCode],
    ) -> dict[int | str, dict[str, Any]]:
        """Describe the responses to requests that this route is for.

        One with a body that none is declared for may also be answered with 408 or 413.
        """
        content: dict[str, Any] = {media_type or "application/json": {}}
        if not media_type and 204 not in statuses:
            content = {"application/json": {"schema": schema(self._app, signature.answer)}}
        elif 204 in statuses:
            content = {}
        responses: dict[int | str, dict[str, Any]] = {
            status: {"description": _ANSWERS.get(status, "The answer"), **({"content": content} if content else {})}
            for status in statuses
        }
        for code in dict.fromkeys([*own, *_shared_problems(method, path, signature)]):
            self._app.state.problems.add(code)
            text = f"{code.says} (`{code}`)"
            response = responses.get(code.status)
            if response is None:
                response = responses[code.status] = {"description": text}
            elif code.status not in statuses:
                response["description"] += f"; {text}"
            response["content"] = {**response.get("content", {}), PROBLEM: {"schema": schema(self._app, Problem)}}
        return responses


def _shared_problems(method: str, path: str, signature: "_Signature") -> list[ProblemCode]:
    """Return what any route of this signature may answer with."""
    found: list[ProblemCode] = [HttpProblem.FAILED, HttpProblem.RESTARTED]
    if path not in ALWAYS_SERVED:
        found.append(HttpProblem.OVERLOADED)
    if signature.needs_token:
        found += [HttpProblem.TOKEN_MISSING, HttpProblem.TOKEN_UNKNOWN, HttpProblem.SESSION_ENDED]
        found += [HttpProblem.ROLE_TOO_LOW, *([HttpProblem.FOREIGN_ORIGIN] if method != "GET" else [])]
    if signature.has_parameters or signature.body is not None:
        found.append(HttpProblem.REQUEST_INVALID)
    if signature.body is not None:
        found += [HttpProblem.BODY_SLOW, HttpProblem.BODY_TOO_LARGE]
    return found


class _Signature:
    """What a route's function says of itself."""

    def __init__(self, handler: Callable[..., object]) -> None:
        hints = get_type_hints(handler, include_extras=True)
        self.body: tuple[str, Any] | None = None
        self.patched: type[msgspec.Struct] | None = None
        first: list[inspect.Parameter] = []
        others: list[inspect.Parameter] = []
        fields: list[tuple[str, Any]] = []
        for name, parameter in inspect.signature(handler).parameters.items():
            kind = hints[name]
            arguments = get_args(kind) if get_origin(kind) is Annotated else (kind,)
            fields.append((name, arguments[0]))
            if any(isinstance(mark, _BodyMarker) for mark in arguments[1:]):
                self.body = (name, arguments[0])
                self.patched = next((mark.kind for mark in arguments[1:] if isinstance(mark, PatchOf)), None)
                kind = Annotated[arguments[0], Depends(_reader(arguments[0]))]
            # Keyword-only, so that a parameter without a default may follow one with a default.
            replaced = parameter.replace(annotation=kind, kind=inspect.Parameter.KEYWORD_ONLY)
            # The caller's role is checked before everything else.
            (first if arguments[0] is Caller else others).append(replaced)
        self.needs_token = bool(first)
        body = self.body[0] if self.body is not None else None
        self.has_parameters = any(parameter.name != body for parameter in others)
        self.parameters = [*first, *others]
        self.arguments = msgspec.defstruct("Arguments", fields)
        answer = hints["return"]
        self.answer = get_args(answer)[0] if get_origin(answer) in (Answer, Encoded) else answer


class Endpoint(NamedTuple):
    """A route as the process with the handlers runs it: with decoded arguments, by name."""

    method: str
    path: str
    arguments: type[msgspec.Struct]
    run: Callable[..., Awaitable[Response]]


def rank_of(app: FastAPI, route: str) -> int:
    """Return 0 for a route that comes before all others, 2 for one that comes after them, and 1 for these."""
    path = route.partition(" ")[2]
    return 0 if path in app.state.urgent else 2 if path in ALWAYS_SERVED else 1


async def answer_call(app: FastAPI, route: str, arguments: bytes) -> Response:
    """Call a route's handler with arguments from another process; exceptions become problem documents."""
    endpoint: Endpoint = app.state.endpoints[route]
    try:
        decoded = msgspec.msgpack.decode(arguments, type=endpoint.arguments)
        return await endpoint.run(**msgspec.structs.asdict(decoded))
    except Exception as error:  # noqa: BLE001  # registered for `Exception`, too, which logs it
        handle = next(app.exception_handlers[kind] for kind in type(error).__mro__ if kind in app.exception_handlers)
        scope = {"type": "http", "method": endpoint.method, "path": endpoint.path, "headers": [], "app": app}
        response: Response = await handle(Request(scope), error)  # type: ignore[misc]  # Starlette's loose type
        return response


def _handling(
    handler: Callable[..., Awaitable[object]], status: int, standby: Callable[[], str]
) -> Callable[..., Awaitable[Response]]:
    """Return a function that calls the handler, unless this process stands by, and encodes its answer."""

    async def run(**arguments: Any) -> Response:
        if reason := standby():
            raise ProblemError(HttpProblem.STANDS_BY, f"{reason}; send the request there", headers=RETRY_AFTER)
        answer = await handler(**arguments)
        if isinstance(answer, Response):
            return answer
        if answer is None or status == HTTPStatus.NO_CONTENT:
            headers = dict(answer.headers) if isinstance(answer, Answer) else None
            return Response(status_code=status, headers=headers)
        if isinstance(answer, Encoded):
            return Response(answer.data, status, media_type="application/json")
        full: Answer[object] = answer if isinstance(answer, Answer) else Answer(answer)
        data = msgspec.json.encode(full.value)
        return Response(data, full.status or status, dict(full.headers), media_type="application/json")

    return run


def _endpoint(
    handler: Callable[..., object],
    run: Callable[..., Awaitable[Response]],
    signature: "_Signature",
    route: str,
    app: FastAPI,
) -> Callable[..., Awaitable[Response]]:
    """Return the function that FastAPI calls with the arguments that it has checked and decoded."""

    @functools.wraps(handler)
    async def endpoint(**arguments: Any) -> Response:
        core: CoreLink | None = app.state.core
        if core is None:
            return await run(**arguments)
        return await core.call(route, _encoded(arguments))

    setattr(endpoint, "__signature__", inspect.Signature(signature.parameters))  # noqa: B010  # what FastAPI reads
    return endpoint


def _encoded(arguments: dict[str, Any]) -> bytes:
    """Return the arguments for the process with the handlers; a number that does not fit becomes a problem."""
    try:
        return msgspec.msgpack.encode(arguments)
    except OverflowError as error:
        raise ProblemError(
            HttpProblem.REQUEST_INVALID, "an integer needs more than 64 bits: use a smaller one"
        ) from error


def _reader(kind: Any) -> Callable[[Request], Awaitable[Any]]:
    async def read(request: Request) -> Any:
        return await read_body(request, kind)

    return read


class InvalidBodyError(ProblemError):
    """A body that does not fit its type; a route may raise it again with a more helpful text."""

    def __init__(self, errors: list[dict[str, str]]) -> None:
        text = "; ".join(f"{error['field']}: {error['problem']}" for error in errors)
        super().__init__(HttpProblem.REQUEST_INVALID, text)
        self.errors = errors


def _error_of(error: msgspec.DecodeError) -> dict[str, str]:
    problem_text, _, path = str(error).partition(" - at ")
    path = path.strip("`").removeprefix("$").replace("[", ".").replace("]", "").lstrip(".")
    return {"field": f"body.{path}".rstrip("."), "problem": problem_text}


async def read_body(request: Request, kind: type[T]) -> T:
    """Decode a JSON body as a msgspec type; an invalid body becomes a problem that names the field."""
    try:
        return msgspec.json.decode(await request.body(), type=kind)
    except msgspec.ValidationError as error:
        raise InvalidBodyError([_error_of(error)]) from error
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise InvalidBodyError([{"field": "body", "problem": f"not valid JSON: {error}"}]) from error
    except RecursionError as error:
        raise InvalidBodyError(
            [{"field": "body", "problem": "lists or objects inside one another, too deep"}]
        ) from error


def patched(record: T, patch: Patch) -> T:
    """Return a record of a body's type with a merge patch applied; raises as an invalid body does."""
    try:
        return msgspec.convert(_merged(msgspec.to_builtins(record), patch), type(record))
    except msgspec.ValidationError as error:
        raise InvalidBodyError([_error_of(error)]) from error


def _merged(target: object, patch: object) -> object:
    """Apply a merge patch as RFC 7396 defines it; the body's decoder has limited how deep it is."""
    if not isinstance(patch, dict):
        return patch
    merged = dict(target) if isinstance(target, dict) else {}
    for name, value in patch.items():
        if value is None:
            merged.pop(name, None)
        else:
            merged[name] = _merged(merged.get(name), value)
    return merged


def _patch_schema(app: FastAPI, kind: type[msgspec.Struct]) -> dict[str, Any]:
    """Return the schema of a merge patch: no field is required, each may be null, and objects may have some fields."""
    schema(app, kind)
    whole: dict[str, Any] = app.state.schemas[kind.__name__]
    fields = {
        name: {} if "$ref" in str(field) else {"anyOf": [field, {"type": "null"}]}
        for name, field in whole["properties"].items()
    }
    name = f"{kind.__name__.removesuffix('Body')}Patch"
    about = f"A JSON merge patch (RFC 7396) of {kind.__name__}: what is null is left out, what is missing stays."
    app.state.schemas[name] = {"title": name, "type": "object", "description": about, "properties": fields}
    return {"$ref": _SCHEMAS.format(name=name)}


def schema(app: FastAPI, kind: Any) -> dict[str, Any]:
    """Return the JSON schema of a msgspec type; types that it references become components of the app's OpenAPI."""
    (described,), components = msgspec.json.schema_components([kind], ref_template=_SCHEMAS)
    app.state.schemas.update(components)
    return described
