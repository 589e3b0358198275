"""What Linux tells of the computer itself: temperatures, throttling, and the strength of its Wi-Fi signal.

Every function returns only what this computer has: a missing sensor is no value, and never 0.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

ROOT: Final = Path("/")
_THROTTLED: Final = "sys/devices/platform/soc/soc:firmware/get_throttled"
_CAUSES: Final = ("under_voltage", "frequency_capped", "throttled", "soft_temperature_limit")
"""Bits 0 to 3 of what the Raspberry Pi's firmware reports: what holds now. Source: its documentation of vcgencmd."""
_LEVEL_COLUMN: Final = 3


def temperatures(root: Path = ROOT) -> dict[str, float]:
    """Return the temperature (degrees Celsius) of each thermal zone, by its type."""
    found = {}
    for zone in sorted((root / "sys/class/thermal").glob("thermal_zone*")):
        kind, value = _text(zone / "type"), _number(_text(zone / "temp"), 10)
        if kind and value is not None:
            found[kind] = value / 1000.0
    return found


def throttling(root: Path = ROOT) -> dict[str, bool]:
    """Return, by cause, whether a Raspberry Pi is slowed down now; empty on other computers."""
    bits = _number(_text(root / _THROTTLED), 16)
    return {} if bits is None else {cause: bool(bits >> bit & 1) for bit, cause in enumerate(_CAUSES)}


def wifi_levels(root: Path = ROOT) -> dict[str, float]:
    """Return the signal level (dBm) of each wireless interface that is connected."""
    found = {}
    for line in _text(root / "proc/net/wireless").splitlines():
        name, colon, rest = line.partition(":")
        columns = rest.split()
        if colon and len(columns) > _LEVEL_COLUMN - 1:
            level = columns[_LEVEL_COLUMN - 1].rstrip(".")
            if level.lstrip("-").isdigit():
                found[name.strip()] = float(level)
    return found


def _text(file: Path) -> str:
    try:
        return file.read_text("utf-8", "replace").strip()
    except OSError:
        return ""


def _number(text: str, base: int) -> int | None:
    try:
        return int(text, base)
    except ValueError:
        return None
