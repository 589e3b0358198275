"""What is known of the device on a serial line before its driver is loaded: how it sounds, and how to stop a base.

Two adapters may be swapped, and what is harmless to one device may move another: whoever opens a port listens first,
and leaves alone what sounds like another device. Only the watchdog writes before: the base's stop command, which no
lidar obeys, because a base that moves can't wait. Imports only the standard library, because guardian and watchdog use
it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

LISTEN_S: Final = 0.2
"""Every device that sends by itself has sent several frames within this time."""
HEARD_MAX: Final = 4096
"""Newest bytes that are examined."""


class SerialSettings(NamedTuple):
    """A serial line, always 8N1. `dtr`: the state of the DTR line in which the device runs; None: either."""

    baud: int
    dtr: bool | None = None


def _never(_data: bytes) -> bool:
    return False


class Signature(NamedTuple):
    """What a device sends.

    recognizes: whether bytes from a line, beginning anywhere, can only come from such a device.
    question: bytes that make a silent one answer, and that no other device obeys; empty: it is never silent.
    answered: whether the bytes that followed the question are the answer.
    """

    recognizes: Callable[[bytes], bool]
    question: bytes = b""
    answered: Callable[[bytes], bool] = _never


def foreign(own: str, heard: bytes, signatures: Mapping[str, Signature]) -> str | None:
    """Return the name of another device than `own` that the bytes come from; None if they may be its own."""
    newest = heard[-HEARD_MAX:]
    if own in signatures and signatures[own].recognizes(newest):
        return None
    return next((name for name, other in signatures.items() if name != own and other.recognizes(newest)), None)


def wrong_device(path: str, own: str, other: str) -> str:
    """Return the sentence for a port on which another device speaks."""
    return (
        f"{path}: a {other} speaks on this port, not a {own}; nothing but stop commands was written to it. Swap the "
        "ports in the robot file, or the plugs"
    )


class LineCheck:
    """What a port sounds like, from its first bytes on. Pure: pass it bytes."""

    def __init__(self, path: str, own: str, signatures: Mapping[str, Signature]) -> None:
        self._path = path
        self._own = own
        self._signatures = signatures
        self._heard = b""

    @property
    def silent(self) -> bool:
        """Whether nothing was heard."""
        return not self._heard

    @property
    def settled(self) -> bool:
        """Whether the device was recognized, the expected one or another."""
        own = self._signatures.get(self._own)
        return (own is not None and own.recognizes(self._heard)) or self.problem is not None

    @property
    def problem(self) -> str | None:
        """The sentence for another device on this port; None if what was heard may be the expected one."""
        other = foreign(self._own, self._heard, self._signatures)
        return None if other is None else wrong_device(self._path, self._own, other)

    @property
    def questions(self) -> list[tuple[str, Signature]]:
        """Other devices that may be on a silent line, by name: ask each, and pass what follows to `answer`."""
        return [(name, other) for name, other in self._signatures.items() if name != self._own and other.question]

    def feed(self, data: bytes) -> None:
        """Store bytes from the line."""
        self._heard = (self._heard + data)[-HEARD_MAX:]

    def answer(self, name: str, data: bytes) -> str | None:
        """Return the sentence for a device that answered its question; None if it did not."""
        return wrong_device(self._path, self._own, name) if self._signatures[name].answered(data) else None


class StopCommand(NamedTuple):
    """What the watchdog needs to stop a base; registered under its name in the entry points `fognav.base_stops`.

    baud: of the base's serial line (8N1).
    stop: stops the wheels in any state of the base, also after a command that was truncated anywhere.
    hold: repeated while no guardian runs; changes nothing on a base at rest.
    charge: lets a base on its charger charge again, if `stop` ends that; empty: it does not.
    charging: whether bytes from the line say that the base is on its charger.
    """

    baud: int
    stop: bytes
    hold: bytes
    charge: bytes = b""
    charging: Callable[[bytes], bool] = _never
