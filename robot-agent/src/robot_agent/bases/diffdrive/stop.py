"""How to stop a diffdrive board, for the watchdog: plain bytes, with no imports but the watchdog's own."""

from typing import Final

from robot_agent.stop_command import StopCommand

# The line feed ends a truncated line. Zero speeds, then motors off, so that a later command can't turn a wheel. Twice,
# because a byte may get lost.
_ZERO_SPEED: Final = b"\n$V,0,0*01BA\n"
STOP: Final = StopCommand(baud=115_200, stop=(_ZERO_SPEED + b"$X*3A0D\n") * 2, hold=_ZERO_SPEED)
