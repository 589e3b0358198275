"""The agent's end of the guardian's socket: feedback in, wheel commands out, connected again whenever it breaks.

The stream of wheel commands reads it, just before each command: the agent is not woken for each feedback, which says
itself when it was sent.
"""

from __future__ import annotations

import asyncio
import math
import select
import socket
import struct
import time
from typing import TYPE_CHECKING, Final

import msgspec

from fog_runtime import logs
from robot_agent.guardian.link import PACKET_LIMIT, BaseFeedback, WheelCommand, decode_reply, encode

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from fog_runtime.clock import Clock

RETRY_S: Final = 0.2
FEEDBACK_TIMEOUT_S: Final = 1.0
"""Without feedback for this long the guardian receives nothing from its base."""
RESET_VALID_S: Final = 1.0
"""An operator's reset that could not be passed on within this time expires: it must not clear a later fault."""
_SENT_WITHIN_S: Final = 30.0
"""The first feedback of a link that is older than this, by the time that it says, says that of another clock."""
_UNREAD_S: Final = 5.0
"""A link unread for longer (of the system's clock) may be full, and the guardian keeps the newest to itself."""
_PACKETS_AT_ONCE: Final = 64
"""A flood of packets must not block the stream."""

_log = logs.get("base")


class GuardianClient:
    """One connection to the guardian at a time. `run` may connect while the agent is still loaded, before `begin`.

    What the guardian sends meanwhile waits in the socket, with its times: the first scan finds odometry of its whole
    turn.
    """

    def __init__(self, path: Path, clock: Clock) -> None:
        self._path = path
        self._clock = clock
        self._on_feedback: Callable[[BaseFeedback, float], object] = _ignored
        self._on_lost: Callable[[float, str], object] = _ignored
        self._linked_at = math.inf
        """When this link was made (s of `time.monotonic`)."""
        self._socket: socket.socket | None = None
        self._readable = select.poll()
        self._end: asyncio.Future[str] | None = None
        """Set when the link is over, to the reason."""
        self._reset_until = -math.inf
        self._feedback_at = -math.inf
        self.pid: int | None = None
        """The guardian's process id; None without a link, or where it runs in a container of its own."""
        self._last_logged = ""
        self._accepted = False
        """Whether the guardian has sent feedback on this link."""
        self._shares_clock = True
        """Whether the times that the guardian tells on this link are those of this clock, as far as that is known."""
        self._sent_at = -math.inf
        """The time of the last feedback that was passed on."""
        self._limited = logs.RateLimited(_log)

    def begin(
        self, on_feedback: Callable[[BaseFeedback, float], object], on_lost: Callable[[float, str], object]
    ) -> None:
        """Let `receive` pass feedback on, with the time at which it was sent, and `run` that the link is lost.

        Where the guardian tells no time, or one of another clock, it is the time of arrival. A link that has waited
        for long, as while kernels were compiled, is made anew.
        """
        self._on_feedback, self._on_lost = on_feedback, on_lost
        self._feedback_at = self._clock.now()
        if self._end is not None and not self._end.done() and time.monotonic() - self._linked_at > _UNREAD_S:
            self._end.set_result("nobody has read the link for long; it is made anew")

    def send(self, command: WheelCommand) -> bool:
        """Send a command without waiting; False when there is no guardian, or it does not read.

        Called at a steady rate, it also detects a guardian that sends no feedback.
        """
        now = self._clock.now()
        if command.reset:
            self._reset_until = now + RESET_VALID_S
        if self._socket is None:
            return False
        if now - self._feedback_at > FEEDBACK_TIMEOUT_S:
            self._lost("the guardian receives nothing from the base; check its cable and power")
        reset = now <= self._reset_until
        try:
            self._socket.send(encode(msgspec.structs.replace(command, reset=reset)))
        except (BlockingIOError, ConnectionError):
            # A full socket: the guardian hangs, and its watchdog kills it. A broken one: `run` connects again.
            return False
        self._reset_until = -math.inf
        return True

    async def run(self) -> None:
        """Stay connected until cancelled."""
        while True:
            try:
                with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as link:
                    link.settimeout(0)
                    await asyncio.get_running_loop().sock_connect(link, str(self._path))
                    self._socket, self._feedback_at = link, self._clock.now()
                    self._linked_at = time.monotonic()
                    self.pid = _peer(link)
                    reason = await self._read(link)
            except OSError as error:
                reason = f"{self._path}: {error.strerror or error}; does the watchdog run?"
            finally:
                self._socket = self.pid = None
            self._lost(reason)
            await self._clock.sleep(RETRY_S)

    async def _read(self, link: socket.socket) -> str:
        """Let `receive` pass feedback on until the link breaks; return the reason."""
        self._accepted = False
        self._end = asyncio.get_running_loop().create_future()
        self._readable.register(link, select.POLLIN)
        try:
            return await self._end
        finally:
            self._readable.unregister(link)
            self._end = None

    def receive(self) -> None:
        """Pass on what the guardian has sent; call it on the loop's thread, before each `send`."""
        link, end = self._socket, self._end
        if link is None or end is None or end.done():
            return
        try:
            for _ in range(_PACKETS_AT_ONCE):
                # Asked first: an exception for each empty socket would cost more.
                if not self._readable.poll(0):
                    return
                if (reason := self._on_packet(link.recv(PACKET_LIMIT + 1))) is not None:
                    end.set_result(reason)
                    return
        except Exception as error:  # noqa: BLE001  # `run`, which awaits `end`, raises it
            end.set_exception(error)

    def _on_packet(self, data: bytes) -> str | None:
        """Pass a packet of the guardian on; return why the link ends with it, None if it does not."""
        if not data:
            return "the guardian closed the link"
        now = self._clock.now()
        try:
            feedback = decode_reply(data)
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            self._limited.warning("feedback_refused", "feedback_refused", now, reason=str(error))
            return None
        if isinstance(feedback, str):
            return f"the guardian refuses this agent: {feedback}"
        if not self._accepted:
            self._accepted = True
            self._shares_clock = feedback.at is None or now - feedback.at <= _SENT_WITHIN_S
            _log.info("guardian_connected", socket=str(self._path))
        self._feedback_at, self._last_logged = now, ""
        self._on_feedback(feedback, self._time_of(feedback, now))
        return None

    def _time_of(self, feedback: BaseFeedback, now: float) -> float:
        """Return when feedback was sent, never before the one that came before it; `now` if another clock says when.

        After a delay of this process many wait, of which each but the last is old: their times are as good as ever.
        """
        if feedback.at is not None and feedback.at > now:
            self._shares_clock = False
        sent_at = now if feedback.at is None or not self._shares_clock else feedback.at
        self._sent_at = max(sent_at, self._sent_at)
        return self._sent_at

    def _lost(self, reason: str) -> None:
        if reason != self._last_logged:
            self._last_logged = reason
            _log.warning("base_lost", reason=reason)
        self._on_lost(self._clock.now(), reason)


def _ignored(_what: object, _at: object) -> None:
    """For what comes before `begin`."""


def _peer(link: socket.socket) -> int | None:
    pid, _, _ = struct.unpack("3i", link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i")))
    return pid or None
