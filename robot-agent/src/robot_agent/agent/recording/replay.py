"""Replay an agent's input log: a new core gets the same inputs and must give the same outputs to the last bit.

`python -m robot_agent.agent.recording.replay FILE` prints the result as JSON and exits with 1 if any output differs.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from fog_contracts.channels import CHANNELS
from fog_contracts.handlers import Moment
from fog_contracts.replica import MapError
from fog_runtime.record import RecordError, read_entries
from robot_agent import registry
from robot_agent.agent.recording import input_log as log
from robot_agent.motion.local_planner import decide

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from robot_agent.agent.core import AgentCore
    from robot_agent.motion.local_planner import Job
    from robot_agent.profiles import Found

_LISTED_MAX: Final = 20
"""Differences that are listed; further ones are only counted."""
_TEXT_LIMIT: Final = 500


class ReplayError(ValueError):
    """A log can't be replayed; the message names the file and the reason."""


class Difference(msgspec.Struct, frozen=True, kw_only=True):
    """A replayed output that differs from the recorded one, both as JSON; `after_input` counts from 1."""

    after_input: int
    recorded: str
    replayed: str


@dataclass(kw_only=True)
class Replayed:
    """Result of a replay: counts by type of entry, modes in order, a digest of all outputs, and differences."""

    inputs: Counter[str] = field(default_factory=Counter)
    outputs: Counter[str] = field(default_factory=Counter)
    modes: list[str] = field(default_factory=list)
    digest: str = ""
    differences: list[Difference] = field(default_factory=list)
    different: int = 0


def replay(path: Path) -> Replayed:
    """Replay a log with a new core; raises `ReplayError` or `RecordError` when it can't be replayed.

    A log that a crash truncated is replayed up to its end.
    """
    entries = _entries(path)
    first = next(entries, None)
    if first is None or not isinstance(first[0], log.Started):
        raise ReplayError(
            f"{path}: the first entry is no start of an agent: this is no input log, or its beginning is missing"
        )
    run = _Run(first[0])
    recorded: list[bytes] = []
    for entry, data in entries:
        if isinstance(entry, log.EntriesLost):
            raise ReplayError(
                f"{path}: {entry.count} entries are missing after input {run.count}: the disk was too slow"
            )
        if isinstance(entry, log.Output):
            recorded.append(data)
            continue
        run.compare(recorded)
        recorded = []
        run.feed(entry)
    # The outputs of the last input may have been truncated.
    run.compare(recorded, whole=False)
    return run.finish()


def _entries(path: Path) -> Iterator[tuple[log.Entry, bytes]]:
    for _, topic, data in read_entries(path):
        kind = log.ENTRY_OF_TOPIC.get(topic)
        if kind is None:
            continue
        try:
            yield msgspec.json.decode(data, type=kind), data
        except msgspec.DecodeError as error:
            raise ReplayError(
                f"{path}: an entry of {topic} was written by another version of the agent: {error}"
            ) from error


def _receive(agent: AgentCore, entry: log.MessageReceived) -> None:
    channel, at = CHANNELS[entry.channel], Moment(entry.now, entry.stamp)
    agent.handlers()[channel](entry.ids, msgspec.convert(entry.message, channel.message), at)


def _ask(agent: AgentCore, entry: log.QueryReceived) -> None:
    channel, at = CHANNELS[entry.channel], Moment(entry.now, entry.stamp)
    request = None if channel.message is None else msgspec.convert(entry.request, channel.message)
    agent.query_handlers()[channel](entry.ids, request, at)


def _load(agent: AgentCore, entry: log.SnapshotLoaded) -> None:
    with suppress(MapError):  # it was refused in the recorded run too, or later outputs will differ
        agent.load(entry.snapshot, entry.now)


_PASSED_ON: Final[Mapping[type[log.Entry], Callable[[AgentCore, Any], object]]] = {
    log.PoseRestored: lambda agent, entry: agent.restore(entry.pose),
    log.SnapshotLoaded: _load,
    log.MessageReceived: _receive,
    log.QueryReceived: _ask,
    log.BaseReceived: lambda agent, entry: agent.on_base(entry.feedback, entry.now),
    log.BaseLost: lambda agent, entry: agent.on_base_lost(entry.now, entry.reason),
    log.HandReceived: lambda agent, entry: agent.on_hand(entry.request, entry.now),
    log.LidarSamplesReceived: lambda agent, entry: agent.on_lidar_samples(entry.samples(), entry.now),
    log.ScanReceived: lambda agent, entry: agent.on_scan(entry.scan(), entry.now),
    log.SuspensionNoticed: lambda agent, entry: agent.on_suspension(entry.seconds),
    log.PoseObserved: lambda agent, entry: agent.on_absolute_observation(entry.observation()),
    log.MarkerSighted: lambda agent, entry: agent.on_sighting(entry.sighting(), entry.now),
    log.EgressAsked: lambda agent, entry: agent.egress_request(entry.now),
    log.EgressReplied: lambda agent, entry: agent.on_egress_reply(entry.request, entry.reply, entry.now),
    log.LoopHealthReceived: lambda agent, entry: agent.on_loop_health(entry.health),
    log.StreamCycle: lambda agent, entry: agent.stream(entry.now, entry.stamp),
    log.Tick: lambda agent, entry: agent.tick(Moment(entry.now, entry.stamp)),
    log.StorageCheck: lambda agent, entry: agent.pose_to_store(entry.now),
}
"""What the core gets of each input that depends on nothing which the replay computes."""


class _Run:
    """A core under replay, and its outputs since the last input."""

    def __init__(self, started: log.Started) -> None:
        self.count = 0
        self._result = Replayed()
        self._digest = hashlib.blake2b(digest_size=16)
        self._produced: list[bytes] = []
        self._job: Job | None = None
        self._found: Found | None = None
        self._agent = log.LoggedAgent(started.config, started.seed, self._on_entry, registry.profile)

    def _on_entry(self, entry: log.Entry) -> None:
        if not isinstance(entry, log.Output):
            return
        data = msgspec.json.encode(entry)
        self._produced.append(data)
        self._digest.update(data)
        self._result.outputs[type(entry).__name__] += 1
        if isinstance(entry, log.WheelsCommanded) and self._result.modes[-1:] != [entry.mode]:
            self._result.modes.append(entry.mode)

    def compare(self, recorded: Sequence[bytes], *, whole: bool = True) -> None:
        """Compare the outputs since the last input with the recorded ones."""
        produced, self._produced = self._produced, []
        if not whole:
            produced = produced[: len(recorded)]
        for index in range(max(len(recorded), len(produced))):
            self._expect(
                recorded[index] if index < len(recorded) else b"nothing",
                produced[index] if index < len(produced) else b"nothing",
            )

    def _expect(self, recorded: bytes, replayed: bytes) -> None:
        if recorded == replayed:
            return
        self._result.different += 1
        if len(self._result.differences) < _LISTED_MAX:
            before, after = (data[:_TEXT_LIMIT].decode(errors="replace") for data in (recorded, replayed))
            self._result.differences.append(Difference(after_input=self.count, recorded=before, replayed=after))

    def feed(self, entry: log.Entry) -> None:
        """Pass an input to the core."""
        self.count += 1
        self._result.inputs[type(entry).__name__] += 1
        match entry:
            case log.SearchCycle():
                search = self._agent.search(entry.now)
                self._found = None if search is None else search.run()
            case log.SearchEnded():
                if self._found is None:
                    raise ReplayError(f"input {self.count}: a search ended that the replay has not begun")
                self._agent.on_found(self._found, Moment(entry.now, entry.stamp))
            case log.ControlCycle():
                self._job = self._agent.control_job(entry.now)
            case log.DecisionMade():
                self._decide(entry)
            case _ if type(entry) in _PASSED_ON:
                _PASSED_ON[type(entry)](self._agent, entry)
            case _:
                raise ReplayError(f"input {self.count}: a log can't continue with {type(entry).__name__}")

    def _decide(self, entry: log.DecisionMade) -> None:
        recorded = msgspec.json.encode(entry.decision)
        self._expect(recorded, b"no job" if self._job is None else msgspec.json.encode(decide(self._job)))
        self._job = None
        self._agent.accept(entry.decision)

    def finish(self) -> Replayed:
        """Return the result."""
        self._result.digest = self._digest.hexdigest()
        return self._result


def main(arguments: Sequence[str] | None = None) -> int:
    """Replay the log named on the command line."""
    parser = argparse.ArgumentParser(prog="python -m robot_agent.agent.recording.replay", description=__doc__)
    parser.add_argument("file", type=Path, help="input log that an agent wrote (FOGNAV_INPUT_LOG)")
    path: Path = parser.parse_args(arguments).file
    try:
        result = replay(path)
    except (ReplayError, RecordError, OSError) as error:
        sys.stderr.write(f"{error}\n")
        return 2
    sys.stdout.write(msgspec.json.format(msgspec.json.encode(result)).decode() + "\n")
    return 1 if result.different else 0


if __name__ == "__main__":
    sys.exit(main())
