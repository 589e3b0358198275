"""Which serial ports are accepted: by names that stay with a device, and real ones only on a clock of real time."""

from __future__ import annotations

import pytest

from robot_agent.serial_port import PortNameError, check_port_name, refuse_speed


class Machine:
    """The folders of a machine in which udev and the kernel describe serial adapters."""

    def __init__(self, root):
        self.root = root

    def plug(self, number, by_path, by_id=None, serial="0001"):
        device = self.root / f"dev/ttyUSB{number}"
        device.parent.mkdir(parents=True, exist_ok=True)
        device.touch()
        usb = self.root / f"sys/devices/usb1/{by_path}"
        interface = usb / f"{by_path}:1.0" / f"ttyUSB{number}"
        interface.mkdir(parents=True)
        for name, text in (("idVendor", "10c4"), ("idProduct", "ea60"), ("serial", serial)):
            (usb / name).write_text(text + "\n")
        place = self.root / f"sys/class/tty/ttyUSB{number}"
        place.mkdir(parents=True)
        (place / "device").symlink_to(interface)
        for folder, name in (("by-path", by_path), ("by-id", by_id)):
            if name:
                link = self.root / "dev/serial" / folder / name
                link.parent.mkdir(parents=True, exist_ok=True)
                link.unlink(missing_ok=True)  # udev gives a shared name to the device that came last
                link.symlink_to(device)

    def check(self, path):
        check_port_name(path, self.root)


@pytest.fixture
def machine(tmp_path):
    return Machine(tmp_path)


def test_a_name_by_id_or_by_path_is_accepted(machine):
    machine.plug(0, "pci-usb-1", "usb-FTDI_A1", serial="A1")
    machine.plug(1, "pci-usb-2", "usb-Silicon_Labs_CP2102_0001")
    for path in ("/dev/serial/by-id/usb-FTDI_A1", "/dev/serial/by-path/pci-usb-2", "/dev/ttyAMA0", "/dev/pts/3"):
        machine.check(path)


def test_a_number_is_refused_with_the_names_that_the_device_has(machine):
    machine.plug(0, "pci-usb-1", "usb-FTDI_A1", serial="A1")
    message = "number of ttyUSB0 .* Use /dev/serial/by-id/usb-FTDI_A1 or /dev/serial/by-path/pci-usb-1"
    with pytest.raises(PortNameError, match=message):
        machine.check("/dev/ttyUSB0")
    own_link = machine.root / "dev/roomba"
    own_link.symlink_to("ttyUSB0")
    with pytest.raises(PortNameError, match=message):
        machine.check("/dev/roomba")


@pytest.mark.parametrize("path", ["/dev/ttyUSB7", "/dev/ttyACM0"])
def test_a_number_is_refused_while_nothing_is_plugged_in(machine, path):
    with pytest.raises(PortNameError, match="Plug the device in and use its name in /dev/serial/by-id"):
        machine.check(path)


def test_a_name_by_id_that_two_adapters_share_is_refused_for_their_sockets(machine):
    machine.plug(0, "pci-usb-1", "usb-Silicon_Labs_CP2102_0001")
    machine.check("/dev/serial/by-id/usb-Silicon_Labs_CP2102_0001")
    machine.plug(1, "pci-usb-2", "usb-Silicon_Labs_CP2102_0001")
    shared = r"either of ttyUSB1 and ttyUSB0: .* 0001. Use /dev/serial/by-path/pci-usb-2"
    with pytest.raises(PortNameError, match=shared):
        machine.check("/dev/serial/by-id/usb-Silicon_Labs_CP2102_0001")
    machine.check("/dev/serial/by-path/pci-usb-1")
    machine.check("/dev/serial/by-path/pci-usb-2")


@pytest.mark.parametrize("speed", [0.1, 0.99, 1.01, 5.0])
def test_real_base_is_refused_on_a_scaled_clock(speed: float) -> None:
    refusal = refuse_speed(speed, "/dev/ttyUSB0")
    assert refusal is not None
    assert "/dev/ttyUSB0" in refusal
    assert "FOGNAV_SPEED" in refusal


@pytest.mark.parametrize(("speed", "device"), [(1.0, "/dev/ttyUSB0"), (1.0, "/dev/pts/3"), (5.0, "/dev/pts/3")])
def test_real_time_and_simulated_devices_are_accepted(speed: float, device: str) -> None:
    assert refuse_speed(speed, device) is None
