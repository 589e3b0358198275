"""The simulated sensor nodes: with the firmware's own code where it can be compiled, else with a model of it.

The core (`firmware/lib/node_core`) is the same code that runs on the board; only the edges differ: here the simulated
world moves the echo lines. It is built once per version of its sources, and stepped once in a millisecond, as the loop
of a board would at least; edges of the echo lines have their exact times.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, Protocol

import msgspec

from fog_contracts.messages import NodeCalibration, NodeReading
from fog_kernels.sonar import default_config
from fog_runtime import logs
from fognav_sim.node import SonarNode
from fognav_sim.sensors import SOUND_M_S

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.messages import NodeConfig
    from fog_contracts.site import NodeSite
    from fognav_sim.world import World

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


FIRMWARE: Final = b"host-1"
STEP_US: Final = 1000
BURST_US: Final = 450
"""From trigger to the rise of the echo line: eight periods of 40 kHz and the module's own delay (HC-SR04)."""
NO_ECHO_US: Final = 38_000
_RSSI_DBM: Final = -55
_TRIGGER: Final = 1
_PUBLISH: Final = 2
_CALIBRATED: Final = 3
_KEPT: Final = 4
_US: Final = 1_000_000


class FirmwareNode:
    """One sensor node of the site; the same interface as `SonarNode`, the model in Python."""

    def __init__(self, core: Core, node: NodeSite, boot: int, start: float) -> None:
        self.node = node
        self.config = default_config(node)
        limits = zip(self.config.range_limit_m, self.config.range_max_m, self.config.no_echo_is_clear, strict=True)
        sonars = [Sonar(round(1000 * limit), round(1000 * farthest), int(silent)) for limit, farthest, silent in limits]
        self._core = core
        self._node = core.new(
            (Sonar * len(sonars))(*sonars), len(sonars), boot, self.config.pause_ms, int(node.every_reading), FIRMWARE
        )
        core.rssi(self._node, _RSSI_DBM)
        self._start = start
        self._now = ctypes.c_uint64(0)
        self._now_by_reference = ctypes.byref(self._now)
        self._edges: list[tuple[int, int, int]] = []
        self._calibration: NodeCalibration | None = None

    def __del__(self) -> None:
        self._core.free(self._node)

    def configure(self, config: NodeConfig) -> bool:
        """Apply a configuration; return False if it is for another number of sonars, and ignore it."""
        text = msgspec.json.encode(config)
        if self._core.configure(self._node, text, len(text)) is not None:
            return False
        self.config = config
        return True

    def on_connected(self) -> None:
        """Publish as after a change: the connection has come back."""
        self._core.connected(self._node)

    def command(self, text: str) -> str | None:
        """Begin what a command asks for, as learning the limits anew; return None, or why not."""
        problem = self._core.command(self._node, text.encode(), len(text.encode()))
        return None if problem is None else str(problem.decode())

    def restore(self, calibration: NodeCalibration) -> bool:
        """Apply a calibration from before the node was switched off; return False if it is for other sonars."""
        text = msgspec.json.encode(calibration)
        return self._core.restore(self._node, text, len(text)) is None

    def take_calibration(self) -> NodeCalibration | None:
        """Return the calibration that has ended, or that counts, since the last call, if one has."""
        calibration, self._calibration = self._calibration, None
        return calibration

    def poll(self, world: World, now: float) -> list[NodeReading]:
        """Run the firmware up to `now` (s); return the readings that it published, oldest first."""
        until = round((now - self._start) * _US)
        core, node, clock = self._core, self._node, self._now
        if until - clock.value > _US:
            # The simulation paused: a node does not catch up on readings that it missed.
            clock.value = until
        readings: list[NodeReading] = []
        while clock.value <= until:
            while self._edges and self._edges[0][0] <= clock.value:
                at, sonar, high = self._edges.pop(0)
                core.edge(node, sonar, high, ctypes.c_uint32(at))
            end = min(until, self._edges[0][0] - 1) if self._edges else until
            event = core.run(node, self._now_by_reference, end, STEP_US)
            if event == _TRIGGER:
                self._trigger(world, clock.value - STEP_US)
            elif event == _PUBLISH:
                readings.append(msgspec.json.decode(core.message(node), type=NodeReading))
            elif event in (_CALIBRATED, _KEPT):
                self._calibration = msgspec.json.decode(core.message(node), type=NodeCalibration)
        return readings

    def _trigger(self, world: World, at_us: int) -> None:
        sonar = self._core.sonar(self._node)
        measured = world.sonar(self.node, sonar)
        flight_us = NO_ECHO_US if measured is None else round(2 * measured / SOUND_M_S * _US)
        rise = at_us + BURST_US
        self._edges = [(rise, sonar, 1), (rise + flight_us, sonar, 0)]


CACHE: Final = ".fognav/firmware"
"""Where a checkout keeps the compiled core."""

_log = logs.get("sim")


class SensorNode(Protocol):
    """What the simulator needs of a sensor node."""

    node: NodeSite

    def configure(self, config: NodeConfig) -> bool:
        """Apply a configuration; return False if it is for another number of sonars, and ignore it."""

    def on_connected(self) -> None:
        """Publish as after a change: the connection has come back."""

    def command(self, text: str) -> str | None:
        """Begin what a command asks for, as learning the limits anew; return None, or why not."""

    def take_calibration(self) -> NodeCalibration | None:
        """Return the calibration that has ended since the last call, if one has."""

    def poll(self, world: World, now: float) -> list[NodeReading]:
        """Run the node up to `now` (s); return the readings that it publishes, oldest first."""


def why_model() -> str | None:
    """Return why simulated nodes run a model, or None where they run the firmware, which is then compiled."""
    try:
        _firmware()
    except (FirmwareError, OSError) as error:
        return str(error)
    return None


def make_nodes(
    nodes: Sequence[NodeSite],
    boot: int,
    start: float,
    kind: Literal["auto", "firmware", "model"] = "auto",
    *,
    apart: float = 0.0,
) -> list[SensorNode]:
    """Return the site's nodes, switched on at `start` (s), `apart` (s) one after the other, in groups of eight.

    Raises `FirmwareError` if `firmware` is asked for and can't be built.
    """
    if kind != "model":
        try:
            core = Core(_firmware())
        except (FirmwareError, OSError) as error:
            if kind == "firmware":
                raise
            _log.info("nodes_run_a_model", reason=str(error))
        else:
            _log.info("nodes_run_the_firmware")
            return [FirmwareNode(core, node, boot + i, start + apart * (i % 8)) for i, node in enumerate(nodes)]
    return [SonarNode(node, boot + i, start + apart * (i % 8)) for i, node in enumerate(nodes)]


def _firmware() -> Path:
    return build_library(find_firmware().parent / CACHE)
