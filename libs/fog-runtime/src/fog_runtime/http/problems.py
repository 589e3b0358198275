"""Errors as problem documents (RFC 9457): an identifier, a plain sentence, and the path of each field that is wrong."""

import re
from enum import StrEnum
from http import HTTPStatus
from typing import Final, Self

import msgspec
from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException
from starlette.routing import Match, Route

from fog_runtime import logs

PROBLEM: Final = "application/problem+json"
RETRY_AFTER: Final = {"Retry-After": "1"}
"""The header of an error that passes by itself."""

_log = logs.get("http")


class ProblemCode(StrEnum):
    """Base of identifiers of problems, each with its status, what it says, and what to do; OpenAPI is made of them.

    Each service has its own; those that all services share are `HttpProblem`.
    """

    status: int
    says: str
    remedy: str

    def __new__(cls, code: str, status: int, says: str, remedy: str = "") -> Self:
        """Return an identifier with its status, what it says, and what to do then, whatever else `detail` names."""
        member = str.__new__(cls, code)
        member._value_, member.status, member.says, member.remedy = code, status, says, remedy
        return member


class HttpProblem(ProblemCode):
    """Problems of any service."""

    TOKEN_MISSING = (
        "token_missing", 401, "The request has no token",
        "Log in on the console, or send `Authorization: Bearer TOKEN`",
    )  # fmt: skip
    TOKEN_UNKNOWN = (
        "token_unknown", 401, "The token is unknown",
        "Use one of the site's tokens: `fognav token list` shows whose there are",
    )  # fmt: skip
    SESSION_ENDED = "session_ended", 401, "The session has ended, or its token was revoked", "Log in again"
    FOREIGN_ORIGIN = (
        "foreign_origin", 403, "A session changes things from the console's own page only",
        "Repeat it on the console's own page, or send a token",
    )  # fmt: skip
    ROLE_TOO_LOW = (
        "role_too_low", 403, "The token's role does not allow this",
        "Use a token with the role that `detail` names, or ask who has one",
    )  # fmt: skip
    NO_ROUTE = "no_route", 404, "The service has no such route", "Look for the route in /openapi.json"
    METHOD_NOT_ALLOWED = (
        "method_not_allowed", 405, "The route has no such method: `Allow` has those that it has",
        "Use a method that `Allow` has",
    )  # fmt: skip
    BODY_SLOW = "body_slow", 408, "The body did not arrive in time", "Send it again, at once"
    BODY_TOO_LARGE = "body_too_large", 413, "The body is too large", "Send less at once"
    REQUEST_INVALID = (
        "request_invalid", 422, "Body, parameter or header is invalid: `errors` names the fields",
        "Correct the fields that `errors` names",
    )  # fmt: skip
    KEY_REUSED = (
        "key_reused",
        422,
        "The Idempotency-Key was used for another request",
        "Use a new Idempotency-Key for each change",
    )
    NO_ENTRY = "no_entry", 422, "The audit trail has no such entry of this record", "Choose one of GET /api/v1/audit"
    NOT_UNDOABLE = "not_undoable", 409, "The change can't be undone", "Make the change that you want instead"
    CHANGED_SINCE = (
        "changed_since", 409, "Somebody has changed the record since: `by`, `action`, `at`, `entry`",
        "Look at the later change; undo that first, or make yours anew",
    )  # fmt: skip
    NOTHING_LOST = (
        "nothing_lost", 409, "There is nothing to recover",
        "Do nothing: GET /api/v1/store says how the store is",
    )  # fmt: skip
    FAILED = (
        "failed", 500, "The service failed: its log names the reason",
        "Look into the log (`fognav logs`), then try again",
    )  # fmt: skip
    STANDS_BY = "stands_by", 503, "This process stands by: another one leads", "Send the request to the one that leads"
    RESTARTED = (
        "restarted", 503, "The service is started again: `Retry-After` says when to try again",
        "Wait as long as `Retry-After` says",
    )  # fmt: skip
    OVERLOADED = (
        "overloaded", 503, "The service serves too many requests: `Retry-After` says when to try again",
        "Wait as long as `Retry-After` says, and send fewer at once",
    )  # fmt: skip
    STORE_AWAY = (
        "store_away", 503, "The store does not answer, or refuses writes; nothing was changed",
        "Try again once Redis runs: /readyz says when",
    )  # fmt: skip
    STORE_UNCERTAIN = (
        "store_uncertain", 503, "The store fell silent: the change may be stored; repeat the request",
        "Repeat it, with the Idempotency-Key if it had one",
    )  # fmt: skip


class FieldProblem(msgspec.Struct, frozen=True):
    """One invalid field of a request: its path, and what is wrong."""

    field: str
    problem: str


class Problem(msgspec.Struct, frozen=True):
    """A problem document, identified by its `type`; some carry more, such as the planner's `code` and `nearest`."""

    type: str
    title: str
    status: int
    detail: str
    remedy: str = ""
    errors: list[FieldProblem] = []


class ProblemError(Exception):
    """An error response: raised anywhere in a handler, it becomes a problem document of `code`, with its status.

    `field` is the path of the invalid part of the request (`body.polygon.0`); `extra` members are added unchanged.
    """

    def __init__(
        self,
        code: ProblemCode,
        detail: str,
        /,
        *,
        field: str | None = None,
        headers: dict[str, str] | None = None,
        **extra: object,
    ) -> None:
        super().__init__(detail)
        self.code = code
        self.detail = detail
        self.errors = [] if field is None else [{"field": field, "problem": detail}]
        self.headers = headers
        self.extra = extra


def problem(
    code: ProblemCode | int,
    detail: str,
    /,
    *,
    errors: list[dict[str, str]] | None = None,
    headers: dict[str, str] | None = None,
    **extra: object,
) -> JSONResponse:
    """Build a problem document: `errors` holds one `{"field": path, "problem": sentence}` for each invalid field.

    A status without an identifier gives one without a type.
    """
    status = code if isinstance(code, int) else code.status
    body: dict[str, object] = {
        "type": "about:blank" if isinstance(code, int) else f"urn:fognav:{code}",
        "title": HTTPStatus(status).phrase if isinstance(code, int) else code.says,
        "status": status,
        "detail": detail,
        **({} if isinstance(code, int) else {"remedy": code.remedy}),
        **extra,
    }
    if errors:
        body["errors"] = errors
    return JSONResponse(body, status, headers, media_type=PROBLEM)


def allowed_methods(request: Request) -> list[str]:
    """Return the methods of every route of the request's path: Starlette names only those of the first."""
    matching = (route for route in request.app.routes if route.matches(request.scope)[0] is not Match.NONE)
    return sorted({method for route in matching if isinstance(route, Route) for method in route.methods or ()})


_BY_STATUS: Final = {404: HttpProblem.NO_ROUTE, 405: HttpProblem.METHOD_NOT_ALLOWED}
_SENTENCES: Final = re.compile(r"^(Value error|Assertion failed), ")


def add_problem_handlers(app: FastAPI) -> None:
    """Answer every error in a request with a problem document."""

    @app.exception_handler(ProblemError)
    async def _(_: Request, error: ProblemError) -> Response:
        return problem(error.code, error.detail, errors=error.errors, headers=error.headers, **error.extra)

    @app.exception_handler(HTTPException)
    async def _(request: Request, error: HTTPException) -> Response:
        detail = str(error.detail)
        if detail == HTTPStatus(error.status_code).phrase:
            detail = f"{request.method} {request.url.path}: {detail.lower()}"
        headers = dict(error.headers or {})
        if error.status_code == HTTPStatus.METHOD_NOT_ALLOWED:
            headers["Allow"] = ", ".join(allowed_methods(request))
        return problem(_BY_STATUS.get(error.status_code, error.status_code), detail, headers=headers)

    @app.exception_handler(RequestValidationError)
    async def _(_: Request, error: RequestValidationError) -> Response:
        errors = [
            {"field": ".".join(str(part) for part in e["loc"]), "problem": _SENTENCES.sub("", e["msg"])}
            for e in error.errors()
        ]
        return problem(HttpProblem.REQUEST_INVALID, f"{errors[0]['field']}: {errors[0]['problem']}", errors=errors)

    @app.exception_handler(Exception)
    async def _(request: Request, error: Exception) -> Response:
        _log.error("request_failed", error=error, method=request.method, path=request.url.path)
        return problem(HttpProblem.FAILED, "the service failed: see its log for the reason")
