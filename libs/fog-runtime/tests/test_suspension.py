from __future__ import annotations

import pytest

from fog_runtime.machine.suspension import SuspensionMonitor


def test_suspension_is_the_growth_of_boot_time_over_monotonic_time():
    clocks = {"monotonic": 100.0, "boot": 130.0}
    monitor = SuspensionMonitor(lambda: clocks["monotonic"], lambda: clocks["boot"])
    clocks["monotonic"] += 5.0
    clocks["boot"] += 5.001
    assert monitor.suspended() == 0.0
    clocks["monotonic"] += 0.05
    clocks["boot"] += 60.05
    assert monitor.suspended() == pytest.approx(60.0)
    assert monitor.suspended() == 0.0


def test_running_computer_is_not_suspended():
    monitor = SuspensionMonitor()
    assert monitor.suspended() == 0.0
