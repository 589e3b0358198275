"""The REST interface of all services: problem documents (RFC 9457), tokens with roles, health, metrics, limits."""

from fog_runtime.http.app import make_app
from fog_runtime.http.http_process import HttpProcess, HttpProcessError, serve_here, unused
from fog_runtime.http.problems import RETRY_AFTER, HttpProblem, ProblemCode, ProblemError
from fog_runtime.http.routes import (
    Answer,
    Body,
    ClientHost,
    Encoded,
    IfMatch,
    Routes,
    etag,
    expected_tag,
    expected_version,
)
from fog_runtime.http.sessions import add_session_routes
from fog_runtime.http.store_routes import (
    IdempotencyKey,
    IfNoneMatch,
    PageSize,
    UndoBody,
    Undone,
    add_recovery,
    add_store_errors,
    add_undo_errors,
    attempt_of,
    must_be_new,
    next_page,
    undone,
)
from fog_runtime.http.tokens import Admin, Caller, Guest, Operator, Tokens, Viewer, load_tokens, still_admits
from fog_runtime.token_file import TokensError, token_hash

__all__ = [
    "RETRY_AFTER",
    "Admin",
    "Answer",
    "Body",
    "Caller",
    "ClientHost",
    "Encoded",
    "Guest",
    "HttpProblem",
    "HttpProcess",
    "HttpProcessError",
    "IdempotencyKey",
    "IfMatch",
    "IfNoneMatch",
    "Operator",
    "PageSize",
    "ProblemCode",
    "ProblemError",
    "Routes",
    "Tokens",
    "TokensError",
    "UndoBody",
    "Undone",
    "Viewer",
    "add_recovery",
    "add_session_routes",
    "add_store_errors",
    "add_undo_errors",
    "attempt_of",
    "etag",
    "expected_tag",
    "expected_version",
    "load_tokens",
    "make_app",
    "must_be_new",
    "next_page",
    "serve_here",
    "still_admits",
    "token_hash",
    "undone",
    "unused",
]
