"""How a diffdrive board sounds on a serial line, its status lines, and how to stop it: plain bytes.

No imports but the watchdog's own.
"""

from __future__ import annotations

import re
from binascii import crc_hqx
from typing import Final

from robot_agent.device_signature import Signature, StopCommand

_STATUS: Final = re.compile(rb"\$(S,[ -#%-)+-~]*)\*([0-9A-F]{4})\n")


def _recognizes(data: bytes) -> bool:
    return any(crc_hqx(body, 0xFFFF) == int(crc, 16) for body, crc in _STATUS.findall(data))


SIGNATURE: Final = Signature(recognizes=_recognizes)


# The line feed ends a truncated line. Zero speeds, then motors off, so that a later command can't turn a wheel. Twice,
# because a byte may get lost.
_ZERO_SPEED: Final = b"\n$V,0,0*01BA\n"
STOP: Final = StopCommand(baud=115_200, stop=(_ZERO_SPEED + b"$X*3A0D\n") * 2, hold=_ZERO_SPEED)
