"""The demonstration and lockstep evaluate the same drive alike: its hazard, outcome, success and summary."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import msgspec
import pytest
import ring_site as ring
from manual_clock import ManualClock

from fog_contracts import channels as ch
from fog_contracts.bus import Bus
from fog_contracts.handlers import Publication
from fog_contracts.messages import CommandReply, RobotGoal, SimCommand, SimTruth
from fognav.demo.attempt import Attempt
from fognav.demo.operator import Operator
from fognav.demo.options import DrivePlan, Options
from fognav.demo.scene import Scene
from fognav_experiments.lockstep import run_lockstep
from fognav_sim.drive.drive import DriveSummary
from fognav_sim.drive.hazard import HazardRequest

if TYPE_CHECKING:
    from collections.abc import Iterable

    from fog_contracts.channels import Channel
    from fog_contracts.handlers import Ids, Moment
    from fog_contracts.messages import Message
    from fog_runtime.configuration.site import LoadedSite
    from fog_runtime.transports.zenoh_edge import ZenohEdge
    from fognav.stack import Stack
    from fognav_experiments.lockstep import LockstepResult

SEED = 3
INSIDE_Z1 = (7.5, 1.5)
OBSERVED = (ch.SIM_TRUTH, ch.ROBOT_STATE, ch.ROBOT_PATH, ch.ROBOT_RELEASE)


@dataclass(frozen=True)
class Observation:
    """A message as the demonstration's operator receives it, at `now` (s)."""

    now: float
    channel: Channel
    ids: Ids
    message: Message


class ObservedBus(Bus):
    """Records what an operator would receive; with `strays` one ground truth has the robot in z1 after 6 m."""

    def __init__(self, site: str, *, strays: bool) -> None:
        super().__init__(site)
        self.observations: list[Observation] = []
        self._strays = strays
        for channel in OBSERVED:
            self._observe(channel)

    def _observe(self, channel: Channel) -> None:
        def record(ids: Ids, message: Message, at: Moment) -> list[Publication]:
            self.observations.append(Observation(at.now, channel, ids, message))
            return []

        self.subscribe({channel: record})

    def publish(self, publications: Iterable[Publication]) -> None:
        super().publish([self._changed(publication) for publication in publications])

    def _changed(self, publication: Publication) -> Publication:
        truth = publication.message
        if not self._strays or not isinstance(truth, SimTruth) or truth.distance < 6.0:
            return publication
        self._strays = False
        x, y = INSIDE_Z1
        return Publication(publication.channel, msgspec.structs.replace(truth, x=x, y=y), publication.ids)


class ReplayedEdge:
    """Hands the operator recorded messages; its simulator accepts every command."""

    def __init__(self) -> None:
        self.sim_commands: list[SimCommand] = []
        self._handlers: dict[Channel, Any] = {}

    def subscribe(self, channel: Channel, _kind: type[Message], handler: Any, **_ids: str) -> None:
        self._handlers[channel] = handler

    def receive(self, observation: Observation) -> None:
        self._handlers[observation.channel](observation.ids, observation.message)

    async def query(self, channel: Channel, request: Message, *_: Any, **_ids: str) -> CommandReply:
        assert channel is ch.SIM_COMMAND
        assert isinstance(request, SimCommand)
        self.sim_commands.append(request)
        return CommandReply(accepted=True, reason="")


def drive_in_lockstep(site: LoadedSite, *, strays: bool) -> tuple[LockstepResult, list[Observation]]:
    bus = ObservedBus(site.site.id, strays=strays)
    result = run_lockstep(site, ring.START, ring.GOAL, SEED, HazardRequest(), bus=bus)
    return result, bus.observations


async def evaluate_in_demo(
    site: LoadedSite, observations: list[Observation], started_at: float
) -> tuple[Attempt, ReplayedEdge]:
    """Let an attempt of the demonstration receive what was observed, without any process."""
    plan = DrivePlan.of(site, Options(seed=SEED))
    scene = Scene(site, plan.robot, SEED, 1.0)
    edge, clock = ReplayedEdge(), ManualClock()
    attempt = Attempt(plan, scene)
    operator = Operator(cast("ZenohEdge", edge), cast("Stack", SimpleNamespace(operator_key=b"")), scene, clock)
    placement = None
    for observation in observations:
        if placement is None and observation.now > started_at:
            clock.advance(started_at - clock.now())
            scene.goal = RobotGoal(goal_id="lockstep-1", pose=ring.START)
            placement = attempt.begin_drive(operator, clock)
        clock.advance(observation.now - clock.now())
        edge.receive(observation)
        if placement is None:
            continue
        await placement.place_if_due()
        assert attempt.drive is not None
        if (outcome := attempt.drive.outcome(clock.now())) is not None:
            attempt.end(outcome)
            break
    return attempt, edge


@pytest.mark.parametrize("strays", [False, True])
@pytest.mark.drive
async def test_demo_and_lockstep_evaluate_the_same_messages_alike(*, strays: bool) -> None:
    site: LoadedSite = ring.ring_site()
    result, observations = drive_in_lockstep(site, strays=strays)
    assert result.time_s is not None
    attempt, edge = await evaluate_in_demo(site, observations, round(observations[-1].now - result.time_s, 2))
    expected = {name: getattr(result, name) for name in DriveSummary.__struct_fields__}
    assert msgspec.structs.asdict(attempt.summary()) == expected
    assert (result.outcome, result.area, result.success, result.area_entered) == ("reached", "z1", not strays, strays)
    assert ("this is no success: it drove into the blocked area" in attempt.scene.events[-1][1]) is strays
    assert attempt.drive is not None
    assert round(attempt.drive.blocked_at_m or 0.0, 2) == result.hazard_at_m
    assert [obstacle.id for command in edge.sim_commands for obstacle in command.place] == ["barrier"]


@pytest.mark.drive
async def test_the_last_line_of_a_demo_without_a_hazard_says_so() -> None:
    site: LoadedSite = ring.ring_site()
    result, observations = drive_in_lockstep(site, strays=False)
    assert result.time_s is not None
    assert site.site.demo is not None
    nothing = msgspec.structs.replace(site.site.demo, areas=[])
    bare = replace(site, site=msgspec.structs.replace(site.site, demo=nothing))
    attempt, edge = await evaluate_in_demo(bare, observations, round(observations[-1].now - result.time_s, 2))
    assert attempt.summary().outcome == "reached"
    assert not edge.sim_commands
    assert attempt.scene.events[-1][1].endswith("site.toml lists no areas")
