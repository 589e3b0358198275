"""Turns readings into hazards: passes each reading to the areas that its node watches.

`readings` decides which readings are news and what one shows, `node_state` with its debounce rule when a node's state
is confirmed, and `areas` what that means for an area. Pure: time comes as `now` (s, the
receiver's monotonic clock) and `stamp` (s since the epoch, for people and traces).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from fog_contracts.channels import BLOCKED, CLEAR
from fog_contracts.messages import NodeCode, Reason
from hazard_aggregator.alerts import node_reports
from hazard_aggregator.areas import THESIS_NODE, Members, WatchedArea
from hazard_aggregator.debounce import DEFAULT_RULE
from hazard_aggregator.node_state import SourceState
from hazard_aggregator.readings import Classification, ReadingOrder, RobotPoses, Taken, classify_reading
from hazard_aggregator.sources import Sources

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping
    from collections.abc import Set as AbstractSet
    from typing import Final

    from fog_contracts.geometry import Point
    from fog_contracts.messages import (
        AreaDefinition,
        AreaHazard,
        AreaState,
        NodeReading,
        NodeValue,
        Reported,
        RobotPose,
    )
    from fog_contracts.site import NodeSite, RobotSite
    from hazard_aggregator.alerts import NodeReport
    from hazard_aggregator.areas import AreaOverride
    from hazard_aggregator.debounce import Registry
    from hazard_aggregator.free_parts import Cones
    from hazard_aggregator.node_state import NodeState
    from hazard_aggregator.readings import Rejection
    from hazard_aggregator.sources import Applied

LATE_TICK_S: Final = 0.5
"""A longer gap (s) between two ticks means that the process itself was stalled."""
THESIS_EXPIRY_S: Final = 60.0
"""A thesis node that has been silent for so long (s) is gone: no site lists it, and one stray message made it."""
_MAX_REJECTIONS: Final = 10_000


class AreaFusion:
    """Holds every area's state; each input returns the hazards that changed.

    `restored` are the hazards that were stored last: a blocked area stays blocked until readings or silence change it.
    All others start as unknown, because only readings of this run can show that an area is clear. `registry` finds
    debounce rules by name, `default_rule` is the one of areas that name none, `cones` are the outlines of what nodes
    see (`Members`), `sonar_cones` those of each sonar, `robots` have the bodies that echoes may come from; raises
    `AreaError` for an invalid area.
    """

    def __init__(  # noqa: PLR0913  # what is known at the start
        self,
        definitions: Iterable[AreaDefinition],
        nodes: Iterable[NodeSite],
        epoch: int,
        restored: Iterable[AreaHazard] = (),
        *,
        registry: Registry,
        default_rule: str = DEFAULT_RULE,
        cones: Mapping[str, list[Point]] | None = None,
        robots: Iterable[RobotSite] = (),
        sonar_cones: Cones | None = None,
    ) -> None:
        self.epoch = epoch
        self.nodes = {node.id: node for node in nodes}
        self._members = Members(self.nodes, registry, default_rule, cones or {})
        self._sonar_cones = sonar_cones
        self._sources = Sources()
        self._areas: dict[str, WatchedArea] = {}
        self._overrides: dict[str, AreaOverride] = {}
        self._tombstones: dict[str, AreaDefinition] = {}
        self._poses = RobotPoses(robots)
        self._seqs: dict[str, int] = {}
        self._by_node: dict[str, list[tuple[WatchedArea, NodeState]]] = {}
        self._orders: dict[str, ReadingOrder] = {}
        self._rejections: list[tuple[str, Rejection]] = []
        self._last_tick: float | None = None
        self._last_tick_skipped = False
        for definition in definitions:
            self._define(definition)
        for hazard in restored:
            if hazard.area in self._areas:
                self._areas[hazard.area].restore_at_start(hazard)

    # --- State ------------------------------------------------------------------------------------------------------

    def hazards(self) -> list[AreaHazard]:
        """Return the state of every area that has been evaluated once (`tick` evaluates all)."""
        return [area.hazard for area in self._areas.values() if area.hazard is not None]

    def definitions(self) -> list[AreaDefinition]:
        """Return all areas, also removed ones (`removed`)."""
        return [*(area.definition for area in self._areas.values()), *self._tombstones.values()]

    def definition(self, area: str) -> AreaDefinition | None:
        """Return the definition of an area that is not removed."""
        found = self._areas.get(area)
        return found.definition if found is not None else None

    def source_topics(self) -> AbstractSet[str]:
        """Return the topics of all sources."""
        return self._sources.topics

    def pop_new_source_topics(self) -> set[str]:
        """Return the topics of sources that are new, or have changed, since the last call."""
        return self._sources.pop_new_topics()

    def is_removed(self, area: str) -> bool:
        """Whether there was an area of this id, and is none now."""
        return area in self._tombstones

    def node_reports(self, now: float) -> list[NodeReport]:
        """Return the health of every node of every area."""
        return node_reports(self._areas.values(), now)

    # --- Inputs -----------------------------------------------------------------------------------------------------

    def on_reading(self, node_id: str, reading: NodeReading, now: float, stamp: float) -> list[AreaHazard]:
        """Apply a reading; one that is no news (`ReadingOrder`) is ignored."""
        watched = self._by_node.get(node_id)
        if not watched:
            return []
        taken = self._orders.setdefault(node_id, ReadingOrder()).place(reading, now)
        if not isinstance(taken, Taken):
            self._reject(node_id, taken)
            for _, node in watched:
                node.ignored += 1
            return []
        if not taken.counts:
            self._reject(node_id, "too_soon")
        classification = _classified(self.nodes.get(node_id), reading, self._poses, taken.at)
        if classification.state == "unknown":
            self._reject(node_id, "implausible")
        changed: list[AreaHazard] = []
        for area, node in watched:
            before = node.outcome
            node.apply(classification, taken.at, stamp, counts=taken.counts, reading=reading)
            if node.outcome != before:  # an area may have a hundred nodes, and nearly no reading changes anything
                changed += self._evaluate(area, stamp)
        return changed

    def on_thesis_state(self, number: int, state: str, now: float, stamp: float) -> list[AreaHazard]:
        """Apply `blocked` or `clear` from a thesis node; any other text counts as an implausible reading."""
        changed: list[AreaHazard] = []
        for area in self._areas.values():
            if area.definition.number != number:
                continue
            name = THESIS_NODE.format(number=number)
            node = area.nodes.get(name)
            if node is None:
                node = area.nodes[name] = self._members.thesis_node(area.definition)
            reported: AreaState = BLOCKED if state == BLOCKED else CLEAR if state == CLEAR else "unknown"
            reason = Reason(NodeCode.REPORTED, f"it reports {reported}")
            if reported == "unknown":
                reason = Reason(NodeCode.NOT_UNDERSTOOD, f"it reports neither {BLOCKED} nor {CLEAR}")
            node.apply(Classification(reported, reason), now, stamp)
            changed += self._evaluate(area, stamp)
        return changed

    def on_source(
        self, topic: str, payload: bytes | None, now: float, stamp: float, *, retained: bool
    ) -> list[AreaHazard]:
        """Apply a message of the sensors that areas name as sources; None: one that is too long."""
        return self._after(self._sources.apply(topic, payload, now, stamp, retained=retained), stamp)

    def on_value(self, node_id: str, value: NodeValue, now: float, stamp: float) -> list[AreaHazard]:
        """Apply a quantity that a node measured to the sources that are made of it."""
        return self._after(self._sources.apply_value(node_id, value, now, stamp), stamp)

    def on_connection_lost(self, stamp: float) -> list[AreaHazard]:
        """Make unknown what sources said that publish on change only: their changes may be lost."""
        return [
            hazard for name in self._sources.on_connection_lost() for hazard in self._evaluate(self._areas[name], stamp)
        ]

    def on_availability(self, node_id: str, online: bool, now: float, stamp: float) -> list[AreaHazard]:  # noqa: FBT001  # the topic's payload
        """Apply a node's availability message or last will; an offline node is unknown until its next readings."""
        changed: list[AreaHazard] = []
        for area, node in self._by_node.get(node_id, ()):
            node.online = online
            if not online and node.state != "unknown":
                node.invalidate(Reason(NodeCode.OFFLINE, "it went offline"))
                node.last_confirmed = now
                changed += self._evaluate(area, stamp)
        for area in () if online else self._sources.on_node_offline(node_id):
            changed += self._evaluate(area, stamp)
        return changed

    def on_pose(self, robot: str, pose: RobotPose, now: float) -> list[AreaHazard]:
        """Record a robot's pose, which may explain later readings, and earlier ones if it comes late."""
        self._poses.add(robot, pose, now)
        return []

    def on_reported(self, thing: str, told: Reported, now: float) -> list[AreaHazard]:
        """Record where a robot of others is, which explains readings as a robot's pose does."""
        self._poses.add_reported(thing, told, now)
        return []

    def tick(self, now: float, stamp: float) -> list[AreaHazard]:
        """Detect silent and flapping nodes; call ten times a second.

        A gap between calls means that the process itself was stalled. Then only the next call evaluates, so that the
        messages that arrived meanwhile are handled first.
        """
        stalled = self._last_tick is not None and now - self._last_tick > LATE_TICK_S and not self._last_tick_skipped
        self._last_tick, self._last_tick_skipped = now, stalled
        if stalled:
            return []
        changed: list[AreaHazard] = []
        for area in self._areas.values():
            self._take_back(area)
            for name, node in list(area.nodes.items()):
                if _is_undefined(area, name) and node.silent_for(now) > THESIS_EXPIRY_S:
                    del area.nodes[name]
                else:
                    node.check_silence(node.silent_after(area.definition.unknown), now)
            changed += self._evaluate(area, stamp)
        self._poses.forget_old(now)
        return changed

    def put_area(self, definition: AreaDefinition, stamp: float) -> list[AreaHazard]:
        """Add, change or (with `removed`) remove an area; its nodes keep their confirmed states."""
        self._define(definition)
        area = self._areas.get(definition.id)
        return self._evaluate(area, stamp) if area else []

    def set_override(self, area_id: str, override: AreaOverride | None, stamp: float) -> list[AreaHazard]:
        """Let an operator's override count for an area, whether it is known already or not; or, with None, no more."""
        if override is None:
            self._overrides.pop(area_id, None)
        else:
            self._overrides[area_id] = override
        area = self._areas.get(area_id)
        return self._evaluate(area, stamp) if area else []

    def restore(self, hazards: Iterable[AreaHazard], stamp: float) -> list[AreaHazard]:
        """Apply hazards that were unreadable at the start; areas that readings have confirmed since keep theirs."""
        known = [(self._areas[hazard.area], hazard) for hazard in hazards if hazard.area in self._areas]
        for area, hazard in known:
            area.restore_late(hazard)
        return [changed for area, _ in known for changed in self._evaluate(area, stamp)]

    def set_epoch(self, epoch: int) -> None:
        """Give all hazards, those to come too, another epoch."""
        self.epoch = epoch
        for area in self._areas.values():
            area.set_epoch(epoch)

    def pop_rejections(self) -> list[tuple[str, Rejection]]:
        """Return nodes whose readings did not count since the last call, each with the reason, for metrics."""
        rejections, self._rejections = self._rejections, []
        return rejections

    def checked(self, definition: AreaDefinition) -> AreaDefinition:
        """Return an area as it counts, with the polygon of its node's cone if it is one; raises `AreaError`."""
        return self._members.checked(definition)

    def cone(self, area: str, node: str, nodes: Collection[str]) -> list[Point]:
        """Return what the sonars of a node see as the polygon of an area with these nodes; raises `AreaError`."""
        return self._members.cone(area, node, nodes)

    # --- Inside -----------------------------------------------------------------------------------------------------

    def _define(self, definition: AreaDefinition) -> None:
        definition = self.checked(definition)
        old = self._areas.get(definition.id)
        if definition.removed:
            self._areas.pop(definition.id, None)
            self._tombstones[definition.id] = definition
        else:
            self._tombstones.pop(definition.id, None)
            nodes = self._members.of_area(definition, old)
            if old is None:
                self._areas[definition.id] = WatchedArea(definition, nodes)
            else:
                old.redefine(definition, nodes)
        self._by_node = {}
        for area in self._areas.values():
            for node in area.nodes.values():
                if not isinstance(node, SourceState):
                    self._by_node.setdefault(node.id, []).append((area, node))
        self._sources = Sources(self._areas.values())

    def _take_back(self, area: WatchedArea) -> None:
        """Take back what blocked an area if poses that came late show that it was a robot, all of it."""
        for node in area.nodes.values():
            if node.site is None or not node.may_be_taken_back or not area.was_blocked_by(node.id):
                continue
            robot = None
            for taken_at, reading in node.unexplained:  # the oldest first: for a box, it is the only one
                robot = classify_reading(node.site, reading, self._poses.at(taken_at, settled=True)).explained_by
                if robot is None:
                    break
            if robot is not None:
                node.take_back(robot)
                area.take_back(node.id)

    def _after(self, applied: Iterable[Applied], stamp: float) -> list[AreaHazard]:
        """Return the hazards that change with what sources said."""
        changed: list[AreaHazard] = []
        for area, source, understood in applied:
            if not understood:
                self._reject(source.id, "implausible")
            changed += self._evaluate(area, stamp)
        return changed

    def _reject(self, node_id: str, reason: Rejection) -> None:
        if len(self._rejections) < _MAX_REJECTIONS:
            self._rejections.append((node_id, reason))

    def _evaluate(self, area: WatchedArea, stamp: float) -> list[AreaHazard]:
        """Return the area's hazard when it changed."""
        seq = self._seqs.get(area.definition.id, 0) + 1
        override = self._overrides.get(area.definition.id)
        hazard = area.evaluate(self.epoch, seq, stamp, override, self._sonar_cones)
        if hazard is None:
            return []
        self._seqs[area.definition.id] = seq
        return [hazard]


def _is_undefined(area: WatchedArea, node: str) -> bool:
    """Whether a node reports only under the area's number on the thesis's topics."""
    return node == THESIS_NODE.format(number=area.definition.number) and node not in area.definition.nodes


def _classified(site: NodeSite | None, reading: NodeReading, poses: RobotPoses, taken_at: float) -> Classification:
    if site is None:
        code = NodeCode.REPORTS_UNKNOWN if reading.state == "unknown" else NodeCode.REPORTED
        sentence = f"the node reports {reading.state} (the site does not define it)"
        return Classification(reading.state, Reason(code, sentence))
    return classify_reading(site, reading, poses.at(taken_at))
