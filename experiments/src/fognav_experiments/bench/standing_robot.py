"""A stand-in for a robot with a goal: it stands still, says where and which path it has, and notes each that comes."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final, NamedTuple

from fog_contracts import channels as ch
from fog_contracts.codec import decode, encode
from fog_contracts.messages import RobotPath, RobotPose, RobotState
from fog_runtime.clock import SystemClock, ticker
from fognav_experiments.bench.running import in_background

if TYPE_CHECKING:
    from contextlib import AbstractAsyncContextManager

    import zenoh

    from fog_contracts.messages import Pose

_RADIUS_M: Final = 0.17
_HEIGHT_M: Final = 0.1
"""Lower than any sensor of a site: it is no hazard itself."""


class Arrived(NamedTuple):
    """A path, and when it arrived (s of this machine's clock)."""

    at: float
    path: RobotPath


class StandingRobot:
    """A robot that stands at its pose."""

    def __init__(self, session: zenoh.Session, site: str, id: str, pose: Pose) -> None:  # noqa: A002  # the robot's
        self.id = id
        self.paths: list[Arrived] = []
        """Paths and refusals since the last `forget`, oldest first, each plan once."""
        self._latest: RobotPath | None = None
        self._session, self._pose = session, pose
        self._keys = {row: row.key(site=site, robot=id) for row in (ch.ROBOT_POSE, ch.ROBOT_STATE)}
        self._clock = SystemClock()
        session.declare_subscriber(ch.ROBOT_PATH.key(site=site, robot=id), self._on_path)

    def _on_path(self, sample: zenoh.Sample) -> None:
        """Note a path; it is called on another thread."""
        now = time.time()
        path, before = decode(ch.ROBOT_PATH, sample.payload.to_bytes(), RobotPath), self._latest
        if before is None or (path.planner_epoch, path.plan_id) != (before.planner_epoch, before.plan_id):
            self._latest = path
            self.paths.append(Arrived(now, path))

    def forget(self) -> None:
        """Forget the paths so far."""
        self.paths = []

    def publishing(self) -> AbstractAsyncContextManager[None]:
        """Publish pose and state meanwhile."""
        return in_background(self._publish(), "robot")

    async def _publish(self) -> None:
        x, y, theta = self._pose.x, self._pose.y, self._pose.theta
        async for _ in ticker(self._clock, ch.ROBOT_POSE.period_s):
            stamp = self._clock.stamp()
            pose = RobotPose(
                x=x, y=y, theta=theta, covariance=[0.0] * 9, v=0.0, w=0.0, radius=_RADIUS_M, height=_HEIGHT_M,
                stamp=stamp,
            )  # fmt: skip
            self._session.put(self._keys[ch.ROBOT_POSE], encode(ch.ROBOT_POSE, pose))
            if (path := self._latest) is not None:
                state = RobotState(
                    mode="NORMAL", reasons=[], enabled=True, battery=None, goal_id=path.goal_id,
                    map_epoch=path.map_epoch, map_seq=path.map_seq, plan_id=path.plan_id,
                    planner_epoch=path.planner_epoch, stamp=stamp,
                )  # fmt: skip
                self._session.put(self._keys[ch.ROBOT_STATE], encode(ch.ROBOT_STATE, state))
