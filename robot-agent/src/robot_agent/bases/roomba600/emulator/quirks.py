"""Deviations of single Roombas from the specification, as their owners report them; all off by default."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

FLASH_TEXT: Final = b"Flash CRC successful: 0x0 (0x0)\r\n"


@dataclass(frozen=True, kw_only=True)
class Quirks:
    """What this robot does otherwise.

    mode_offset: added to the mode in the stream. mode_noise: every so many frames the stream's mode is 32 (0: never).
    text_period_s: it prints a text into the stream so often (0: never). damaged: every so many frames one has a wrong
    byte (0: never). bytes_wake: what it receives wakes it. stays_safe_on_dock: Safe mode holds on the dock, but the
    wheels do not move there. mode_change_s: each change of its mode takes so long, and what follows waits. baud: its
    rate. keeps_baud: it stays at its rate, whatever it is told.
    """

    mode_offset: int = 0
    mode_noise: int = 0
    text_period_s: float = 0.0
    damaged: int = 0
    bytes_wake: bool = False
    stays_safe_on_dock: bool = False
    mode_change_s: float = 0.0
    baud: int = 115200
    keeps_baud: bool = False


class LineNoise:
    """Applies the quirks of the stream to its frames."""

    def __init__(self, quirks: Quirks) -> None:
        self._quirks = quirks
        self._frames = 0
        self._text_at = quirks.text_period_s

    def mode(self, mode: int) -> int:
        """Return the mode that the next frame reports."""
        if self._quirks.mode_noise and self._frames % self._quirks.mode_noise == 0:
            return 32
        return mode + self._quirks.mode_offset

    def frame(self, frame: bytes, now: float) -> bytes:
        """Return what is sent for a frame: itself, damaged, or with a text before it."""
        self._frames += 1
        if self._quirks.damaged and self._frames % self._quirks.damaged == 0:
            place = self._frames % len(frame)
            frame = frame[:place] + bytes((frame[place] ^ 0x10,)) + frame[place + 1 :]
        if self._quirks.text_period_s and now >= self._text_at:
            self._text_at = now + self._quirks.text_period_s
            # The robot prints without regard to the frame that it is sending.
            return frame[:7] + FLASH_TEXT + frame[7:]
        return frame
