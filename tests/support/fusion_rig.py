"""A fusion of one area's nodes, which tests feed with readings, poses and time."""

from collections.abc import Sequence

from fog_contracts.messages import AreaDefinition, AreaHazard, NodeReading, Pose, RobotPose, SonarStatus
from fog_contracts.site import NodeSite, RobotSite, Sonar
from hazard_aggregator.fusion import AreaFusion
from hazard_aggregator.registry import find_rule

SQUARE = [(0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (0.0, 1.0)]
LIMIT = 1.2
START = Pose(x=0.0, y=0.0, theta=0.0)
PERIOD = 0.1


def area(*nodes: str, **fields) -> AreaDefinition:
    return AreaDefinition(id="hall", polygon=SQUARE, nodes=list(nodes), number=7, **fields)


def site(name: str, height: float = 0.3, *, no_echo_is_clear: bool = True) -> NodeSite:
    sonars = [Sonar(angle=a, range_limit=LIMIT, no_echo_is_clear=no_echo_is_clear) for a in (0.0, 0.1)]
    return NodeSite(id=name, area="hall", x=0.0, y=0.5, theta=0.0, height=height, sonars=sonars)


def pose(x: float, y: float, *, height: float = 0.35, localized: bool = True) -> RobotPose:
    return RobotPose(
        x=x,
        y=y,
        theta=0.0,
        covariance=[0.0] * 9,
        v=0.0,
        w=0.0,
        radius=0.17,
        height=height,
        stamp=0.0,
        localized=localized,
    )


def measured(seq: int, *, uptime_ms: int, state: str = "clear") -> NodeReading:
    distance = 0.8 if state == "blocked" else 3.0
    return NodeReading(seq=seq, boot=1, uptime_ms=uptime_ms, range_m=[distance, 3.0], status=["ok", "ok"], state=state)


class Rig:
    """A fusion with a clock that moves one node period per reading."""

    def __init__(
        self, *nodes: NodeSite, restored: list[AreaHazard] | None = None, robots: Sequence[RobotSite] = (), **fields
    ) -> None:
        self.core = AreaFusion(
            [area(*(n.id for n in nodes), **fields)],
            nodes,
            1,
            restored or [],
            registry=find_rule,
            default_rule="consecutive",
            robots=robots,
        )
        self.now = 100.0
        self.seq = 0
        self.changes: list[AreaHazard] = []
        self.wait(0.0)

    def read(
        self,
        *ranges: float | None,
        state: str | None = None,
        node: str = "n1",
        times: int = 1,
        status: list[SonarStatus] | None = None,
    ) -> None:
        for _ in range(times):
            self.now += PERIOD
            self.seq += 1
            reported = state or ("blocked" if any(r is not None and r < LIMIT for r in ranges) else "clear")
            reading = NodeReading(
                seq=self.seq,
                boot=1,
                uptime_ms=round(1000 * self.now),
                range_m=list(ranges),
                status=status or ["no_echo" if r is None else "ok" for r in ranges],
                state=reported,
            )
            self.changes += self.core.on_reading(node, reading, self.now, self.now + 1e6)

    def wait(self, seconds: float) -> None:
        end = self.now + seconds
        while True:
            self.changes += self.core.tick(self.now, self.now + 1e6)
            if self.now >= end:
                return
            self.now = min(self.now + 0.1, end)

    @property
    def hazard(self) -> AreaHazard:
        return self.core.hazards()[0]
