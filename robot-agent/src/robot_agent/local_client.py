"""The tools' end of the agent's local socket: what the robot measures, live, and driving by hand."""

from __future__ import annotations

import socket
import time
from typing import TYPE_CHECKING, Any, Final, Self

import msgspec

from robot_agent.agent.hand_driving import HandBack, HandReply, ResetFault, Steer, TakeOver
from robot_agent.agent.local_link import PACKET_LIMIT, decode, encode_request

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from robot_agent.agent.hand_driving import HandRequest

REPLY_S: Final = 2.0
"""An agent that has not answered after this long is gone, or hangs."""


class LocalRobotError(Exception):
    """There is no agent at the socket, or its link broke; the message names it and the remedy."""


class LocalRobot:
    """A link to the agent on this computer; a context manager. Blocking: use it on a thread of its own."""

    def __init__(self, path: Path) -> None:
        """Connect; raises `LocalRobotError`."""
        self.path = path
        self._link = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._waiting: list[Any] = []
        try:
            self._link.connect(str(path))
        except OSError as error:
            self._link.close()
            raise LocalRobotError(f"{path}: {_remedy(error)}") from error

    def entries(self, timeout: float) -> Iterator[Any]:
        """Yield entries (`agent.recording.input_log`) and `Missed`, until none has come for `timeout` s.

        The first is `Started`, with the robot's configuration. Raises `LocalRobotError` when the link breaks.
        """
        while (what := self._waiting.pop(0) if self._waiting else self._receive(timeout)) is not None:
            if isinstance(what, HandReply):
                raise LocalRobotError(f"{self.path}: {what.reason}")
            yield what

    def take_over(self) -> HandReply:
        """Begin to drive by hand, and return whether the robot agrees; raises `LocalRobotError`."""
        return self._ask(TakeOver())

    def hand_back(self) -> HandReply:
        """End driving by hand; raises `LocalRobotError`."""
        return self._ask(HandBack())

    def reset(self) -> HandReply:
        """Reset a latched fault; raises `LocalRobotError`."""
        return self._ask(ResetFault())

    def steer(self, v: float, w: float) -> None:
        """Drive at v (m/s) and turn at w (rad/s) for the next 0.15 s; call it 20 times a second.

        Never blocks. Raises `LocalRobotError`.
        """
        self.send(Steer(v=v, w=w))

    def send(self, request: HandRequest) -> None:
        """Say something without waiting for its reply, which `poll` returns; raises `LocalRobotError`."""
        self._link.settimeout(0.0)
        try:
            self._link.send(encode_request(request))
        except BlockingIOError:
            return  # what does not fit into the socket is not worth waiting for: the agent does not read
        except OSError as error:
            raise LocalRobotError(f"{self.path}: {_remedy(error)}") from error

    def poll(self) -> list[Any]:
        """Return all that has come, replies too, without waiting; raises `LocalRobotError` when the link breaks."""
        come, self._waiting = self._waiting, []
        while (what := self._receive(0.0)) is not None:
            come.append(what)
        return come

    def fileno(self) -> int:
        """Return the socket's number, for `select`."""
        return self._link.fileno()

    def close(self) -> None:
        """Close the link; a robot that was driven by hand stops."""
        self._link.close()

    def _ask(self, request: HandRequest) -> HandReply:
        self.send(request)
        until = time.monotonic() + REPLY_S
        while (left := until - time.monotonic()) > 0.0:
            what = self._receive(left)
            if isinstance(what, HandReply):
                return what
            if what is not None:
                self._waiting.append(what)
        raise LocalRobotError(f"{self.path}: the agent does not answer within {REPLY_S:g} s: restart it")

    def _receive(self, timeout: float) -> Any:  # noqa: ANN401  # what a packet holds
        """Return what the next packet of a kind that this version knows holds; None if none comes in time (s)."""
        until = time.monotonic() + timeout
        while True:
            self._link.settimeout(max(0.0, until - time.monotonic()))
            try:
                packet = self._link.recv(PACKET_LIMIT)
            except (TimeoutError, BlockingIOError):
                return None
            except OSError as error:
                raise LocalRobotError(f"{self.path}: {_remedy(error)}") from error
            if not packet:
                raise LocalRobotError(f"{self.path}: the agent has closed the link: see its log")
            try:
                what = decode(packet)
            except msgspec.DecodeError as error:
                reason = f"the agent is of another version ({error}): install the same"
                raise LocalRobotError(f"{self.path}: {reason}") from error
            if what is not None:
                return what

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _remedy(error: OSError) -> str:
    match error:
        case FileNotFoundError():
            return "no robot's agent runs here: start it, or name its socket"
        case ConnectionRefusedError():
            return "the agent that made it is gone: start it"
        case PermissionError():
            return "you may not open it: run this as the robot's user, or join its group (usermod -aG fognav YOU)"
        case _:
            return f"{error.strerror or error}: is the agent still running?"
