"""The firmware's core, compiled for this computer: builds it once per version of its sources, and loads it.

The core (`firmware/lib/node_core`) is the same code that runs on the board; only the edges differ: here a simulated
world moves the echo lines.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
from pathlib import Path
from typing import Final

SOURCES: Final = ("lib/node_core/src", "lib/node_edge/src", "host", "include")
FLAGS: Final = ("-std=c++17", "-O2", "-Wall", "-Wextra", "-Werror", "-fno-exceptions", "-fno-rtti", "-fPIC", "-shared")
_BUILD_TIMEOUT_S: Final = 120.0


class FirmwareError(RuntimeError):
    """The firmware's core can't be built or loaded here; the message says why and what to do."""


class Sonar(ctypes.Structure):
    """Calibration of a sonar, as the core's C interface takes it."""

    _fields_ = (("limit_mm", ctypes.c_int32), ("max_mm", ctypes.c_int32), ("no_echo_is_clear", ctypes.c_int32))


def find_firmware() -> Path:
    """Return the folder `firmware` of this checkout, or of FOGNAV_FIRMWARE_DIR."""
    named = os.environ.get("FOGNAV_FIRMWARE_DIR")
    candidates = [Path(named)] if named else [parent / "firmware" for parent in Path(__file__).parents]
    for folder in candidates:
        if (folder / SOURCES[0]).is_dir():
            return folder
    raise FirmwareError("there are no sources of the firmware here: set FOGNAV_FIRMWARE_DIR to a checkout's `firmware`")


def find_compiler() -> str:
    """Return the path of a C++ compiler."""
    for name in (os.environ.get("CXX", ""), "g++", "clang++"):
        if name and (found := shutil.which(name)):
            return found
    raise FirmwareError("there is no C++ compiler: install g++ (Debian: apt-get install g++), or name one in CXX")


def build_library(cache: Path, flags: tuple[str, ...] = FLAGS) -> Path:
    """Return the core as a shared library, from the folder `cache` or compiled into it.

    Raises `FirmwareError` without sources or compiler, and with the compiler's words where it refuses the sources.
    """
    firmware = find_firmware()
    files = sorted(
        file for folder in SOURCES for file in (firmware / folder).iterdir() if file.suffix in {".cpp", ".hpp", ".h"}
    )
    digest = hashlib.sha256(" ".join(flags).encode())
    for file in files:
        digest.update(file.name.encode() + b"\0" + file.read_bytes())
    library = cache / f"node_core-{digest.hexdigest()[:16]}.so"
    if library.exists():
        return library
    cache.mkdir(parents=True, exist_ok=True)
    # Under a name of its own first: another process may build the same at the same time.
    unfinished = library.with_suffix(f".{os.getpid()}")
    sources = [str(file) for file in files if file.suffix == ".cpp"]
    includes = [f"-I{firmware / folder}" for folder in SOURCES]
    command = [find_compiler(), *flags, *includes, *sources, "-o", str(unfinished)]
    try:
        done = subprocess.run(  # noqa: S603  # the compiler that this machine or its user names, on our own sources
            command, check=False, capture_output=True, text=True, timeout=_BUILD_TIMEOUT_S
        )
    except subprocess.TimeoutExpired as error:
        raise FirmwareError(f"the compiler did not finish the firmware's core in {_BUILD_TIMEOUT_S:.0f} s") from error
    if done.returncode != 0:
        raise FirmwareError(f"the firmware's core does not compile:\n{done.stderr.strip()}")
    unfinished.replace(library)
    return library


class Core(ctypes.CDLL):
    """The loaded library, with its functions' types."""

    def __init__(self, library: Path) -> None:
        super().__init__(str(library))
        node = ctypes.c_void_p
        signatures: dict[str, tuple[object, tuple[object, ...]]] = {
            "new": (
                node,
                (
                    ctypes.POINTER(Sonar),
                    ctypes.c_int,
                    ctypes.c_uint32,
                    ctypes.c_int,
                    ctypes.c_int,
                    ctypes.c_char_p,
                ),
            ),
            "free": (None, (node,)),
            "run": (ctypes.c_int, (node, ctypes.POINTER(ctypes.c_uint64), ctypes.c_uint64, ctypes.c_uint32)),
            "sonar": (ctypes.c_int, (node,)),
            "message": (ctypes.c_char_p, (node,)),
            "edge": (None, (node, ctypes.c_int, ctypes.c_int, ctypes.c_uint32)),
            "configure": (ctypes.c_char_p, (node, ctypes.c_char_p, ctypes.c_uint32)),
            "connected": (None, (node,)),
            "temperature": (None, (node, ctypes.c_int)),
            "measure_temperature": (None, (node, ctypes.c_int)),
            "rssi": (None, (node, ctypes.c_int)),
            "command": (ctypes.c_char_p, (node, ctypes.c_char_p, ctypes.c_uint32)),
            "restore": (ctypes.c_char_p, (node, ctypes.c_char_p, ctypes.c_uint32)),
            "calibrating": (ctypes.c_int, (node,)),
            "calibration": (ctypes.c_int, (node, ctypes.c_int)),
            "describe_calibration": (ctypes.c_char_p, (ctypes.c_int,)),
            "limit_mm": (ctypes.c_int32, (node, ctypes.c_int)),
            "max_mm": (ctypes.c_int32, (node, ctypes.c_int)),
            "no_echo_is_clear": (ctypes.c_int, (node, ctypes.c_int)),
            "no_echo_us": (ctypes.c_uint32, (node, ctypes.c_int)),
        }
        for name, (result, arguments) in signatures.items():
            function = self[f"fognav_node_{name}"]
            function.restype = result  # type: ignore[assignment]  # ctypes takes None for void
            function.argtypes = arguments  # type: ignore[assignment]  # types of ctypes, each
            setattr(self, name, function)
