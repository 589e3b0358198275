"""How to stop a Roomba 600, for the watchdog: plain bytes, with no imports but the watchdog's own."""

from typing import Final

from robot_agent.stop_command import StopCommand

_ZERO_SPEED: Final = bytes((145, 0, 0, 0, 0))

# Start, Safe, Drive Direct 0 0. Sent twice: the guardian may have died in the middle of a command, and the base
# would take its missing bytes from the first copy.
STOP: Final = StopCommand(baud=115200, stop=(bytes((128, 131)) + _ZERO_SPEED) * 2, hold=_ZERO_SPEED)
