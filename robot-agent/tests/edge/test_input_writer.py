from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path

from guardian_rig import DEADLINE_S
from little_world import AGENT, LittleWorld

from fog_runtime import record
from fog_runtime.record import Recorder, read_entries
from robot_agent.agent.core import AgentCore
from robot_agent.agent.recording.input_log import TOPIC_OF_ENTRY, BaseLost, EntriesLost, LoggedAgent
from robot_agent.agent.recording.input_writer import LOST, InputWriter, open_core
from robot_agent.agent.recording.replay import replay


def lost():
    return LOST._value.get()


def topics(path):
    return [topic for _, topic, _ in read_entries(path)]


def test_input_log_is_complete_at_the_end_and_can_be_replayed(tmp_path):
    path = tmp_path / "logs" / "inputs.mcap"
    with open_core(AGENT, 4, path) as core:
        assert isinstance(core, LoggedAgent)
        world = LittleWorld(seed=4, start_agent=lambda _config, _seed: core)
        world.agent.load(world.master.snapshot(), world.now)
        world.run(1.0)
    result = replay(path)
    assert result.differences == []
    assert result.outputs["WheelsCommanded"] == len(world.commands)
    assert len(world.commands) >= 10  # as often as a robot that stands gets them, or as one that drives


def test_an_agent_without_a_log_is_a_plain_core():
    with open_core(AGENT, 4, None) as core:
        assert type(core) is AgentCore


def test_an_agent_without_a_log_loads_no_library_for_one():
    program = "import sys, robot_agent.agent.service; print('mcap' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_log_of_the_previous_run_is_kept(tmp_path):
    path = tmp_path / "inputs.mcap"
    for reason in ("first", "second", "third"):
        with InputWriter(path) as writer:
            writer.write(BaseLost(reason=reason, now=1.0))
    assert [b"third" in data for _, _, data in read_entries(path)] == [True]
    assert [b"second" in data for _, _, data in read_entries(tmp_path / "inputs.previous.mcap")] == [True]


def test_full_disk_is_counted_and_does_not_stop_the_agent(caplog):
    before = lost()
    with open_core(AGENT, 4, Path("/dev/full")) as core:
        world = LittleWorld(seed=4, start_agent=lambda _config, _seed: core)
        world.agent.load(world.master.snapshot(), world.now)
        world.run(2.0)
    without_log = LittleWorld(seed=4)
    without_log.agent.load(without_log.master.snapshot(), without_log.now)
    without_log.run(2.0)
    assert world.commands == without_log.commands != []
    assert lost() > before
    assert caplog.messages.count("input_log_ended") == 1


def test_agent_runs_without_a_log_that_can_not_be_opened(tmp_path, caplog):
    (tmp_path / "file").write_text("no folder")
    with open_core(AGENT, 4, tmp_path / "file" / "inputs.mcap") as core:
        assert type(core) is AgentCore
    assert "input_log_not_opened" in caplog.messages


def test_slow_disk_leaves_an_entry_where_entries_are_missing(tmp_path, monkeypatch):
    begun, release, written = threading.Event(), threading.Event(), threading.Semaphore(0)

    class SlowRecorder(Recorder):
        def write_entry(self, topic, entry, log_time_ns):
            begun.set()
            release.wait()
            super().write_entry(topic, entry, log_time_ns)
            written.release()

    monkeypatch.setattr(record, "Recorder", SlowRecorder)
    path, entry, before = tmp_path / "inputs.mcap", BaseLost(reason="x", now=1.0), lost()
    with InputWriter(path, queue_limit=2) as writer:
        writer.write(entry)
        assert begun.wait(DEADLINE_S)
        for _ in range(5):
            writer.write(entry)  # two may wait
        assert lost() - before == 3
        release.set()
        assert all(written.acquire(timeout=DEADLINE_S) for _ in range(3))
        writer.write(entry)
    kinds = [TOPIC_OF_ENTRY[kind] for kind in (BaseLost, BaseLost, BaseLost, EntriesLost, BaseLost)]
    assert topics(path) == kinds


def test_entry_that_can_not_be_encoded_ends_the_log_with_its_reason(tmp_path, caplog):
    before = lost()
    with InputWriter(tmp_path / "inputs.mcap") as writer:
        writer.write(BaseLost(reason="\ud800", now=1.0))
    assert lost() - before == 1
    assert "input_log_ended" in caplog.messages
