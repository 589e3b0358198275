"""Authorization: bearer tokens with roles, read from a file with their hashes, again whenever it changes."""

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated, Final

import msgspec
from fastapi import Depends, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from fog_runtime import logs
from fog_runtime.http.problems import HttpProblem, ProblemError
from fog_runtime.token_file import ROLES, Role, TokenEntry, TokensError, read_tokens, token_hash

_RANKS: Final = {role: rank for rank, role in enumerate(ROLES)}
_bearer = HTTPBearer(auto_error=False, description="A token of the tokens file")
_log = logs.get("tokens")


class Caller(msgspec.Struct, frozen=True):
    """The owner of a valid token; the name appears in the audit log."""

    name: str
    role: Role


class Tokens:
    """The callers by the hashes of their tokens; with a file, as it is at each request. Used from several threads."""

    def __init__(self, entries: Iterable[TokenEntry] = (), file: Path | None = None) -> None:
        self._file = file
        self._seen = _state(file)
        self._callers = _callers(entries)

    def caller(self, token: str) -> Caller | None:
        """Return the owner of a token, or None for an unknown one."""
        self._read_again()
        return self._callers.get(token_hash(token))

    def _read_again(self) -> None:
        """Read the file if it has changed: without one there are no callers, an invalid one changes nothing."""
        state = _state(self._file)
        if self._file is None or state == self._seen:
            return
        self._seen = state
        try:
            callers = _callers(read_tokens(self._file)) if state is not None else {}
        except TokensError as error:
            _log.error("tokens_unusable", reason=str(error), kept=len(self._callers))
            return
        before, after = set(self._callers.values()), set(callers.values())
        self._callers = callers
        _log.info(
            "tokens_changed",
            added=sorted(f"{c.name} ({c.role})" for c in after - before),
            removed=sorted(f"{c.name} ({c.role})" for c in before - after),
        )


def _callers(entries: Iterable[TokenEntry]) -> dict[str, Caller]:
    return {entry.sha256: Caller(entry.name, entry.role) for entry in entries}


def _state(file: Path | None) -> tuple[int, ...] | None:
    """Return what changes with a file's content or access, None if there is none."""
    try:
        found = os.stat(file) if file is not None else None  # noqa: PTH116  # once per request
    except OSError:
        return None
    return (found.st_ino, found.st_mtime_ns, found.st_ctime_ns, found.st_size) if found is not None else None


def load_tokens(file: Path | None) -> Tokens:
    """Read a tokens file, and again when it changes; without a file every write is refused.

    Raises `TokensError` for a file that can't be used now.
    """
    return Tokens() if file is None else Tokens(read_tokens(file), file)


def require(role: Role) -> Callable[..., Caller]:
    """Return a dependency that admits callers of this role or a higher one: `Depends(require("operator"))`."""

    def check(
        request: Request, credentials: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)]
    ) -> Caller:
        challenge = {"WWW-Authenticate": "Bearer"}
        if credentials is None:
            detail = "this request needs a token: send `Authorization: Bearer TOKEN`"
            raise ProblemError(HttpProblem.TOKEN_MISSING, detail, headers=challenge)
        tokens: Tokens = request.app.state.tokens
        caller = tokens.caller(credentials.credentials)
        if caller is None:
            detail = "the token is unknown: use one of the site's tokens"
            raise ProblemError(HttpProblem.TOKEN_UNKNOWN, detail, headers=challenge)
        if _RANKS[caller.role] < _RANKS[role]:
            detail = f"this request needs the role {role}; {caller.name} has the role {caller.role}"
            raise ProblemError(HttpProblem.ROLE_TOO_LOW, detail)
        return caller

    return check


Viewer = Annotated[Caller, Depends(require("viewer"))]
"""A parameter of a route that viewers, operators and admins may call."""
Admin = Annotated[Caller, Depends(require("admin"))]
"""A parameter of a route that admins may call."""
Operator = Annotated[Caller, Depends(require("operator"))]
"""A parameter of a route that operators and admins may call."""
