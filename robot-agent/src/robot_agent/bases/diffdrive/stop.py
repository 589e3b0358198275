"""How to stop a diffdrive board, for the watchdog: plain bytes, nothing imported that the watchdog has not."""

from typing import Final

from robot_agent.stop_command import StopCommand

# The line feed ends a line that was cut off. Zero speeds, then motors off: what somebody else may have sent meanwhile
# can't turn a wheel any more. Twice, because a byte may get lost.
_ZERO_SPEED: Final = b"\n$V,0,0*01BA\n"
STOP: Final = StopCommand(baud=115_200, stop=(_ZERO_SPEED + b"$X*3A0D\n") * 2, hold=_ZERO_SPEED)
