import pytest

from robot_agent.serial_port import refuse_speed


@pytest.mark.parametrize("speed", [0.1, 0.99, 1.01, 5.0])
def test_real_base_is_refused_on_a_scaled_clock(speed: float) -> None:
    refusal = refuse_speed(speed, "/dev/ttyUSB0")
    assert refusal is not None
    assert "/dev/ttyUSB0" in refusal
    assert "FOGNAV_SPEED" in refusal


@pytest.mark.parametrize(("speed", "device"), [(1.0, "/dev/ttyUSB0"), (1.0, "/dev/pts/3"), (5.0, "/dev/pts/3")])
def test_real_time_and_simulated_devices_are_accepted(speed: float, device: str) -> None:
    assert refuse_speed(speed, device) is None
