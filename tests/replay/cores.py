"""Feed a recording to fresh cores and write what they publish: `python cores.py RECORDING SITE OUT`.

Time is the recording's: an input is handled at its recorded time, and every core ticks each 0.1 s of recorded time.
It is a program of its own, so that a test can run it with different hash seeds.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec

from fog_contracts import channels as ch
from fog_contracts.bus import Bus
from fog_contracts.follower import MapFollower
from fog_contracts.handlers import Moment, Publication
from fog_contracts.messages import (
    AreaHazard,
    MapDelta,
    MapHeartbeat,
    MapSnapshot,
    Message,
    PlanReply,
    PlanRequest,
    Pose,
    RobotGoal,
    RobotPath,
    ZoneSet,
)
from fog_runtime.configuration.site import LoadedSite, load_site
from fog_runtime.record import read
from fognav_experiments.processes import AggregatorProcess, MapProcess, PlannerProcess
from hazard_aggregator.core import Aggregator
from hazard_aggregator.fusion import AreaFusion
from hazard_aggregator.registry import find_rule
from map_service.core import MapCore
from map_service.registry import make_layers
from planner.core import PlannerCore

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from fog_contracts.handlers import Ids

RecordedMessage = tuple[float, ch.Channel, dict[str, str], Message | str]

TICK_S: Final = 0.1


class ReplayError(Exception):
    """The recording lacks messages that a replay needs, or is inconsistent."""


def load_recording(recording: Path) -> list[RecordedMessage]:
    """Return all messages in the order of recording, with their times (s)."""
    return [(time_ns * 1e-9, channel, ids, message) for time_ns, channel, ids, message in read(recording)]


def first(messages: list[RecordedMessage], channel: ch.Channel) -> tuple[float, Message]:
    """Return a channel's first message, with its time (s)."""
    for at, recorded_channel, _, message in messages:
        if recorded_channel is channel and isinstance(message, Message):
            return at, message
    raise ReplayError(f"no message of {channel.name} was recorded")


class Replay:
    """One core on a bus of its own, which receives what the other processes published in a recording."""

    def __init__(self, messages: list[RecordedMessage], site: LoadedSite, role: ch.Role, start: float) -> None:
        self.bus = Bus(site.site.id)
        self.published: list[Message] = []
        """The messages that the core has published, except text."""
        self._messages = [event for event in messages if event[0] >= start]
        self._role = role
        self._start = start
        own = [c for c in ch.CHANNELS.values() if c.kind == "pub" and role in c.publishers and c.message is not None]
        self.bus.subscribe(dict.fromkeys(own, self._record))

    def _record(self, _ids: Ids, message: Message, _at: Moment) -> Sequence[Publication]:
        self.published.append(message)
        return ()

    def run(
        self,
        tick: Callable[[Moment], object],
        deliver: Callable[[Moment], object] | None = None,
        *,
        own: Callable[[RecordedMessage, Moment], object] | None = None,
    ) -> None:
        """Deliver every message at its recorded time, and tick each 0.1 s of recorded time.

        `own` receives what the live process had published itself: this reveals inputs that cross no channel.
        """
        deliver = deliver or self.bus.deliver
        due = self._start
        for event in self._messages:
            at = Moment(event[0], event[0])
            while due <= at.now:
                tick(Moment(due, due))
                deliver(Moment(due, due))
                due += TICK_S
            _, channel, ids, message = event
            if self._role not in channel.publishers:
                self.bus.publish([Publication(channel, message, ids)])
            elif own is not None:
                own(event, at)
            deliver(at)


def replay_aggregator(messages: list[RecordedMessage], site: LoadedSite) -> list[AreaHazard]:
    """Return the hazards that an aggregator publishes, with a store without delay."""
    start, hazard = first(messages, ch.AREA_HAZARD)
    assert isinstance(hazard, AreaHazard)
    replay = Replay(messages, site, "hazard-aggregator", start)
    core = Aggregator(AreaFusion(site.site.definitions(), site.site.nodes, hazard.epoch, registry=find_rule))
    replay.run(AggregatorProcess(core, replay.bus).tick)
    return [message for message in replay.published if isinstance(message, AreaHazard)]


def empty_map(messages: list[RecordedMessage], site: LoadedSite) -> MapCore:
    """Return a map-service's core in its initial state: what no recording contains comes from the site."""
    _, heartbeat = first(messages, ch.MAP_HEARTBEAT)
    assert isinstance(heartbeat, MapHeartbeat)
    return MapCore(
        site.site.id,
        site.map,
        heartbeat.epoch,
        layers=make_layers(site.map, site.site.layers),
        definitions=site.site.definitions(),
    )


def replay_map(messages: list[RecordedMessage], site: LoadedSite) -> tuple[list[MapDelta], MapSnapshot]:
    """Return the deltas that a map-service publishes, and its final map."""
    replay = Replay(messages, site, "map-service", messages[0][0])
    process = MapProcess(empty_map(messages, site), replay.bus)
    start = Moment(messages[0][0], messages[0][0])
    process.load_zones([], start)

    def load_stored_zones(event: RecordedMessage, at: Moment) -> None:
        if isinstance(zones := event[3], ZoneSet):
            process.load_zones(zones.zones, at)

    replay.run(process.tick, own=load_stored_zones)
    return [m for m in replay.published if isinstance(m, MapDelta)], process.core.costmap.snapshot()


def replay_deltas(messages: list[RecordedMessage], site: LoadedSite) -> list[MapHeartbeat]:
    """Return every version that a replica reaches by the recorded deltas; raises `ReplayError` for one that fails."""
    follower, versions = MapFollower(), []
    follower.on_snapshot(empty_map(messages, site).costmap.snapshot(), messages[0][0])
    for at, _, _, message in messages:
        if isinstance(message, MapDelta):
            applied = follower.on_delta(message, at)
            if follower.wants_snapshot(at):
                delta = f"recorded delta {message.seq} part {message.part}"
                raise ReplayError(f"{delta} does not continue {follower.version}")
            if applied is not None:
                version = applied.version
                versions.append(MapHeartbeat(epoch=version.epoch, seq=version.seq, hash=version.hash, sent=(0, at)))
    return versions


def new_planner(messages: list[RecordedMessage], site: LoadedSite, replay: Replay) -> PlannerProcess:
    """Return a planner that has loaded the first map."""
    _, path = first(messages, ch.ROBOT_PATH)
    assert isinstance(path, RobotPath)
    core = PlannerCore(path.planner_epoch)
    core.load(empty_map(messages, site).costmap.snapshot(), messages[0][0])
    return PlannerProcess(core, replay.bus)


def replay_planner(messages: list[RecordedMessage], site: LoadedSite) -> list[RobotPath | RobotGoal]:
    """Return the paths and goals that a planner publishes."""
    replay = Replay(messages, site, "planner", messages[0][0])
    planner = new_planner(messages, site, replay)

    def set_recorded_goal(event: RecordedMessage, _at: Moment) -> None:
        _, _, ids, goal = event
        if isinstance(goal, RobotGoal):
            # The recorded goal does not show whether the operator asked for a heading.
            planner.set_goal(ids["robot"], goal, any_heading=True)

    replay.run(planner.tick, planner.deliver, own=set_recorded_goal)
    return [message for message in replay.published if isinstance(message, (RobotPath, RobotGoal))]


def paths_by_map(messages: list[RecordedMessage]) -> list[RecordedMessage]:
    """Return the messages with each path at the end of the time of its version of the map.

    They are published on channels of their own, so a path and a delta may overtake one another.
    """
    others = [event for event in messages if not isinstance(event[3], RobotPath)]
    placed: dict[int, list[RecordedMessage]] = {}
    for _, channel, ids, path in messages:
        if isinstance(path, RobotPath):
            newer = (index for index, event in enumerate(others) if _is_newer(event[3], path))
            place = next(newer, len(others))
            at = others[min(place, len(others) - 1)][0]
            placed.setdefault(place, []).append((at, channel, ids, path))
    ordered: list[RecordedMessage] = []
    for index, event in enumerate(others):
        ordered += [*placed.get(index, ()), event]
    return ordered + placed.get(len(others), [])


def _is_newer(message: Message | str, path: RobotPath) -> bool:
    return isinstance(message, MapDelta) and message.epoch == path.map_epoch and message.seq > path.map_seq


def recompute_plans(messages: list[RecordedMessage], site: LoadedSite) -> list[RobotPath]:
    """Return each recorded plan computed again, from its first point on its map version."""
    messages = paths_by_map(messages)
    replay = Replay(messages, site, "planner", messages[0][0])
    planner, plans, known = new_planner(messages, site, replay), [], 0
    # A path may be recorded before the goal to which it leads: each is published on a channel of its own.
    goals = {m.goal_id: m.pose for _, _, _, m in messages if isinstance(m, RobotGoal) and m.pose is not None}

    def plan(event: RecordedMessage, at: Moment) -> None:
        nonlocal known
        message = event[3]
        if isinstance(message, RobotPath) and message.plan_id != known and message.points:
            known, goal = message.plan_id, goals[message.goal_id]
            x, y = message.points[0]
            request = PlanRequest(start=Pose(x=x, y=y, theta=0.0), goal=goal)
            reply = replay.bus.query(ch.PLANNER_PLAN, request, PlanReply, at)
            assert reply is not None
            plans.append(
                msgspec.structs.replace(
                    message,
                    points=reply.points,
                    map_epoch=reply.map_epoch,
                    map_seq=reply.map_seq,
                    refusal=reply.refusal,
                )
            )
            # As in the planner, the goal's distance field speeds up the next search.
            planner.set_goal("r", RobotGoal(goal_id="again", pose=goal))

    replay.run(planner.tick, planner.deliver, own=plan)
    return plans


def main() -> None:
    """Replay, and write one file of JSON lines per output."""
    recording, folder, out = (Path(argument) for argument in sys.argv[1:])
    messages, site = load_recording(recording), load_site(folder)
    deltas, snapshot = replay_map(messages, site)
    outputs: dict[str, list[Message]] = {
        "hazards": [*replay_aggregator(messages, site)],
        "deltas": [*deltas],
        "snapshot": [snapshot],
        "versions": [*replay_deltas(messages, site)],
        "paths": [*replay_planner(messages, site)],
        "plans": [*recompute_plans(messages, site)],
    }
    for name, published in outputs.items():
        (out / f"{name}.jsonl").write_bytes(b"".join(msgspec.json.encode(message) + b"\n" for message in published))


if __name__ == "__main__":
    main()
