"""Which mode the Open Interface is in, by what a robot's sensor stream says of it (packet 35).

Some robots of the 600 series report every mode one too high in the stream (Passive 2, Safe 3), so the offset is learned
whenever the robot is woken: Start brings it into Passive mode, and what it reports then is Passive. Others report a
number that is no mode for some frames.
"""

from __future__ import annotations

from typing import Final

from robot_agent.bases.roomba600.open_interface import Mode

SETTLE_S: Final = 0.1
"""After Start: frames of before may still arrive, and the robot needs some 20 ms to change its mode."""
SAME_FRAMES: Final = 3
"""The offset is learned from so many equal frames."""
NOISE_S: Final = 0.1
"""A number that is no mode is ignored for so long."""
_MODES: Final = {mode.value: mode for mode in Mode}


class ModeMonitor:
    """Follows the mode through noise and offset; `None` while the offset is not known yet."""

    def __init__(self) -> None:
        self.mode: Mode | int | None = None
        self._offset: int | None = None
        self._started_at: float | None = None
        self._reported = -1
        self._repeats = 0
        self._noise_since: float | None = None

    def restart(self) -> None:
        """Learn the offset again, from now on: Start was sent."""
        self.mode = self._offset = self._started_at = self._noise_since = None
        self._repeats = 0

    @property
    def offset(self) -> int | None:
        """By how much the robot reports its mode too high; None while it is not known."""
        return self._offset

    def on_report(self, value: int, now: float) -> None:
        """Handle the mode that a frame reports."""
        if self._offset is None:
            self._learn(value, now)
        else:
            self._follow(value - self._offset, now)

    def _learn(self, value: int, now: float) -> None:
        if self._started_at is None:
            self._started_at = now
        if now - self._started_at < SETTLE_S:
            return
        self._repeats = self._repeats + 1 if value == self._reported else 1
        self._reported = value
        if self._repeats >= SAME_FRAMES and value in {Mode.PASSIVE, Mode.PASSIVE + 1}:
            self._offset = value - Mode.PASSIVE
            self.mode = Mode.PASSIVE

    def _follow(self, value: int, now: float) -> None:
        if (mode := _MODES.get(value)) is not None:
            self.mode, self._noise_since = mode, None
        elif self._noise_since is None:
            self._noise_since = now
        elif now - self._noise_since > NOISE_S:
            self.mode = value
