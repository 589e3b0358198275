"""How to stop a base: plain bytes, for a process that imports next to nothing (the watchdog)."""

from typing import NamedTuple


class StopCommand(NamedTuple):
    """All that the watchdog knows of a base; registered under its name in the entry points `fognav.base_stops`.

    baud: of the base's serial line (8N1).
    stop: stops the wheels from any state of the base, also after a command that was cut off anywhere.
    hold: repeated while nobody drives; costs little and changes nothing on a base that stands.
    """

    baud: int
    stop: bytes
    hold: bytes
