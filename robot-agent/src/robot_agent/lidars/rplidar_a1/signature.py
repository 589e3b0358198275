"""How an RPLidar sounds on a serial line: descriptors, boot text, a running scan. Plain bytes, no numpy."""

from __future__ import annotations

import re
from typing import Final

from robot_agent.device_signature import Signature

_TEXT: Final = re.compile(rb"RP ?LIDAR System")
_DESCRIPTOR: Final = re.compile(
    rb"\xa5\x5a(?:\x05\x00\x00\x40\x81|\x54\x00\x00\x40\x82|\x14\x00\x00\x00\x04|\x03\x00\x00\x00\x06)"
)
_NODE: Final = 5
_NODES: Final = 24
"""So many nodes in a row have their check bits by chance once in 4 ** 24 places."""
_CAPSULE: Final = 84


def _recognizes(data: bytes) -> bool:
    return (
        _TEXT.search(data) is not None
        or _DESCRIPTOR.search(data) is not None
        or any(_nodes_at(data, begin) for begin in range(_NODE))
        or any(_capsules_at(data, begin) for begin in range(min(_CAPSULE, len(data))))
    )


def _nodes_at(data: bytes, begin: int) -> bool:
    """Whether nodes follow one another from one of the places that lie whole nodes after `begin`."""
    run = 0
    for place in range(begin, len(data) - 1, _NODE):
        first, second = data[place], data[place + 1]
        run = run + 1 if (first ^ first >> 1) & second & 1 else 0
        if run >= _NODES:
            return True
    return False


def _capsules_at(data: bytes, begin: int) -> bool:
    """Whether a whole express capsule with its checksum begins here."""
    capsule = data[begin : begin + _CAPSULE]
    if len(capsule) < _CAPSULE or capsule[0] >> 4 != 0xA or capsule[1] >> 4 != 0x5:
        return False
    checksum = 0
    for byte in capsule[2:]:
        checksum ^= byte
    return checksum == (capsule[0] & 0xF) | (capsule[1] & 0xF) << 4


# A silent one is not asked: whoever asks it in its own protocol presses the buttons of a Roomba.
SIGNATURE: Final = Signature(recognizes=_recognizes)
