"""The REST interface of all services: problem documents (RFC 9457), tokens with roles, health, metrics, limits."""

from fog_runtime.http.app import make_app
from fog_runtime.http.problems import ProblemError
from fog_runtime.http.routes import Answer, Body, IfMatch, Routes, etag, expected_version
from fog_runtime.http.server import serve
from fog_runtime.http.tokens import Operator, Tokens, TokensError, Viewer, load_tokens, token_hash

__all__ = [
    "Answer",
    "Body",
    "IfMatch",
    "Operator",
    "ProblemError",
    "Routes",
    "Tokens",
    "TokensError",
    "Viewer",
    "etag",
    "expected_version",
    "load_tokens",
    "make_app",
    "serve",
    "token_hash",
]
