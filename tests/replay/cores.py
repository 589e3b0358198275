"""Feed a recording to fresh cores and write down all that they say: `python cores.py RECORDING SITE OUT`.

Time is the recording's: an input is taken when it was recorded, and every core beats each 0.1 s of recorded time.
A program of its own, so that a test can run it twice with other hash seeds.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec

from fog_contracts import channels as ch
from fog_contracts.follower import MapFollower
from fog_contracts.handlers import Moment
from fog_contracts.messages import (
    AreaHazard,
    HazardArea,
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
from hazard_aggregator.core import Aggregator
from hazard_aggregator.registry import find_rule
from map_service.core import MapCore
from map_service.registry import make_layers
from planner.core import PlannerCore

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from fog_contracts.handlers import Publication

Heard = tuple[float, ch.Channel, dict[str, str], Message | str]

BEAT_S: Final = 0.1


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


def beating(heard: list[Heard], begin: float) -> Iterator[tuple[float, Heard | None]]:
    """Yield the messages since `begin`, and None at every beat between them."""
    due = begin
    for message in heard:
        at = message[0]
        if at < begin:
            continue
        while due <= at:
            yield due, None
            due += BEAT_S
        yield at, message


def aggregate(heard: list[Heard], site: LoadedSite) -> list[AreaHazard]:
    """Return the hazards that an aggregator announces, with a store that answers at once."""
    begin, hazard = first(heard, ch.AREA_HAZARD)
    assert isinstance(hazard, AreaHazard)
    core = Aggregator(site.site.definitions(), site.site.nodes, hazard.epoch, registry=find_rule)
    handlers = core.handlers()
    announced: list[AreaHazard] = []
    for at, event in beating(heard, begin):
        moment = Moment(at, at)
        if event is None:
            publications = core.tick(moment)
        else:
            _, channel, ids, message = event
            if channel not in handlers:
                continue
            publications = [*handlers[channel](ids, message, moment)]
        published = (*publications, *core.stored(core.to_store()))
        announced += [p.message for p in published if isinstance(p.message, AreaHazard)]
    return announced


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
    core, deltas = empty_map(heard, site), []
    handlers = core.handlers()

    def take(publications: Sequence[Publication]) -> None:
        deltas.extend(p.message for p in publications if isinstance(p.message, MapDelta))

    begin = Moment(heard[0][0], heard[0][0])
    # What crosses no channel: the aggregator lives, and the broker is connected.
    take(core.load_zones([], begin))
    take(core.on_broker(begin, connected=True))
    take(core.on_aggregator("recorded", begin, alive=True))
    for at, event in beating(heard, begin.now):
        moment = Moment(at, at)
        if event is None:
            take(core.tick(moment))
            continue
        _, channel, ids, message = event
        if isinstance(message, ZoneSet):
            take(core.load_zones(message.zones, moment))
        elif channel in handlers:
            take(handlers[channel](ids, message, moment))
    return deltas, core.costmap.snapshot()


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


def inform(core: PlannerCore, event: Heard) -> bool:
    """Give a planner a recorded input; return whether it wakes it."""
    at, channel, ids, message = event
    if isinstance(message, RobotGoal):
        # The recorded goal is what the planner made of a person's wish: a place that asks for no heading is not in it.
        core.set_goal(ids["robot"], message, any_heading=True)
        return True
    handler = core.handlers().get(channel)
    if handler is not None:
        handler(ids, message, Moment(at, at))
    return channel in core.URGENT


def guide(core: PlannerCore) -> None:
    """Compute the distance fields that it wants, as its process does after a turn."""
    for job in core.field_jobs():
        job.run()
        core.take_field(job)


def new_planner(heard: list[Heard], site: LoadedSite) -> PlannerCore:
    """Return a planner that knows the first map."""
    _, path = first(heard, ch.ROBOT_PATH)
    assert isinstance(path, RobotPath)
    core = PlannerCore(path.planner_epoch)
    core.load(empty_map(heard, site).costmap.snapshot(), heard[0][0])
    return core


def decide(heard: list[Heard], site: LoadedSite) -> list[RobotPath | RobotGoal]:
    """Return what a planner tells the robots."""
    core, told = new_planner(heard, site), []
    for at, event in beating(heard, heard[0][0]):
        if event is not None and not inform(core, event):
            continue
        published = (publication.message for publication in core.tick(Moment(at, at)))
        told += [message for message in published if isinstance(message, (RobotPath, RobotGoal))]
        guide(core)
    return told


def plan_again(heard: list[Heard], site: LoadedSite) -> list[RobotPath]:
    """Return each recorded plan anew: from where it begins, on the map version that it names."""
    core, known, goal, again = new_planner(heard, site), 0, None, []
    for event in heard:
        message = event[3]
        if isinstance(message, (MapDelta, HazardArea, ZoneSet)):
            inform(core, event)
            guide(core)
        elif isinstance(message, RobotGoal):
            goal = message.pose or goal
        elif isinstance(message, RobotPath) and message.plan_id != known and message.points and goal is not None:
            known = message.plan_id
            x, y = message.points[0]
            request = PlanRequest(start=Pose(x=x, y=y, theta=0.0), goal=goal)
            reply = core.answerers()[ch.PLANNER_PLAN]({}, request, Moment(event[0], event[0]))
            assert isinstance(reply, PlanReply)
            again.append(
                msgspec.structs.replace(
                    message,
                    points=reply.points,
                    map_epoch=reply.map_epoch,
                    map_seq=reply.map_seq,
                    refusal=reply.refusal,
                )
            )
            core.set_goal("r", RobotGoal(goal_id="again", pose=goal))
            guide(core)
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
