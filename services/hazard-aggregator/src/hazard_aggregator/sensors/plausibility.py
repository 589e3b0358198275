"""Classifies one reading of a node: compares its sonars with their calibration, and echoes with robots in the cone.

Pure: the caller passes where the robots were.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from fog_contracts.cones import SONAR_HALF_CONE
from hazard_aggregator.debounce import Observation, SonarSample

if TYPE_CHECKING:
    from collections.abc import Container, Iterable
    from typing import Final

    from fog_contracts.messages import AreaState, NodeReading, RobotPose
    from fog_contracts.site import NodeSite, Sonar
    from hazard_aggregator.sensors.robot_poses import Whereabouts

EXPLAIN_TOLERANCE: Final = 0.3
"""How far (m) a measured range may differ from the expected range of a robot's rim to be explained by that robot."""
POSE_SIGMAS: Final = 2.0
MAX_POSE_MARGIN: Final = 0.3
"""The margin for a robot's pose error across the beam: so many standard deviations, and at most so far (m)."""
MIN_RANGE: Final = 0.02
"""Below this range (m) an HC-SR04 measures its own ringing (datasheet: 2 cm to 4 m)."""
LIMIT_TOLERANCE: Final = 0.01
"""A range this close (m) to the limit may be classified either way: node and aggregator round differently."""
_SILENT: Final = "no sonar of the node hears anything, as if they were dead or covered"
NODE_HYSTERESIS: Final = 0.05
"""A node that is blocked stays so until its echo is this far (m) beyond the limit (the firmware's `kHysteresisMm`)."""


class Classification(NamedTuple):
    """The state that a reading shows, and why; `explained_by` is the robot that causes all of its blocking echoes."""

    state: AreaState
    reason: str
    explained_by: str | None = None
    sonars: tuple[SonarSample, ...] = ()

    @property
    def observation(self) -> Observation:
        """What a debounce rule sees of the reading."""
        return Observation(self.state, self.sonars)


def classify_sonar(sonar: Sonar, status: str, measured: float | None, shift: float = 0.0) -> tuple[AreaState, str]:
    """Return what one sonar shows: an echo nearer than its limit is `blocked`, an implausible value `unknown`.

    `shift` (m) moves the limit, for readings that are within rounding of it.
    """
    if status == "stuck":
        return "unknown", "the echo line is stuck"
    if status == "no_echo":
        return _classify_no_echo(sonar, measured)
    if measured is None:
        return "unknown", "it reports an echo without a range"
    return _classify_echo(sonar, measured, shift)


def _classify_echo(sonar: Sonar, measured: float, shift: float) -> tuple[AreaState, str]:
    if measured < MIN_RANGE:
        return "unknown", f"{measured:.3f} m is nearer than a sonar can measure"
    if measured < sonar.range_limit + shift:
        return "blocked", f"something at {measured:.2f} m, nearer than {sonar.range_limit:.2f} m"
    if sonar.range_max is not None and measured > sonar.range_max:
        return "unknown", f"an echo from {measured:.2f} m: the free area gives none from beyond {sonar.range_max:.2f} m"
    return "clear", f"nothing nearer than {sonar.range_limit:.2f} m"


def _classify_no_echo(sonar: Sonar, measured: float | None) -> tuple[AreaState, str]:
    if measured is not None:
        return "unknown", f"it reports no echo and yet a range of {measured:.2f} m"
    if sonar.no_echo_is_clear:
        return "clear", "no echo, as calibrated"
    return "unknown", "no echo where the opposite wall should echo"


def expected_range(site: NodeSite, sonar: Sonar, pose: RobotPose, away: float = 0.0) -> float | None:
    """Return the range (m) at which this sonar should measure the robot's rim, or None when it is outside the cone.

    The footprint is a circle; it is in the cone when any part of it may be within half the beam's width of the axis,
    given the uncertainty of its pose across the beam: along a bare corridor that can be decimetres; and given how far
    `away` (m) from it the robot may be. A robot that is lower than the node's mounting height is not seen.
    """
    if site.height >= pose.height:
        return None
    dx, dy = pose.x - site.x, pose.y - site.y
    distance = math.hypot(dx, dy)
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
        return Classification("unknown", f"it reports {len(reading.range_m)} sonars, the site has {len(site.sonars)}")
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
    return Classification(fused, f"sonar {index}: {classified[index][1]}", sonars=_samples(site, reading, classified))


def _classify_blocked(
    site: NodeSite, reading: NodeReading, classified: list[tuple[AreaState, str]], known: list[Whereabouts]
) -> Classification:
    """Return what a reading with blocking echoes shows: it is explained if robots explain all of them."""
    blocking = [i for i, (state, _) in enumerate(classified) if state == "blocked"]
    robots = {i: explaining_robot(site, site.sonars[i], reading.range_m[i] or 0.0, known) for i in blocking}
    explained = {i for i, robot in robots.items() if robot is not None}
    samples = _samples(site, reading, classified, explained)
    for index in blocking:
        if robots[index] is None:
            return Classification("blocked", f"sonar {index}: {classified[index][1]}", sonars=samples)
    first = blocking[0]
    return Classification("blocked", f"sonar {first} sees the robot {robots[first]}", robots[first], samples)


def _samples(
    site: NodeSite,
    reading: NodeReading,
    classified: list[tuple[AreaState, str]],
    explained: Container[int] = (),
) -> tuple[SonarSample, ...]:
    return tuple(
        SonarSample(state, measured, sonar.range_limit, index in explained, sonar.false_echo_rate)
        for index, (sonar, measured, (state, _)) in enumerate(
            zip(site.sonars, reading.range_m, classified, strict=True)
        )
    )


def _fuse(site: NodeSite, reading: NodeReading, shift: float) -> tuple[list[tuple[AreaState, str]], AreaState]:
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


def _contradiction(reading: NodeReading, classified: list[tuple[AreaState, str]], fused: AreaState) -> Classification:
    """Return why the node's reported state contradicts its ranges."""
    index = next(i for i, (state, _) in enumerate(classified) if state == fused)
    if reading.state == "unknown":
        return Classification("unknown", "the node reports unknown")
    return Classification(
        "unknown", f"the node reports {reading.state}, but sonar {index} shows: {classified[index][1]}"
    )
