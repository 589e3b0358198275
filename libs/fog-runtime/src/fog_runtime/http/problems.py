"""Errors as problem documents (RFC 9457): a status, a plain sentence, and the path of each field that is wrong."""

import re
from http import HTTPStatus
from typing import Final

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


class FieldProblem(msgspec.Struct, frozen=True):
    """One invalid field of a request: its path, and what is wrong."""

    field: str
    problem: str


class Problem(msgspec.Struct, frozen=True):
    """A problem document; some carry further members, such as the planner's `code` and `nearest`."""

    type: str
    title: str
    status: int
    detail: str
    errors: list[FieldProblem] = []


class ProblemError(Exception):
    """An error response: raised anywhere in a handler, it becomes a problem document.

    `field` is the path of the invalid part of the request (`body.polygon.0`); `extra` members are added unchanged.
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
    """Build a problem document: `errors` holds one `{"field": path, "problem": sentence}` for each invalid field."""
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


def _allowed_methods(request: Request) -> list[str]:
    """Return the methods of every route of the request's path: Starlette names only those of the first."""
    matching = (route for route in request.app.routes if route.matches(request.scope)[0] is not Match.NONE)
    return sorted({method for route in matching if isinstance(route, Route) for method in route.methods or ()})


_SENTENCES: Final = re.compile(r"^(Value error|Assertion failed), ")


def add_problem_handlers(app: FastAPI) -> None:
    """Answer every error in a request with a problem document."""

    @app.exception_handler(ProblemError)
    async def _(_: Request, error: ProblemError) -> Response:
        return problem(error.status, error.detail, errors=error.errors, headers=error.headers, **error.extra)

    @app.exception_handler(HTTPException)
    async def _(request: Request, error: HTTPException) -> Response:
        detail = str(error.detail)
        if detail == HTTPStatus(error.status_code).phrase:
            detail = f"{request.method} {request.url.path}: {detail.lower()}"
        headers = dict(error.headers or {})
        if error.status_code == HTTPStatus.METHOD_NOT_ALLOWED:
            headers["Allow"] = ", ".join(_allowed_methods(request))
        return problem(error.status_code, detail, headers=headers)

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
        return problem(500, "the service failed: see its log for the reason")
