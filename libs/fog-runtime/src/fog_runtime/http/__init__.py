"""The REST interface of all services: problem documents (RFC 9457), tokens with roles, health, metrics, limits."""

from fog_runtime.http.app import MAP_UPLOAD, MAP_UPLOADS, make_app
from fog_runtime.http.http_process import HttpProcess, HttpProcessError, serve_here, unused
from fog_runtime.http.problems import RETRY_AFTER, HttpProblem, ProblemCode, ProblemError
from fog_runtime.http.routes import (
    Answer,
    Body,
    ClientHost,
    Encoded,
    IfMatch,
    Patch,
    PatchOf,
    Routes,
    etag,
    expected_tag,
    expected_version,
    patched,
)
from fog_runtime.http.sessions import add_session_routes
from fog_runtime.http.tokens import Admin, Anybody, Caller, Guest, Operator, Tokens, Viewer, load_tokens, still_admits
from fog_runtime.token_file import TokensError, token_hash

__all__ = [
    "MAP_UPLOAD",
    "MAP_UPLOADS",
    "RETRY_AFTER",
    "Admin",
    "Answer",
    "Anybody",
    "Body",
    "Caller",
    "ClientHost",
    "Encoded",
    "Guest",
    "HttpProblem",
    "HttpProcess",
    "HttpProcessError",
    "IfMatch",
    "Operator",
    "Patch",
    "PatchOf",
    "ProblemCode",
    "ProblemError",
    "Routes",
    "Tokens",
    "TokensError",
    "Viewer",
    "add_session_routes",
    "etag",
    "expected_tag",
    "expected_version",
    "load_tokens",
    "make_app",
    "patched",
    "serve_here",
    "still_admits",
    "token_hash",
    "unused",
]
