"""The agent's decisions, without I/O; reading this file from the top explains the robot.

Values and times go in, values come out. `now` is the robot's own monotonic clock (s), by which every age is measured;
`stamp` is the wall clock (s) and only dates messages and traces. Whoever runs the core
- passes it every message of `handlers()`, every query of `query_handlers()`, and the input from base and lidar;
- calls `stream` 20 times a second, 10 times while `idle`, and sends the wheel command to the guardian; base and lidar
  need not be read before a call that `repeats`;
- runs `search(now).run()`, if there is a search, on any thread, and passes the result to `on_found`; then
  `decide(control_job(now))` of `motion.local_planner`, on any thread, and passes the decision to `accept`; every
  `profile.control_period`, unless the robot is `standing_by` and there was no job;
- calls `tick` 10 times a second and publishes what it returns;
- sends the query of `egress_request` to the planner, and passes the reply to `on_egress_reply`;
- lets the lidar's motor turn while `lidar_on`;
- stores `berth_to_store`, if there is one, and ends;
- requests a snapshot of the map while `wants_snapshot`, passes what `prepare_map` makes of it to
  `load`, and stores what `pose_to_store` returns.
"""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Final

from msgspec.structs import replace

from fog_contracts import channels as ch
from fog_contracts.follower import MapFollower
from fog_contracts.handlers import Fence
from fog_contracts.handover import next_berth
from fog_contracts.messages import SENTENCE_MAX, CommandReply, LoopHealth, Reason, ReasonCode, RefusalCode
from fog_contracts.replica import MapError
from robot_agent.agent.hand_driving import HandBack, HandReply, Steer, TakeOver, Watch
from robot_agent.agent.maneuvers import Maneuvers
from robot_agent.agent.motion_guard import MotionGuard
from robot_agent.agent.navigation import Navigation, PreparedMap, prepare_map
from robot_agent.agent.obstacle_reporter import WAY_M, ObstacleReporter
from robot_agent.agent.operator_commands import OperatorCommands, initial_pose_refusal
from robot_agent.agent.path_driving import PathDriving
from robot_agent.agent.pose_persistence import PosePersistence
from robot_agent.agent.power import IdleScans, RestPolicy
from robot_agent.agent.reports import PublishingPolicy, hindrances, robot_pose, robot_state
from robot_agent.agent.safety_supervisor import BaseSource, LidarSource, SafetySupervisor, safety_inputs
from robot_agent.localization.localizer import Localizer
from robot_agent.localization.odometry import EncoderFault, Odometry, possible_motion
from robot_agent.profiles import fog_only

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from fog_contracts.handlers import Handler, Ids, Moment, Publication, QueryHandler
    from fog_contracts.messages import (
        Berth,
        EgressRequest,
        HandOver,
        MapSnapshot,
        PlanReply,
        Pose,
        ProfileName,
        RobotCommand,
        RobotObstacles,
        RobotPose,
        RobotState,
        Trace,
    )
    from fog_contracts.replica import Replica
    from robot_agent.agent.hand_driving import HandRequest
    from robot_agent.config import AgentConfig
    from robot_agent.guardian.link import BaseFeedback, WheelCommand
    from robot_agent.hardware import LaserScan, LidarSamples
    from robot_agent.localization.markers import Sighting
    from robot_agent.localization.pose import AbsoluteObservation, SavedPose
    from robot_agent.motion.local_planner import Decision, Job
    from robot_agent.profiles import FindProfile, Found, Profile, Search
    from robot_agent.safety.conditions import Request
    from robot_agent.safety.gate import SafetyOutputs
    from robot_agent.safety.maneuver import ManeuverKind

POSSIBLE_WHILE_SUSPENDED: Final = (0.5, 0.5)
"""How far (m, rad) a robot is expected to be moved by others while its computer is suspended."""
RESUMES_S: Final = 60.0
"""How long a robot that was handed over enabled may take until it drives on by itself: then somebody has to look."""
STANDBY_S: Final = 0.14
"""A robot that stands by looks at its inputs at the first call after this time: at every second one. They age by 0.2 s
more at most, and it stands; the gate's limits begin at 0.3 s."""


class AgentCore:
    """One robot. All methods belong on one thread; `decide` and `prepare_map` may run on others."""

    def __init__(self, config: AgentConfig, seed: int = 0, find_profile: FindProfile = fog_only) -> None:
        self._config = config
        self._base = BaseSource(config.drive_train.travel_wrap_m)
        self._odometry = Odometry(config.drive_train)
        self._lidar = LidarSource(config.safety.returns_least)
        self._localizer = Localizer(config.localization, seed)
        self._pose_persistence = PosePersistence(self._localizer, config.drive_train)
        self._fence = Fence()
        self._map = MapFollower()
        self._driving = PathDriving(config)
        self._navigation = Navigation(config, self._map, self._driving, self._localizer, find_profile)
        self._guard = MotionGuard(config, self._localizer)
        self._maneuvers = Maneuvers(config, self._localizer, self._guard)
        self._safety = SafetySupervisor(config.safety)
        self._rest = RestPolicy(config.rest_after)
        self._idle_scans = IdleScans()
        self._reporter = ObstacleReporter(config.obstacle_ttl, config.obstacle_limit, config.radius)
        self._commands = OperatorCommands(config, self)
        self._publishing = PublishingPolicy(config.robot)
        self._berth = config.berth
        self._resumes_until = math.inf if config.resumes else -math.inf
        """After a ride the robot enables itself until then, if nobody has told it anything."""
        self._leaves = False
        self._loop_health = LoopHealth()
        self._looked_at = self._ticked_at = -math.inf
        """When `stream` last evaluated its inputs, and `tick` last looked for what to publish."""

    @property
    def robot(self) -> str:
        """The robot's id."""
        return self._config.robot

    # --- messages from the fog ---

    def handlers(self) -> Mapping[ch.Channel, Handler]:
        """Return the handlers of all subscribed channels; of channels with `{robot}` the robot's own only."""
        return self._fence.guarded(self._navigation.handlers())

    def query_handlers(self) -> Mapping[ch.Channel, QueryHandler]:
        """Return the handlers of all served queries."""
        return {ch.ROBOT_COMMAND: self._on_command}

    def _on_command(self, _ids: Ids, command: RobotCommand, at: Moment) -> CommandReply:
        self._looked_at = self._ticked_at = -math.inf  # what it changes shows at once
        self._resumes_until = -math.inf  # whoever tells it anything decides from then on
        if self._leaves:
            reason = "the robot starts again on another floor: tell it there"
            return CommandReply.refused(Reason(RefusalCode.OTHER_RUN, reason))
        return self._commands.answer(command, at)

    # --- the map ---

    def wants_snapshot(self, now: float) -> bool:
        """Return whether the replica of the map needs a snapshot from the map-service."""
        return self._navigation.wants_snapshot(now)

    def prepare_map(self, snapshot: MapSnapshot) -> PreparedMap:
        """Do what takes long when a snapshot is loaded, on any thread; raises `MapError` when it is invalid."""
        return prepare_map(snapshot, self._localizer)

    def load(self, map_: MapSnapshot | PreparedMap, now: float) -> None:
        """Load a snapshot, from the map-service or from disk, prepared or not; raises `MapError` when it is invalid."""
        prepared = map_ if isinstance(map_, PreparedMap) else self.prepare_map(map_)
        if not self._fence.reaches(ch.MAP, prepared.snapshot.epoch):
            raise MapError(f"the snapshot has epoch {prepared.snapshot.epoch}, which no {ch.MAP} can have yet")
        self._map.on_snapshot(prepared.decoded, now)
        self._fence.raise_to(ch.MAP, prepared.snapshot.epoch)
        self._pose_persistence.load_map(prepared.snapshot.site, prepared.fields)
        self._navigation.on_map_loaded(now)

    # --- base and lidar ---

    def on_base(self, feedback: BaseFeedback, now: float) -> None:
        """Handle feedback of the base."""
        slept = self._base.asleep
        self._base.on_feedback(feedback, now)
        if slept and not self._base.asleep:
            self._localizer.on_unmeasured_motion(*POSSIBLE_WHILE_SUSPENDED, "the base was asleep")
        if feedback.status.wheel_drop:
            self._localizer.markers.forget_support()  # somebody may carry it to a place that looks alike
        self._pose_persistence.on_base(feedback)
        motion = self._odometry.update(feedback.odometry, now)
        if isinstance(motion, EncoderFault):
            return
        self._localizer.on_odometry(now, motion.x, motion.y, motion.theta)
        if motion.skipped is not None:
            self._localizer.on_unmeasured_motion(*possible_motion(motion.skipped, self._config.drive_train))
        if (seen := self._maneuvers.docking.observation(self._base.docked_for(now), now)) is not None:
            self._localizer.on_absolute_observation(seen)

    def on_suspension(self, seconds: float) -> None:
        """Record that the computer was suspended: the robot may have been pushed or carried since."""
        self._localizer.on_unmeasured_motion(
            *POSSIBLE_WHILE_SUSPENDED, f"the computer was suspended for {seconds:.1f} s"
        )

    def on_absolute_observation(self, observation: AbsoluteObservation) -> bool:
        """Handle a pose that was measured without the lidar (dock); False when it is too old to be used."""
        return self._localizer.on_absolute_observation(observation)

    def on_sighting(self, sighting: Sighting, now: float) -> None:
        """Handle a marker that the camera has seen; `now` is when it is known."""
        self._localizer.on_sighting(sighting, now)

    def on_base_lost(self, now: float, reason: str) -> None:
        """Record that the link to the guardian broke."""
        del now
        self._base.on_lost(reason)

    def on_lidar_samples(self, samples: LidarSamples, now: float) -> None:
        """Handle the lidar's newest samples, which arrived at `now`."""
        self._lidar.on_samples(now)
        self._guard.on_samples(samples)

    def on_scan(self, scan: LaserScan, now: float) -> None:
        """Handle a whole scan that arrived at `now`.

        Repeated identical scans don't correct the pose, and an idle robot looks at every third one only.
        """
        self._lidar.on_scan(scan, now)
        self._rest.on_scan()
        if not self._idle_scans.counts(idle=self.idle, status=self._localizer.status):
            return
        if scan.repeats < self._config.safety.identical_scans:
            self._localizer.on_scan(scan, now)
            self._guard.on_scan(scan, self.replica)

    def on_loop_health(self, health: LoopHealth) -> None:
        """Record how punctual the process's loops are."""
        self._loop_health = health

    # --- driving ---

    def stream(self, now: float, stamp: float) -> WheelCommand:
        """Evaluate safety and return the wheel speeds to send now; call it 20 times a second, 10 times while `idle`."""
        if self.repeats(now):
            self._safety.pass_over(now)
            return self._rested(self._driving.wheels.repeat(now))
        self._looked_at = now
        goal_id = self._driving.mission.goal_id
        self._rest.update(busy=not self.idle, goal_id=goal_id, now=now, base_ready=self._base.ready)
        safety = self._evaluate_safety(now)
        self._resumes_until = min(self._resumes_until, now + RESUMES_S)
        waits = [reason.code for reason in self._safety.state.reasons] == [ReasonCode.NOT_ENABLED]
        if now < self._resumes_until and waits:
            safety = self._evaluate_safety(now, "enable")
            if safety.refusal is None:
                self._resumes_until = -math.inf
        if self._maneuvers.may_seek_dock(self._safety.state, self._base.feedback, self._driving, now):
            safety = self._evaluate_safety(now, "dock")
            self._maneuvers.docking.on_begun(safety.refusal, now)
        maneuver = self._maneuvers.command(self._safety.state, safety, self._driving, now)
        return self._rested(maneuver or self._driving.command(safety, self._guard.limit, now, stamp))

    def _rested(self, command: WheelCommand) -> WheelCommand:
        """Return the command, by which the base may sleep while the robot rests."""
        rest = self._config.rest_base and not self._rest.lidar_on
        return replace(command, rest=True) if rest else command

    def egress_request(self, now: float) -> EgressRequest | None:
        """Return the query for a way out of a blocked area that is due; pass its reply to `on_egress_reply`."""
        return self._maneuvers.egress.request(self._localizer.pose(now), self.safety, now)

    def on_egress_reply(self, request: EgressRequest, reply: PlanReply | None, now: float) -> None:
        """Handle the planner's reply to an `egress_request`; None when it did not answer."""
        self._maneuvers.egress.on_reply(request, reply, self._localizer.pose(now), now)

    def search(self, now: float) -> Search | None:
        """Return the search for a path that is due; None in the profile `fog`. Call it before each `control_job`."""
        return self._navigation.search(now)

    def on_found(self, found: Found, at: Moment) -> None:
        """Handle what a search found."""
        self._navigation.on_found(found, at)

    def control_job(self, now: float) -> Job | None:
        """Return the inputs of the next decision; None while there is no goal or the robot must not drive."""
        return self._driving.job(self._localizer, self.replica, self.safety, now)

    def accept(self, decision: Decision) -> None:
        """Drive by a decision; one for a path that is no longer followed is dropped."""
        self._driving.accept(decision)

    def _evaluate_safety(self, now: float, request: Request | None = None) -> SafetyOutputs:
        pose = self._localizer.pose(now)
        trusted = pose if self._localizer.status in {"good", "weak"} else None
        # On its dock the gate lets a mission begin what an operator may request there.
        leaves = self._driving.mission.active and self._base.docked_for(now) is not None
        asked: Request | None = "undock" if leaves and request in {None, "enable"} else request
        maneuver = self._maneuvers.inputs(self._safety.state, self.replica, trusted, now, asked)
        ahead = self._maneuvers.way_ahead(request, maneuver)
        inputs = safety_inputs(
            self._base,
            self._lidar,
            self._navigation,
            self._localizer,
            self._driving.mission,
            path_problem=self._driving.path_problem(self.replica, self._guard, self.safety, now),
            inside_blocked=self._navigation.inside_blocked(trusted, self._reporter, now) if trusted else None,
            inside_watched=trusted is not None and self._navigation.inside_watched(trusted),
            blocked_ahead=self._navigation.blocked_ahead(trusted, ahead, self._reporter, now) if trusted else None,
            near_blocked=self._navigation.near_blocked(trusted) if trusted else None,
            maneuver=maneuver,
            caution=self._navigation.caution(pose, now) if pose else None,
            resting=self._rest.reason,
            now=now,
        )
        outputs = self._safety.evaluate(inputs, now, request)
        if outputs.changed:
            self._ticked_at = -math.inf  # whoever watches a robot that stands by learns of it with the next tick
        self._driving.obey(outputs)
        return outputs

    # --- operators' commands: `OperatorCommands` calls these ---

    def request(self, request: Request, now: float) -> SafetyOutputs:
        """Pass an operator's request to the safety gate; the outputs carry its refusal."""
        self._rest.on_request(request)
        self._maneuvers.on_request(request, self._safety.state)
        outputs = self._evaluate_safety(now, request)
        if request == "reset" and outputs.refusal is None:
            self._driving.wheels.pass_reset()
        return outputs

    @property
    def by_hand(self) -> bool:
        """Whether somebody drives the robot by hand."""
        return self._makes("teleop")

    def _makes(self, kind: ManeuverKind) -> bool:
        maneuver = self._safety.state.maneuver
        return maneuver is not None and maneuver.kind == kind

    @property
    def _stands(self) -> bool:
        """Whether neither the agent turns the wheels nor the base itself, on its way into its dock."""
        return self._driving.wheels.at_rest and not self._makes("dock")

    def on_hand(self, request: HandRequest, now: float) -> HandReply | None:
        """Handle the word of an operator at the robot; the reply is None for one that steers or watches."""
        self._rest.wake()
        wanted: Request = "teleop" if isinstance(request, TakeOver) else "reset"
        match request:
            case Steer():
                self._maneuvers.hand.steer(request.v, request.w, now)
                return None
            case Watch():
                return None
            case HandBack():
                self._maneuvers.hand.end("the link to who drove it broke" if request.lost else "it was handed back")
                return HandReply(accepted=True, reason="the robot stands, and waits to be enabled")
        self._looked_at = self._ticked_at = self._resumes_until = -math.inf  # as for a command
        goes_on = wanted == "teleop" and self.by_hand
        refusal = None if goes_on else self.request(wanted, now).refusal
        if refusal is not None:
            return HandReply(
                accepted=False, reason=refusal[:SENTENCE_MAX], code=refusal.code, causes=list(refusal.causes)
            )
        if wanted == "teleop":
            self._maneuvers.hand.begin(now)
            return HandReply(accepted=True, reason="drive it by hand; watch it")
        return HandReply(accepted=True, reason="the fault is reset")

    def order_dock(self, now: float) -> Reason | None:
        """Let the robot go to its dock; return why it does not, None if it does."""
        self._rest.wake()
        docked = self._base.docked_for(now) is not None
        return self._maneuvers.docking.order(self._safety.state, self._driving.mission, docked=docked, now=now)

    def cancel_goal(self) -> str | None:
        """Cancel the goal, and the way into the dock; return what was cancelled, None if nothing was."""
        docks = self._maneuvers.docking.cancel(running=self._makes("dock"))
        goal = self._driving.cancel_goal()
        return "its way to its dock" if goal is None and docks else goal and f"the goal {goal}"

    def set_initial_pose(self, pose: Pose | None) -> Reason | None:
        """Start localization at a pose in `map`; return why the pose is refused, None when it is accepted."""
        refusal = initial_pose_refusal(pose, self.replica, at_rest=self._stands)
        if refusal is None and pose is not None:
            self._rest.wake()
            self._localizer.initial_pose(pose.x, pose.y, pose.theta)
        return refusal

    def hand_over(self, given: HandOver | None) -> Reason | None:
        """Leave this floor for another one; return why not, None when it is done, or was.

        Then `berth_to_store` has the new record: whoever runs the core stores it, and ends.
        """
        if self._berth is None or given is None:
            return Reason(RefusalCode.ONE_FLOOR, "this robot has no list of floors (FOGNAV_FLOORS_FILE)")
        if given.floor not in self._config.floors:
            known = ", ".join(self._config.floors)
            return Reason(RefusalCode.NO_FLOOR, f"this robot does not know {given.floor} (known: {known})")
        if not self._stands:
            return Reason(RefusalCode.DRIVING, "the robot is driving: it must stand where it leaves the floor")
        if self._safety.state.mode == "FAULT":
            return Reason(
                RefusalCode.FAULT_LATCHED, "the robot is in FAULT: somebody must look at it and reset it first"
            )
        after = next_berth(self._berth, given)
        if isinstance(after, Reason):
            return after
        self._berth = after
        return None

    @property
    def goes_on(self) -> bool:
        """Whether the robot may enable itself after a ride: it is enabled, and waits for no operator."""
        state = self._safety.state
        return state.enabled and state.maneuver is None and not state.awaits_operator

    def leave(self) -> None:
        """Take no command any more: this run ends, and what it accepted now the next one would not know."""
        self._leaves = True

    @property
    def berth_to_store(self) -> Berth | None:
        """The robot's record of its floor once it was handed over, which must be durable before it speaks there."""
        return self._berth if self._berth != self._config.berth else None

    def switch_profile(self, name: ProfileName) -> Reason | None:
        """Navigate by another profile; return why not, None when it is done."""
        self._rest.wake()
        return self._navigation.switch(name, at_rest=self._stands)

    # --- publications ---

    def tick(self, at: Moment) -> Sequence[Publication]:
        """Advance time, at least ten times a second; return what to publish now."""
        if at.now - self._ticked_at < STANDBY_S and self.standing_by:
            return ()
        self._ticked_at = at.now
        feedback = self._base.feedback
        # A wheel that has dropped: somebody may carry the robot.
        lifted = feedback is not None and feedback.status.wheel_drop
        self._pose_persistence.search(self.safety.mode, at.now, at_rest=self._driving.wheels.at_rest and not lifted)
        return self._publishing.due(
            partial(self.pose, at),
            self.state(at),
            partial(self._report_obstacles, at),
            at.now,
            barred=self._way_is_barred(at.now),
            standing=self.idle and self._localizer.status == "good" and self._localizer.twist() == (0.0, 0.0),
        )

    def _report_obstacles(self, at: Moment) -> RobotObstacles | None:
        if self.profile.onboard:
            return None  # such a robot keeps what it sees on its own costmap
        scan_age, impassable = self._lidar.scan_age(at.now), self._driving.impassable(at.now)
        way = self._driving.way(WAY_M)
        return self._reporter.report(self._localizer, self.replica, scan_age, at, impassable, way)

    def _way_is_barred(self, now: float) -> bool:
        """Look at the path ahead; return whether something on it must be reported at once."""
        if self.profile.onboard or not self._reporter.wants_look(now):
            return False
        return self._reporter.look(self._localizer, self.replica, self._lidar.scan_age(now), self._driving.way(WAY_M))

    def pose(self, at: Moment) -> RobotPose | None:
        """Return the pose; None while it is unknown."""
        return robot_pose(self._localizer, self._config, at)

    def state(self, at: Moment) -> RobotState:
        """Return mode, reasons, goal, path and map version as a message."""
        mission = self._driving.mission
        driven = mission if mission.active and self.safety.mission_may_drive else None
        state = robot_state(
            self._safety.state,
            mission,
            self.replica.version,
            self._base.feedback,
            hindrances=[
                *hindrances(driven, self._driving.wheels.decision, self._guard.reason),
                *self._localizer.markers.problems.values(),
            ],
            battery_low=self._config.battery_low,
            traces=self._driving.traces.recent,
            loop=self._loop_health,
            epochs=self._fence.epochs,
            boot=self._config.boot,
            profile=self.profile.name,
            docking=self._maneuvers.docking,
            hypotheses=self._localizer.hypotheses,
            at=at,
        )
        if self._berth is None:
            return state
        floors = list(self._config.floors)
        return replace(state, berth=self._config.berth, floors=floors, carries_missions=True)

    def finished_traces(self) -> list[Trace]:
        """Return the traces that were completed since the last call, each once: for histograms."""
        return self._driving.traces.take_finished()

    # --- restart ---

    def restore(self, saved: SavedPose) -> None:
        """Start at a stored pose as soon as the map of its site is loaded; the lidar verifies it."""
        self._pose_persistence.restore(saved, self.replica.site)

    def pose_to_store(self, now: float) -> SavedPose | None:
        """Return the pose if it is trusted and differs from the last one returned, so that it is worth a write."""
        return self._pose_persistence.to_store(self.replica.site, now)

    # --- read-only views ---

    @property
    def localizer(self) -> Localizer:
        """The pose estimator."""
        return self._localizer

    @property
    def idle(self) -> bool:
        """Whether the robot stands, and nothing is to be done: then half the calls of `stream` are enough."""
        return not (self._localizer.searching or self._driving.busy(self._safety.state, self.safety))

    @property
    def standing_by(self) -> bool:
        """Whether an idle robot knows where it is, and wants nothing: then it looks at its inputs 5 times a second."""
        if self._localizer.status != "good" or self._driving.mission.active or self.profile.onboard:
            return False
        return self.idle and self._safety.state.maneuver is None and not self._maneuvers.docking.ordered

    def repeats(self, now: float) -> bool:
        """Return whether `stream` at `now` would send the same command again without a look at any input."""
        return now - self._looked_at < STANDBY_S and self.standing_by

    @property
    def lidar_on(self) -> bool:
        """Whether the lidar has to run: not while the robot rests."""
        return self._rest.lidar_on

    @property
    def encoder_faults(self) -> int:
        """Number of encoder readings that no motion of the wheels explains."""
        return self._odometry.faults

    def map_age(self, now: float) -> float | None:
        """Return the time (s) since the map was last confirmed to be the newest; None before the first time."""
        age = self._navigation.age(now)
        return None if math.isinf(age) else age

    @property
    def replica(self) -> Replica:
        """The costmap that the robot drives by: the replica of the fog's, or its own."""
        return self._navigation.replica

    def way(self, limit: float) -> NDArray[np.float64]:
        """Return the path ahead, (n, 2) m in frame `map`, `limit` m of it; no points without one."""
        return self._driving.way(limit)

    @property
    def profile(self) -> Profile:
        """How the robot navigates; its control loop runs at the period that this says."""
        return self._navigation.profile

    @property
    def safety(self) -> SafetyOutputs:
        """The safety gate's last outputs."""
        return self._safety.outputs
