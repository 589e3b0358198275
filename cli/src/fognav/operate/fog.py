"""The fog that a command talks to (a demo, this machine's fog node, or one elsewhere), and its REST APIs."""

import http.client
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote, urlsplit

import msgspec

from fog_contracts.messages import Id, Mode
from fog_runtime.credentials import Credentials
from fog_supervisor import net
from fognav.credentials import own_credentials
from fognav.operate.systems import FOG_NODE, System, addresses, find_systems, registered
from fognav.output import FailedError, WrongUseError
from fognav.programs import MAP_SERVICE, PLANNER, ROUTER

FOG: Final = "FOGNAV_FOG"
TOKEN: Final = "FOGNAV_TOKEN"  # noqa: S105  # a variable's name
TOKEN_FILE: Final = "FOGNAV_TOKEN_FILE"  # noqa: S105  # same
_GIVE_TOKEN: Final = f"Set {TOKEN} to an operator's token, or {TOKEN_FILE} to a file that holds it"

_IN_COMMANDS: Final[Mapping[str, str]] = {
    "alerts": "`fognav alert list`",
    "areas": "`fognav area list`",
    "floors": "`fognav floor list`",
    "masks/keepout.png": "`fognav map export nav2`",
    "nodes": "`fognav node list`",
    "places": "those that are known",
    "robots": "those that are known",
    "schedules": "`fognav mission schedules`",
    "store": "`fognav store status`",
    "zone-sets": "`fognav zone list`",
    "zones": "`fognav zone list`",
}
"""What a command says for a route of the services' problem documents, which speak to programs that use REST."""


class RefusedError(FailedError):
    """A service refused a request; `status`, `code` and `reason` are those of its problem document."""

    def __init__(self, message: str, status: int, problem: object = None) -> None:
        super().__init__(message)
        self.status = status
        self.problem: Mapping[str, Any] = problem if isinstance(problem, dict) else {}

    @property
    def code(self) -> str:
        """The problem's identifier; empty without one."""
        return str(self.problem.get("type", "")).rpartition(":")[2]

    @property
    def reason(self) -> str:
        """The service's own words."""
        return str(self.problem.get("detail") or self)


class Outcome(msgspec.Struct, frozen=True, kw_only=True):
    """What became of a command: the robot's answer, and its mode afterwards (None if it publishes no state).

    `code` identifies the refusal, and `causes` the conditions behind it, as in `CommandReply`.
    """

    accepted: bool
    reason: str
    mode: Mode | None
    code: str = ""
    causes: list[str] = []


@dataclass(frozen=True)
class Fog:
    """A running system and the caller's secrets for it."""

    system: System

    @cached_property
    def site(self) -> str:
        """Id of the site; raises `FailedError` if the map-service can't be asked for it."""
        return self.system.site or str(self.get(MAP_SERVICE, "/api/v1/map")["site"])

    @cached_property
    def token(self) -> str | None:
        """The caller's bearer token, or None; raises `WrongUseError` for a file that can't be read."""
        if token := os.environ.get(TOKEN):
            return token
        file = os.environ.get(TOKEN_FILE) or self.system.token_file
        if file is None:
            return self.credentials.token or None
        try:
            return Path(file).read_text("ascii").strip()
        except (OSError, UnicodeDecodeError) as error:
            raise WrongUseError(f"the token file {file} can't be read: {error}. {_GIVE_TOKEN}") from error

    @cached_property
    def credentials(self) -> Credentials:
        """The caller's credentials, or nobody's; raises `WrongUseError` for a file that can't be used."""
        return own_credentials(self.system.credentials_file)

    def robot(self, chosen: str | None) -> str:
        """Return the chosen robot, or the only one; raises `WrongUseError` when there is a choice."""
        if chosen is not None:
            try:
                return msgspec.convert(chosen, Id)
            except msgspec.ValidationError as error:
                raise WrongUseError(f"--robot {chosen}: an id has only a to z, 0 to 9 and -, at most 32") from error
        known = self.system.robots or [str(robot["id"]) for robot in self.get(PLANNER, "/api/v1/robots")]
        if len(known) == 1:
            return known[0]
        raise WrongUseError(f"name a robot with --robot; {self.system.name} has: {', '.join(known) or 'none'}")

    def get(self, service: str, path: str) -> Any:  # noqa: ANN401  # JSON
        """Return the JSON answer of a service; raises `FailedError`, or `RefusedError` with the service's reason."""
        return self.send("GET", service, path)

    def send(  # the parts of a request
        self,
        method: str,
        service: str,
        path: str,
        body: object = None,
        headers: Mapping[str, str] | None = None,
        timeout_s: float = net.HTTP_TIMEOUT_S,
    ) -> Any:  # noqa: ANN401  # JSON
        """Send a request to a service and return its JSON answer; raises as `get`."""
        return self._answer(method, service, path, body, headers, timeout_s).body

    def fetch(self, service: str, path: str) -> bytes:
        """Return what a service answers that is no JSON, such as a picture; raises as `get`."""
        return self._answer("GET", service, path).data

    def _answer(  # the parts of a request
        self,
        method: str,
        service: str,
        path: str,
        body: object = None,
        headers: Mapping[str, str] | None = None,
        timeout_s: float = net.HTTP_TIMEOUT_S,
    ) -> net.Response:
        url = self.system.urls.get(service)
        if url is None:
            raise FailedError(f"the {service} of {self.system.name} does not run: look at its log, then start it")
        parts = urlsplit(url)
        try:
            response = net.request(
                method,
                parts.port or 80,
                quote(path, safe="/?=&"),
                body=body,
                token=self.token,
                headers=headers,
                host=parts.hostname or net.LOOPBACK,
                tls=self.credentials.tls_context() if parts.scheme == "https" else None,
                timeout_s=timeout_s,
            )
        except (OSError, http.client.HTTPException) as error:
            raise FailedError(
                f"the {service} does not answer at {url}: {error}. Check that it runs there (fognav status)"
            ) from error
        if response.status >= http.client.BAD_REQUEST:
            problem = response.body if isinstance(response.body, dict) else {}
            remedy = _GIVE_TOKEN if response.status == http.client.UNAUTHORIZED else str(problem.get("remedy", ""))
            words = ". ".join(part for part in (f"the {service} refused it: {response.reason}", remedy) if part)
            raise RefusedError(_in_commands(words), response.status, response.body)
        return response


def _in_commands(text: str) -> str:
    """Return what a problem document says, in the words of the command."""
    named = re.sub(r"GET /api/v1/([a-z-]+(?:/[a-z.]+)*)", lambda found: _IN_COMMANDS.get(found[1], found[0]), text)
    added = re.sub(r"[:;] PUT one first", "", re.sub(r", or (?:POST|PUT) a new one", ", or add one", named))
    return re.sub(r"`(?:detail|errors)` names", "it names", added)


def find_fog(address: str | None) -> Fog:
    """Return the fog to talk to: `address` or FOGNAV_FOG is a host or a name from `fognav status`.

    Without either it is the only demo or fog node of this machine; raises `FailedError` without any, `WrongUseError`
    when there is a choice.
    """
    named = address or os.environ.get(FOG)
    if named:
        found = [system for system in registered() if system.name == named]
        if len(found) > 1:
            folders = ", ".join(str(system.data) for system in found)
            raise WrongUseError(
                f"several systems of this machine are named {named} (data in {folders}): end all but one, "
                "or give the other's site an id of its own in its site.toml"
            )
        return Fog(found[0] if found else _fog_node(named))
    fogs = [system for system in find_systems() if system.kind != "robot"]
    if not fogs:
        raise FailedError(
            "no demo or fog node runs on this machine. Start one (fognav demo --keep-running), "
            f"or name a fog node with --fog ADDRESS or {FOG}"
        )
    if len(fogs) > 1:
        names = ", ".join(system.name for system in fogs)
        raise WrongUseError(f"several systems run on this machine: choose one with --fog ({names})")
    return Fog(fogs[0])


def _fog_node(name: str) -> System:
    """Return the fog node of a host, or of this machine by its name; raises `WrongUseError` for more than a host."""
    if "/" in name or re.fullmatch(r"[^:]*:[0-9]*", name):
        raise WrongUseError(
            f"--fog {name}: give a host's name or address, without scheme and port. The ports are those of "
            "docker-compose.yml; set FOGNAV_PLANNER_PORT, … if they were changed"
        )
    host = net.LOOPBACK if name == FOG_NODE else name
    return System(
        name=name, kind="fog node", site="", urls=addresses(host, secured=bool(own_credentials().authority)), pids={}
    )


def router(fog: Fog) -> str:
    """Return the endpoint of a fog's zenoh router."""
    return fog.system.urls[ROUTER]
