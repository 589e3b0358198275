"""A world that is just large enough to close the loop: a grid, a unicycle with encoders, a lidar by ray casting.

It feeds an `AgentCore` as its edge would: feedback at 22 Hz, lidar scans at 5.5 Hz whose beams are taken one after
another while the robot moves, decisions at 5 Hz, wheel commands at 20 Hz, at 10 Hz while it is idle. Everything runs on
emulated time.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field, replace

import numpy as np
from msgspec import structs

from fog_contracts import channels as ch
from fog_contracts.commands import sign
from fog_contracts.costs import Inflation
from fog_contracts.grid import GridGeometry, Window
from fog_contracts.handlers import Moment
from fog_contracts.messages import PlanReply, Pose, RobotCommand, RobotGoal, RobotPath, RobotRelease, RobotState, Trace
from fog_contracts.replica import MasterMap
from fog_kernels.inflation import inflate, inflation_table
from fog_kernels.raycast import cast
from robot_agent.agent.core import AgentCore
from robot_agent.config import AgentConfig, agent_config
from robot_agent.guardian.link import BaseFeedback
from robot_agent.hardware import (
    BaseStatus,
    DriveTrain,
    LaserScan,
    LidarSamples,
    LidarTraits,
    WheelOdometry,
)
from robot_agent.localization.pose import Pose2
from robot_agent.motion.local_planner import decide
from robot_agent.scan_builder import RepeatCounter

KEY = b"k" * 32
TICK_M = math.pi * 0.072 / 508.8
AXLE = 0.235
DRIVE_TRAIN = DriveTrain(axle_m=AXLE, wheel_speed_max_m_s=0.5, travel_wrap_m=65_536 * TICK_M)
DT = 0.01
BEAMS = 360
SCAN_S = 0.18
ANGLES = -(np.arange(BEAMS) + 0.5) * 2 * math.pi / BEAMS  # clockwise, as the real head rotates
WRAPPED = np.array([math.remainder(angle, 2 * math.pi) for angle in ANGLES])
LIDAR = LidarTraits(range_min_m=0.15, range_max_m=12.0, scan_period_s=SCAN_S)
AGENT = agent_config("r1", KEY, DRIVE_TRAIN, LIDAR, boot="b1")
START = 1_000.0
STAMP = 1_700_000_000.0


def grid_of(rooms, width_m, height_m, resolution=0.05):
    """Static map: occupied everywhere but in the given rectangles (left, bottom, right, top in m)."""
    geometry = GridGeometry(round(width_m / resolution), round(height_m / resolution), resolution, 0.0, 0.0)
    static = np.full(geometry.shape, 254, np.uint8)
    for left, bottom, right, top in rooms:
        rows = slice(round(bottom / resolution), round(top / resolution))
        static[rows, round(left / resolution) : round(right / resolution)] = 0
    return static, geometry


# An L of corridors with niches, so that no two places look alike.
L_ROOMS = [(1, 1, 13, 3), (11, 1, 13, 11), (3, 3, 4, 4.4), (6.5, 3, 8.5, 3.6), (9.6, 6, 11, 7.2), (13, 8.5, 13.8, 9.3)]
L_PATH = [(2.0, 2.0), (6.0, 2.0), (11.0, 2.0), (11.7, 2.3), (12.0, 3.0), (12.0, 6.0), (12.0, 10.0)]


@dataclass
class LittleWorld:
    rooms: list = field(default_factory=lambda: L_ROOMS)
    size: tuple = (15.0, 12.0)
    pose: tuple = (2.0, 2.0, 0.0)
    seed: int = 1
    lidar_noise: float = 0.01
    lidar_noise_share: float = 0.0  # of the range, besides
    start_agent: type = AgentCore
    resolution: float = 0.05
    glass: list = field(default_factory=list)  # rectangles whose walls return nothing
    wheel_error: float = 0.0  # by how much the encoders count too far, as a share
    wheel_noise: float = 0.0  # by how much (m) they are off after a metre at random, both alike
    config: AgentConfig = AGENT  # of the body and the lidar's place on it, too
    posts: list = field(default_factory=list)  # rectangles (left, bottom, right, top in m) that no map has
    guardian: str = ""  # id of its run

    def __post_init__(self):
        self.static, self.geometry = grid_of(self.rooms, *self.size, self.resolution)
        self.solid = (self.static == 254).astype(np.uint8)
        self.table = inflation_table(self.geometry.resolution, Inflation(cost_scaling=6.0))
        self.raw = self.static.copy()
        self.master = MasterMap("lab", self.geometry, self.static, inflate(self.raw, self.table), epoch=7)
        self.rng = np.random.default_rng(self.seed)
        self.agent = self.start_agent(self.config, self.seed)
        self.now = START
        self.steps = 0
        self.stream_steps = 5
        self.x, self.y, self.theta = self.pose
        self.wheels = (0.0, 0.0)
        self.ticks = [60_000.0, 10.0]
        self.beams = []
        self.scan_started = self.now
        self.lidar_on = self.heartbeats_on = self.base_on = True
        self.link_delay = self.link_delay_growth = 0.0  # of heartbeats: s, and s per s
        self.bumper = self.wheel_drop = self.docked = False
        self.fault = None
        self.bumped = False
        self.stopped = self.guardian_wrap = None
        self.resting = False
        self.path = None
        self.path_on = True
        self.goal = None
        self.collided = False
        self.travelled = 0.0
        self.commands = []
        self.nonce = 0
        self.repeats = RepeatCounter()
        self.frozen_scan = None
        self.decide_on = True
        self.way_out = []
        self.resets = 0
        self.restarts = 0
        self.published = []
        self.worst_error = (0.0, 0.0)

    @property
    def stamp(self):
        return STAMP + self.now - START

    @property
    def moment(self):
        return Moment(self.now, self.stamp)

    def send(self, channel, message):
        """Pass a message of the fog to the agent."""
        assert self.agent.handlers()[channel]({"robot": "r1"}, message, self.moment) == ()

    def ask(self, command):
        """Pass an operator's command to the agent as it is; return the reply."""
        return self.agent.query_handlers()[ch.ROBOT_COMMAND]({"robot": "r1"}, command, self.moment)

    def obstacles(self):
        """Run until the agent next reports obstacles; return the report."""
        self.published.clear()
        assert self.run(1.1, lambda w: w.published_on(ch.ROBOT_OBSTACLES)), "no report of obstacles within a second"
        return self.published_on(ch.ROBOT_OBSTACLES)[0]

    def published_on(self, channel):
        """Return what the agent has published on a channel."""
        return [publication.message for publication in self.published if publication.channel is channel]

    def command(self, kind, **more):
        self.nonce += 1
        unsigned = RobotCommand(
            kind=kind, robot="r1", operator="ann", nonce=f"nonce-{self.nonce:016d}", **self.run_and_clock, **more
        )
        return self.ask(sign(unsigned, KEY))

    @property
    def run_and_clock(self):
        """The fields of a command that come from the robot's latest state."""
        state = self.state()
        return {"boot": state.boot, "issued_at": state.clock}

    def ready(self):
        """Bring a new agent to NORMAL, as an operator would."""
        self.agent.load(self.master.snapshot(), self.now)
        self.run(0.6)
        reply = self.command("initial_pose", pose=Pose(x=self.x + 0.2, y=self.y - 0.15, theta=self.theta + 0.1))
        assert reply.accepted, reply
        self.run(3.0)
        reply = self.command("enable")
        assert reply.accepted, reply
        self.run(0.2)
        assert self.state().mode == "NORMAL", self.state().reasons
        return self

    def drive_to(self, points, goal_id="g1", plan_id=1, released=None, theta=None, traces=()):
        x, y = points[-1]
        self.goal = RobotGoal(goal_id=goal_id, pose=Pose(x=x, y=y, theta=theta or 0.0), planner_epoch=3)
        self.path = RobotPath(
            plan_id=plan_id,
            planner_epoch=3,
            goal_id=goal_id,
            points=points,
            map_epoch=self.master.version.epoch,
            map_seq=self.master.version.seq,
            released_length=1e3 if released is None else released,
            goal_theta=theta,
            traces=list(traces),
        )
        self.send(ch.ROBOT_GOAL, self.goal)
        self.send(ch.ROBOT_PATH, self.path)

    def block(self, left, bottom, right, top, *, solid=False, publish=True):
        """Make a rectangle lethal in the master costmap and, if solid, put an obstacle there."""
        g = self.geometry
        window = g.window_around(left, bottom, right - 1e-6, top - 1e-6)
        if solid:
            self.solid[window.rows, window.columns] = 1
        self.raw[window.rows, window.columns] = 254
        whole = Window(0, 0, g.width, g.height)
        deltas = self.master.write([("cost", whole, inflate(self.raw, self.table))], [], [])
        if publish:
            for delta in deltas:
                self.send(ch.MAP_DELTA, delta)
        return deltas

    def restart(self):
        """Kill the agent and start another one with the pose that it had saved."""
        saved = self.agent.pose_to_store(self.now)
        self.wheels = (0.0, 0.0)
        self.restarts += 1
        self.agent = self.start_agent(replace(self.config, boot=f"b{1 + self.restarts}"), self.seed + self.restarts)
        if saved is not None:
            self.agent.restore(saved)
        return saved

    def state(self) -> RobotState:
        return self.agent.state(self.moment)

    def error(self):
        pose = self.agent.pose(self.moment)
        return math.hypot(pose.x - self.x, pose.y - self.y), abs(math.remainder(pose.theta - self.theta, 2 * math.pi))

    def run(self, seconds, until=None):
        for _ in range(round(seconds / DT)):
            self._step()
            if until is not None and until(self):
                return True
        return until is None

    def _step(self):
        self.steps += 1
        self.now = START + self.steps * DT
        self._move()
        if self.base_on and self.steps % 4 == 0:
            left, right = ((int(t) & 0xFFFF) * TICK_M for t in self.ticks)
            self.agent.on_base(
                BaseFeedback(
                    seq=self.steps,
                    status=BaseStatus(
                        bumper_left=self.bumper,
                        wheel_drop=self.wheel_drop,
                        battery=0.8,
                        charging=self.docked,
                        docked=self.docked,
                    ),
                    odometry=WheelOdometry(left_m=left, right_m=right),
                    fault=self.fault,
                    bumped=self.bumped,
                    stopped=self.stopped,
                    travel_wrap_m=self.guardian_wrap,
                    guardian=self.guardian,
                ),
                self.now,
            )
        self._scan()
        if self.heartbeats_on and self.steps % 10 == 0:
            self.link_delay += 10 * DT * self.link_delay_growth
            self.send(ch.MAP_HEARTBEAT, self.master.heartbeat(self.stamp - self.link_delay))
        if self.path is not None and self.path_on and self.steps % 50 == 0:
            self._publish_as_planner()
        if self.decide_on and self.steps % round(self.agent.profile.control_period / DT) == 0:
            self._control()
        if self.steps % self.stream_steps == 0:
            command = self.agent.stream(self.now, self.stamp)
            self.stream_steps = 10 if self.agent.idle else 5
            self.resets += command.reset
            self.resting = command.rest
            if command.reset:
                self.fault = None
            self.wheels = (command.left, command.right) if self.base_on else (0.0, 0.0)
            self.commands.append((self.now, command.left, command.right))
            if self.agent.localizer.status == "good":
                self.worst_error = tuple(max(pair) for pair in zip(self.worst_error, self.error(), strict=True))
        if self.steps % 10 == 0:
            self.published.extend(self.agent.tick(self.moment))
            if (request := self.agent.egress_request(self.now)) is not None:
                self.agent.on_egress_reply(request, PlanReply(points=self.way_out), self.now)

    def _control(self):
        if (search := self.agent.search(self.now)) is not None:
            self.agent.on_found(search.run(), self.moment)
        if (job := self.agent.control_job(self.now)) is not None:
            self.agent.accept(decide(job))

    def _publish_as_planner(self):
        """Publish goal and release, and the path while the robot does not name it; end a goal that it has reached."""
        if self.state().goal_reached:
            self.goal, self.path = structs.replace(self.goal, pose=None), None
        self.send(ch.ROBOT_GOAL, self.goal)
        if self.path is None:
            return
        if (self.state().planner_epoch, self.state().plan_id) != (self.path.planner_epoch, self.path.plan_id):
            self.send(ch.ROBOT_PATH, self.path)
        self.send(ch.ROBOT_RELEASE, release_of(self.path))

    def _move(self):
        left, right = self.wheels
        v, w = (left + right) / 2, (right - left) / AXLE
        self.theta += 0.5 * w * DT
        nx, ny = self.x + v * DT * math.cos(self.theta), self.y + v * DT * math.sin(self.theta)
        self.theta += 0.5 * w * DT
        g = self.geometry
        near = g.window_around(nx - 0.2, ny - 0.2, nx + 0.2, ny + 0.2)
        solid = self.solid[near.rows, near.columns]
        if solid.any():
            rows, columns = np.nonzero(solid)
            xs = g.origin_x + (columns + near.x + 0.5) * g.resolution
            ys = g.origin_y + (rows + near.y + 0.5) * g.resolution
            if np.hypot(xs - nx, ys - ny).min() < 0.16:
                self.collided = True
                return
        for corner in itertools.chain.from_iterable(map(_outline, self.posts)):
            at = Pose2(nx, ny, self.theta).inverse_transform(np.array([corner]))[0]
            if self.config.footprint.outside_by(*at) < 0.0:
                self.collided = True
                return
        moved = math.hypot(nx - self.x, ny - self.y)
        self.travelled += moved
        self.x, self.y = nx, ny
        slip = self.wheel_noise * math.sqrt(moved) * self.rng.standard_normal() if self.wheel_noise else 0.0
        for wheel, speed in enumerate((left, right)):
            counted = speed * DT * (1 + self.wheel_error + 0.02 * self.rng.standard_normal())
            self.ticks[wheel] += (counted + slip) / TICK_M

    def _scan(self):
        """Cast the beams that the head measures during this step."""
        if not self.lidar_on:
            self.beams = []
            self.scan_started = self.now
            return
        share = (self.now - self.scan_started) / SCAN_S
        due = min(BEAMS, round(share * BEAMS))
        new = slice(len(self.beams), due)
        if due > len(self.beams):
            angles = ANGLES[new]
            g, lidar = self.geometry, self.config.localization
            x, y = Pose2(self.x, self.y, self.theta).transform(np.array([(lidar.lidar_x, lidar.lidar_y)]))[0]
            ranges = cast(self.solid, g.resolution, g.origin_x, g.origin_y, x, y, angles + self.theta, 12.0)
            for post in self.posts:
                ranges = np.fmin(ranges, _ranges_of(post, x, y, angles + self.theta))
            ranges[~np.isfinite(ranges)] = math.nan
            for left, bottom, right, top in self.glass:
                ends = x + ranges * np.cos(angles + self.theta), y + ranges * np.sin(angles + self.theta)
                ranges[(ends[0] > left) & (ends[0] < right) & (ends[1] > bottom) & (ends[1] < top)] = math.nan
            ranges += (self.lidar_noise + self.lidar_noise_share * ranges) * self.rng.standard_normal(len(ranges))
            ranges[self.rng.random(len(ranges)) < 0.02] = math.nan
            ranges[ranges < lidar.range_min] = math.nan
            self.beams.extend(ranges.tolist())
            samples = LidarSamples(
                angles_rad=WRAPPED[new].astype(np.float32),
                ranges_m=ranges.astype(np.float32),
                started_at=self.now - DT,
                ended_at=self.now,
            )
            self.agent.on_lidar_samples(samples, self.now)
        if len(self.beams) == BEAMS:
            data = self.frozen_scan if self.frozen_scan is not None else np.column_stack((ANGLES, self.beams))
            scan = LaserScan(
                angles_rad=WRAPPED.copy(),
                ranges_m=data[:, 1].copy(),
                quality=np.full(BEAMS, 40, np.uint8),
                started_at=self.scan_started,
                ended_at=self.now,
                repeats=self.repeats.count(np.round(data, 4)),
            )
            self.agent.on_scan(scan, self.now)
            self.beams = []
            self.scan_started = self.now


def _ranges_of(post, x, y, directions):
    """Return the range (m) of each ray from (x, y) to a rectangle, infinite beside it (the method of slabs)."""
    left, bottom, right, top = post
    with np.errstate(divide="ignore"):
        across = np.sort([(left - x) / np.cos(directions), (right - x) / np.cos(directions)], axis=0)
        along = np.sort([(bottom - y) / np.sin(directions), (top - y) / np.sin(directions)], axis=0)
    enters, leaves = np.maximum(across[0], along[0]), np.minimum(across[1], along[1])
    return np.where((enters <= leaves) & (enters > 0.0), enters, np.inf)


def _outline(post, step=0.01):
    """Return points (m) on the sides of a rectangle, a centimetre apart."""
    left, bottom, right, top = post
    xs, ys = (np.linspace(low, high, round((high - low) / step) + 1) for low, high in ((left, right), (bottom, top)))
    return [(x, y) for x in xs for y in (bottom, top)] + [(x, y) for y in ys for x in (left, right)]


def release_of(path, **changes):
    """Return the release of a path as it is, with some changes."""
    fields = {name: getattr(path, name) for name in RobotRelease.__struct_fields__}
    return RobotRelease(**fields | changes)


def trace(area="z4"):
    return Trace(area=area, epoch=1, seq=1, first_reading=STAMP, confirmed=STAMP + 0.5)
