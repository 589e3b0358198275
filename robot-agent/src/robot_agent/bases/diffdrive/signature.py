"""How a diffdrive board sounds on a serial line: its status lines. No imports but the guardian's own."""

from __future__ import annotations

import re
from binascii import crc_hqx
from typing import Final

from robot_agent.device_signature import Signature

_STATUS: Final = re.compile(rb"\$(S,[ -#%-)+-~]*)\*([0-9A-F]{4})\n")


def _recognizes(data: bytes) -> bool:
    return any(crc_hqx(body, 0xFFFF) == int(crc, 16) for body, crc in _STATUS.findall(data))


SIGNATURE: Final = Signature(recognizes=_recognizes)
