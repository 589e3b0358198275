"""The confirmed state of one node or source in one area: debounce, silence, contradictions, flapping. Pure."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from fog_contracts.messages import NodeCode, Reason, UnknownPolicy
from hazard_aggregator.free_parts import FarWall

if TYPE_CHECKING:
    from fog_contracts.messages import AreaState, Availability, NodeReading, Source
    from fog_contracts.site import NodeSite
    from hazard_aggregator.debounce import Rule
    from hazard_aggregator.readings import Classification
    from hazard_aggregator.source_values import SourceReader

WINDOW_S: Final = 60.0
STEADY_S: Final = 5.0
"""So long (s) one state must last before a flapping node is believed again."""


class FlapDetector:
    """Counts the changes of state within a minute; nodes tell only those between blocked and clear."""

    def __init__(self, max_changes: int) -> None:
        self.max_changes = max_changes
        self.flapping = False
        self._changes: deque[float] = deque()
        self._state: AreaState | None = None
        self._since = 0.0

    def update(self, confirmed: AreaState, now: float) -> bool:
        """Take a confirmed state at `now` (s); return whether the node flaps."""
        if self.flapping and now - self._since >= STEADY_S:
            self.flapping = False
            self._changes.clear()
        if confirmed != self._state:
            if self._state is not None:
                self._changes.append(now)
            self._state, self._since = confirmed, now
        while self._changes and now - self._changes[0] > WINDOW_S:
            self._changes.popleft()
        if len(self._changes) > self.max_changes:
            self.flapping = True
        return self.flapping


EXPLAINED_S: Final = 7.0
"""Robots may explain a node's echoes for so long (s), which crossing its cone takes; then nothing is known any more."""
_EXPLAINED_PAUSE_S: Final = 3.0
"""After so long without an explained echo the robot is gone, and the time begins anew."""
TAKEN_BACK_MAX: Final = 3
"""So often poses that come late take back what a node saw, until it sees a clear area: they may be invented."""
_UNEXPLAINED_MAX: Final = 300
_PAST_M: Final = 0.2
"""A robot's echo from so much farther away shows that what blocked is gone: a pose is some centimetres off."""
_REPEATED_S: Final = 1.0
_ALIKE_M: Final = 0.02
"""A reading that differs by so little from the last one of these is kept once in this time: 300 last for minutes."""
_PERIODS: Final = 3
"""A source is silent after so many of its periods."""


_NOT_HEARD: Final = Reason(NodeCode.NOT_HEARD, "no reading received yet")


@dataclass
class NodeState:
    """One node of one area; a node of the thesis has no `site`."""

    id: str
    site: NodeSite | None
    rule: Rule
    last_reading: float | None = None
    last_confirmed: float = 0.0
    state: AreaState = "unknown"
    reason: Reason = _NOT_HEARD
    online: bool | None = None
    ever_received: bool = False
    unconfirmed: bool = True  # no state was confirmed since the last invalidation
    explained_by: str | None = None
    explained_since: float = -math.inf
    explained_at: float = -math.inf
    unexplained: list[tuple[float, NodeReading]] = field(default_factory=list)
    """The readings with echoes that no robot explained, since one confirmed that the area is clear."""
    blocked_at: dict[int, float] = field(default_factory=dict)
    """The farthest echo (m) of each sonar that no robot explained, since the area was clear."""
    taken_back: int = 0
    run_state: AreaState | None = None
    run_began: float = 0.0
    received: int = 0
    ignored: int = 0
    area_penalty: int | None = None
    flaps: FlapDetector = field(default_factory=lambda: FlapDetector(UnknownPolicy().max_changes))
    free: frozenset[int] = frozenset()
    """The sonars that show their parts of the area free."""

    def __post_init__(self) -> None:
        self.far_wall = FarWall(self.site)

    @property
    def outcome(self) -> tuple[AreaState, str, str | None, bool, frozenset[int], tuple[int, ...]]:
        """All that an area's hazard depends on."""
        seen = self.free, tuple(self.far_wall.near)
        return self.state, self.reason, self.explained_by, self.ever_received, *seen

    @property
    def penalty(self) -> int | None:
        """The cost of the area while this one alone is blocked; None: the area is impassable then."""
        own = None if self.site is None else self.site.penalty
        return self.area_penalty if own is None else own

    def silent_after(self, policy: UnknownPolicy) -> float:
        """Return after how long a silence (s) the state is unknown."""
        return policy.silent_after_s

    def silent_for(self, now: float) -> float:
        """Return the time (s) since the last reading was taken; without one, since the first call."""
        if self.last_reading is None:
            self.last_reading = self.last_confirmed = now
        return now - self.last_reading

    def invalidate(self, reason: Reason) -> None:
        """Set the state to unknown until readings confirm another one."""
        self.state = "unknown"
        self.reason = reason
        self.unconfirmed = True
        self.explained_by = None
        self.run_state = None
        self.unexplained = []
        self.blocked_at = {}
        self.rule.reset()

    @property
    def may_be_taken_back(self) -> bool:
        """Whether all that it saw since its last clear area is known, and poses took that back a few times only."""
        return 0 < len(self.unexplained) < _UNEXPLAINED_MAX and self.taken_back < TAKEN_BACK_MAX

    def take_back(self, robot: str) -> None:
        """Set the state to unknown: what blocked it was this robot, whose poses came late."""
        self.taken_back += 1
        self.invalidate(Reason(NodeCode.POSE_LATE, f"it saw the robot {robot}, whose pose came late"))

    def flap(self) -> None:
        """Set the state to unknown until it is steady."""
        reason = f"it flaps: it changed more than {self.flaps.max_changes} times within a minute"
        if self.reason != reason:
            self.invalidate(Reason(NodeCode.FLAPS, reason))

    def restore_blocked(self) -> None:
        """Set the state in which an earlier run left the node's area."""
        self.state = "blocked"
        self.reason = Reason(NodeCode.BLOCKED_BEFORE, "the area was blocked before the restart")

    def check_silence(self, limit: float, now: float) -> None:
        """Invalidate the state of a node that was silent, or confirmed nothing, for longer than `limit` (s)."""
        self.free = self.far_wall.free(now)
        if self.silent_for(now) > limit:
            reason = f"it has been silent for more than {limit:g} s"
            # A few readings since an earlier silence confirmed nothing, and do not count after this one.
            if self.state != "unknown" or self.reason != reason or self.run_state is not None:
                self.invalidate(Reason(NodeCode.SILENT, reason))
        elif now - self.last_confirmed > limit and self.state != "unknown":
            self.invalidate(Reason(NodeCode.CONTRADICTORY, "its readings contradict one another"))

    def receive(self, taken_at: float) -> None:
        """Record a sign of life (s, the receiver's clock)."""
        self.silent_for(taken_at)
        self.received += 1
        self.last_reading = taken_at
        self.ever_received = True
        self.online = True

    def apply(
        self,
        classification: Classification,
        taken_at: float,
        stamp: float,
        *,
        counts: bool = True,
        reading: NodeReading | None = None,
    ) -> None:
        """Apply one classified reading, taken at `taken_at` (s, the receiver's clock).

        One that does not count is a sign of life, but no measurement of its own.
        """
        self.receive(taken_at)
        self.free = self.far_wall.on_reading(classification.sonars if counts else None, taken_at)
        if classification.explained_by is not None:
            self._apply_explained(classification.explained_by, taken_at)
            classification = self._past(classification)
        too_long = classification.state == "clear" and self._explained_too_long(taken_at)
        if classification.explained_by is not None or not counts or too_long:
            return
        if classification.state == "blocked":
            self._note_blocked(classification, taken_at, reading)
        if classification.state != self.run_state and not (classification.state == "unknown" and self.run_state):
            self.run_state = classification.state
            self.run_began = stamp
        confirmed = self.rule.update(classification.observation, taken_at)
        if confirmed is None:
            return
        self.last_confirmed = taken_at
        self.explained_by = None
        if confirmed == "unknown":
            self.run_state = None
        elif confirmed == "clear":
            self.unexplained.clear()
            self.blocked_at.clear()
            self.taken_back = 0
        else:
            # It sees more than the robot that has stood before it: what it hears of that robot now may show that this
            # is gone. Without that the area, impassable by now, would stay so for as long as the robot is shut in.
            self.explained_since = taken_at
        if confirmed != "unknown" and self.flaps.update(confirmed, taken_at):
            self.flap()
            return
        if confirmed != self.state or self.unconfirmed:
            # Later readings of the same state leave the reason: the hazard would change with every centimetre.
            self.state, self.reason, self.unconfirmed = confirmed, classification.reason, False

    def _note_blocked(self, classification: Classification, taken_at: float, reading: NodeReading | None) -> None:
        """Keep what no robot explains of a reading."""
        if reading is not None and not self._is_known(taken_at, reading):
            self.unexplained.append((taken_at, reading))
        for number, sonar in enumerate(classification.sonars):
            if sonar.state == "blocked" and sonar.range_m is not None and not sonar.explained:
                self.blocked_at[number] = max(sonar.range_m, self.blocked_at.get(number, 0.0))

    def _is_known(self, taken_at: float, reading: NodeReading) -> bool:
        """Whether a reading adds nothing to those that no robot explained: it repeats the last, or they are full."""
        if not 0 < len(self.unexplained) < _UNEXPLAINED_MAX:
            return bool(self.unexplained)
        since, last = self.unexplained[-1]
        pairs = zip(reading.range_m, last.range_m, strict=False)
        alike = all(abs((a or 0.0) - (b or 0.0)) <= _ALIKE_M for a, b in pairs) and reading.status == last.status
        return alike and taken_at - since < _REPEATED_S

    def _apply_explained(self, robot: str, taken_at: float) -> None:
        """Apply a reading whose echoes are a robot's.

        It counts neither way: the debounce rule does not see it, and the timer that detects flapping restarts. But
        what stands behind or beside the robot is not seen either, and the robot may be wrong about its place.
        """
        if taken_at - self.explained_at > _EXPLAINED_PAUSE_S:
            self.explained_since = taken_at
        self.explained_at = taken_at
        if not self._explained_too_long(taken_at):
            self.explained_by = robot
            self.last_confirmed = taken_at
            return
        reason = f"robot {robot} has stood before it for more than {EXPLAINED_S:g} s, by its pose: it sees nothing else"
        if self.reason != reason or self.state != "unknown":
            unexplained = self.unexplained  # poses that are under way may explain them still
            self.invalidate(Reason(NodeCode.ROBOT_STAYS, reason))
            self.unexplained = unexplained

    def _past(self, classification: Classification) -> Classification:
        """Return a clear reading in place of an explained one whose sonars hear the robot beyond all that blocked.

        Where they don't, what blocked may still stand there, and it is returned as it is. Who walks between a node and
        a robot would shut the robot in otherwise, since all that the node hears from then on is the robot.
        """
        if self.state != "blocked" or not self.blocked_at:
            return classification
        samples = []
        for number, sonar in enumerate(classification.sonars):
            beyond = self.blocked_at.get(number, -math.inf) + _PAST_M
            gone = sonar.explained and sonar.range_m is not None and sonar.range_m > beyond
            samples.append(sonar._replace(state="clear", explained=False) if gone else sonar)
        if any(sample.state != "clear" for sample in samples):
            return classification
        reason = Reason(NodeCode.NOTHING_NEAR, f"what blocked is gone: {classification.reason}")
        return classification._replace(state="clear", reason=reason, explained_by=None, sonars=tuple(samples))

    def _explained_too_long(self, taken_at: float) -> bool:
        return taken_at - self.explained_at <= _EXPLAINED_PAUSE_S and taken_at - self.explained_since > EXPLAINED_S


@dataclass
class SourceState(NodeState):
    """One source of one area, with its profile filled in; `pending` is a value that waits for its sensor's connection.

    `misread`: its last message was not understood. `new`: its topics are not subscribed to yet, for this source.
    `value_at`: boot and seq of a node's last value. `said`: whether each of its availability topics says that it is
    connected. `recalled`: its next value may be what its gateway knew before an outage.
    """

    source: Source | None = None
    reader: SourceReader | None = None
    pending: bytes | None = None
    misread: bool = False
    new: bool = True
    value_at: tuple[int, int] | None = None
    said: dict[str, bool] = field(default_factory=dict)
    recalled: bool = False

    @property
    def penalty(self) -> int | None:
        """The cost of the area while this source alone is blocked; None: the area is impassable then."""
        own = None if self.source is None else self.source.penalty
        return self.area_penalty if own is None else own

    @property
    def availabilities(self) -> list[Availability]:
        """What says whether its sensor is connected; all must."""
        return [] if self.source is None else self.source.availabilities

    @property
    def publishes_on_change(self) -> bool:
        """Whether its silence means nothing."""
        return self.source is None or self.source.period_s is None

    @property
    def doubt(self) -> Reason | None:
        """Why it may clear nothing now; None: its sensor is connected, or is known to be by its period alone."""
        if self.availabilities and not self.online:
            named = [each.topic for each in self.availabilities if not self.said.get(each.topic)]
            sentence = f"it reports clear, but {' and '.join(named)} must say first that it is connected"
            return Reason(NodeCode.NOT_CONNECTED_YET, sentence)
        if not self.recalled:
            return None
        sentence = "its gateway has just started, and may repeat what it knew before"
        return Reason(NodeCode.NOT_CONNECTED_YET, sentence)

    def say(self, topic: str, *, online: bool) -> None:
        """Record whether an availability topic says that its sensor is connected."""
        self.said[topic] = online
        known = [self.said.get(each.topic) for each in self.availabilities]
        self.online = False if False in known else None if None in known else True

    def forget(self) -> None:
        """Forget whether its sensor is connected, and what waits for that."""
        self.said.clear()
        self.pending, self.online, self.recalled = None, None, False

    def receive(self, taken_at: float) -> None:
        """Record a sign of life (s, the receiver's clock), which a gateway may give for a sensor that is gone."""
        online = self.online
        super().receive(taken_at)
        if self.availabilities:
            self.online = online

    def silent_after(self, policy: UnknownPolicy) -> float:  # noqa: ARG002  # a source has its own period
        """Return after how long a silence (s) the state is unknown: never, if the source publishes on change."""
        period = None if self.source is None else self.source.period_s
        return math.inf if period is None else _PERIODS * period

    def invalidate(self, reason: Reason) -> None:
        """Set the state to unknown until messages confirm another one."""
        super().invalidate(reason)
        self.misread = False
        if self.reader is not None:
            self.reader.reset()
