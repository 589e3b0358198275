"""The whole system with the second base and the second lidar: it drives, and what must stop it does."""

from __future__ import annotations

import os
import signal
import time
from typing import TYPE_CHECKING

import pytest
from driver import Floor

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [pytest.mark.live, pytest.mark.timeout(120)]

EAST = (58.0, 28.4)
STOPPED_WITHIN_S = 0.3


async def test_a_diffdrive_base_with_an_ld19_drives_and_stops_when_its_guardian_dies(tmp_path: Path) -> None:
    async with Floor(tmp_path, base="diffdrive", lidar="ld19") as floor:
        await floor.drive_to(*EAST)
        await floor.goes_on()
        assert floor.off < 0.15
        guardian = floor.guardian
        assert guardian is not None
        killed = time.monotonic()
        os.kill(guardian, signal.SIGKILL)
        await floor.until(lambda: floor.guardian not in {None, guardian}, 20, "another guardian runs")
        lines = floor.log_lines(killed)
        first_rest = next(line.at for line in lines if line.stands)
        assert first_rest - killed < STOPPED_WITHIN_S
        await floor.drives()
        await floor.goes_on()
        assert floor.off < 0.15
        assert floor.truth.contacts == 0
