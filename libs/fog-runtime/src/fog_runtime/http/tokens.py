"""Authorization: bearer tokens with roles, read from a file with their hashes, again whenever it changes; and sessions.

A session is what a browser keeps instead of a token (ADR 67): a cookie with the owner's name and an expiry, signed with
a key that all services of a site have. Nobody stores it. The signature covers the hash of the owner's token, so that a
session ends with its token, and does not come back when somebody of the same name gets another one.
"""

import base64
import binascii
import hashlib
import hmac
import os
import re
import secrets
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Final

import msgspec
from fastapi import Depends, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from fog_runtime import logs
from fog_runtime.http.problems import HttpProblem, ProblemError
from fog_runtime.keys import read_session_key
from fog_runtime.token_file import ROLES, Role, TokenEntry, TokensError, read_tokens, token_hash

SESSION_S: Final = 12 * 3600.0
"""How long a session lasts, unless its page asks who is logged in: each time it asks, it lasts as long again."""
PART: Final = "Fognav-Part"
"""The header by which a program says which of its parts asks by its token: the caller's name is `NAME/PART` then.

No token has a name with a slash, so that nobody passes for another so.
"""
_PART: Final = re.compile(r"[a-z0-9-]{1,32}")
_NAME_MAX: Final = 100
_SAFE: Final = frozenset({"GET", "HEAD", "OPTIONS"})
_RANKS: Final = {role: rank for rank, role in enumerate(ROLES)}
_bearer = HTTPBearer(
    auto_error=False, description="A token of the tokens file; a browser's session (POST /api/v1/session) stands for it"
)
_log = logs.get("tokens")


class Caller(msgspec.Struct, frozen=True):
    """The owner of a valid token; the name appears in the audit log. `until` is when a session ends (s, Unix time).

    `session` tells apart the browsers that are logged in by the same token; empty without a session.
    """

    name: str
    role: Role
    until: float | None = None
    session: str = ""
    token: str = ""
    """Name of the token, where `name` tells apart the programs that share it."""

    @property
    def asker(self) -> str:
        """Whose requests are counted together where each caller may have so many at a time."""
        return self.token or self.name


class _Session(msgspec.Struct, frozen=True, array_like=True):
    name: str
    until: float
    id: str = ""


class Tokens:
    """The callers by the hashes of their tokens; with a file, as it is at each request. Used from several threads."""

    def __init__(
        self,
        entries: Iterable[TokenEntry] = (),
        file: Path | None = None,
        *,
        session_key: bytes | None = None,
        now: Callable[[], float] = time.time,
    ) -> None:
        """Without a `session_key` there are no sessions; `now` is the time of day (s)."""
        self._file = file
        self._seen = _state(file)
        self._key = session_key
        self._callers = self._with_codes(entries)
        self._now = now

    def caller(self, token: str) -> Caller | None:
        """Return the owner of a token, or None for an unknown one."""
        self._read_again()
        return self._callers.get(token_hash(token))

    @property
    def gateway_proof(self) -> bytes:
        """What a gateway that has the key of sessions sends with a request, to be believed for whom; empty without."""
        return b"" if self._key is None else hmac.digest(self._key, b"fognav gateway", "sha256").hex().encode()

    def cookie_name(self, *, encrypted: bool) -> str:
        """Return the name of a session's cookie.

        It is another one for each key: a browser sends a host's cookies to all its ports, and each may be a floor. With
        `__Host-` browsers accept it from this host only, and encrypted.
        """
        site = hashlib.sha256(b"fognav cookie " + (self._key or b"")).hexdigest()[:8]
        return f"__Host-fognav-{site}" if encrypted else f"fognav-{site}"

    def new_session(self, owner: Caller) -> tuple[str, Caller] | None:
        """Return the value of a cookie for the owner of a token, and the owner with the session's end.

        None without a key, or if the owner has no token any more.
        """
        self._read_again()
        known = self._callers.items()
        sha256 = next((key for key, each in known if (each.name, each.role) == (owner.name, owner.role)), None)
        if self._key is None or sha256 is None:
            return None
        until = self._now() + SESSION_S
        payload = msgspec.msgpack.encode(_Session(owner.name, until, owner.session or secrets.token_hex(8)))
        value = f"{_text(payload)}.{_text(self._signature(self._key, payload, sha256))}"
        return value, msgspec.structs.replace(owner, until=until)

    def caller_of_session(self, cookies: Mapping[str, str], *, encrypted: bool) -> Caller | None:
        """Return whose valid session is among the cookies of a request, None if none is."""
        value = cookies.get(self.cookie_name(encrypted=encrypted))
        if self._key is None or not value:
            return None
        self._read_again()
        try:
            payload, signature = (base64.b64decode(part, b"-_", validate=True) for part in value.split("."))
            session = msgspec.msgpack.decode(payload, type=_Session)
        except (binascii.Error, ValueError, msgspec.DecodeError):
            return None
        for sha256, caller in list(self._callers.items()):
            if caller.name == session.name:
                expected = self._signature(self._key, payload, sha256)
                if hmac.compare_digest(signature, expected) and self._now() < session.until:
                    return msgspec.structs.replace(caller, until=session.until, session=session.id)
        return None

    def code_of(self, admin: Caller) -> str | None:
        """Return the guest's token that belongs to an admin, for codes on walls; None without a key, or such an admin.

        Nobody stores it: it is made of the key of sessions and of the admin's token, with which it ends.
        """
        self._read_again()
        known = self._callers.items()
        sha256 = next((key for key, each in known if (each.name, each.role) == (admin.name, "admin")), None)
        return None if self._key is None or sha256 is None else _code(self._key, sha256)

    def _with_codes(self, entries: Iterable[TokenEntry]) -> dict[str, Caller]:
        """Return the callers by the hashes of their tokens, and the guests whose tokens belong to admins."""
        found: dict[str, Caller] = {}
        for entry in entries:
            found[entry.sha256] = Caller(entry.name, entry.role)
            if entry.role == "admin" and self._key is not None:
                found[token_hash(_code(self._key, entry.sha256))] = Caller(f"codes of {entry.name}", "guest")
        return found

    @staticmethod
    def _signature(key: bytes, payload: bytes, sha256: str) -> bytes:
        return hmac.digest(key, b"fognav session " + sha256.encode() + payload, "sha256")

    def _read_again(self) -> None:
        """Read the file if it has changed: without one there are no callers, an invalid one changes nothing."""
        state = _state(self._file)
        if self._file is None or state == self._seen:
            return
        self._seen = state
        try:
            callers = self._with_codes(read_tokens(self._file)) if state is not None else {}
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


def _code(key: bytes, sha256: str) -> str:
    return _text(hmac.digest(key, b"fognav code " + sha256.encode(), "sha256")).rstrip("=")


def _text(data: bytes) -> str:
    return base64.urlsafe_b64encode(data).decode("ascii")


def _state(file: Path | None) -> tuple[int, ...] | None:
    """Return what changes with a file's content or access, None if there is none."""
    try:
        found = os.stat(file) if file is not None else None  # noqa: PTH116  # once per request
    except OSError:
        return None
    return (found.st_ino, found.st_mtime_ns, found.st_ctime_ns, found.st_size) if found is not None else None


def load_tokens(file: Path | None, session_key_file: Path | None = None) -> Tokens:
    """Read a tokens file, and again when it changes; without a file every write is refused.

    `session_key_file` has the key of sessions; without it only tokens are accepted. Raises `TokensError` for a tokens
    file that can't be used now, and `KeyFileError` for such a key.
    """
    key = None if session_key_file is None else read_session_key(session_key_file)
    return Tokens(session_key=key) if file is None else Tokens(read_tokens(file), file, session_key=key)


def is_encrypted(request: Request) -> bool:
    """Whether the client speaks HTTPS with us, or with the gateway that asks for it."""
    return request.url.scheme == "https"


def comes_from_elsewhere(request: Request) -> bool | None:
    """Whether another site's page lets a browser send this; None if the request does not tell (no browser does so)."""
    if site := request.headers.get("sec-fetch-site"):
        return site != "same-origin"
    if origin := request.headers.get("origin"):
        return origin != f"{request.url.scheme}://{request.headers.get('host', '')}"
    return None


def require(role: Role) -> Callable[..., Caller]:
    """Return a dependency that admits callers of this role or a higher one: `Depends(require("operator"))`.

    A caller proves who it is by a bearer token or, without one, by a session.
    """

    def check(
        request: Request, credentials: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)]
    ) -> Caller:
        tokens: Tokens = request.app.state.tokens
        caller = _of_session(request, tokens) if credentials is None else _of_token(credentials.credentials, tokens)
        if _RANKS[caller.role] < _RANKS[role]:
            detail = (
                f"this request needs the role {role}; {caller.name} has the role {caller.role}: use a token with that "
                "role, or ask who has one"
            )
            raise ProblemError(HttpProblem.ROLE_TOO_LOW, detail)
        part = request.headers.get(PART)
        return caller if credentials is None or part is None else _part_of(caller, part)

    return check


def _part_of(caller: Caller, part: str) -> Caller:
    if _PART.fullmatch(part) is None:
        detail = f"the header {PART} has up to 32 small letters, digits and -, or is left out"
        raise ProblemError(HttpProblem.REQUEST_INVALID, detail, field=f"header.{PART}")
    name = f"{caller.name[: _NAME_MAX - len(part) - 1]}/{part}"
    return msgspec.structs.replace(caller, name=name, token=caller.name)


def still_admits(request: Request, role: Role) -> bool:
    """Whether the caller of a request that lasts would be admitted now: a token may be revoked, a session may end."""
    return _admitted(request, role) is not None


def _admitted(request: Request, role: Role) -> Caller | None:
    scheme, _, token = request.headers.get("authorization", "").partition(" ")
    bearer = HTTPAuthorizationCredentials(scheme=scheme, credentials=token) if scheme.lower() == "bearer" else None
    try:
        return require(role)(request, bearer)
    except ProblemError:
        return None


def _whoever(request: Request) -> Caller | None:
    return _admitted(request, "guest")


_CHALLENGE: Final = {"WWW-Authenticate": "Bearer"}


def _of_token(token: str, tokens: Tokens) -> Caller:
    caller = tokens.caller(token)
    if caller is None:
        detail = "the token is unknown: use one of the site's tokens"
        raise ProblemError(HttpProblem.TOKEN_UNKNOWN, detail, headers=_CHALLENGE)
    return caller


def _of_session(request: Request, tokens: Tokens) -> Caller:
    encrypted = is_encrypted(request)
    if tokens.cookie_name(encrypted=encrypted) not in request.cookies:
        detail = "this request needs a token: send `Authorization: Bearer TOKEN`, or log in on the console"
        raise ProblemError(HttpProblem.TOKEN_MISSING, detail, headers=_CHALLENGE)
    caller = tokens.caller_of_session(request.cookies, encrypted=encrypted)
    if caller is None:
        detail = "the session has ended, or its token was revoked: log in again"
        raise ProblemError(HttpProblem.SESSION_ENDED, detail, headers=_CHALLENGE)
    if request.method not in _SAFE and comes_from_elsewhere(request) is not False:
        # A browser adds the cookie to what another site's page sends, too.
        detail = (
            "a session changes things from the console's own page only: open the console and repeat it there, or send "
            "a token"
        )
        raise ProblemError(HttpProblem.FOREIGN_ORIGIN, detail)
    return caller


Anybody = Annotated[Caller | None, Depends(_whoever)]
"""A parameter of a route that needs no token: whose valid one the request has all the same, None for nobody's."""
Guest = Annotated[Caller, Depends(require("guest"))]
"""A parameter of a route that everybody with a token may call."""
Viewer = Annotated[Caller, Depends(require("viewer"))]
"""A parameter of a route that viewers, operators and admins may call."""
Admin = Annotated[Caller, Depends(require("admin"))]
"""A parameter of a route that admins may call."""
Operator = Annotated[Caller, Depends(require("operator"))]
"""A parameter of a route that operators and admins may call."""
