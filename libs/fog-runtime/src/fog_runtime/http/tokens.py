"""Authorization: bearer tokens with roles, read from a file with their hashes."""

import hashlib
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Final, Literal, get_args

import msgspec
from fastapi import Depends, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from fog_runtime.http.problems import ProblemError

Role = Literal["viewer", "operator", "admin"]

_RANKS: Final = {role: rank for rank, role in enumerate(get_args(Role))}
_bearer = HTTPBearer(auto_error=False, description="A token of the tokens file")


class Caller(msgspec.Struct, frozen=True):
    """The owner of a valid token; the name appears in the audit log."""

    name: str
    role: Role


class TokensError(ValueError):
    """A tokens file is missing or invalid; the message names the file, the entry and the remedy."""


class _Entry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: Annotated[str, msgspec.Meta(min_length=1, max_length=100)]
    role: Role
    sha256: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]


class _TokensFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    tokens: list[_Entry] = []


class Tokens:
    """The callers by the SHA-256 of their tokens (tokens are long and random, so a plain hash is enough)."""

    def __init__(self, callers: dict[str, Caller] | None = None) -> None:
        self._callers = callers or {}

    def caller(self, token: str) -> Caller | None:
        """Return the owner of a token, or None for an unknown one."""
        return self._callers.get(token_hash(token))


def token_hash(token: str) -> str:
    """Return the hash of a token, as in the tokens file."""
    return hashlib.sha256(token.encode()).hexdigest()


def load_tokens(file: Path | None) -> Tokens:
    """Read a tokens file (TOML: `[[tokens]]` with name, role, sha256); without a file every write is refused.

    Raises `TokensError`.
    """
    if file is None:
        return Tokens()
    try:
        entries = msgspec.convert(tomllib.loads(file.read_text("utf-8")), _TokensFile).tokens
    except OSError as error:
        raise TokensError(f"{file}: can't be read ({error.strerror}). Create it or unset FOGNAV_TOKENS_FILE") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise TokensError(f"{file}: is not valid TOML ({error}). Correct that line") from error
    except msgspec.ValidationError as error:
        raise TokensError(f"{file}: {error}. Each of [[tokens]] needs name, role and sha256") from error
    callers = {entry.sha256: Caller(entry.name, entry.role) for entry in entries}
    if len(callers) != len(entries):
        raise TokensError(f"{file}: two entries have the same sha256. Give each caller a token of their own")
    return Tokens(callers)


def require(role: Role) -> Callable[..., Caller]:
    """Return a dependency that admits callers of this role or a higher one: `Depends(require("operator"))`."""

    def check(
        request: Request, credentials: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)]
    ) -> Caller:
        challenge = {"WWW-Authenticate": "Bearer"}
        if credentials is None:
            raise ProblemError(401, "this request needs a token: send `Authorization: Bearer TOKEN`", headers=challenge)
        tokens: Tokens = request.app.state.tokens
        caller = tokens.caller(credentials.credentials)
        if caller is None:
            raise ProblemError(401, "the token is unknown: use one of the site's tokens", headers=challenge)
        if _RANKS[caller.role] < _RANKS[role]:
            raise ProblemError(403, f"this request needs the role {role}; {caller.name} has the role {caller.role}")
        return caller

    return check


Viewer = Annotated[Caller, Depends(require("viewer"))]
"""A parameter of a route that viewers, operators and admins may call."""
Admin = Annotated[Caller, Depends(require("admin"))]
"""A parameter of a route that admins may call."""
Operator = Annotated[Caller, Depends(require("operator"))]
"""A parameter of a route that operators and admins may call."""
