"""The whole system with the second base and the second lidar: it drives, and stops when its guardian dies."""

from __future__ import annotations

import os
import signal
import time
from typing import TYPE_CHECKING

import pytest
from driver import LiveSystem

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [pytest.mark.live, pytest.mark.timeout(120)]

EAST = (58.0, 28.4)
STOPPED_WITHIN_S = 0.3


async def test_robot_with_diffdrive_and_ld19_drives_and_stops_when_its_guardian_dies(tmp_path: Path) -> None:
    async with LiveSystem(tmp_path, base="diffdrive", lidar="ld19") as system:
        await system.drive_to(*EAST)
        await system.wait_progress()
        assert system.localization_error < 0.15
        guardian = system.guardian
        assert guardian is not None
        killed = time.monotonic()
        os.kill(guardian, signal.SIGKILL)
        await system.until(lambda: system.guardian not in {None, guardian}, 20, "a new guardian runs")
        lines = system.log_lines(killed)
        first_stop = next(line.at for line in lines if line.stopped)
        assert first_stop - killed < STOPPED_WITHIN_S
        await system.wait_driving()
        await system.wait_progress()
        assert system.localization_error < 0.15
        assert system.truth.contacts == 0
