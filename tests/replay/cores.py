"""Feed a recording to fresh cores and write down all that they say: `python cores.py RECORDING SITE OUT`.

Time is the recording's: an input is taken when it was recorded, and every core ticks each 0.1 s of recorded time.
A program of its own, so that a test can run it twice with other hash seeds.
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
from fog_runtime.record import read
from fog_runtime.site import LoadedSite, load_site
from fognav_experiments.processes import AggregatorProcess, MapProcess, PlannerProcess
from hazard_aggregator.core import Aggregator
from hazard_aggregator.registry import find_rule
from map_service.core import MapCore
from map_service.registry import make_layers
from planner.core import PlannerCore

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from fog_contracts.handlers import Ids

Heard = tuple[float, ch.Channel, dict[str, str], Message | str]

TICK_S: Final = 0.1


class ReplayError(Exception):
    """The recording lacks what a replay needs, or contradicts itself."""


def hear(recording: Path) -> list[Heard]:
    """Return all messages in the order of recording, with their times in seconds."""
    return [(time_ns * 1e-9, channel, ids, message) for time_ns, channel, ids, message in read(recording)]


def first(heard: list[Heard], channel: ch.Channel) -> tuple[float, Message]:
    """Return time and content of a channel's first message."""
    for at, told_on, _, message in heard:
        if told_on is channel and isinstance(message, Message):
            return at, message
    raise ReplayError(f"no message of {channel.name} was recorded")


class Replay:
    """One core on a bus of its own, which hears what the other parts of the system published in a recording."""

    def __init__(self, heard: list[Heard], site: LoadedSite, role: ch.Role, begin: float) -> None:
        self.bus = Bus(site.site.id)
        self.published: list[Message] = []
        """What the core has published, without text."""
        self._heard = [event for event in heard if event[0] >= begin]
        self._role = role
        self._begin = begin
        own = [c for c in ch.CHANNELS.values() if c.kind == "pub" and role in c.publishers and c.message is not None]
        self.bus.subscribe(dict.fromkeys(own, self._note))

    def _note(self, _ids: Ids, message: Message, _at: Moment) -> Sequence[Publication]:
        self.published.append(message)
        return ()

    def run(
        self,
        tick: Callable[[Moment], object],
        deliver: Callable[[Moment], object] | None = None,
        *,
        own: Callable[[Heard, Moment], object] | None = None,
    ) -> None:
        """Deliver every message when it was recorded, and tick each 0.1 s of recorded time.

        What the core itself had published is handed to `own`: it tells of inputs that cross no channel.
        """
        deliver = deliver or self.bus.deliver
        due = self._begin
        for event in self._heard:
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


def aggregate(heard: list[Heard], site: LoadedSite) -> list[AreaHazard]:
    """Return the hazards that an aggregator announces, with a store that answers at once."""
    begin, hazard = first(heard, ch.AREA_HAZARD)
    assert isinstance(hazard, AreaHazard)
    replay = Replay(heard, site, "hazard-aggregator", begin)
    core = Aggregator(site.site.definitions(), site.site.nodes, hazard.epoch, registry=find_rule)
    replay.run(AggregatorProcess(core, replay.bus).tick)
    return [message for message in replay.published if isinstance(message, AreaHazard)]


def empty_map(heard: list[Heard], site: LoadedSite) -> MapCore:
    """Return a map-service's core as it stands at its start: what no recording holds comes from the site."""
    _, heartbeat = first(heard, ch.MAP_HEARTBEAT)
    assert isinstance(heartbeat, MapHeartbeat)
    return MapCore(
        site.site.id,
        site.map,
        heartbeat.epoch,
        layers=make_layers(site.map, site.site.layers),
        definitions=site.site.definitions(),
    )


def draw(heard: list[Heard], site: LoadedSite) -> tuple[list[MapDelta], MapSnapshot]:
    """Return the deltas that a map-service publishes, and its last map."""
    replay = Replay(heard, site, "map-service", heard[0][0])
    process = MapProcess(empty_map(heard, site), replay.bus)
    begin = Moment(heard[0][0], heard[0][0])
    process.load_zones([], begin)
    process.connect(begin)

    def take_stored_zones(event: Heard, at: Moment) -> None:
        if isinstance(zones := event[3], ZoneSet):
            process.load_zones(zones.zones, at)

    replay.run(process.tick, own=take_stored_zones)
    return [m for m in replay.published if isinstance(m, MapDelta)], process.core.costmap.snapshot()


def copy(heard: list[Heard], site: LoadedSite) -> list[MapHeartbeat]:
    """Return every version that a copy reaches by the recorded deltas; raises `ReplayError` if one does not fit."""
    follower, versions = MapFollower(), []
    follower.on_snapshot(empty_map(heard, site).costmap.snapshot(), heard[0][0])
    for at, _, _, message in heard:
        if isinstance(message, MapDelta):
            applied = follower.on_delta(message, at)
            if follower.wants_snapshot(at):
                raise ReplayError(f"recorded delta {message.seq} part {message.part} does not fit {follower.version}")
            if applied is not None:
                version = applied.version
                versions.append(MapHeartbeat(epoch=version.epoch, seq=version.seq, hash=version.hash, stamp=at))
    return versions


def new_planner(heard: list[Heard], site: LoadedSite, replay: Replay) -> PlannerProcess:
    """Return a planner that knows the first map."""
    _, path = first(heard, ch.ROBOT_PATH)
    assert isinstance(path, RobotPath)
    core = PlannerCore(path.planner_epoch)
    core.load(empty_map(heard, site).costmap.snapshot(), heard[0][0])
    return PlannerProcess(core, replay.bus)


def decide(heard: list[Heard], site: LoadedSite) -> list[RobotPath | RobotGoal]:
    """Return what a planner tells the robots."""
    replay = Replay(heard, site, "planner", heard[0][0])
    planner = new_planner(heard, site, replay)

    def take_mission(event: Heard, _at: Moment) -> None:
        _, _, ids, goal = event
        if isinstance(goal, RobotGoal):
            # The recorded goal is what the planner made of a person's wish: a place that asks for no heading is not
            # in it.
            planner.set_goal(ids["robot"], goal, any_heading=True)

    replay.run(planner.tick, planner.deliver, own=take_mission)
    return [message for message in replay.published if isinstance(message, (RobotPath, RobotGoal))]


def plan_again(heard: list[Heard], site: LoadedSite) -> list[RobotPath]:
    """Return each recorded plan anew: from where it begins, on the map version that it names."""
    replay = Replay(heard, site, "planner", heard[0][0])
    planner, again, known, goal = new_planner(heard, site, replay), [], 0, None

    def plan(event: Heard, at: Moment) -> None:
        nonlocal known, goal
        message = event[3]
        if isinstance(message, RobotGoal):
            goal = message.pose or goal
        elif isinstance(message, RobotPath) and message.plan_id != known and message.points and goal is not None:
            known = message.plan_id
            x, y = message.points[0]
            request = PlanRequest(start=Pose(x=x, y=y, theta=0.0), goal=goal)
            reply = replay.bus.query(ch.PLANNER_PLAN, request, PlanReply, at)
            assert reply is not None
            again.append(
                msgspec.structs.replace(
                    message,
                    points=reply.points,
                    map_epoch=reply.map_epoch,
                    map_seq=reply.map_seq,
                    refusal=reply.refusal,
                )
            )
            # Its distance field speeds up the search for the next plan, as it does in the planner.
            planner.set_goal("r", RobotGoal(goal_id="again", pose=goal))

    replay.run(planner.tick, planner.deliver, own=plan)
    return again


def main() -> None:
    """Replay, and write one file of JSON lines per core."""
    recording, folder, out = (Path(argument) for argument in sys.argv[1:])
    heard, site = hear(recording), load_site(folder)
    deltas, snapshot = draw(heard, site)
    said: dict[str, list[Message]] = {
        "hazards": [*aggregate(heard, site)],
        "deltas": [*deltas],
        "snapshot": [snapshot],
        "versions": [*copy(heard, site)],
        "told": [*decide(heard, site)],
        "again": [*plan_again(heard, site)],
    }
    for name, messages in said.items():
        (out / f"{name}.jsonl").write_bytes(b"".join(msgspec.json.encode(message) + b"\n" for message in messages))


if __name__ == "__main__":
    main()
