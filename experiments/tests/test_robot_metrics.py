"""What a robot's exporter tells during a drive: its page, what is counted of it, and what is said if it is silent."""

from __future__ import annotations

import os
import time

import pytest
from prometheus_client import REGISTRY

from fog_runtime.health import Health, serve_health
from fognav_experiments.comparison.robot_metrics import MetricsError, Reading, RobotUsage, read
from robot_agent.agent.edges.exporter import RobotCollector


@pytest.fixture
def address():
    """Serve this process's own metrics as an agent serves its robot's."""
    collector = RobotCollector()
    collector.pids = {"agent": os.getpid()}
    REGISTRY.register(collector)
    server = serve_health(Health())
    yield f"127.0.0.1:{server.port}"
    server.close()
    REGISTRY.unregister(collector)


def test_a_robot_s_processes_are_read_from_its_exporter_by_thread(address):
    usage = RobotUsage()
    usage.add(100.0, read(address))
    begun = time.process_time()
    while time.process_time() - begun < 0.2:
        pass
    usage.add(102.0, read(address))
    told = usage.fields()
    assert told["cpu_percent"]["robot-agent"] >= 100.0 * 0.2 / 2.0
    assert sum(told["thread_percent"]["robot-agent"].values()) == pytest.approx(
        told["cpu_percent"]["robot-agent"], abs=0.1
    )
    assert told["peak_mb"]["robot-agent"] > 20.0
    (sample,) = told["samples"]
    assert (sample.at, sample.memory_mb.keys()) == (2.0, {"robot-agent"})


def test_a_process_that_was_started_again_is_counted_from_zero_and_one_reading_tells_nothing():
    usage = RobotUsage()
    usage.add(0.0, Reading({"robot-agent": {"python": 50.0}}, {"robot-agent": 200.0}))
    assert usage.fields() == {}
    usage.add(10.0, Reading({"robot-agent": {"python": 51.0}}, {"robot-agent": 220.0}))
    usage.add(20.0, Reading({"robot-agent": {"python": 0.5, "decide": 0.5}}, {"robot-agent": 150.0}))
    told = usage.fields()
    assert told["cpu_percent"] == {"robot-agent": 10.0}  # 1 s, and then 1 s, of 20
    assert told["thread_percent"] == {"robot-agent": {"decide": 2.5, "python": 7.5}}
    assert told["peak_mb"] == {"robot-agent": 220.0}
    usage.clear()
    assert usage.fields() == {}


def test_an_exporter_that_can_not_be_read_is_named_with_a_remedy():
    with pytest.raises(MetricsError, match=r"names no address of its metrics.*FOGNAV_HTTP_HOST"):
        read("")
    with pytest.raises(MetricsError, match=r"127\.0\.0\.1:1 can't be read .*: open that port"):
        read("127.0.0.1:1")
    server = serve_health(Health())
    with pytest.raises(MetricsError, match="tells nothing of a robot's processes"):
        read(f"127.0.0.1:{server.port}")
    server.close()
