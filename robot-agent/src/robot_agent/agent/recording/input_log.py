"""Log of the inputs of the agent's core, in order and with their exact times, and of its outputs.

`LoggedAgent` is an `AgentCore` that passes an entry to `write` before every input and after every output. A new core
that gets the same inputs gives the same outputs to the last bit (`replay`, beside this). An agent without a log is a
plain `AgentCore` and has no overhead. The module is long, because each input of the core has an entry, and what writes
it.

No secret enters the log: its configuration holds `LOG_KEY` in place of the operators' key, and commands that were
signed with theirs are signed anew with it.
"""

from __future__ import annotations

import hmac
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from fog_contracts import channels as ch
from fog_contracts.commands import sign
from fog_contracts.handlers import completed
from fog_contracts.messages import EgressRequest, LoopHealth, MapSnapshot, Mode, PlanReply, RobotCommand
from robot_agent.agent.core import AgentCore
from robot_agent.agent.hand_driving import HandRequest
from robot_agent.agent.navigation import PreparedMap
from robot_agent.config import AgentConfig
from robot_agent.guardian.link import BaseFeedback, WheelCommand
from robot_agent.hardware import LaserScan, LidarSamples
from robot_agent.localization.markers import Sighting
from robot_agent.localization.pose import AbsoluteObservation, Pose2, SavedPose
from robot_agent.motion.local_planner import Decision
from robot_agent.profiles import fog_only

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from fog_contracts.channels import Channel
    from fog_contracts.handlers import Handler, Ids, Moment, Publication, QueryHandler
    from fog_contracts.messages import Message
    from robot_agent.agent.hand_driving import HandReply
    from robot_agent.motion.local_planner import Job
    from robot_agent.profiles import FindProfile, Found, Search

LOG_KEY: Final = b"known to all: signs commands in logs only"
"""Replaces the operators' key in a log."""


class Entry(msgspec.Struct, frozen=True, kw_only=True):
    """One entry of the log. `now` is s of the robot's monotonic clock, `stamp` s since the epoch."""


class Input(Entry, frozen=True, kw_only=True):
    """An input of the core, written before the core handles it."""


class Output(Entry, frozen=True, kw_only=True):
    """An output of the core, caused by the input before it."""


class Started(Input, frozen=True, kw_only=True):
    """A new core; the first entry of every log."""

    config: AgentConfig
    seed: int


class PoseRestored(Input, frozen=True, kw_only=True):
    """A pose of an earlier run, or the site's start pose."""

    pose: SavedPose


class SnapshotLoaded(Input, frozen=True, kw_only=True):
    """A snapshot of the map, from the map-service or from disk."""

    snapshot: MapSnapshot
    now: float


class MessageReceived(Input, frozen=True, kw_only=True):
    """A message of a channel, by the channel's name."""

    channel: str
    ids: dict[str, str]
    message: Any
    now: float
    stamp: float


class QueryReceived(Input, frozen=True, kw_only=True):
    """A query, by its channel's name."""

    channel: str
    ids: dict[str, str]
    request: Any
    now: float
    stamp: float


class BaseReceived(Input, frozen=True, kw_only=True):
    """Feedback of the base, from the guardian."""

    feedback: BaseFeedback
    now: float


class BaseLost(Input, frozen=True, kw_only=True):
    """The link to the guardian broke."""

    reason: str
    now: float


class SuspensionNoticed(Input, frozen=True, kw_only=True):
    """The computer was suspended for `seconds`."""

    seconds: float


class PoseObserved(Input, frozen=True, kw_only=True):
    """A pose in `map` (x, y, theta) that was measured without the lidar, with its covariance by rows."""

    pose: tuple[float, float, float]
    covariance: tuple[float, ...]
    observed_at: float

    def observation(self) -> AbsoluteObservation:
        """Return the observation."""
        return AbsoluteObservation(Pose2(*self.pose), np.array(self.covariance).reshape(3, 3), self.observed_at)


class MarkerSighted(Input, frozen=True, kw_only=True):
    """A marker in a picture of the camera: its pose in frame `base` with its covariance by rows, and when it was seen.

    `now`: when the agent learned of it.
    """

    marker: int
    pose: tuple[float, float, float]
    covariance: tuple[float, ...]
    seen_at: float
    now: float

    def sighting(self) -> Sighting:
        """Return the sighting."""
        return Sighting(self.marker, Pose2(*self.pose), np.array(self.covariance).reshape(3, 3), self.seen_at)


class HandReceived(Input, frozen=True, kw_only=True):
    """The word of an operator at the robot, who drives it by hand."""

    request: HandRequest
    now: float


class LidarSamplesReceived(Input, frozen=True, kw_only=True):
    """Lidar samples arrived: their arrays as bytes, float32, little-endian, so that they come back exactly."""

    angles_rad: bytes
    ranges_m: bytes
    started_at: float
    ended_at: float
    now: float

    @classmethod
    def of(cls, samples: LidarSamples, now: float) -> LidarSamplesReceived:
        """Return the entry of samples that arrived at `now`."""
        return cls(
            angles_rad=np.asarray(samples.angles_rad, "<f4").tobytes(),
            ranges_m=np.asarray(samples.ranges_m, "<f4").tobytes(),
            started_at=float(samples.started_at),
            ended_at=float(samples.ended_at),
            now=now,
        )

    def samples(self) -> LidarSamples:
        """Return the samples."""
        return LidarSamples(
            angles_rad=np.frombuffer(self.angles_rad, "<f4"),
            ranges_m=np.frombuffer(self.ranges_m, "<f4"),
            started_at=self.started_at,
            ended_at=self.ended_at,
        )


class ScanReceived(Input, frozen=True, kw_only=True):
    """A whole scan: its arrays as bytes, float64, float64 and uint8, little-endian, so that they come back exactly.

    masked: a byte for each sample, 1 if it looks at the robot itself; empty: none does. Logs of releases before it lack
    it: they have no masked samples at all, so those that are left seem later or earlier than they were.
    """

    angles_rad: bytes
    ranges_m: bytes
    quality: bytes
    started_at: float
    ended_at: float
    repeats: int
    now: float
    masked: bytes = b""

    @classmethod
    def of(cls, scan: LaserScan, now: float) -> ScanReceived:
        """Return the entry of a scan that arrived at `now`."""
        return cls(
            angles_rad=np.asarray(scan.angles_rad, "<f8").tobytes(),
            ranges_m=np.asarray(scan.ranges_m, "<f8").tobytes(),
            quality=np.asarray(scan.quality, np.uint8).tobytes(),
            started_at=float(scan.started_at),
            ended_at=float(scan.ended_at),
            repeats=int(scan.repeats),
            now=now,
            masked=b"" if scan.masked is None else np.asarray(scan.masked, np.bool_).tobytes(),
        )

    def scan(self) -> LaserScan:
        """Return the scan."""
        return LaserScan(
            angles_rad=np.frombuffer(self.angles_rad, "<f8"),
            ranges_m=np.frombuffer(self.ranges_m, "<f8"),
            quality=np.frombuffer(self.quality, np.uint8),
            started_at=self.started_at,
            ended_at=self.ended_at,
            repeats=self.repeats,
            masked=np.frombuffer(self.masked, np.bool_) if self.masked else None,
        )


class EgressAsked(Input, frozen=True, kw_only=True):
    """The robot asked the planner for a way out of a blocked area: only a reply to what it asked counts."""

    now: float


class EgressReplied(Input, frozen=True, kw_only=True):
    """The planner's reply to the query for a way out of a blocked area; None when it did not answer."""

    request: EgressRequest
    reply: PlanReply | None
    now: float


class LoopHealthReceived(Input, frozen=True, kw_only=True):
    """How punctual the process's loops are."""

    health: LoopHealth


class SearchCycle(Input, frozen=True, kw_only=True):
    """The control loop asked for a search of a path, in profiles in which the robot plans for itself."""

    now: float


class SearchEnded(Input, frozen=True, kw_only=True):
    """The last search ended. What it found depends on it alone, so a replay searches again."""

    now: float
    stamp: float


class ControlCycle(Input, frozen=True, kw_only=True):
    """The control loop requested a job."""

    now: float


class DecisionMade(Input, frozen=True, kw_only=True):
    """The decision for the last job. It depends on that job alone, so a replay computes it again."""

    decision: Decision


class StreamCycle(Input, frozen=True, kw_only=True):
    """The stream loop requested a wheel command."""

    now: float
    stamp: float


class Tick(Input, frozen=True, kw_only=True):
    """The publish loop advanced time."""

    now: float
    stamp: float


class StorageCheck(Input, frozen=True, kw_only=True):
    """The housekeeping loop requested a pose to store."""

    now: float


class WheelsCommanded(Output, frozen=True, kw_only=True):
    """The wheel command, and the mode that allowed it."""

    command: WheelCommand
    mode: Mode


class Published(Output, frozen=True, kw_only=True):
    """A publication, by its channel's name."""

    channel: str
    ids: dict[str, str]
    message: Any


class Answered(Output, frozen=True, kw_only=True):
    """The answer to a query."""

    reply: Any


class PoseStored(Output, frozen=True, kw_only=True):
    """A pose to store."""

    pose: SavedPose


class EntriesLost(Entry, frozen=True, kw_only=True):
    """`count` entries are missing here because the disk was too slow. Nothing after them can be replayed."""

    count: int


_KINDS: Final[tuple[type[Entry], ...]] = (
    Started, PoseRestored, SnapshotLoaded, MessageReceived, QueryReceived, BaseReceived, BaseLost, SuspensionNoticed,
    PoseObserved, MarkerSighted, HandReceived, LidarSamplesReceived, ScanReceived, LoopHealthReceived, SearchCycle,
    SearchEnded, ControlCycle, DecisionMade, StreamCycle, Tick, StorageCheck, EgressAsked, EgressReplied,
    WheelsCommanded, Published, Answered, PoseStored, EntriesLost,
)  # fmt: skip
ENTRY_OF_TOPIC: Final[Mapping[str, type[Entry]]] = {f"agent/{kind.__name__}": kind for kind in _KINDS}
TOPIC_OF_ENTRY: Final[Mapping[type[Entry], str]] = {kind: topic for topic, kind in ENTRY_OF_TOPIC.items()}
"""Topic of the recording under which each type of entry is written."""


class LoggedAgent(AgentCore):
    """An `AgentCore` that passes all of its inputs and outputs to `write`, which must not block."""

    def __init__(
        self, config: AgentConfig, seed: int, write: Callable[[Entry], object], find_profile: FindProfile = fog_only
    ) -> None:
        self._write = write
        self._key = config.operator_key
        write(Started(config=replace(config, operator_key=LOG_KEY), seed=seed))
        super().__init__(config, seed, find_profile)

    def handlers(self) -> Mapping[Channel, Handler]:
        """Return the core's handlers, each of which logs its message and publications."""
        return {channel: partial(self._handle, channel, handler) for channel, handler in super().handlers().items()}

    def query_handlers(self) -> Mapping[Channel, QueryHandler]:
        """Return the core's query handlers, each of which logs its request and reply."""
        return {
            channel: partial(self._answer, channel, query_handler)
            for channel, query_handler in super().query_handlers().items()
        }

    def _handle(
        self, channel: Channel, handler: Handler, ids: Ids, message: Message, at: Moment
    ) -> Sequence[Publication]:
        self._write(MessageReceived(channel=channel.name, ids=dict(ids), message=message, now=at.now, stamp=at.stamp))
        return self._log_publications(handler(ids, message, at))

    def _answer(self, channel: Channel, query_handler: QueryHandler, ids: Ids, request: Any, at: Moment) -> Message:  # noqa: ANN401  # of the channel's type
        logged = self._re_signed(request) if channel is ch.ROBOT_COMMAND else request
        self._write(QueryReceived(channel=channel.name, ids=dict(ids), request=logged, now=at.now, stamp=at.stamp))
        reply = completed(query_handler(ids, request, at))
        self._write(Answered(reply=reply))
        return reply

    def _re_signed(self, command: RobotCommand) -> RobotCommand:
        """Return the command signed with `LOG_KEY` if it was signed with the operators' key, else without signature."""
        if hmac.compare_digest(sign(command, self._key).signature, command.signature):
            return sign(command, LOG_KEY)
        return msgspec.structs.replace(command, signature=b"")

    def load(self, map_: MapSnapshot | PreparedMap, now: float) -> None:
        """Log the snapshot and load it."""
        snapshot = map_.snapshot if isinstance(map_, PreparedMap) else map_
        self._write(SnapshotLoaded(snapshot=snapshot, now=now))
        super().load(map_, now)

    def restore(self, saved: SavedPose) -> None:
        """Log the pose and start at it."""
        self._write(PoseRestored(pose=saved))
        super().restore(saved)

    def on_base(self, feedback: BaseFeedback, now: float) -> None:
        """Log the feedback and handle it."""
        self._write(BaseReceived(feedback=feedback, now=now))
        super().on_base(feedback, now)

    def on_base_lost(self, now: float, reason: str) -> None:
        """Log that the link broke, and record it."""
        self._write(BaseLost(reason=reason, now=now))
        super().on_base_lost(now, reason)

    def on_suspension(self, seconds: float) -> None:
        """Log the suspension and record it."""
        self._write(SuspensionNoticed(seconds=seconds))
        super().on_suspension(seconds)

    def on_absolute_observation(self, observation: AbsoluteObservation) -> bool:
        """Log the observation and handle it."""
        pose = (observation.pose.x, observation.pose.y, observation.pose.theta)
        covariance = tuple(float(value) for value in observation.covariance.ravel())
        self._write(PoseObserved(pose=pose, covariance=covariance, observed_at=observation.stamp))
        return super().on_absolute_observation(observation)

    def on_sighting(self, sighting: Sighting, now: float) -> None:
        """Log the sighting and handle it."""
        covariance = tuple(float(value) for value in sighting.covariance.ravel())
        self._write(
            MarkerSighted(
                marker=sighting.marker, pose=sighting.pose, covariance=covariance, seen_at=sighting.stamp, now=now
            )
        )
        super().on_sighting(sighting, now)

    def on_hand(self, request: HandRequest, now: float) -> HandReply | None:
        """Log the word of an operator at the robot, and the reply, and handle it."""
        self._write(HandReceived(request=request, now=now))
        reply = super().on_hand(request, now)
        if reply is not None:
            self._write(Answered(reply=reply))
        return reply

    def on_lidar_samples(self, samples: LidarSamples, now: float) -> None:
        """Log the samples and handle them."""
        self._write(LidarSamplesReceived.of(samples, now))
        super().on_lidar_samples(samples, now)

    def on_scan(self, scan: LaserScan, now: float) -> None:
        """Log the scan and handle it."""
        self._write(ScanReceived.of(scan, now))
        super().on_scan(scan, now)

    def egress_request(self, now: float) -> EgressRequest | None:
        """Return the query for a way out that is due, and log that it was asked."""
        request = super().egress_request(now)
        if request is not None:
            self._write(EgressAsked(now=now))
        return request

    def on_egress_reply(self, request: EgressRequest, reply: PlanReply | None, now: float) -> None:
        """Log the reply and handle it."""
        self._write(EgressReplied(request=request, reply=reply, now=now))
        super().on_egress_reply(request, reply, now)

    def on_loop_health(self, health: LoopHealth) -> None:
        """Log the loops' health and record it."""
        self._write(LoopHealthReceived(health=health))
        super().on_loop_health(health)

    def search(self, now: float) -> Search | None:
        """Log the cycle, if the robot plans for itself, and return the search."""
        if self.profile.onboard:
            self._write(SearchCycle(now=now))
        return super().search(now)

    def on_found(self, found: Found, at: Moment) -> None:
        """Log the end of the search and handle what it found."""
        self._write(SearchEnded(now=at.now, stamp=at.stamp))
        super().on_found(found, at)

    def control_job(self, now: float) -> Job | None:
        """Log the control cycle and return its job."""
        self._write(ControlCycle(now=now))
        return super().control_job(now)

    def accept(self, decision: Decision) -> None:
        """Log the decision and drive by it."""
        self._write(DecisionMade(decision=decision))
        super().accept(decision)

    def stream(self, now: float, stamp: float) -> WheelCommand:
        """Log the stream cycle and its command."""
        self._write(StreamCycle(now=now, stamp=stamp))
        command = super().stream(now, stamp)
        self._write(WheelsCommanded(command=command, mode=self.safety.mode))
        return command

    def tick(self, at: Moment) -> Sequence[Publication]:
        """Log the tick and its publications."""
        self._write(Tick(now=at.now, stamp=at.stamp))
        return self._log_publications(super().tick(at))

    def pose_to_store(self, now: float) -> SavedPose | None:
        """Log the request, and the pose if there is one to store."""
        self._write(StorageCheck(now=now))
        pose = super().pose_to_store(now)
        if pose is not None:
            self._write(PoseStored(pose=pose))
        return pose

    def _log_publications(self, publications: Sequence[Publication]) -> Sequence[Publication]:
        for publication in publications:
            self._write(
                Published(channel=publication.channel.name, ids=dict(publication.ids), message=publication.message)
            )
        return publications
