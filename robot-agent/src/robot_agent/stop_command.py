"""How to stop a base: plain bytes, for a process with almost no imports (the watchdog)."""

from typing import NamedTuple


class StopCommand(NamedTuple):
    """What the watchdog needs to stop a base; registered under its name in the entry points `fognav.base_stops`.

    baud: of the base's serial line (8N1).
    stop: stops the wheels in any state of the base, also after a command that was truncated anywhere.
    hold: repeated while no guardian runs; changes nothing on a base at rest.
    """

    baud: int
    stop: bytes
    hold: bytes
