"""What Prometheus gets of a robot: a computer of files, and what an agent has observed."""

from __future__ import annotations

import os
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from prometheus_client import CollectorRegistry, generate_latest

from fog_contracts.messages import LoopHealth, Power, RobotState
from robot_agent.agent.edges.exporter import Observed, RobotCollector, name_thread, parent, sample
from robot_agent.localization.pose import Uncertainty


def write(root, path, text):
    file = root / path
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)


def write_thread(root, pid, thread, name, nanoseconds, switches):
    folder = f"proc/{pid}/task/{thread}"
    write(root, f"{folder}/comm", f"{name}\n")
    write(root, f"{folder}/schedstat", f"{nanoseconds} 90 7\n")
    write(root, f"{folder}/status", f"Name:\t{name}\nvoluntary_ctxt_switches:\t{switches}\n")


def state(**changes):
    common = {
        "mode": "NORMAL", "reasons": [], "enabled": True, "battery": None, "goal_id": None, "map_epoch": 7,
        "map_seq": 3, "plan_id": None,
    }  # fmt: skip
    return RobotState(**{**common, **changes})


def observed(**changes):
    values = {"state": state(), "map_age": None, "particles": 0, "uncertainty": None, "corrupted": {}}
    return Observed(**{**values, **changes})


@pytest.fixture
def collector(tmp_path):
    return RobotCollector(tmp_path)


@pytest.fixture
def metric(collector):
    registry = CollectorRegistry()
    registry.register(collector)
    return lambda name, **labels: registry.get_sample_value(f"fognav_{name}", labels)


def names(collector):
    registry = CollectorRegistry()
    registry.register(collector)
    text = generate_latest(registry).decode()
    return {line.split()[2] for line in text.splitlines() if line.startswith("# TYPE")}


def test_vitals_tell_each_process_s_share_of_a_core_and_the_wifi_that_there_is(collector, tmp_path):
    own = os.getpid()
    collector.pids = {"agent": own, "guardian": own}
    assert collector.vitals(10.0, 1.0) is None, "there is nothing to compare with"
    assert collector.vitals(11.0, 2.0) is None, "it is not due yet"
    begun = time.process_time()
    while time.process_time() - begun < 0.1:
        pass
    first = collector.vitals(12.0, 3.0)
    assert first.cpu == {"agent": pytest.approx(5.0, abs=4.9), "guardian": first.cpu["agent"]}
    assert first.cpu["agent"] >= 5.0, "0.1 s of 2 s"
    assert first.wifi_dbm is None
    write(tmp_path, "proc/net/wireless", "Inter-| sta\n face | tus\n wlan0: 0000   54.  -56.  -256\n")
    collector.pids = {"agent": own, "watchdog": 2**22 + 1}
    later = collector.vitals(14.0, 5.0)
    assert (set(later.cpu), later.wifi_dbm, later.stamp) == ({"agent"}, -56.0, 5.0)


def test_nothing_is_exported_that_does_not_exist(collector):
    assert names(collector) == set()
    collector.pids = {"agent": 5}
    assert names(collector) == set(), "the process has ended"
    collector.observed = observed()
    assert names(collector) == {"fognav_robot_mode", "fognav_late_stops_total"}


def test_each_process_has_its_threads_wakeups_and_memory(collector, metric, tmp_path):
    write_thread(tmp_path, 5, 5, "python", 1_500_000_000, 10)
    write_thread(tmp_path, 5, 6, "rx", 250_000_000, 4)
    write_thread(tmp_path, 5, 7, "rx", 250_000_000, 6)
    write(tmp_path, "proc/5/status", "Name:\tpython\nVmRSS:\t  2048 kB\n")
    write_thread(tmp_path, 8, 8, "python", 3_000_000_000, 7)
    collector.pids = {"agent": 5, "guardian": 8}
    assert metric("thread_cpu_seconds_total", process="agent", thread="python") == pytest.approx(1.5)
    assert metric("thread_cpu_seconds_total", process="agent", thread="rx") == pytest.approx(0.5)
    assert metric("thread_cpu_seconds_total", process="guardian", thread="python") == pytest.approx(3.0)
    assert metric("process_wakeups_total", process="agent") == 20
    assert metric("process_resident_bytes", process="agent") == pytest.approx(2048 * 1024)


def test_computer_tells_temperature_throttling_and_signal_where_it_has_them(collector, metric, tmp_path):
    write(tmp_path, "sys/class/thermal/thermal_zone0/type", "cpu-thermal\n")
    write(tmp_path, "sys/class/thermal/thermal_zone0/temp", "48312\n")
    write(tmp_path, "sys/class/thermal/thermal_zone1/type", "broken\n")
    write(tmp_path, "sys/class/thermal/thermal_zone1/temp", "\n")
    write(tmp_path, "sys/devices/platform/soc/soc:firmware/get_throttled", "50005\n")
    write(
        tmp_path, "proc/net/wireless",
        "Inter-| sta-|   Quality        |   Discarded packets\n"
        " face | tus | link level noise |  nwid  crypt\n"
        " wlan0: 0000   54.  -56.  -256        0      0\n",
    )  # fmt: skip
    assert metric("computer_celsius", zone="cpu-thermal") == pytest.approx(48.312)
    assert metric("computer_celsius", zone="broken") is None
    assert metric("computer_throttled", cause="under_voltage") == 1
    assert metric("computer_throttled", cause="frequency_capped") == 0
    assert metric("computer_throttled", cause="throttled") == 1
    assert metric("wifi_level_dbm", interface="wlan0") == -56


def test_raspberry_pi_5_tells_what_slows_it_down(collector, metric, tmp_path):
    write(tmp_path, "sys/devices/platform/soc@107c000000/soc@107c000000:firmware/get_throttled", "50005\n")
    assert metric("computer_throttled", cause="under_voltage") == 1
    assert metric("computer_throttled", cause="soft_temperature_limit") == 0


@pytest.mark.parametrize("alarm", [0, 1])
def test_monitor_of_the_supply_tells_of_under_voltage_where_the_firmware_s_report_is_missing(
    collector, metric, tmp_path, alarm
):
    write(tmp_path, "sys/class/hwmon/hwmon0/name", "cpu_thermal\n")
    write(tmp_path, "sys/class/hwmon/hwmon0/in0_lcrit_alarm", "1\n")
    write(tmp_path, "sys/class/hwmon/hwmon2/name", "rpi_volt\n")
    write(tmp_path, "sys/class/hwmon/hwmon2/in0_lcrit_alarm", f"{alarm}\n")
    assert metric("computer_throttled", cause="under_voltage") == alarm
    assert metric("computer_throttled", cause="throttled") is None


def test_agent_tells_mode_reasons_map_pose_and_errors(collector, metric):
    collector.observed = observed(
        state=state(
            mode="DEGRADED", codes=["map_late", "map_late"], base_fault="bumper", loop=LoopHealth(late_stops=2)
        ),
        map_age=1.2,
        particles=512,
        uncertainty=Uncertainty(0.2, 0.05, 0.03),
        corrupted={"base": 3, "lidar": 0},
    )
    assert metric("robot_mode", mode="DEGRADED") == 1
    assert metric("robot_mode", mode="NORMAL") is None
    assert metric("robot_reason", reason="map_late") == 1
    assert metric("robot_base_fault", fault="bumper") == 1
    assert metric("robot_map_age_seconds") == pytest.approx(1.2)
    assert (metric("robot_map_version", part="epoch"), metric("robot_map_version", part="seq")) == (7, 3)
    assert metric("particles") == 512
    assert metric("pose_sigma_meters", direction="along") == pytest.approx(0.2)
    assert metric("pose_sigma_meters", direction="across") == pytest.approx(0.05)
    assert metric("pose_sigma_radians") == pytest.approx(0.03)
    assert metric("late_stops_total") == 2
    assert (metric("serial_errors_total", port="base"), metric("serial_errors_total", port="lidar")) == (3, 0)


def test_battery_and_light_sensors_are_those_of_the_last_state(collector, metric):
    power = Power(voltage_v=15.5, current_a=-0.4, temperature_c=24.0, charging="trickle")
    collector.observed = observed(state=state(battery=0.5, power=power, proximity=[3, 900]))
    assert metric("battery_charge_ratio") == 0.5
    assert metric("battery_volts") == 15.5
    assert metric("battery_amperes") == -0.4
    assert metric("battery_celsius") == 24.0
    assert metric("battery_charging", state="trickle") == 1.0
    assert metric("proximity_strength", sensor="1") == 900.0
    collector.observed = observed(state=state(power=Power(charging="no")))
    assert metric("battery_charging", state="trickle") is None
    assert metric("battery_charging", state="no") == 1.0
    assert metric("battery_volts") is None
    assert metric("battery_charge_ratio") is None


def test_parent_of_a_process_is_known_while_it_runs(tmp_path):
    assert parent(os.getpid()) == os.getppid()
    assert parent(2**30) is None
    write(tmp_path, "proc/9/stat", "9 (a) b) S 4 9 9 0")
    assert parent(9, tmp_path) == 4


def test_named_thread_is_listed_by_its_name_among_the_threads_of_its_process():
    before = {thread.name for thread in sample(os.getpid()).values()}
    with ThreadPoolExecutor(1, initializer=name_thread, initargs=("decide-7",)) as pool:
        names = pool.submit(lambda: [thread.name for thread in sample(os.getpid()).values()]).result()
    assert "decide-7" not in before
    assert names.count("decide-7") == 1


def test_thread_keeps_its_name_where_the_list_can_not_be_written(tmp_path):
    name_thread("decide", tmp_path)
