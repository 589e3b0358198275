"""How to stop a Roomba 600, for the watchdog: plain bytes, with no imports but the watchdog's own."""

from typing import Final

from robot_agent.stop_command import StopCommand

_ZERO_SPEED: Final = bytes((0, 0, 0, 0, 145, 0, 0, 0, 0))
_STOP: Final = bytes((128, 131)) + _ZERO_SPEED

# Start, Safe, Drive Direct 0 0. Sent twice: the guardian may have died in the middle of a command, and the base would
# take its missing bytes from what precedes the second copy: 2 + 2 * 255 at most, if a byte was wrong (docs/safety.md).
STOP: Final = StopCommand(baud=115200, stop=_STOP + bytes(512) + _STOP, hold=_ZERO_SPEED)
