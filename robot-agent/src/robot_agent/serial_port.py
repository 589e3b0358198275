"""The edge: a serial device as a file descriptor, 8N1, raw, never blocking; and which names of ports are accepted.

Plain termios, because the protocols need nothing more and because an inherited descriptor (the guardian's) must work as
a port too. Imports only the standard library, because the watchdog uses it.

Accepted are names that stay with a device, whatever was plugged in before it. `/dev/ttyUSB0` is whichever adapter was
found first. After a re-plug it may be the other one, and a command means something else there: the stop command of an
RPLidar is a button press for a Roomba.
"""

from __future__ import annotations

import errno
import fcntl
import os
import re
import select
import struct
import sys
import termios
from contextlib import suppress
from pathlib import Path
from typing import Final, Literal, Self

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


_READ_BYTES: Final = 65536
_WRITE_WAIT_S: Final = 0.1
_LINES: Final = {"dtr": termios.TIOCM_DTR, "rts": termios.TIOCM_RTS}


_LOW_LATENCY: Final = 1 << 13
"""ASYNC_LOW_LATENCY of the kernel's `serial_struct`, whose flags are its fifth integer."""
_SERIAL_STRUCT_BYTES: Final = 128
_FLAGS_OFFSET: Final = 16


class PortLost(Exception):  # noqa: N818  # named after the event
    """The serial device is missing, in use, or no longer responds."""

    def __init__(self, path: str, reason: str) -> None:
        """Name the port, the reason and the remedy."""
        super().__init__(
            f"{path}: {reason}; check that the device is plugged in and powered, that this user may use it (group "
            "dialout) and that no other process has it open"
        )
        self.path = path
        self.reason = reason


class Port:
    """An open serial port. Close it yourself or use it in a `with` statement; nothing happens on garbage collection."""

    def __init__(self, fd: int, path: str, *, owned: bool) -> None:
        """Wrap a descriptor that is already set up; normally use `open_port` or `from_fd`."""
        self._fd = fd
        self._owned = owned
        self.path = path

    @classmethod
    def from_fd(cls, fd: int, path: str | None = None) -> Self:
        """Use a descriptor that another process opened and set up; `close` leaves it open.

        Raises:
            PortLost: if the descriptor is not open.

        """
        name = path or f"inherited descriptor {fd}"
        try:
            os.set_blocking(fd, False)
        except OSError as error:
            raise PortLost(name, _reason(error)) from error
        return cls(fd, name, owned=False)

    def fileno(self) -> int:
        """Descriptor for select, asyncio or a child process; -1 once closed."""
        return self._fd

    @property
    def device(self) -> str:
        """The terminal behind the path, such as /dev/ttyUSB0 behind a symbolic link.

        Raises:
            PortLost: when the device is lost.

        """
        try:
            return os.ttyname(self._fd)
        except OSError as error:
            raise PortLost(self.path, _reason(error)) from error

    def read_available(self) -> bytes:
        """Return the bytes that have arrived, without waiting; b"" if none have.

        Raises:
            PortLost: when the device is lost.

        """
        try:
            data = os.read(self._fd, _READ_BYTES)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise PortLost(self.path, _reason(error)) from error
        if not data:
            raise PortLost(self.path, "the device hung up")
        return data

    def write(self, data: bytes) -> None:
        """Send all bytes, so that no command is ever truncated; wait for a full buffer, 0.1 s at most.

        Raises:
            PortLost: when the device is lost or accepts nothing.

        """
        rest = memoryview(data)
        while rest:
            try:
                rest = rest[os.write(self._fd, rest) :]
            except BlockingIOError:
                if not select.select((), (self._fd,), (), _WRITE_WAIT_S)[1]:
                    raise PortLost(self.path, f"the device has taken no byte for {_WRITE_WAIT_S} s") from None
            except OSError as error:
                raise PortLost(self.path, _reason(error)) from error

    def set_line(self, name: Literal["dtr", "rts"], *, on: bool) -> bool:
        """Set or clear the DTR or the RTS line. False where there is none, as on a pty.

        Raises:
            PortLost: when the device is lost.

        """
        request = termios.TIOCMBIS if on else termios.TIOCMBIC
        try:
            fcntl.ioctl(self._fd, request, struct.pack("i", _LINES[name]))
        except OSError as error:
            if error.errno in {errno.ENOTTY, errno.EINVAL}:
                return False
            raise PortLost(self.path, _reason(error)) from error
        return True

    def set_baud(self, baud: int) -> None:
        """Change the rate for all who use this terminal, once everything is sent that was written.

        Raises:
            PortLost: when the device is lost or does not support the rate.

        """
        speed = _speed(self.path, baud)
        try:
            attributes = termios.tcgetattr(self._fd)
            attributes[4] = attributes[5] = speed
            termios.tcsetattr(self._fd, termios.TCSADRAIN, attributes)
        except termios.error as error:
            raise PortLost(self.path, str(error.args[-1])) from error

    def discard_input(self) -> None:
        """Discard bytes that have arrived and were not read. Raises PortLost when the device is lost."""
        try:
            termios.tcflush(self._fd, termios.TCIFLUSH)
        except termios.error as error:
            raise PortLost(self.path, str(error.args[-1])) from error

    def close(self) -> None:
        """Close the port; harmless when done twice."""
        fd, self._fd = self._fd, -1
        if fd >= 0 and self._owned:
            os.close(fd)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def open_port(path: str, baud: int) -> Port:
    """Open a serial device (or pty) for this process alone: 8N1 at `baud`, raw, non-blocking, without added latency.

    Raises:
        PortNameError: for a name that does not stay with one device.
        PortLost: if it is missing, forbidden, in use by another Port, no terminal, or does not support the rate.

    """
    check_port_name(path)
    try:
        fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise PortLost(path, _reason(error)) from error
    try:
        _set_up(fd, path, baud)
    except BaseException:
        os.close(fd)
        raise
    return Port(fd, path, owned=True)


def _set_up(fd: int, path: str, baud: int) -> None:
    speed = _speed(path, baud)
    try:
        # Advisory, and shared with processes that inherit the descriptor.
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise PortLost(path, "another process has locked it") from error
    except OSError as error:
        raise PortLost(path, f"it can't be locked for this process alone ({_reason(error)})") from error
    try:
        if not _is_pty(os.ttyname(fd)):
            # Refuses later openers that know no lock. A pty keeps it for ever: its other end holds it open.
            fcntl.ioctl(fd, termios.TIOCEXCL)
            _set_low_latency(fd)
    except OSError as error:
        raise PortLost(path, f"not a serial device ({_reason(error)})") from error
    try:
        control = termios.tcgetattr(fd)[6]
        control[termios.VMIN] = 1
        control[termios.VTIME] = 0
        mode = termios.CS8 | termios.CREAD | termios.CLOCAL
        termios.tcsetattr(fd, termios.TCSAFLUSH, [0, 0, mode, 0, speed, speed, control])
    except termios.error as error:
        raise PortLost(path, f"not a serial device ({error.args[-1]})") from error


def _speed(path: str, baud: int) -> int:
    speed: int | None = getattr(termios, f"B{baud}", None)
    if speed is None:
        raise PortLost(path, f"this system has no rate of {baud} baud")
    return speed


def _set_low_latency(fd: int) -> None:
    """Let an FTDI adapter pass on bytes after 1 ms and not after 16; most others have no such timer, and refuse."""
    values = bytearray(_SERIAL_STRUCT_BYTES)
    with suppress(OSError):
        fcntl.ioctl(fd, termios.TIOCGSERIAL, values)
        flags = int.from_bytes(values[_FLAGS_OFFSET : _FLAGS_OFFSET + 4], sys.byteorder) | _LOW_LATENCY
        values[_FLAGS_OFFSET : _FLAGS_OFFSET + 4] = flags.to_bytes(4, sys.byteorder)
        fcntl.ioctl(fd, termios.TIOCSSERIAL, values)


def _is_pty(device: str) -> bool:
    return device.startswith("/dev/pts/")


def refuse_speed(speed: float, device: str) -> str | None:
    """Return why this device must not be used on a clock of this speed; None when it may.

    All limits are in seconds of the clock. On a simulated device, a pty, the clock may be faster or slower; on a real
    one a slow clock would let the wheels turn, and old scans count, for longer than the limits allow.
    """
    if speed == 1.0 or _is_pty(device):
        return None
    return f"FOGNAV_SPEED is {speed:g}, but {device} is no simulated device: unset it, a real robot needs real time"


def _reason(error: OSError) -> str:
    return error.strerror or str(error)
