"""How an LD19 sounds on a serial line: it sends packets from power-on. Plain bytes, no numpy."""

from __future__ import annotations

from typing import Final

from robot_agent.device_signature import Signature

_HEADER: Final = b"\x54\x2c"
_PACKET: Final = 47
_PACKETS: Final = 2


def _recognizes(data: bytes) -> bool:
    begin = data.find(_HEADER)
    while begin >= 0:
        packets = (data[begin + number * _PACKET :][:_PACKET] for number in range(_PACKETS))
        if all(len(packet) == _PACKET and packet[:2] == _HEADER and not _crc(packet) for packet in packets):
            return True
        begin = data.find(_HEADER, begin + 1)
    return False


def _crc(data: bytes) -> int:
    """CRC-8, polynomial 0x4D; 0 over a packet with its own."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x4D if crc & 0x80 else crc << 1) & 0xFF
    return crc


SIGNATURE: Final = Signature(recognizes=_recognizes)
