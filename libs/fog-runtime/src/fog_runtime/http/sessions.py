"""Login of people who use a browser: a token becomes a session, kept in a cookie that no script can read."""

from typing import Annotated, Final

from fastapi import Depends, Request

from fog_contracts.messages import Message
from fog_runtime import logs
from fog_runtime.admission import KNOWN, source_of
from fog_runtime.clock import Clock
from fog_runtime.http.problems import HttpProblem, ProblemCode, ProblemError
from fog_runtime.http.routes import Answer, Body, ClientHost, Routes
from fog_runtime.http.tokens import SESSION_S, Admin, Caller, Guest, Tokens, comes_from_elsewhere, is_encrypted
from fog_runtime.token_file import Role

PATH: Final = "/api/v1/session"
ATTEMPTS: Final = 10
"""How many unknown tokens a client may send at once."""
ATTEMPT_S: Final = 6.0
"""How soon it may send another one after these."""

_log = logs.get("sessions")


class SessionProblem(ProblemCode):
    """Problems of logging in."""

    TOO_MANY_ATTEMPTS = (
        "too_many_attempts", 429, "Too many unknown tokens: `Retry-After` says when to try again",
        "Wait as long as `Retry-After` says, and copy the token anew",
    )  # fmt: skip
    NO_SESSIONS = (
        "no_sessions", 503, "This service has no key of sessions",
        "Set FOGNAV_SESSION_KEY_FILE of each service to the site's session.key",
    )  # fmt: skip


class Login(Message, frozen=True, kw_only=True):
    """Who logs in: by one of the site's tokens."""

    token: str


class Session(Message, frozen=True, kw_only=True):
    """Who is logged in: the token's name and role. `until` (s, Unix time) is when the session ends, null for a token.

    Each GET lets a session last for twelve hours from then on.
    """

    name: str
    role: Role
    until: float | None = None


class Code(Message, frozen=True, kw_only=True):
    """A guest's token for the codes that visitors scan."""

    token: str


class Attempts:
    """Counts the unknown tokens of each client, of as many clients as admission remembers."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._free_at: dict[str, float] = {}
        """When a client has used none of its attempts any more, the latest to fail last."""

    def wait_s(self, host: str) -> float:
        """Return for how long a client must wait until its next attempt: 0 if it need not."""
        used = (self._free_at.get(_source(host), 0.0) - self._clock.now()) / ATTEMPT_S
        return max(0.0, (used - ATTEMPTS + 1) * ATTEMPT_S)

    def failed(self, host: str) -> None:
        """Count an attempt."""
        source, now = _source(host), self._clock.now()
        self._free_at[source] = max(self._free_at.pop(source, now), now) + ATTEMPT_S
        if len(self._free_at) > KNOWN:
            del self._free_at[next(iter(self._free_at))]


def _source(host: str) -> str:
    try:
        return source_of(host)
    except ValueError:
        return host


def _own_page(request: Request) -> bool:
    if comes_from_elsewhere(request):
        detail = "only the console's own page logs in: open the console, and log in there"
        raise ProblemError(HttpProblem.FOREIGN_ORIGIN, detail)
    return is_encrypted(request)


Encrypted = Annotated[bool, Depends(is_encrypted)]


def add_session_routes(routes: Routes, tokens: Tokens, clock: Clock) -> None:
    """Add login, logout, and who is logged in, in the service that serves the page. The others accept its sessions."""
    attempts = Attempts(clock)

    def answer(caller: Caller, *, encrypted: bool) -> Answer[Session]:
        made = tokens.new_session(caller)
        if made is None:
            raise _no_sessions()
        value, owner = made
        cookie = _cookie(tokens, value, SESSION_S, encrypted=encrypted)
        return Answer(Session(name=owner.name, role=owner.role, until=owner.until), _headers(cookie))

    @routes.post(
        PATH,
        problems=[
            HttpProblem.TOKEN_UNKNOWN, HttpProblem.FOREIGN_ORIGIN, SessionProblem.TOO_MANY_ATTEMPTS,
            SessionProblem.NO_SESSIONS,
        ],
    )  # fmt: skip
    async def log_in(
        body: Body[Login], host: ClientHost, encrypted: Annotated[bool, Depends(_own_page)]
    ) -> Answer[Session]:
        """Log in with a token: the answer sets a cookie, which the services accept beside tokens."""
        caller = tokens.caller(body.token)
        if caller is None:
            # Who has a token is never kept out: many may share an address, and nobody guesses 256 bits.
            if wait_s := attempts.wait_s(host):
                detail = f"you sent {ATTEMPTS} unknown tokens: try again in {wait_s:.0f} s, with one that is known"
                headers = {"Retry-After": f"{max(1.0, wait_s):.0f}"}
                raise ProblemError(SessionProblem.TOO_MANY_ATTEMPTS, detail, headers=headers)
            attempts.failed(host)
            detail = "nobody has this token: copy one that `fognav token create` printed, without spaces around it"
            raise ProblemError(HttpProblem.TOKEN_UNKNOWN, detail)
        _log.info("logged_in", name=caller.name, role=caller.role)
        return answer(caller, encrypted=encrypted)

    @routes.get(PATH, problems=[SessionProblem.NO_SESSIONS])
    async def who_is_logged_in(caller: Guest, encrypted: Encrypted) -> Answer[Session]:
        """Who asks, in which role. A session lasts for twelve hours from this request on."""
        if caller.until is None:
            return Answer(Session(name=caller.name, role=caller.role), _headers())
        return answer(caller, encrypted=encrypted)

    @routes.delete(PATH)
    async def log_out(encrypted: Encrypted) -> Answer[None]:
        """Log out this browser. To end a person's sessions everywhere, revoke the token."""
        return Answer(None, _headers(_cookie(tokens, "", 0, encrypted=encrypted)))

    _add_code(routes, tokens)


def _add_code(routes: Routes, tokens: Tokens) -> None:
    @routes.post(f"{PATH}/code", problems=[SessionProblem.NO_SESSIONS])
    async def code_for_visitors(caller: Admin) -> Code:
        """Return the guest's token for the codes of visitors that this admin prints; it ends with the admin's token."""
        token = tokens.code_of(caller)
        if token is None:
            raise _no_sessions()
        return Code(token=token)


def _no_sessions() -> ProblemError:
    detail = "set FOGNAV_SESSION_KEY_FILE of each service to the site's session.key, and restart them"
    return ProblemError(SessionProblem.NO_SESSIONS, detail)


def _cookie(tokens: Tokens, value: str, seconds: float, *, encrypted: bool) -> str:
    name = tokens.cookie_name(encrypted=encrypted)
    secure = "; Secure" if encrypted else ""
    return f"{name}={value}; Path=/; Max-Age={seconds:.0f}; HttpOnly; SameSite=Strict{secure}"


def _headers(cookie: str = "") -> dict[str, str]:
    return {"Cache-Control": "no-store", **({"Set-Cookie": cookie} if cookie else {})}
