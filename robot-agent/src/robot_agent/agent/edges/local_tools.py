"""The agent's socket for tools on its own computer: entries as they happen down, an operator's words up (ADR 64).

Nobody who reads slowly delays the agent: what does not fit into a reader's socket is missing for that reader, who is
told how much. Nothing is encoded while nobody is connected.
"""

from __future__ import annotations

import asyncio
import socket
from collections import deque
from typing import TYPE_CHECKING, Final

import msgspec

from fog_contracts.messages import RefusalCode
from fog_runtime import logs
from robot_agent.agent.hand_driving import HandBack, HandReply, Steer, TakeOver, Watch
from robot_agent.agent.local_link import REQUEST_LIMIT, Missed, decode_request, encode

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from fog_runtime.clock import Clock
    from robot_agent.agent.core import AgentCore
    from robot_agent.agent.hand_driving import HandRequest
    from robot_agent.agent.local_link import Equipment
    from robot_agent.agent.recording.input_log import Entry, Started

CLIENTS_MAX: Final = 8
_WATCH_S: Final = 1.0
_MODE: Final = 0o660
_REPLIES_MAX: Final = 8

_log = logs.get("local_tools")


class _Client:
    def __init__(self, link: socket.socket) -> None:
        self.link = link
        self.missed = 0
        self._replies: deque[bytes] = deque(maxlen=_REPLIES_MAX)

    def send(self, packet: bytes) -> None:
        """Send an entry if there is room for it; raises `ConnectionError`."""
        try:
            while self._replies:
                self.link.send(self._replies[0])
                self._replies.popleft()
            if self.missed:
                self.link.send(encode(Missed(count=self.missed)))
                self.missed = 0
            self.link.send(packet)
        except BlockingIOError:
            self.missed += 1

    def reply(self, packet: bytes) -> None:
        """Send a reply, or before the next entry for which there is room; raises `ConnectionError`."""
        try:
            self.link.send(packet)
        except BlockingIOError:
            self._replies.append(packet)


class LocalTools:
    """Serves the socket until cancelled; all of it on the loop's thread."""

    def __init__(
        self, path: Path, started: Started, equipment: Callable[[], Equipment], core: AgentCore, clock: Clock
    ) -> None:
        """Prepare; each client gets `started` first, then `equipment`, and the core what one says."""
        self._path = path
        self._started = started
        self._equipment = equipment
        self._core = core
        self._clock = clock
        self._clients: dict[int, _Client] = {}
        self._driver: _Client | None = None

    @property
    def watched(self) -> bool:
        """Whether somebody is connected: only then `publish` has to be called."""
        return bool(self._clients)

    def publish(self, entry: Entry | Equipment) -> None:
        """Send an entry to whoever is connected; never blocks."""
        if self._clients:
            packet = encode(entry)
            for client in list(self._clients.values()):
                self._send(client, packet)

    async def run(self) -> None:
        """Serve clients; a robot drives without them, so that a socket which can't be made is only logged."""
        try:
            listener = _listen(self._path)
        except OSError as error:
            _log.error("local_tools_not_served", socket=str(self._path), reason=error.strerror or str(error))
            return
        loop = asyncio.get_running_loop()
        loop.add_reader(listener, self._accept, listener)
        try:
            while True:
                if self._clients:
                    self._on_request(Watch())
                    self.publish(self._equipment())
                await asyncio.sleep(_WATCH_S)
        finally:
            loop.remove_reader(listener)
            listener.close()
            for client in list(self._clients.values()):
                self._drop(client)
            self._path.unlink(missing_ok=True)

    def _accept(self, listener: socket.socket) -> None:
        try:
            link, _ = listener.accept()
        except OSError:
            return  # it has gone already
        link.setblocking(False)  # noqa: FBT003  # the system's own name
        client = _Client(link)
        if len(self._clients) >= CLIENTS_MAX:
            reason = f"{CLIENTS_MAX} tools are connected to this robot's agent already: end one"
            client.send(encode(HandReply(accepted=False, reason=reason)))
            link.close()
            return
        self._clients[link.fileno()] = client
        asyncio.get_running_loop().add_reader(link, self._read, client)
        self._on_request(Watch())
        self._send(client, encode(self._started))
        self._send(client, encode(self._equipment()))

    def _read(self, client: _Client) -> None:
        try:
            packet = client.link.recv(REQUEST_LIMIT)
            request = decode_request(packet) if packet else None
        except BlockingIOError:
            return
        except (OSError, msgspec.DecodeError, UnicodeDecodeError) as error:
            _log.warning("local_request_refused", reason=str(error))
            request = None
        if request is None:
            self._drop(client)
            return
        reply = self._answer(client, request)
        if reply is not None:
            if not (isinstance(request, TakeOver) and not reply.accepted):  # tools ask until the robot agrees
                _log.info("by_hand", request=type(request).__name__, accepted=reply.accepted, reason=reply.reason)
            self._send(client, encode(reply), is_reply=True)

    def _on_request(self, request: HandRequest) -> HandReply | None:
        return self._core.on_hand(request, self._clock.now())

    def _answer(self, client: _Client, request: HandRequest) -> HandReply | None:
        match request:
            case Watch():
                return None
            case TakeOver() if self._core.by_hand and client is not self._driver:
                code, reason = RefusalCode.HAND_TAKEN, "somebody else drives the robot by hand: let them end it first"
                return HandReply(accepted=False, reason=reason, code=code)
            case Steer() | HandBack() if client is not self._driver:
                if isinstance(request, Steer):
                    return None  # of one whose time is over, until it hears of it
                reason = "it is not driven by hand from here"
                return HandReply(accepted=False, reason=reason, code=RefusalCode.NOT_BY_HAND)
        reply = self._on_request(request)
        if isinstance(request, TakeOver) and reply is not None:
            self._driver = client if reply.accepted else None
        elif isinstance(request, HandBack):
            self._driver = None
        return reply

    def _send(self, client: _Client, packet: bytes, *, is_reply: bool = False) -> None:
        try:
            (client.reply if is_reply else client.send)(packet)
        except OSError:
            self._drop(client)

    def _drop(self, client: _Client) -> None:
        """Forget a client; if it drove the robot by hand, the robot stops."""
        if client.link.fileno() < 0:
            return  # gone before all of a new client's first entries were sent
        self._clients.pop(client.link.fileno(), None)
        asyncio.get_running_loop().remove_reader(client.link)
        client.link.close()
        if client is self._driver:
            self._driver = None
            self._on_request(HandBack(lost=True))


def _listen(path: Path) -> socket.socket:
    """Return the listening socket; raises `OSError`. One that an agent left when it was killed is replaced."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as probe:
        try:
            probe.connect(str(path))
        except FileNotFoundError:
            pass
        except ConnectionRefusedError:
            path.unlink(missing_ok=True)
        else:
            raise OSError(0, "another agent serves it")
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        listener.bind(str(path))
        path.chmod(_MODE)
        listener.listen(CLIENTS_MAX)
        listener.setblocking(False)  # noqa: FBT003  # the system's own name
    except OSError:
        listener.close()
        raise
    return listener
