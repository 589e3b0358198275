"""What one reading of a node means: whether it is news, plausible, or an echo of a robot. Pure; time is an argument."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

from msgspec import structs

from fog_contracts.channels import NODE_READING
from fog_contracts.cones import SONAR_HALF_CONE
from fog_contracts.costs import ROBOT_RADIUS
from fog_contracts.liveness import DelayEstimator
from fog_contracts.messages import CircleShape, NodeCode, Pose, Reason, RobotPose
from fog_contracts.site import RobotSite
from hazard_aggregator.debounce import Observation, SonarSample

if TYPE_CHECKING:
    from collections.abc import Container, Iterable, Iterator

    from fog_contracts.messages import AreaState, NodeReading, Reported
    from fog_contracts.site import NodeSite, Sonar

USABLE_S: Final = 3.0
"""A pose says where its robot is for so long; one that does not hear the fog for so long stands (its safety gate)."""
HISTORY_S: Final = 10.0
"""So long poses are remembered: they may explain echoes that were there before them."""
UNHEARD_S: Final = 600.0
"""So long the last pose of a robot is remembered that is not heard any more."""
SPEED_M_S: Final = 0.3
MAX_SPEED_M_S: Final = 0.5
"""A robot may have begun to drive at the first speed since its pose; none drives faster than the second."""
_POSES: Final = 200
REPORTED_RADIUS_MAX: Final = 1.0
"""No robot of others explains an echo farther (m) from its centre."""
_ANY_ROBOT: Final = RobotSite(id="any", start=Pose(x=0.0, y=0.0, theta=0.0), radius=ROBOT_RADIUS)


class Whereabouts(NamedTuple):
    """Where a robot was at some time: no further than `away` (m) from the position of `pose`."""

    robot: str
    pose: RobotPose
    away: float


class _Track:
    """The poses of one robot, each with the time (s, the receiver's clock) that it is of."""

    def __init__(self) -> None:
        self.poses: deque[tuple[float, RobotPose]] = deque(maxlen=_POSES)
        self._delay = DelayEstimator()
        self._clock = -math.inf

    def add(self, pose: RobotPose, now: float) -> None:
        if pose.clock < self._clock:
            self._delay = DelayEstimator()  # its computer was started again
        self._clock = pose.clock
        # One that does not tell its clock counts as timely.
        taken_at = now - self._delay.update(pose.clock, now) if pose.clock > 0.0 else now
        if not self.poses or taken_at >= self.poses[-1][0]:
            self.poses.append((taken_at, pose))


class RobotPoses:
    """The latest poses of all robots; `robots` are those of the site, any other has a body as they have by default.

    Poses arrive late over Wi-Fi, and an echo does not: a pose counts from when it was estimated, by the robot's own
    clock, and a robot may have moved since. Its body is that of the site, whatever it says of itself.
    """

    def __init__(self, robots: Iterable[RobotSite] = ()) -> None:
        self._robots = {robot.id: robot for robot in robots}
        self._tracks: dict[str, _Track] = {}

    def add(self, robot: str, pose: RobotPose, now: float) -> None:
        """Record a robot's pose that arrives `now`."""
        body = self._robots.get(robot, _ANY_ROBOT)
        self._tracks.setdefault(robot, _Track()).add(structs.replace(pose, radius=body.radius, height=body.height), now)

    def add_reported(self, thing: str, told: Reported, now: float) -> None:
        """Record where a robot of others is; its body is what is reported, and it is none of the site's."""
        if told.kind != "robot" or not isinstance(told.shape, CircleShape) or thing in self._robots:
            return
        x, y = told.shape.centre
        pose = RobotPose(
            x=x, y=y, theta=told.theta, v=told.v, w=0.0, covariance=[0.0] * 9, stamp=0.0, height=told.height,
            radius=min(told.shape.radius, REPORTED_RADIUS_MAX),
        )  # fmt: skip
        self._tracks.setdefault(thing, _Track()).add(pose, now)

    def at(self, taken_at: float, *, settled: bool = False) -> Iterator[Whereabouts]:
        """Yield where the robots were at a time, of those that were localized; if `settled`, of those with later poses.

        A robot's first pose does not tell where it was before.
        """
        for robot, track in self._tracks.items():
            before = next((entry for entry in reversed(track.poses) if entry[0] <= taken_at), None)
            after = next((entry for entry in track.poses if entry[0] > taken_at), None)
            if before is None or (settled and after is None):
                continue
            if min(abs(entry[0] - taken_at) for entry in (before, after) if entry is not None) > USABLE_S:
                if not settled or after is None:
                    continue
                known = Whereabouts(robot, after[1], 0.0)  # without the fog it stood where it is heard again
            else:
                known = _ahead(robot, before, taken_at) if after is None else _between(robot, before, after, taken_at)
            if known.pose.localized:
                yield known

    def forget_old(self, now: float) -> None:
        """Discard poses that explain nothing any more; the last one before a silence does."""
        for track in self._tracks.values():
            while len(track.poses) > 1 and now - track.poses[1][0] > HISTORY_S:
                track.poses.popleft()
        self._tracks = {robot: track for robot, track in self._tracks.items() if now - track.poses[-1][0] <= UNHEARD_S}


def _between(
    robot: str, before: tuple[float, RobotPose], after: tuple[float, RobotPose], taken_at: float
) -> Whereabouts:
    """Return where a robot was between two of its poses."""
    (began, first), (ended, second) = before, after
    share = (taken_at - began) / (ended - began)
    x, y = (1.0 - share) * first.x + share * second.x, (1.0 - share) * first.y + share * second.y
    nearest = first if share < 0.5 else second  # half-way
    away = min(share, 1.0 - share) * (ended - began) * SPEED_M_S
    return Whereabouts(robot, structs.replace(nearest, x=x, y=y), away)


def _ahead(robot: str, before: tuple[float, RobotPose], taken_at: float) -> Whereabouts:
    """Return where a robot is after its latest pose: half-way between where it was and where it drives to."""
    pose, seconds = before[1], taken_at - before[0]
    v = min(max(pose.v, -MAX_SPEED_M_S), MAX_SPEED_M_S)
    x, y = pose.x + 0.5 * v * seconds * math.cos(pose.theta), pose.y + 0.5 * v * seconds * math.sin(pose.theta)
    return Whereabouts(robot, structs.replace(pose, x=x, y=y), 0.5 * max(abs(v), SPEED_M_S) * seconds)


Rejection = Literal["duplicate", "outdated", "earlier_boot", "late", "too_soon", "implausible"]
"""Why a reading does not count."""

SILENT_S: Final = NODE_READING.max_age_s
"""A reading older than this does not count."""
FORGOTTEN_S: Final = 30.0
"""After so long a silence an earlier boot, or an older seq, is a node that repeats its numbers, and no late reading."""
MIN_PERIOD_S: Final = 0.04
"""Readings closer together are one: a node's are 45 ms apart at the least (the firmware's `kShortestUs`)."""
STEADY_S: Final = 15.0
"""A node's clock is not ours: its oscillator may be poor, or a host's NTP slews it, by up to 0.0833 s each second."""
_BOOTS: Final = 8
_SEQ_RANGE: Final = 2**32


class Taken(NamedTuple):
    """A reading that is news: when it was taken (s, the receiver's clock), and whether as a measurement of its own."""

    at: float
    counts: bool


class ReadingOrder:
    """Boot, seq and uptime of a node's latest reading.

    Messages are delayed, repeated and reordered, and a broker that was frozen delivers all that it has queued at once.
    A reading is placed by its node's boot, seq and uptime: its age is that of the measurement, not of its arrival.
    """

    def __init__(self) -> None:
        self._boots: deque[int] = deque(maxlen=_BOOTS)
        self._seq = -1
        self._uptime_s = 0.0
        self._counted_uptime_s: float | None = None
        self._delay = DelayEstimator(STEADY_S)
        self._accepted_at: float | None = None

    def place(self, reading: NodeReading, now: float) -> Taken | Rejection:
        """Return when a reading was taken that arrives `now` (s), or why it is no news.

        Boots are random numbers: one that was never heard is new. An earlier boot, or an older seq of the same boot, is
        accepted only once the node has been silent for 30 s: its clock would begin anew, and what the network held back
        for long would count as fresh. A seq has 32 bits and may wrap.
        """
        forgotten = self._accepted_at is None or now - self._accepted_at > FORGOTTEN_S
        same_boot = bool(self._boots) and self._boots[-1] == reading.boot
        if not forgotten and (problem := self._problem(reading, same_boot=same_boot)) is not None:
            return problem
        uptime_s = reading.uptime_ms / 1000
        if not same_boot or uptime_s < self._uptime_s:  # uptime begins anew, or its 32 bits have wrapped
            self._delay, self._counted_uptime_s = DelayEstimator(STEADY_S), None
        delay = self._delay.update(uptime_s, now)
        if delay > SILENT_S:
            return "late"
        if not same_boot:
            self._boots.append(reading.boot)
        self._seq, self._uptime_s, self._accepted_at = reading.seq, uptime_s, now
        counts = self._counted_uptime_s is None or uptime_s - self._counted_uptime_s >= MIN_PERIOD_S
        if counts:
            self._counted_uptime_s = uptime_s
        return Taken(now - delay, counts)

    def _problem(self, reading: NodeReading, *, same_boot: bool) -> Rejection | None:
        if not same_boot:
            return "earlier_boot" if reading.boot in self._boots else None
        ahead = (reading.seq - self._seq) % _SEQ_RANGE
        if ahead == 0:
            return "duplicate"
        return "outdated" if ahead >= _SEQ_RANGE // 2 else None


EXPLAIN_TOLERANCE: Final = 0.3
"""How far (m) a measured range may differ from the expected range of a robot's rim to be explained by that robot."""
POSE_SIGMAS: Final = 2.0
MAX_POSE_MARGIN: Final = 0.3
"""The margin for a robot's pose error across the beam: so many standard deviations, and at most so far (m)."""
MIN_RANGE: Final = 0.02
"""Below this range (m) an HC-SR04 measures its own ringing (datasheet: 2 cm to 4 m)."""
LIMIT_TOLERANCE: Final = 0.01
"""A range this close (m) to the limit may be classified either way: node and aggregator round differently."""
_SILENT: Final = Reason(NodeCode.NO_ECHO, "no sonar of the node hears anything, as if they were dead or covered")
NODE_HYSTERESIS: Final = 0.05
"""A node that is blocked stays so until its echo is this far (m) beyond the limit (the firmware's `kHysteresisMm`)."""


_Classified = tuple["AreaState", Reason]
"""What one sonar shows, and why."""


class Classification(NamedTuple):
    """The state that a reading shows, and why; `explained_by` is the robot that causes all of its blocking echoes."""

    state: AreaState
    reason: Reason
    explained_by: str | None = None
    sonars: tuple[SonarSample, ...] = ()

    @property
    def observation(self) -> Observation:
        """What a debounce rule sees of the reading."""
        return Observation(self.state, self.sonars)


def classify_sonar(sonar: Sonar, status: str, measured: float | None, shift: float = 0.0) -> _Classified:
    """Return what one sonar shows: an echo nearer than its limit is `blocked`, an implausible value `unknown`.

    `shift` (m) moves the limit, for readings that are within rounding of it.
    """
    if status == "stuck":
        return "unknown", Reason(NodeCode.ECHO_STUCK, "the echo line is stuck")
    if status == "no_echo":
        return _classify_no_echo(sonar, measured)
    if measured is None:
        return "unknown", Reason(NodeCode.IMPLAUSIBLE, "it reports an echo without a range")
    return _classify_echo(sonar, measured, shift)


def _classify_echo(sonar: Sonar, measured: float, shift: float) -> _Classified:
    if measured < MIN_RANGE:
        near = f"{measured:.3f} m is nearer than a sonar can measure"
        return "unknown", Reason(NodeCode.IMPLAUSIBLE, near)
    if measured < sonar.range_limit + shift:
        near = f"something at {measured:.2f} m, nearer than {sonar.range_limit:.2f} m"
        return "blocked", Reason(NodeCode.SOMETHING_NEAR, near)
    if sonar.range_max is not None and measured > sonar.range_max:
        far = f"an echo from {measured:.2f} m: the free area gives none from beyond {sonar.range_max:.2f} m"
        return "unknown", Reason(NodeCode.IMPLAUSIBLE, far)
    return "clear", Reason(NodeCode.NOTHING_NEAR, f"nothing nearer than {sonar.range_limit:.2f} m")


def _classify_no_echo(sonar: Sonar, measured: float | None) -> _Classified:
    if measured is not None:
        return "unknown", Reason(NodeCode.IMPLAUSIBLE, f"it reports no echo and yet a range of {measured:.2f} m")
    if sonar.no_echo_is_clear:
        return "clear", Reason(NodeCode.NOTHING_NEAR, "no echo, as calibrated")
    return "unknown", Reason(NodeCode.NO_ECHO, "no echo where the opposite wall should echo")


def expected_range(site: NodeSite, sonar: Sonar, pose: RobotPose, away: float = 0.0) -> float | None:
    """Return the range (m) at which this sonar should measure the robot's rim, or None when it is outside the cone.

    The footprint is a circle; it is in the cone when any part of it may be within half the beam's width of the axis,
    given the uncertainty of its pose across the beam: along a bare corridor that can be decimetres; and given how far
    `away` (m) from it the robot may be. A robot that is lower than the cone, which opens downwards, too, is not seen.
    """
    dx, dy = pose.x - site.x, pose.y - site.y
    distance = math.hypot(dx, dy)
    if site.height - (distance + away) * math.tan(SONAR_HALF_CONE) >= pose.height:
        return None
    if distance <= pose.radius:
        return 0.0
    off_axis = abs(math.remainder(math.atan2(dy, dx) - site.theta - sonar.angle, math.tau))
    reach = pose.radius + away + _pose_margin(pose, -dy / distance, dx / distance)
    if off_axis - math.asin(min(1.0, reach / distance)) > SONAR_HALF_CONE:
        return None
    return distance - pose.radius


def _pose_margin(pose: RobotPose, nx: float, ny: float) -> float:
    """Return how far (m) the robot may be from its pose in the direction of the unit vector (nx, ny)."""
    xx, xy, yx, yy = pose.covariance[0], pose.covariance[1], pose.covariance[3], pose.covariance[4]
    variance = nx * nx * xx + nx * ny * (xy + yx) + ny * ny * yy
    return min(MAX_POSE_MARGIN, POSE_SIGMAS * math.sqrt(max(0.0, variance)))


def explaining_robot(site: NodeSite, sonar: Sonar, measured: float, robots: Iterable[Whereabouts]) -> str | None:
    """Return the robot in the sonar's cone whose rim may be within 0.3 m of the measured range, or None."""
    for robot, pose, away in robots:
        expected = expected_range(site, sonar, pose, away)
        if expected is not None and abs(expected - measured) <= EXPLAIN_TOLERANCE + away:
            return robot
    return None


def classify_reading(site: NodeSite, reading: NodeReading, robots: Iterable[Whereabouts]) -> Classification:
    """Return what a reading shows about the area.

    The sonars are fused as the node does it: blocked if one is, clear if all are, unknown otherwise. A reading whose
    reported state contradicts its ranges is unknown. A reading counts neither way if robots explain all of its
    blocking echoes.
    """
    if len(reading.range_m) != len(site.sonars):
        differ = f"it reports {len(reading.range_m)} sonars, the site has {len(site.sonars)}"
        return Classification("unknown", Reason(NodeCode.SONARS_DIFFER, differ))
    classified, fused = _fuse(site, reading, 0.0)
    if fused != reading.state:
        for shift in (LIMIT_TOLERANCE, -LIMIT_TOLERANCE, NODE_HYSTERESIS + LIMIT_TOLERANCE):
            other, other_fused = _fuse(site, reading, shift)
            if other_fused == reading.state:
                classified, fused = other, other_fused
                break
        else:
            return _contradiction(reading, classified, fused)
    if fused == "blocked":
        return _classify_blocked(site, reading, classified, list(robots))
    index = next(i for i, (state, _) in enumerate(classified) if state == fused)
    return Classification(fused, _of_sonar(index, classified), sonars=_samples(site, reading, classified))


def _classify_blocked(
    site: NodeSite, reading: NodeReading, classified: list[_Classified], known: list[Whereabouts]
) -> Classification:
    """Return what a reading with blocking echoes shows: it is explained if robots explain all of them."""
    blocking = [i for i, (state, _) in enumerate(classified) if state == "blocked"]
    robots = {i: explaining_robot(site, site.sonars[i], reading.range_m[i] or 0.0, known) for i in blocking}
    explained = {i for i, robot in robots.items() if robot is not None}
    samples = _samples(site, reading, classified, explained)
    for index in blocking:
        if robots[index] is None:
            return Classification("blocked", _of_sonar(index, classified), sonars=samples)
    first = blocking[0]
    seen = Reason(NodeCode.SEES_ROBOT, f"sonar {first} sees the robot {robots[first]}")
    return Classification("blocked", seen, robots[first], samples)


def _of_sonar(index: int, classified: list[_Classified]) -> Reason:
    reason = classified[index][1]
    return Reason(reason.code, f"sonar {index}: {reason}")


def _samples(
    site: NodeSite,
    reading: NodeReading,
    classified: list[_Classified],
    explained: Container[int] = (),
) -> tuple[SonarSample, ...]:
    return tuple(
        SonarSample(state, measured, sonar.range_limit, index in explained, sonar.false_echo_rate)
        for index, (sonar, measured, (state, _)) in enumerate(
            zip(site.sonars, reading.range_m, classified, strict=True)
        )
    )


def _fuse(site: NodeSite, reading: NodeReading, shift: float) -> tuple[list[_Classified], AreaState]:
    """Classify every sonar with its limit moved by `shift` (m), and fuse the results."""
    classified = [
        classify_sonar(sonar, status, measured, shift)
        for sonar, status, measured in zip(site.sonars, reading.status, reading.range_m, strict=True)
    ]
    if all(status == "no_echo" for status in reading.status):
        # A dead or covered sonar is as silent as a free area: alone, silence never shows that nothing is there.
        classified = [("unknown", _SILENT if state == "clear" else reason) for state, reason in classified]
    states = {state for state, _ in classified}
    return classified, "blocked" if "blocked" in states else "unknown" if "unknown" in states else "clear"


def _contradiction(reading: NodeReading, classified: list[_Classified], fused: AreaState) -> Classification:
    """Return why the node's reported state contradicts its ranges."""
    index = next(i for i, (state, _) in enumerate(classified) if state == fused)
    if reading.state == "unknown":
        return Classification("unknown", Reason(NodeCode.REPORTS_UNKNOWN, "the node reports unknown"))
    sentence = f"the node reports {reading.state}, but sonar {index} shows: {classified[index][1]}"
    return Classification("unknown", Reason(NodeCode.CONTRADICTORY, sentence))
