"""REST as all services speak it: problem documents (RFC 9457), bearer tokens with roles, health, metrics, limits."""

import asyncio
import hashlib
import re
import socket
import tomllib
from collections.abc import Awaitable, Callable, Iterator, MutableMapping
from contextlib import contextmanager
from http import HTTPStatus
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeVar, get_args

import msgspec
import uvicorn
from fastapi import Depends, FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from starlette.exceptions import HTTPException

from fog_runtime import logs, metrics
from fog_runtime.files import write_port_file
from fog_runtime.health import Health
from fog_runtime.version import VERSION

T = TypeVar("T")
Role = Literal["viewer", "operator", "admin"]

BODY_LIMIT: Final = 1024 * 1024
_DRAINED: Final = 16
PROBLEM: Final = "application/problem+json"
_RANKS: Final = {role: rank for rank, role in enumerate(get_args(Role))}
_SCHEMAS: Final = "#/components/schemas/{name}"

_log = logs.get("http")
_bearer = HTTPBearer(auto_error=False, description="A token of the tokens file")


class ProblemError(Exception):
    """An answer that is an error: raise it anywhere in a handler, it becomes a problem document.

    `field` is the path of what is wrong in the request (`body.polygon.0`); `extra` members are added as they are.
    """

    def __init__(
        self,
        status: int,
        detail: str,
        *,
        field: str | None = None,
        headers: dict[str, str] | None = None,
        **extra: object,
    ) -> None:
        super().__init__(detail)
        self.status = status
        self.detail = detail
        self.errors = [] if field is None else [{"field": field, "problem": detail}]
        self.headers = headers
        self.extra = extra


def problem(
    status: int,
    detail: str,
    *,
    errors: list[dict[str, str]] | None = None,
    headers: dict[str, str] | None = None,
    **extra: object,
) -> JSONResponse:
    """Build a problem document: `errors` holds one `{"field": path, "problem": sentence}` for each thing wrong."""
    body: dict[str, object] = {
        "type": "about:blank",
        "title": HTTPStatus(status).phrase,
        "status": status,
        "detail": detail,
        **extra,
    }
    if errors:
        body["errors"] = errors
    return JSONResponse(body, status, headers, media_type=PROBLEM)


# --- Who may do what ------------------------------------------------------------------------------------------------


class Caller(msgspec.Struct, frozen=True):
    """Somebody who showed a valid token; the name goes into the audit log."""

    name: str
    role: Role


class TokensError(ValueError):
    """A tokens file that can't be used; the message names the file, the entry and the remedy."""


class _Entry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: Annotated[str, msgspec.Meta(min_length=1, max_length=100)]
    role: Role
    sha256: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]


class _TokensFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    tokens: list[_Entry] = []


class Tokens:
    """The callers by their tokens' SHA-256 (tokens are long and random, so a plain hash is enough)."""

    def __init__(self, callers: dict[str, Caller] | None = None) -> None:
        self._callers = callers or {}

    def caller(self, token: str) -> Caller | None:
        """Return who this token belongs to, or None."""
        return self._callers.get(token_hash(token))


def token_hash(token: str) -> str:
    """Return what stands in the tokens file for a token."""
    return hashlib.sha256(token.encode()).hexdigest()


def load_tokens(file: Path | None) -> Tokens:
    """Read a tokens file (TOML: `[[tokens]]` with name, role, sha256); without a file nobody may write anything.

    Raises `TokensError`.
    """
    if file is None:
        return Tokens()
    try:
        entries = msgspec.convert(tomllib.loads(file.read_text("utf-8")), _TokensFile).tokens
    except OSError as error:
        raise TokensError(f"{file}: can't be read ({error.strerror}). Create it or unset FOGNAV_TOKENS_FILE") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise TokensError(f"{file}: is no valid TOML ({error}). Correct the place it names") from error
    except msgspec.ValidationError as error:
        raise TokensError(f"{file}: {error}. Each of [[tokens]] needs name, role and sha256") from error
    callers = {entry.sha256: Caller(entry.name, entry.role) for entry in entries}
    if len(callers) != len(entries):
        raise TokensError(f"{file}: two entries have the same sha256. Give each caller a token of their own")
    return Tokens(callers)


def require(role: Role) -> Callable[..., Caller]:
    """Return a dependency that lets callers of this role or a higher one through: `Depends(require("operator"))`."""

    def check(
        request: Request, credentials: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)]
    ) -> Caller:
        challenge = {"WWW-Authenticate": "Bearer"}
        if credentials is None:
            raise ProblemError(401, "this needs a token: send `Authorization: Bearer TOKEN`", headers=challenge)
        tokens: Tokens = request.app.state.tokens
        caller = tokens.caller(credentials.credentials)
        if caller is None:
            raise ProblemError(401, "nobody has this token", headers=challenge)
        if _RANKS[caller.role] < _RANKS[role]:
            raise ProblemError(403, f"this needs the role {role}; {caller.name} is {caller.role}")
        return caller

    return check


# --- Bodies as the contracts' types ---------------------------------------------------------------------------------


def _error_of(error: msgspec.DecodeError) -> dict[str, str]:
    problem_text, _, path = str(error).partition(" - at ")
    path = path.strip("`").removeprefix("$").replace("[", ".").replace("]", "").lstrip(".")
    return {"field": f"body.{path}".rstrip("."), "problem": problem_text}


async def read_body(request: Request, kind: type[T]) -> T:
    """Decode a JSON body as a msgspec type; a body that is none becomes a problem that names the field."""
    try:
        return msgspec.json.decode(await request.body(), type=kind)
    except msgspec.ValidationError as error:
        raise _InvalidBodyError([_error_of(error)]) from error
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise _InvalidBodyError([{"field": "body", "problem": f"no valid JSON: {error}"}]) from error


def expected_version(if_match: str | None) -> int | None:
    """Return the version that an If-Match header names: None when any will do, -1 for what no version ever is."""
    if if_match is None or if_match.strip() == "*":
        return None
    tag = re.fullmatch(r'"([0-9]{1,16})"', if_match.strip())
    return int(tag[1]) if tag else -1


class _InvalidBodyError(ProblemError):
    def __init__(self, errors: list[dict[str, str]]) -> None:
        super().__init__(422, f"{errors[0]['field']}: {errors[0]['problem']}")
        self.errors = errors


def body_schema(app: FastAPI, kind: Any) -> dict[str, Any]:
    """Describe a msgspec body for OpenAPI: `@app.put(..., openapi_extra=body_schema(app, Zone))`."""
    return {"requestBody": {"required": True, "content": {"application/json": {"schema": schema(app, kind)}}}}


def answer_schema(app: FastAPI, kind: Any, description: str = "The answer") -> dict[int | str, dict[str, Any]]:
    """Describe a msgspec answer for OpenAPI: `@app.get(..., responses=answer_schema(app, Zone))`."""
    return {200: {"description": description, "content": {"application/json": {"schema": schema(app, kind)}}}}


def schema(app: FastAPI, kind: Any) -> dict[str, Any]:
    """Return the JSON schema of a msgspec type; the types that it refers to become components of the app's OpenAPI."""
    (described,), components = msgspec.json.schema_components([kind], ref_template=_SCHEMAS)
    app.state.schemas.update(components)
    return described


# --- The app --------------------------------------------------------------------------------------------------------

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]


class _BodyLimit:
    """Takes a request's body in before the app runs, up to the limit: no handler can be made to hold more."""

    def __init__(self, app: Callable[[Scope, Receive, Send], Awaitable[None]], limit: int) -> None:
        self._app = app
        self._limit = limit

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        body = bytearray()
        size = 0
        more = True
        # What is too much is read on for a while and thrown away: a client that is cut off in the middle of its
        # sending sees a reset connection instead of the answer.
        while more and size <= _DRAINED * self._limit:
            message = await receive()
            if message["type"] != "http.request":
                return  # the client went away
            part = message.get("body", b"")
            size += len(part)
            more = message.get("more_body", False)
            if size <= self._limit:
                body += part
        if size > self._limit:
            headers = {"Connection": "close"} if more else None
            answer = problem(413, f"the body has more than {self._limit} bytes", headers=headers)
            await answer(scope, receive, send)
            return
        given = False

        async def replay() -> MutableMapping[str, Any]:
            nonlocal given
            if given:
                return await receive()
            given = True
            return {"type": "http.request", "body": bytes(body), "more_body": False}

        await self._app(scope, replay, send)


_SENTENCES: Final = re.compile(r"^(Value error|Assertion failed), ")


def _add_problems(app: FastAPI) -> None:
    @app.exception_handler(ProblemError)
    async def _(_: Request, error: ProblemError) -> Response:
        return problem(error.status, error.detail, errors=error.errors, headers=error.headers, **error.extra)

    @app.exception_handler(HTTPException)
    async def _(request: Request, error: HTTPException) -> Response:
        detail = str(error.detail)
        if detail == HTTPStatus(error.status_code).phrase:
            detail = f"{request.method} {request.url.path}: {detail.lower()}"
        return problem(error.status_code, detail, headers=dict(error.headers) if error.headers else None)

    @app.exception_handler(RequestValidationError)
    async def _(_: Request, error: RequestValidationError) -> Response:
        errors = [
            {"field": ".".join(str(part) for part in e["loc"]), "problem": _SENTENCES.sub("", e["msg"])}
            for e in error.errors()
        ]
        return problem(422, f"{errors[0]['field']}: {errors[0]['problem']}", errors=errors)

    @app.exception_handler(Exception)
    async def _(request: Request, error: Exception) -> Response:
        _log.error("request_failed", error=error, method=request.method, path=request.url.path)
        return problem(500, "the service failed; its log has the reason")


def _add_health(app: FastAPI, health: Health) -> None:
    @app.get("/healthz", tags=["health"], summary="Whether the process runs")
    async def healthz() -> dict[str, str]:
        return {"status": "ok"}

    @app.get("/readyz", tags=["health"], summary="Whether it can do its work; 503 names what is missing")
    async def readyz() -> JSONResponse:
        report = health.report()
        return JSONResponse(report, 200 if report["ready"] else 503)

    @app.get("/metrics", tags=["health"], summary="Metrics for Prometheus", response_class=Response)
    async def prometheus() -> Response:
        text, kind = metrics.exposition()
        return Response(text, media_type=kind)


def make_app(title: str, health: Health, tokens: Tokens, *, body_limit: int = BODY_LIMIT) -> FastAPI:
    """Build an app with health, metrics, problem documents, roles and a body limit; OpenAPI is at /openapi.json."""
    # The interactive pages would load scripts from the internet.
    app = FastAPI(title=title, version=VERSION, docs_url=None, redoc_url=None)
    app.state.tokens = tokens
    app.state.schemas = {}
    _add_problems(app)
    _add_health(app, health)
    app.add_middleware(_BodyLimit, limit=body_limit)
    generate = app.openapi

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            described = generate()
            described.setdefault("components", {}).setdefault("schemas", {}).update(app.state.schemas)
            app.openapi_schema = described
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]  # FastAPI's documented way to extend the schema
    return app


class _Server(uvicorn.Server):
    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Leave signals alone: `fog_runtime.process` handles them."""
        yield


async def serve(app: FastAPI, host: str = "127.0.0.1", port: int = 0, port_file: Path | None = None) -> None:
    """Serve until cancelled; the port (0: any free one) is logged as `listening` and written to `port_file`.

    Open requests get 2 s to end. Raises `OSError` when the port is taken.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.create_server((host, port), family=family, backlog=128) as listener:
        chosen = int(listener.getsockname()[1])
        config = uvicorn.Config(
            app, log_config=None, access_log=False, lifespan="off", timeout_graceful_shutdown=2, server_header=False
        )
        server = _Server(config)
        task = asyncio.create_task(server.serve(sockets=[listener]), name=f"http {chosen}")
        try:
            _log.info("listening", url=f"http://{host}:{chosen}", port=chosen)
            write_port_file(port_file, chosen)
            await asyncio.shield(task)
        finally:
            server.should_exit = True
            await asyncio.gather(task, return_exceptions=True)
