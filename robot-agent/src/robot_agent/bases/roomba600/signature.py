"""How a Roomba sounds on a serial line, by stream frames and the text that it prints, and how to stop it: plain bytes.

A silent one is asked for its OI mode. No imports but the watchdog's own.
"""

from __future__ import annotations

import re
from typing import Final

from robot_agent.device_signature import Signature, StopCommand

_TEXT: Final = re.compile(rb"bl-start|bootloader id|STR730|Flash CRC|bat: +min|Slept for")
_FRAME_MAX: Final = 172
_FRAMES: Final = 2
_MODES: Final = 4
"""Packet 35 is 0 to 3, on some robots one more."""


def _recognizes(data: bytes) -> bool:
    return _TEXT.search(data) is not None or any(
        _frames_at(data, begin) for begin in range(len(data)) if data[begin] == 19
    )


def _frames_at(data: bytes, begin: int) -> bool:
    """Whether whole stream frames follow one another from here, each with its checksum."""
    for _ in range(_FRAMES):
        if begin + 2 > len(data) or data[begin] != 19:
            return False
        end = begin + data[begin + 1] + 3
        if not 4 < end - begin <= _FRAME_MAX or end > len(data) or sum(data[begin:end]) & 0xFF:
            return False
        begin = end
    return True


def _answered(data: bytes) -> bool:
    return len(data) == 1 and data[0] <= _MODES


# Start, Sensors 35: without Start the base would ignore the question. It ends in Passive mode, with its wheels at rest.
SIGNATURE: Final = Signature(recognizes=_recognizes, question=bytes((128, 142, 35)), answered=_answered)


# Both streams of the guardian, up to packet 34, the charger's contacts.
_CONTACTS: Final = re.compile(
    rb"\x13[\x40\x16]\x07.\x09.\x0a.\x0b.\x0c."
    rb"(?:\x0d.\x0e.\x15.\x16..\x17..\x18.\x19..\x1a..|\x0e.)\x22(.)\x23",
    re.DOTALL,
)


def _charging(data: bytes) -> bool:
    """Whether a charger has contact by the newest whole frame of the guardian's stream."""
    for found in reversed([*_CONTACTS.finditer(data)]):
        frame = data[found.start() : found.start() + data[found.start() + 1] + 3]
        if len(frame) == frame[1] + 3 and not sum(frame) & 0xFF:
            return bool(found[1][0] & 3)
    return False


_ZERO_SPEED: Final = bytes((0, 0, 0, 0, 145, 0, 0, 0, 0))
_STOP: Final = bytes((128, 131)) + _ZERO_SPEED

# Start, Safe, Drive Direct 0 0. Sent twice: the guardian may have died in the middle of a command, and the base would
# take its missing bytes from what precedes the second copy: 2 + 2 * 255 at most, if a byte was wrong (docs/safety.md).
# It ends in Safe mode, in which some do not charge on their dock: Start leads into Passive mode, at rest.
STOP: Final = StopCommand(
    baud=115200, stop=_STOP + bytes(512) + _STOP, hold=_ZERO_SPEED, charge=bytes((128,) * 5), charging=_charging
)
