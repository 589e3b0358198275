"""A recording as its terminal shows it, and when it ends."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from typing import TYPE_CHECKING, Final

import numpy as np
from rich.console import Group
from rich.live import Live
from rich.text import Text

from fog_contracts.costs import FREE, LETHAL
from fognav.output import console

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from fog_mapping.live import LiveMap
    from fognav.robot_page.recording import Recording

_COLOURS: Final = {LETHAL: "grey93", FREE: "grey35"}
_ROBOT: Final = "bright_green"
_DRAWN_S: Final = 1.0


@contextlib.contextmanager
def until_told(seconds: float | None) -> Iterator[Callable[[], bool]]:
    """Yield whether to end: after so many seconds, or when the operator or the system says so."""
    told = threading.Event()
    until = None if seconds is None else time.monotonic() + seconds
    before = {number: signal.signal(number, lambda *_: told.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: told.is_set() or (until is not None and time.monotonic() >= until)
    finally:
        for number, action in before.items():
            signal.signal(number, action)


@contextlib.contextmanager
def shown(recording: Recording, begun: float) -> Iterator[Callable[[], None]]:
    """Yield what shows the recording: in a terminal a growing map, elsewhere what is wrong, as it changes."""
    told = ""
    if not console.is_terminal:

        def tell() -> None:
            nonlocal told
            if recording.advice != told:
                told = recording.advice
                console.print(told or "all is well again", markup=False)

        yield tell
        return
    drawn, picture = 0.0, Text()
    with Live(console=console, auto_refresh=False, transient=True) as live:

        def draw() -> None:
            nonlocal drawn, picture
            now = time.monotonic()
            if now - drawn >= _DRAWN_S and recording.map is not None:
                drawn = now
                picture = map_text(recording.map, console.width, console.height - 4)
            state = recording.view.state
            line = (
                f"{now - begun:.0f} s, {recording.scans} scans, {recording.megabytes:.1f} MB, {state.get('mode', '')}"
            )
            live.update(
                Group(picture, Text(line), Text(recording.advice, style="bold yellow"), Text("Ctrl-C ends")),
                refresh=True,
            )

        yield draw


def map_text(live: LiveMap, width: int, height: int) -> Text:
    """Draw a map in so many characters, each two squares high, and the robot in it."""
    shown = live.map()
    if shown is None or width < 2 or height < 2:
        return Text()
    rows, columns = np.nonzero(shown.cells == LETHAL)
    x, y = (live.pose[:2] - (shown.geometry.origin_x, shown.geometry.origin_y)) / shown.geometry.resolution
    rows, columns = np.append(rows, int(y)), np.append(columns, int(x))
    bottom, left = int(rows.min()), int(columns.min())
    part = shown.cells[bottom : int(rows.max()) + 1, left : int(columns.max()) + 1]
    step = max(1, -(-part.shape[1] // width), -(-part.shape[0] // (2 * height)))
    part = np.pad(part, ((0, -part.shape[0] % (2 * step)), (0, -part.shape[1] % step)), constant_values=1)
    blocks = part.reshape(part.shape[0] // step, step, part.shape[1] // step, step).swapaxes(1, 2)
    squares = np.full(blocks.shape[:2], "", dtype=object)
    squares[(blocks == FREE).any(axis=(2, 3))] = _COLOURS[FREE]
    squares[(blocks == LETHAL).any(axis=(2, 3))] = _COLOURS[LETHAL]
    squares[(int(y) - bottom) // step, (int(x) - left) // step] = _ROBOT
    text = Text()
    for row in range(squares.shape[0] - 1, 0, -2):
        for upper, lower in zip(squares[row], squares[row - 1], strict=True):
            style = f"{upper or 'default'} on {lower or 'default'}"
            text.append("▀" if upper else (" " if not lower else "▀"), style=style if upper or lower else "")
        text.append("\n")
    return text
