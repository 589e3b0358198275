"""The simulated world (zenoh, msgpack): not part of a real system."""

from typing import Annotated

from msgspec import Meta

from fog_contracts.messages.basics import Count, Described, Id, Message, Metres, Pose, Radians, Ring, Speed, Stamp


class SimObstacle(Message, frozen=True, kw_only=True):
    """An obstacle on the simulated floor: an upright prism with this polygon and height (m)."""

    id: Id
    polygon: Ring
    height: Annotated[float, Meta(gt=0.0, le=5.0, extra={"unit": "m"})] = 1.0


class SimTruth(Message, frozen=True, kw_only=True):
    """Ground truth of the simulated world; `clearance` is the distance (m) from the robot's rim to what is nearest."""

    robot: Id
    x: Metres
    y: Metres
    theta: Radians
    left: Speed
    right: Speed
    distance: Annotated[float, Meta(ge=0.0, extra={"unit": "m"})]
    clearance: Annotated[float, Meta(extra={"unit": "m"})]
    min_clearance: Annotated[float, Meta(extra={"unit": "m"})]
    contacts: Count
    obstacles: list[SimObstacle] = []
    stamp: Stamp = 0.0
    sustained_speed: float = 1.0


class SimRefusal(Described):
    """Why the simulated world refuses a change."""

    MISFIT = "misfit", "what is placed has no valid shape or place"
    NO_OBSTACLE = "no_obstacle", "there is no such obstacle to remove"


class SimCommand(Message, frozen=True, kw_only=True):
    """Change the simulated world: place obstacles, remove them by id, move the robot elsewhere (`kidnap`)."""

    place: list[SimObstacle] = []
    remove: list[Id] = []
    kidnap: Pose | None = None
    lidar_silent: bool | None = None
    nodes_silent: list[Id] | None = None
