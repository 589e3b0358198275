"""What was to be seen on a drive, and when: enough to draw it later without driving again."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import msgspec

from fog_contracts import channels as ch

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.bus import Bus
    from fog_contracts.handlers import Ids, Moment, Publication
    from fog_contracts.messages import HazardArea, ProfileName, RobotPath, SimTruth

POSE_S: Final = 1.0
"""Time between two recorded positions."""


class Timeline(msgspec.Struct, frozen=True, kw_only=True):
    """Times in s from the goal on; positions in m, frame `map`.

    `poses`: true positions (time, x, y). `paths`: corners of the fog's paths, in the setup `fog` only. `areas`: states
    of the watched areas (time, id, whether blocked). `barrier_at`: when the obstacle appeared; None if it never did.
    """

    poses: list[tuple[float, float, float]]
    paths: list[tuple[float, list[tuple[float, float]]]]
    areas: list[tuple[float, str, bool]]
    barrier_at: float | None


class TimelineRecorder:
    """Listens to a drive's bus."""

    def __init__(self, bus: Bus, setup: ProfileName) -> None:
        self._poses: list[tuple[float, float, float]] = []
        self._paths: list[tuple[float, list[tuple[float, float]]]] = []
        self._areas: list[tuple[float, str, bool]] = []
        self._now = 0.0
        bus.subscribe({ch.SIM_TRUTH: self._on_truth, ch.HAZARD: self._on_hazard})
        if setup == "fog":
            bus.subscribe({ch.ROBOT_PATH: self._on_path})

    def timeline(self, time_s: float, barrier_at: float | None) -> Timeline:
        """Return what was recorded, for a drive that took so long and has just ended."""
        began = self._now - time_s
        return Timeline(
            poses=[(round(at - began, 2), x, y) for at, x, y in self._poses if at >= began],
            paths=[(round(at - began, 2), points) for at, points in self._paths],
            areas=[(round(at - began, 2), area, blocked) for at, area, blocked in self._areas],
            barrier_at=barrier_at,
        )

    def _on_truth(self, _ids: Ids, truth: SimTruth, at: Moment) -> Sequence[Publication]:
        self._now = at.now
        if not self._poses or at.now - self._poses[-1][0] >= POSE_S:
            self._poses.append((at.now, round(truth.x, 3), round(truth.y, 3)))
        return ()

    def _on_path(self, _ids: Ids, path: RobotPath, at: Moment) -> Sequence[Publication]:
        self._paths.append((at.now, [(round(x, 3), round(y, 3)) for x, y in path.points]))
        return ()

    def _on_hazard(self, ids: Ids, area: HazardArea, at: Moment) -> Sequence[Publication]:
        area_id, blocked = ids["area"], area.hazard.state == "blocked"
        known = next((state for _, name, state in reversed(self._areas) if name == area_id), None)
        if blocked != known:
            self._areas.append((at.now, area_id, blocked))
        return ()
