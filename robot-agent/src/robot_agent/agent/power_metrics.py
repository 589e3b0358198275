"""Battery and light sensors as metrics."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from prometheus_client import Gauge

if TYPE_CHECKING:
    from fog_contracts.messages import RobotState

BATTERY: Final = Gauge("fognav_battery_charge_ratio", "Charge of the robot's battery over its capacity")
VOLTAGE: Final = Gauge("fognav_battery_volts", "Voltage of the robot's battery")
CURRENT: Final = Gauge("fognav_battery_amperes", "Current into the robot's battery; negative while it discharges")
TEMPERATURE: Final = Gauge("fognav_battery_celsius", "Temperature of the robot's battery")
CHARGING: Final = Gauge("fognav_battery_charging", "1 for what the charger does", ["state"])
PROXIMITY: Final = Gauge(
    "fognav_proximity_strength", "Strength of a light sensor, 0 to 4095, 0 at the left", ["sensor"]
)


def observe_power(state: RobotState) -> None:
    """Set the gauges to what a state says; what a base does not measure keeps out."""
    power = state.power
    if state.battery is not None:
        BATTERY.set(state.battery)
    if power is not None:
        for gauge, value in (
            (VOLTAGE, power.voltage_v),
            (CURRENT, power.current_a),
            (TEMPERATURE, power.temperature_c),
        ):
            if value is not None:
                gauge.set(value)
        CHARGING.clear()
        if power.charging is not None:
            CHARGING.labels(power.charging).set(1)
    for number, strength in enumerate(state.proximity):
        PROXIMITY.labels(number).set(strength)
