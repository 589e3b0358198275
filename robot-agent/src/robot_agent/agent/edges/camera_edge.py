"""The camera edge: takes pictures on a thread of its own, looks for markers in them, and tells the loop what it sees.

A robot drives without it as well: what goes wrong here is logged, and tried again. Pictures come from a V4L2 device
(linuxpy), or from a named pipe into which another program writes grey PGM: those of cameras that V4L2 does not serve,
as a Raspberry Pi's own, or rendered ones. The detector is that of AprilTag's authors (pyapriltags).
"""

from __future__ import annotations

import asyncio
import stat
import threading
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from prometheus_client import Counter

from fog_runtime import logs
from robot_agent.agent.edges.exporter import name_thread
from robot_agent.localization.marker_pose import sighting_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from typing import BinaryIO

    from numpy.typing import NDArray
    from pyapriltags import Detector

    from fog_contracts.robot import CameraSettings
    from fog_contracts.site import MarkerSite
    from fog_runtime.clock import Clock
    from robot_agent.localization.markers import Sighting

    Picture = NDArray[np.uint8]

PICTURES = Counter("fognav_camera_pictures_total", "Pictures of the camera in which markers were looked for")
SIGHTINGS = Counter("fognav_marker_sightings_total", "Markers of the site that the camera has seen", ["marker"])

_REOPEN_S: Final = 1.0
_MARGIN_MIN: Final = 30.0
_BITS_WRONG_MAX: Final = 1
"""A pattern that is less clear, or of which more bits are wrong, may be none: what looks alike is everywhere."""
_HEADER_MAX: Final = 16
_LUMINANCE: Final = {"GREY": 1, "YUYV": 2}
"""Pixel formats of V4L2 that are asked for, with the bytes of a pixel: the first is its brightness."""

_log = logs.get("camera")


class CameraError(Exception):
    """The camera gives no pictures; the message says why, and what to do."""


class CameraEdge:
    """Takes pictures while it runs; each sighting is passed to `on_sighting` on the loop's thread."""

    def __init__(
        self,
        settings: CameraSettings,
        markers: Sequence[MarkerSite],
        clock: Clock,
        on_sighting: Callable[[Sighting, float], object],
    ) -> None:
        self._settings = settings
        self._sizes: Mapping[int, float] = {marker.id: marker.size for marker in markers}
        self._clock = clock
        self._on_sighting = on_sighting
        self._ends = threading.Event()
        self._last_logged = ""

    async def run(self) -> None:
        """Look for markers until cancelled."""
        loop = asyncio.get_running_loop()

        def tell(sighting: Sighting) -> None:
            with suppress(RuntimeError):  # the loop has ended meanwhile, and with it whom this would interest
                loop.call_soon_threadsafe(self._on_sighting, sighting, self._clock.now())

        # A daemon: nothing interrupts the read of a pipe into which nobody writes.
        threading.Thread(target=self._watch, args=(tell,), name="camera", daemon=True).start()
        try:
            await asyncio.Event().wait()
        finally:
            self._ends.set()

    def _watch(self, tell: Callable[[Sighting], object]) -> None:
        import pyapriltags  # noqa: PLC0415  # an optional dependency, of robots with a camera

        name_thread("camera")
        detector = pyapriltags.Detector(families="tag36h11")
        while not self._ends.is_set():
            try:
                for sighting in self.sightings(detector):
                    tell(sighting)
            except Exception as error:  # noqa: BLE001  # whatever one picture does, the next ones count
                if str(error) != self._last_logged:
                    _log.warning("camera_problem", source=self._settings.source, reason=str(error) or repr(error))
                self._last_logged = str(error)
            self._ends.wait(self._clock.real(_REOPEN_S))

    def sightings(self, detector: Detector) -> Iterator[Sighting]:
        """Yield the sightings in each picture that is due, until the source ends; raises `CameraError` or `OSError`."""
        settings = self._settings
        due = self._clock.now()
        for picture in pictures(settings):
            now = self._clock.now()
            if self._ends.is_set():
                return
            if now < due:
                continue
            due = max(due + 1.0 / settings.rate_hz, now)
            PICTURES.inc()
            self._last_logged = ""
            for found in detector.detect(picture):
                size = self._sizes.get(found.tag_id)
                if size is None or found.hamming > _BITS_WRONG_MAX or found.decision_margin < _MARGIN_MIN:
                    continue
                sighting = sighting_of(found.tag_id, found.corners, size, settings, now - settings.latency_s)
                if sighting is not None:
                    SIGHTINGS.labels(found.tag_id).inc()
                    yield sighting


def pictures(settings: CameraSettings) -> Iterator[Picture]:
    """Yield grey pictures (height, width) as they come, until the source ends; raises `CameraError` or `OSError`."""
    path = Path(settings.source)
    if not path.exists():
        raise CameraError(f"{path} does not exist: plug the camera in, or correct `source` of [camera]")
    yield from _from_device(settings) if stat.S_ISCHR(path.stat().st_mode) else _from_pipe(path, settings)


def _from_pipe(path: Path, settings: CameraSettings) -> Iterator[Picture]:
    with path.open("rb") as pipe:
        while (header := _read_header(pipe)) is not None:
            width, height = header
            _check_size(width, height, settings)
            data = pipe.read(width * height)
            if len(data) < width * height:
                return
            yield np.frombuffer(data, np.uint8).reshape(height, width)


def _read_header(pipe: BinaryIO) -> tuple[int, int] | None:
    """Return width and height of the next PGM; None at the end. Raises `CameraError` for anything else."""
    words: list[bytes] = []
    word = b""
    while len(words) < 4:
        byte = pipe.read(1)
        if not byte and not words and not word:
            return None
        if byte.isspace() and word:
            words.append(word)
            word = b""
        elif not byte or len(word) > _HEADER_MAX:
            break
        else:
            word += byte
    if len(words) < 4 or words[0] != b"P5" or not words[1].isdigit() or not words[2].isdigit() or words[3] != b"255":
        raise CameraError("what comes is no grey PGM of 8 bits (P5 WIDTH HEIGHT 255): let the program write that")
    return int(words[1]), int(words[2])


def _from_device(settings: CameraSettings) -> Iterator[Picture]:
    from linuxpy.video.device import Device, V4L2Error, VideoCapture  # noqa: PLC0415  # optional, as above

    try:
        with Device(settings.source) as device:
            capture = VideoCapture(device)
            offered = {form.pixel_format.name for form in device.info.formats}
            usable = [name for name in _LUMINANCE if name in offered]
            if not usable:
                raise CameraError(
                    f"it offers {', '.join(sorted(offered))}, none of {', '.join(_LUMINANCE)}: use another camera, or "
                    "let a program write grey PGM into a named pipe"
                )
            capture.set_format(settings.width_px, settings.height_px, usable[0])
            form, step = capture.get_format(), _LUMINANCE[usable[0]]
            _check_size(form.width, form.height, settings)
            with capture:
                for frame in capture:
                    rows = np.frombuffer(frame.data, np.uint8)[: form.size].reshape(form.height, -1)
                    yield np.ascontiguousarray(rows[:, : step * form.width : step])
    except (V4L2Error, OSError) as error:
        raise CameraError(
            f"{settings.source} gives no pictures: {error}. Plug it in, end what else uses it, or name another device"
        ) from error


def _check_size(width: int, height: int, settings: CameraSettings) -> None:
    if (width, height) != (settings.width_px, settings.height_px):
        raise CameraError(
            f"its pictures have {width} x {height} pixels, and [camera] says {settings.width_px} x {settings.height_px}"
            ": correct width_px and height_px, and the focal length with them"
        )
