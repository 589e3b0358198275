"""Who drives the measured robot by hand: the real `fognav teleop`, by a held key of a terminal or by a held page."""

from __future__ import annotations

import asyncio
import contextlib
import os
import pty
import re
import sys
from typing import TYPE_CHECKING, Any, Final

import msgspec
from websockets.asyncio.client import connect

if TYPE_CHECKING:
    import signal
    from pathlib import Path

    from websockets.asyncio.client import ClientConnection

SPEED_M_S: Final = 0.15
_REPEAT_S: Final = 0.033
"""How often a terminal repeats a key that is held."""
_SAY_S: Final = 0.05
"""How often a page says what its pad is held for."""
_TAKE_OVER: Final = '{"type": "take_over"}'
_ASK_S: Final = 0.2
_START_S: Final = 30.0


class Hand:
    """One `fognav teleop` at a robot's socket, which drives straight ahead from `hold` on."""

    def __init__(self, socket: Path) -> None:
        self._command = (sys.executable, "-m", "fognav", "teleop", "--socket", str(socket))
        self._process: asyncio.subprocess.Process | None = None
        self._terminal = -1
        self._page: ClientConnection | None = None
        self._holding: asyncio.Future[Any] | None = None
        self._tick = 0
        """The newest time that the page was told: it says its speed with it, so that an old one is not obeyed."""

    async def hold_key(self) -> None:
        """Hold the key that drives ahead, in a terminal."""
        self._terminal, theirs = pty.openpty()
        command = (*self._command, "--speed", str(SPEED_M_S))
        self._process = await asyncio.create_subprocess_exec(
            *command, stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True
        )
        os.close(theirs)
        os.set_blocking(self._terminal, False)
        self._holding = asyncio.create_task(self._repeat_key())

    async def hold_page(self) -> None:
        """Hold the pad of its page; raises `TimeoutError`."""
        pipe = asyncio.subprocess.PIPE
        self._process = await asyncio.create_subprocess_exec(*self._command, "--page", stderr=pipe)
        assert self._process.stderr is not None
        async with asyncio.timeout(_START_S):
            line = (await self._process.stderr.readline()).decode()
        address = re.sub(r"^.*http://([^/]+)/(\S*)\s*$", r"ws://\1/live\2", line)
        self._page = await connect(address, max_queue=None)
        async with asyncio.timeout(_START_S):
            while not await self._agrees(self._page):
                pass
        self._holding = asyncio.gather(self._hear(self._page), self._repeat_word(self._page))

    async def _agrees(self, page: ClientConnection) -> bool:
        """Take the robot over by the page; return whether it agrees, which it does once it is healthy."""
        await page.send(_TAKE_OVER)
        while not (replies := (await self._told(page)).get("replies")):
            pass
        accepted = bool(replies[-1]["accepted"])
        await asyncio.sleep(0.0 if accepted else _ASK_S)
        return accepted

    async def _repeat_key(self) -> None:
        while True:
            with contextlib.suppress(BlockingIOError):
                os.read(self._terminal, 65536)  # what it prints is not looked at, and must not fill the terminal
            os.write(self._terminal, b"i")
            await asyncio.sleep(_REPEAT_S)

    async def _told(self, page: ClientConnection) -> dict[str, Any]:
        told: dict[str, Any] = msgspec.json.decode(await page.recv())
        self._tick = told.get("tick", self._tick)
        return told

    async def _hear(self, page: ClientConnection) -> None:
        while True:
            await self._told(page)

    async def _repeat_word(self, page: ClientConnection) -> None:
        while True:
            steer = {"type": "steer", "v": SPEED_M_S, "w": 0.0, "tick": self._tick}
            await page.send(msgspec.json.encode(steer).decode())
            await asyncio.sleep(_SAY_S)

    def let_go(self) -> None:
        """Press no key any more; of a page: say nothing more, as one whose network is gone."""
        if self._holding is not None:
            self._holding.cancel()

    def close_page(self) -> None:
        """Break the page's connection off."""
        self.let_go()
        assert self._page is not None
        self._page.transport.abort()

    def signal(self, number: signal.Signals) -> None:
        """Send the command a signal."""
        assert self._process is not None
        self._process.send_signal(number)

    async def end(self) -> None:
        """End whatever is left of it."""
        self.let_go()
        if self._holding is not None:
            await asyncio.gather(self._holding, return_exceptions=True)
        if self._page is not None:
            self._page.transport.abort()
        if self._process is not None:
            with contextlib.suppress(ProcessLookupError):
                self._process.kill()
            await self._process.wait()
        if self._terminal >= 0:
            os.close(self._terminal)
