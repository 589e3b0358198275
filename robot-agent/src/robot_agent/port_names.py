"""Which names of serial ports are accepted: those that stay with a device, whatever was plugged in before it.

`/dev/ttyUSB0` is whichever adapter was found first. After a re-plug it may be the other one, and a command means
something else there: the stop command of an RPLidar is a button press for a Roomba. Imports only the standard library,
because the watchdog uses it.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

_NUMBERED: Final = re.compile(r"tty(?:USB|ACM)\d+")
_BY_ID: Final = "dev/serial/by-id"
_BY_PATH: Final = "dev/serial/by-path"


class PortNameError(ValueError):
    """The name of a port is refused; the message has the names to use instead."""


def check_port_name(path: str, root: Path = Path("/")) -> None:
    """Accept a name that stays with one device: of `/dev/serial`, or of a port without a number by plug order.

    Raises:
        PortNameError: for a number of `/dev/ttyUSB` or `/dev/ttyACM` (also behind a link of one's own), and for a name
            by id that two adapters share, since it belongs to either.

    """
    device = (root / path.lstrip("/")).resolve()
    if not _NUMBERED.fullmatch(device.name):
        return
    folder = (root / path.lstrip("/")).parent
    if folder not in {root / _BY_ID, root / _BY_PATH}:
        raise PortNameError(
            f"{path} is no name to rely on: the number of {device.name} depends on the order of plugging in. "
            f"{_remedy(_links(device, _BY_ID, root) + _links(device, _BY_PATH, root))}"
        )
    identity = _identity(device.name, root)
    if folder == root / _BY_ID and identity is not None:
        twins = [
            other for other in _numbered_devices(root) if other != device and _identity(other.name, root) == identity
        ]
        if twins:
            raise PortNameError(
                f"{path} may be either of {device.name} and {twins[0].name}: both adapters have the serial number "
                f"{identity[2] or '(none)'}. {_remedy(_links(device, _BY_PATH, root))}, which names the socket it is in"
            )


def _remedy(names: list[str]) -> str:
    if names:
        return f"Use {' or '.join(names)}"
    return "Plug the device in and use its name in /dev/serial/by-id or /dev/serial/by-path"


def _links(device: Path, folder: str, root: Path) -> list[str]:
    """Return the names in a folder of links that lead to a device."""
    if not (root / folder).is_dir():
        return []
    return [f"/{folder}/{link.name}" for link in sorted((root / folder).iterdir()) if link.resolve() == device]


def _numbered_devices(root: Path) -> list[Path]:
    return [device for device in sorted((root / "dev").glob("tty*")) if _NUMBERED.fullmatch(device.name)]


def _identity(name: str, root: Path) -> tuple[str, str, str] | None:
    """Return the vendor, product and serial number of the USB adapter behind a terminal; None if it is none."""
    place = (root / "sys/class/tty" / name / "device").resolve()
    for folder in (place, *place.parents):
        if (folder / "idVendor").is_file():
            vendor, product, serial = (_read(folder / file) for file in ("idVendor", "idProduct", "serial"))
            return vendor, product, serial
    return None


def _read(file: Path) -> str:
    try:
        return file.read_text("ascii").strip()
    except OSError:
        return ""
