"""What a base measures of battery and light bumper reaches the robot's state, its metrics and, if low, its reasons."""

from __future__ import annotations

import pytest

from fog_contracts.messages import Power
from fog_runtime.configuration.robot_file import default_robot
from robot_agent.agent.power import power_warnings
from robot_agent.bases.diffdrive.emulator import DiffDriveEmulator
from robot_agent.bases.roomba600.driver import MEASURE_S
from robot_agent.bases.roomba600.emulator import Battery, RoombaEmulator
from robot_agent.guardian.core import GuardianCore
from robot_agent.hardware import BaseStatus
from robot_agent.registry import make_base


def readings(base, name, seconds, *, change=None):
    """The feedback of a base in emulated time; `change` is called before each step with the time."""
    core, now, feedback = GuardianCore(make_base(default_robot(base=name))), 10.0, []
    for step in range(round(seconds / 0.01)):
        now += 0.01
        if change is not None:
            change(step * 0.01)
        base.tick(now, 0.01)
        outputs = [core.on_bytes(base.outgoing(now), now), core.tick(now)]
        for output in outputs:
            feedback += output.feedback
            base.receive(output.data, now)
    return feedback


def test_battery_charger_and_light_bumper_of_a_roomba_are_read():
    base = RoombaEmulator(battery=Battery(charge_mah=650.0, capacity_mah=2600.0))
    base.world.light_signals = (0, 10, 250, 3000, 4095, 7)
    base.world.temperature_c = 31
    status = readings(base, "roomba600", 1.0)[-1].status
    assert status.battery == pytest.approx(0.25, abs=0.001)
    assert status.proximity == (0, 10, 250, 3000, 4095, 7)
    power = status.power
    assert (power.charge_ah, power.capacity_ah, power.temperature_c) == (0.65, 2.6, 31.0)
    assert power.voltage_v == pytest.approx(base.battery.voltage_mv / 1000, abs=0.01)
    assert power.current_a == pytest.approx(-0.18)
    assert power.charging == "no"
    base.world.home_base = True
    status = readings(base, "roomba600", 1.0)[-1].status
    assert (status.charging, status.power.charging) == (True, "bulk")
    assert status.power.current_a == pytest.approx(1.25)


def test_voltage_of_a_board_is_read():
    status = readings(DiffDriveEmulator(), "diffdrive", 0.5)[-1].status
    assert status.power.voltage_v is not None
    assert 10.0 < status.power.voltage_v < 13.0
    assert status.proximity == ()


def test_noise_of_the_measurements_sends_no_more_feedback():
    def flicker(base):
        def change(at):
            base.world.light_signals = (round(at * 1000) % 4000,) * 6

        return change

    still, noisy = RoombaEmulator(), RoombaEmulator()
    expected = len(readings(still, "roomba600", 4.0))
    feedback = readings(noisy, "roomba600", 4.0, change=flicker(noisy))
    assert len(feedback) == expected
    assert len({each.status.proximity for each in feedback}) >= 4.0 / MEASURE_S - 1


@pytest.mark.parametrize(
    ("status", "warnings"),
    [
        (None, []),
        (BaseStatus(), []),
        (BaseStatus(battery=0.2), []),
        (BaseStatus(battery=0.199), ["the battery is low (15 %): take the robot to its charger"]),
        (BaseStatus(battery=0.15), ["the battery is low (15 %): take the robot to its charger"]),
        (BaseStatus(battery=0.0), ["the battery is low (0 %): take the robot to its charger"]),
        (BaseStatus(battery=0.1, charging=True), []),
        (
            BaseStatus(battery=0.9, charging=True, power=Power(charging="fault")),
            ["the charger reports a fault: the battery does not charge"],
        ),
    ],
)
def test_a_low_battery_and_a_charger_in_fault_are_reasons(status, warnings):
    assert power_warnings(status, 0.2) == warnings
