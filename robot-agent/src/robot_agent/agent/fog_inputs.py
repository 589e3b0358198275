"""What the agent does with the fog's messages: the map, blocked places, goals and paths."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fog_contracts import channels as ch

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from fog_contracts.handlers import Handler, Ids, Moment, Publication
    from fog_contracts.messages import MapDelta, MapHeartbeat, RobotGoal, RobotPath, RobotRelease
    from robot_agent.agent.blocked_places import BlockedPlaces
    from robot_agent.agent.navigation import Navigation
    from robot_agent.agent.path.path_driving import PathDriving
    from robot_agent.localization.localizer import Localizer


class FogInputs:
    """Passes each message to the part of the agent that it concerns."""

    def __init__(
        self, navigation: Navigation, places: BlockedPlaces, driving: PathDriving, localizer: Localizer
    ) -> None:
        self._navigation = navigation
        self._places = places
        self._driving = driving
        self._localizer = localizer

    def handlers(self) -> Mapping[ch.Channel, Handler]:
        """Return the handlers of all subscribed channels; of channels with `{robot}` the robot's own only."""
        return {
            ch.MAP_DELTA: self._on_delta,
            ch.MAP_HEARTBEAT: self._on_heartbeat,
            **self._places.handlers(),
            ch.ROBOT_GOAL: self._on_goal,
            ch.ROBOT_PATH: self._on_path,
            ch.ROBOT_RELEASE: self._on_release,
        }

    def _on_delta(self, _ids: Ids, delta: MapDelta, at: Moment) -> Sequence[Publication]:
        self._navigation.on_delta(delta, at.now)
        return ()

    def _on_heartbeat(self, _ids: Ids, heartbeat: MapHeartbeat, at: Moment) -> Sequence[Publication]:
        self._navigation.on_heartbeat(heartbeat, at.now)
        return ()

    def _on_goal(self, _ids: Ids, goal: RobotGoal, at: Moment) -> Sequence[Publication]:
        self._driving.on_goal(goal, self._localizer.pose(at.now), self._navigation.replica, at)
        return ()

    def _on_path(self, _ids: Ids, path: RobotPath, at: Moment) -> Sequence[Publication]:
        self._navigation.on_path(path, at)
        return ()

    def _on_release(self, _ids: Ids, release: RobotRelease, at: Moment) -> Sequence[Publication]:
        self._navigation.on_release(release, at.now)
        return ()
