"""What one reading of a node says about its area: the sonars against their calibration, the robots that explain them.

Pure: the poses of robots come as arguments, already found fresh by the caller.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterable
    from typing import Final

    from fog_contracts.messages import AreaState, NodeReading, RobotPose
    from fog_contracts.site import NodeSite, Sonar

CONE_HALF_ANGLE: Final = math.radians(7.5)
"""Half of the beam's width: the HC-SR04 sees 15 degrees (Mendes 2022, section 3.3)."""
EXPLAINED_WITHIN: Final = 0.3
"""How far (m) a measured range may be from where a robot's rim should be and still be that robot."""
DOUBT_SIGMAS: Final = 2.0
DOUBT_LIMIT: Final = 0.3
"""How far (m) off the beam a robot may be believed that is in it: two standard deviations of its pose, this at most."""
SHORTEST_RANGE: Final = 0.02
"""Below this (m) an HC-SR04 measures its own ringing (datasheet: 2 cm to 4 m)."""
LIMIT_TOLERANCE: Final = 0.01
"""A range this near (m) to the limit may be called either way: node and fog round differently."""


class Classification(NamedTuple):
    """What a reading says, in words too; `explained_by` names the robot that is all the reading sees."""

    state: AreaState
    reason: str
    explained_by: str | None = None


def classify_sonar(sonar: Sonar, status: str, measured: float | None, shift: float = 0.0) -> tuple[AreaState, str]:
    """Return what one sonar says: an echo nearer than its limit is `blocked`; what can't be right is `unknown`.

    `shift` (m) moves the limit, to classify readings that are as near to it as rounding.
    """
    if status == "stuck":
        return "unknown", "the echo line is stuck"
    if status == "no_echo":
        return _classify_silence(sonar, measured)
    if measured is None:
        return "unknown", "it reports an echo without a range"
    if measured < SHORTEST_RANGE:
        return "unknown", f"{measured:.3f} m is nearer than a sonar can measure"
    if measured < sonar.range_limit + shift:
        return "blocked", f"something at {measured:.2f} m, nearer than {sonar.range_limit:.2f} m"
    return "clear", f"nothing nearer than {sonar.range_limit:.2f} m"


def _classify_silence(sonar: Sonar, measured: float | None) -> tuple[AreaState, str]:
    if measured is not None:
        return "unknown", f"it reports no echo and yet a range of {measured:.2f} m"
    if sonar.no_echo_is_clear:
        return "clear", "no echo, as calibrated"
    return "unknown", "no echo where the opposite wall should echo"


def expected_range(site: NodeSite, sonar: Sonar, pose: RobotPose) -> float | None:
    """Return where (m) this sonar should see the robot's rim, or None when the robot is not in its cone.

    The footprint is a circle; it is in the cone when any part of it may be within half the beam's width of the axis,
    as far as the robot's own doubt about its pose across the beam goes: along a bare corridor that can be decimetres.
    A robot that is lower than the node hangs is not seen.
    """
    if site.height >= pose.height:
        return None
    dx, dy = pose.x - site.x, pose.y - site.y
    distance = math.hypot(dx, dy)
    if distance <= pose.radius:
        return 0.0
    off_axis = abs(math.remainder(math.atan2(dy, dx) - site.theta - sonar.angle, math.tau))
    reach = pose.radius + _doubt_across(pose, -dy / distance, dx / distance)
    if off_axis - math.asin(min(1.0, reach / distance)) > CONE_HALF_ANGLE:
        return None
    return distance - pose.radius


def _doubt_across(pose: RobotPose, nx: float, ny: float) -> float:
    """Return how far (m) the robot may be off its pose in the direction (nx, ny) of unit length."""
    xx, xy, yx, yy = pose.covariance[0], pose.covariance[1], pose.covariance[3], pose.covariance[4]
    variance = nx * nx * xx + nx * ny * (xy + yx) + ny * ny * yy
    return min(DOUBT_LIMIT, DOUBT_SIGMAS * math.sqrt(max(0.0, variance)))


def explaining_robot(
    site: NodeSite, sonar: Sonar, measured: float, poses: Iterable[tuple[str, RobotPose]]
) -> str | None:
    """Return the robot whose rim lies in the sonar's cone within 0.3 m of the measured range, or None."""
    for robot, pose in poses:
        expected = expected_range(site, sonar, pose)
        if expected is not None and abs(expected - measured) <= EXPLAINED_WITHIN:
            return robot
    return None


def classify_reading(site: NodeSite, reading: NodeReading, poses: Iterable[tuple[str, RobotPose]]) -> Classification:
    """Return what a reading says about the area.

    The sonars are fused as the node does it: blocked if one says so, clear if all do, unknown otherwise. A node whose
    own word contradicts its ranges is not believed. Blocking echoes that robots explain make the reading count
    neither way, as long as no other echo blocks.
    """
    if len(reading.range_m) != len(site.sonars):
        return Classification("unknown", f"it reports {len(reading.range_m)} sonars, the site has {len(site.sonars)}")
    classified, fused = _fuse(site, reading, 0.0)
    if fused != reading.state:
        for shift in (LIMIT_TOLERANCE, -LIMIT_TOLERANCE):
            other, other_fused = _fuse(site, reading, shift)
            if other_fused == reading.state:
                classified, fused = other, other_fused
                break
        else:
            return _contradiction(reading, classified, fused)
    if fused == "blocked":
        blocking = [i for i, (state, _) in enumerate(classified) if state == "blocked"]
        fresh = list(poses)
        robots = [explaining_robot(site, site.sonars[i], reading.range_m[i] or 0.0, fresh) for i in blocking]
        for index, robot in zip(blocking, robots, strict=True):
            if robot is None:
                return Classification("blocked", f"sonar {index}: {classified[index][1]}")
        return Classification("blocked", f"sonar {blocking[0]} sees the robot {robots[0]}", explained_by=robots[0])
    index = next(i for i, (state, _) in enumerate(classified) if state == fused)
    return Classification(fused, f"sonar {index}: {classified[index][1]}")


def _fuse(site: NodeSite, reading: NodeReading, shift: float) -> tuple[list[tuple[AreaState, str]], AreaState]:
    """Classify every sonar with its limit shifted (m), and fuse them."""
    classified = [
        classify_sonar(sonar, status, measured, shift)
        for sonar, status, measured in zip(site.sonars, reading.status, reading.range_m, strict=True)
    ]
    states = {state for state, _ in classified}
    return classified, "blocked" if "blocked" in states else "unknown" if "unknown" in states else "clear"


def _contradiction(reading: NodeReading, classified: list[tuple[AreaState, str]], fused: AreaState) -> Classification:
    """Say why the node's own word is not believed."""
    index = next(i for i, (state, _) in enumerate(classified) if state == fused)
    if reading.state == "unknown":
        return Classification("unknown", "the node calls its own reading unknown")
    return Classification("unknown", f"the node says {reading.state}, but of sonar {index}: {classified[index][1]}")
