"""This floor as others see it, and the floors on other machines as this one sees them; one stop for all (ADR 73).

A floor is an island: nothing that its robots, sensors or services need is here. What is known of another floor was said
by its own console-service, and has an age. A stop is sent to each floor once, and never again by itself: robots that
somebody has enabled since must not stop because a link has come back.
"""

from __future__ import annotations

import asyncio
import re
import ssl
import time
import tomllib
from collections import deque
from contextlib import AsyncExitStack, aclosing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Final, Literal, NamedTuple, TypeVar
from urllib.parse import urlsplit

import httpx
import msgspec
from prometheus_client import Gauge
from starlette.requests import Request

from console_service.forward import CONSOLE, PLANNER, Forward
from console_service.views import FloorRobot
from fog_contracts.messages import Id, Message
from fog_runtime import logs
from fog_runtime.clock import ticker
from fog_runtime.configuration.settings import SettingsError
from fog_runtime.credentials import Credentials
from fog_runtime.http import ProblemError
from fog_runtime.http.tokens import PART

if TYPE_CHECKING:
    from collections.abc import Callable, Collection
    from pathlib import Path

    from console_service.core import ConsoleCore
    from fog_runtime.clock import Clock
    from fog_runtime.health import Health

HERE: Final = "/api/v1/floors/here"
PERIOD_S: Final = 1.0
"""How often each floor is asked, if there are few."""
_ASKS_HZ: Final = 200.0
"""How many are asked in a second at most: an answer takes a millisecond, and a stop waits for none."""
_OLD_PERIODS: Final = 3.0
"""What is older than so many periods is not shown as present."""
AWAY_S: Final = 10.0
"""A robot that was not heard for so long is away: it holds by itself, and its silence does not make a stop fail."""
ANSWER_LIMIT: Final = 1 << 20
"""Bytes of an answer: a floor that somebody has taken over must not fill the memory of another."""
_LISTED_S: Final = 1.0
"""How long the planner may take to list its robots; those that are known are stopped meanwhile."""
_ASK: Final = httpx.Timeout(2.0)
_STOP: Final = httpx.Timeout(6.0, connect=3.0)
"""A robot has 2 s to answer; a first packet that is lost is sent again after 1 s."""
_STOPPED_S: Final = 8.0
"""For its whole answer: one that never ends must not hide that others have stopped."""
_NO_AUTHORITY: Final = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
"""For addresses without encryption: it trusts nobody. Each client would make one of its own, of 0.7 MB."""
_MANEUVERS: Final = frozenset({"EGRESS", "DOCK", "TELEOP"})
"""Modes in which a robot moves that is not enabled."""
_LOOPBACK: Final = ("127.0.0.1", "::1", "localhost")

REACHABLE = Gauge("fognav_console_floor_reachable", "Whether a floor on another machine answers", ["floor"])
_log = logs.get("console-service")
_T = TypeVar("_T")


class FloorView(Message, frozen=True, kw_only=True):
    """A floor: what its services lack that are not ready, its robots, its areas that are blocked or unknown.

    `stopped`: robots were heard just now, and none of them may drive, or moves without being enabled.
    """

    site: Id
    not_ready: dict[str, str]
    robots: list[FloorRobot]
    blocked: list[str]
    unknown: list[str]
    stopped: bool


class RobotStop(Message, frozen=True, kw_only=True):
    """What became of a robot's stop: `detail` says why it is not known to have stopped; `age_s` as in `FloorRobot`."""

    id: str
    stopped: bool
    age_s: float | None
    detail: str = ""


class FloorStop(Message, frozen=True, kw_only=True):
    """What became of a floor's stop. Acknowledged: all its robots but those that are away said that they stop.

    That takes somebody who knows them: the planner's list, for callers who may read it, or a console-service that has
    listened for a while. Otherwise `detail` says why, and what to do.
    """

    id: Id
    acknowledged: bool
    robots: list[RobotStop]
    detail: str = ""


Trouble = Literal["", "silent", "refused", "other_floor", "unreadable"]
"""Why a floor is not known: it does not answer, refuses the token, is another one, or says what nobody understands."""


class FloorEntry(Message, frozen=True, kw_only=True):
    """A floor, and how old what is known of it is (`age_s`; null: nothing is), last heard at `heard` (s, Unix time).

    `address` is its console's, empty for this floor itself. `trouble` identifies why it is not `reachable`, `detail` is
    a sentence.
    """

    id: Id
    address: str
    reachable: bool
    age_s: float | None
    heard: float | None
    trouble: Trouble
    detail: str
    floor: FloorView | None


class Peer(NamedTuple):
    """A floor on another machine: where its console-service serves REST, with which token, and whom to trust there.

    One that has two copies has two addresses.
    """

    id: str
    addresses: tuple[str, ...]
    token: str
    tls: ssl.SSLContext | None


_Address = Annotated[str, msgspec.Meta(pattern=r"^https?://[^/?#]+/?$(?!\n)")]


class _Listed(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    address: _Address
    credentials: str
    second_address: _Address | None = None


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    floors: dict[Id, _Listed] = {}


def read_peers(file: Path | None, own: str) -> list[Peer]:
    """Return the floors of a list, without the `own` one: all machines may have the same. None: there are no others.

    Raises `SettingsError`, and `CredentialsError` for a file of credentials.
    """
    if file is None:
        return []
    remedy = "docs/campus.md has an example"
    try:
        listed = msgspec.convert(tomllib.loads(file.read_text("utf-8")), _File).floors
    except OSError as error:
        raise SettingsError(f"the list of floors {file} can't be read: {error.strerror}. {remedy}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SettingsError(f"the list of floors {file} is not valid TOML: {error}. {remedy}") from error
    except msgspec.ValidationError as error:
        raise SettingsError(f"the list of floors {file}: {error}. {remedy}") from error
    return [_peer(file, floor, entry) for floor, entry in listed.items() if floor != own]


def _peer(file: Path, floor: str, entry: _Listed) -> Peer:
    own = Credentials.read(file.parent / entry.credentials)
    if not own.token:
        raise SettingsError(
            f"{file}: the credentials of {floor} have no token: make them there by `fognav token create NAME --role "
            "viewer --out FILE`"
        )
    addresses = (entry.address, *([entry.second_address] if entry.second_address else []))
    for address in addresses:
        parts = urlsplit(address)
        try:
            _ = parts.port
        except ValueError as error:
            raise SettingsError(f"{file}: the address of {floor}, {address}: {error}. Correct its port") from error
        if parts.scheme != "https" and parts.hostname not in _LOOPBACK:
            raise SettingsError(
                f"{file}: {address} is not encrypted, so everybody in the network could read the token of {floor}. "
                "Begin it with https://"
            )
    encrypted = any(address.startswith("https:") for address in addresses)
    trusted = own.tls_context() if encrypted else None
    return Peer(floor, tuple(address.rstrip("/") for address in addresses), own.token, trusted)


class OwnFloor:
    """This floor: what there is to say of it, and its stop."""

    def __init__(self, core: ConsoleCore, forward: Forward, health: Health, now: Callable[[], float]) -> None:
        """`now` returns the time (s, monotonic)."""
        self._core = core
        self._forward = forward
        self._health = health
        self._now = now
        self._begun_at = time.monotonic()
        self._readiness: tuple[float, asyncio.Task[dict[str, str]]] | None = None

    @property
    def id(self) -> str:
        """Its site's id."""
        return self._core.site

    async def view(self) -> FloorView:
        """Return its state; its services are asked whether they are ready once a second, whoever asks for it."""
        now = self._now()
        if self._readiness is None or now - self._readiness[0] >= PERIOD_S:
            self._readiness = now, asyncio.create_task(self._forward.readiness())
        not_ready = dict(await asyncio.shield(self._readiness[1]))
        if missing := self._health.report()["missing"]:
            not_ready[CONSOLE] = ", ".join(map(str, missing))
        robots, areas = self._core.floor(self._now())
        present = [robot for robot in robots if not _is_away(robot) and robot.enabled is not None]
        return FloorView(
            site=self.id,
            not_ready=not_ready,
            robots=robots,
            blocked=areas.get("blocked", []),
            unknown=areas.get("unknown", []),
            stopped=bool(present) and not any(robot.enabled or robot.mode in _MANEUVERS for robot in present),
        )

    async def stop(self, request: Request) -> FloorStop:
        """Stop all its robots at once, for the caller of a request; the planner sends and records it."""
        robots, _ = self._core.floor(self._now())
        # Only who has listened for a while knows that a robot is silent.
        lacks = ", ".join(map(str, self._health.report()["missing"]))
        knows = time.monotonic() - self._begun_at >= AWAY_S and not lacks
        known, further = await asyncio.gather(
            asyncio.gather(*(self._stop(robot, request) for robot in robots)),
            self._stop_further({robot.id for robot in robots}, request),
        )
        asked = [*zip(robots, known, strict=True), *(further or ())]
        failed = [
            f"{stop.id}: {stop.detail}"
            for robot, (stop, has_answered) in asked
            if not stop.stopped and not (has_answered and knows and _is_away(robot))
        ]
        if not asked and PLANNER in await self._forward.readiness():
            failed = ["its planner does not run, and no robot is known"]
        elif further is None and not knows:
            why = f"it is not connected to {lacks}" if lacks else f"it has begun less than {AWAY_S:g} s ago"
            failed.append(f"the console-service may not know all robots: {why} (`fognav status`)")
        detail = "; ".join(failed) + (". Stop what still drives on the spot, and press again" if failed else "")
        return FloorStop(id=self.id, acknowledged=not failed, robots=[stop for _, (stop, _) in asked], detail=detail)

    async def _stop_further(
        self, known: Collection[str], request: Request
    ) -> list[tuple[FloorRobot, tuple[RobotStop, bool]]] | None:
        """Stop the robots of which only the planner knows; None if it does not tell the caller of its robots.

        Those of the site it knows, and all that it has heard.
        """
        asking = Request({**request.scope, "method": "GET"})
        try:
            async with asyncio.timeout(_LISTED_S):
                async with aclosing(await self._forward.send(PLANNER, asking, b"/api/v1/robots", b"")) as answer:
                    text = await answer.aread()
            listed = msgspec.json.decode(text, type=list[_Named]) if answer.is_success else None
        except (ProblemError, httpx.TransportError, TimeoutError, msgspec.MsgspecError) as error:
            _log.warning("robots_unknown", reason=repr(error))
            return None
        if listed is None:
            return None  # a stop needs no token, and this does
        robots = [
            FloorRobot(id=robot.id, age_s=None, mode=None, enabled=None, codes=[])
            for robot in listed
            if robot.id not in known
        ]
        return [*zip(robots, await asyncio.gather(*(self._stop(robot, request) for robot in robots)), strict=True)]

    async def _stop(self, robot: FloorRobot, request: Request) -> tuple[RobotStop, bool]:
        """Stop a robot; return what became of it, and whether it is the planner that says so."""
        try:
            answer = await self._forward.send(PLANNER, request, f"/api/v1/robots/{robot.id}/stop".encode(), b"")
            text = await answer.aread()
            await answer.aclose()
        except ProblemError as error:
            return RobotStop(id=robot.id, stopped=False, age_s=robot.age_s, detail=error.detail), False
        except httpx.TransportError as error:
            detail = f"the planner broke off ({error})"
            return RobotStop(id=robot.id, stopped=False, age_s=robot.age_s, detail=detail), False
        detail = "" if answer.is_success else _detail(text, answer.status_code)
        return RobotStop(id=robot.id, stopped=answer.is_success, age_s=robot.age_s, detail=detail), True


def _is_away(robot: FloorRobot) -> bool:
    return robot.age_s is None or robot.age_s > AWAY_S


class _Named(msgspec.Struct):
    id: Id


class _Problem(msgspec.Struct):
    detail: str = ""


def _detail(text: bytes, status: int) -> str:
    """Return the sentence of a problem document."""
    try:
        return msgspec.json.decode(text, type=_Problem).detail or f"HTTP {status}"
    except msgspec.MsgspecError:
        return f"HTTP {status}"


class _AskError(Exception):
    """A floor gave no answer of use; the message says why, and what to do."""

    def __init__(self, trouble: Trouble, message: str) -> None:
        super().__init__(message)
        self.trouble: Trouble = trouble


def _client(peer: Peer, address: str, patience: httpx.Timeout) -> httpx.AsyncClient:
    return httpx.AsyncClient(
        base_url=address, headers={"Authorization": f"Bearer {peer.token}"}, timeout=patience, trust_env=False,
        verify=_NO_AUTHORITY if peer.tls is None else peer.tls,
    )  # fmt: skip


async def _ask(client: httpx.AsyncClient, method: str, path: str, kind: type[_T]) -> _T:
    """Send a request to a floor and return its answer; raises `_AskError`."""
    address, data = client.base_url, bytearray()
    try:
        async with client.stream(method, path) as answer:
            async for part in answer.aiter_bytes():
                data += part
                if len(data) > ANSWER_LIMIT:
                    raise _AskError("unreadable", f"{address} says too much: look what runs there")
    except httpx.HTTPError as error:
        raise _AskError(
            "silent",
            f"{address} does not answer ({str(error) or type(error).__name__}): look at the link and whether the fog "
            "node runs there (fognav status)",
        ) from error
    if answer.status_code in (httpx.codes.UNAUTHORIZED, httpx.codes.FORBIDDEN):
        raise _AskError(
            "refused", f"{address} refuses the token of this list of floors: make another there (fognav token create)"
        )
    if not answer.is_success:
        raise _AskError("unreadable", f"{address}: {_detail(bytes(data), answer.status_code)}")
    try:
        return msgspec.json.decode(data, type=kind)
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise _AskError("unreadable", f"{address}: {error}. Check that versions match") from error


def _of(peer: Peer, view: FloorView) -> FloorView:
    if view.site == peer.id:
        return view
    raise _AskError(
        "other_floor", f"{peer.addresses[0]} is the floor {view.site}, not {peer.id}: correct the list of floors"
    )


@dataclass
class _Known:
    floor: FloorView | None = None
    asked_at: float = 0.0
    """When what is known was asked for (s, monotonic): it is no older."""
    heard: float | None = None
    trouble: Trouble = "silent"
    detail: str = "it was not asked yet"


class Hub:
    """The floors on other machines; `run` asks them for as long as it runs."""

    def __init__(self, peers: Collection[Peer], clock: Clock) -> None:
        """Nothing is known of them before `run`."""
        self._clock = clock
        self._peers = {peer.id: peer for peer in peers}
        self._known = {peer.id: _Known() for peer in peers}
        self._period_s = max(PERIOD_S, len(self._peers) / _ASKS_HZ)

    @property
    def ids(self) -> list[str]:
        """The floors on other machines."""
        return list(self._peers)

    async def run(self) -> None:
        """Ask all floors, each by itself, until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            for place, peer in enumerate(self._peers.values()):
                # Not all at once: while so many answers are taken apart, a stop would wait.
                begin_s = self._period_s * place / len(self._peers)
                tasks.create_task(self._follow(peer, begin_s), name=f"floor {peer.id}")

    async def _follow(self, peer: Peer, begin_s: float) -> None:
        await self._clock.sleep(begin_s)
        async with AsyncExitStack() as contexts:
            clients = deque(
                [await contexts.enter_async_context(_client(peer, address, _ASK)) for address in peer.addresses]
            )
            async for now in ticker(self._clock, self._period_s):
                await self._look(peer, clients[0], now)
                if self._known[peer.id].trouble == "silent":
                    clients.rotate()

    async def _look(self, peer: Peer, client: httpx.AsyncClient, now: float) -> None:
        """Ask a floor how it is, at `now`."""
        known = self._known[peer.id]
        try:
            view = _of(peer, await _ask(client, "GET", HERE, FloorView))
        except _AskError as error:
            if known.trouble != error.trouble:
                _log.warning("floor_lost", floor=peer.id, reason=str(error))
            known.trouble, known.detail = error.trouble, str(error)
        else:
            if known.trouble:
                _log.info("floor_found", floor=peer.id)
            known.floor, known.asked_at, known.heard = view, now, self._clock.stamp()
            known.trouble, known.detail = "", ""
        REACHABLE.labels(peer.id).set(not known.trouble)

    def entries(self) -> list[FloorEntry]:
        """Return what is known of the floors on other machines."""
        now = self._clock.now()
        found = []
        for floor, known in self._known.items():
            age = None if known.floor is None else round(max(0.0, now - known.asked_at), 1)
            late = not known.trouble and age is not None and age > _OLD_PERIODS * self._period_s
            found.append(
                FloorEntry(
                    id=floor,
                    address=self._peers[floor].addresses[0],
                    reachable=not known.trouble and not late,
                    age_s=age,
                    heard=known.heard,
                    trouble="silent" if late else known.trouble,
                    detail=known.detail,
                    floor=known.floor,
                )
            )
        return found

    async def stop(self, floor: str, who: str) -> FloorStop:
        """Stop a floor on another machine, now and once; what does not succeed is in the answer.

        The floor's audit trail names `who`, as part of whose token this one has. A floor with two addresses is asked at
        both: its copies lead to the same robots, and one may be dead.
        """
        peer, first = self._peers[floor], None
        asked = [asyncio.create_task(self._stop_at(peer, address, who)) for address in peer.addresses]
        try:
            for answered in asyncio.as_completed(asked):
                answer = await answered
                if answer.acknowledged:
                    return answer
                first = max(first or answer, answer, key=lambda each: len(each.robots))
        finally:
            for task in asked:
                task.cancel()
        assert first is not None, "a floor has an address"
        return first

    async def _stop_at(self, peer: Peer, address: str, who: str) -> FloorStop:
        try:
            # Not by a connection that waits since the last question: it may be dead, and nobody has noticed.
            async with _client(peer, address, _STOP) as client:
                client.headers[PART] = re.sub(r"[^a-z0-9-]", "-", who.lower())[:32]
                async with asyncio.timeout(_STOPPED_S):
                    return await _ask(client, "POST", f"{HERE}/stop", FloorStop)
        except (_AskError, TimeoutError) as error:
            detail = (
                f"{str(error) or 'its answer does not end'}. Its robots may go on driving: press again, use that "
                "floor's own console, or stop them on the spot. Nothing is sent again by itself"
            )
            return FloorStop(id=peer.id, acknowledged=False, robots=[], detail=detail)
