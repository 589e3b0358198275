"""Visits: a robot comes to where a person stands, waits until they follow, and leads them to another public place.

Pure: inputs are values, time is an argument (s, monotonic). Robots drive missions as ever; this only decides which ones
to ask for, and which to end (ADR 69). Three rules hold whatever happens, in whatever order:

- an operator's word ends the visit: whoever gives the robot another mission, takes its mission away, or commands it;
- a robot has one visit at most, and is taken only while it has no mission;
- a mission of a visit without its visit is ended, so that no robot drives for nobody.
"""

from __future__ import annotations

import math
import secrets
from collections import deque
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

from fog_contracts.messages import ReasonCode
from planner.problems import PlannerProblem

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from fog_contracts.messages import Place, RobotState

WAITING_MAX: Final = 8
"""Most visits that are not over; who comes later is asked to come again."""
PER_SOURCE: Final = 3
"""Most of them from one client's address: a code is for everybody."""
ASKED_MAX, ASKED_S = 6, 60.0
"""Most visits that an address may ask for, in so many seconds."""
UNSEEN_S: Final = 60.0
"""Who waits and does not look at the page for so long has gone."""
READY_S: Final = 90.0
"""How long a robot waits for "go"."""
DRIVE_S: Final = 900.0
"""How long a way may take."""
TROUBLE_S: Final = 20.0
"""How long a robot may be without a path, or unheard: a closed corridor, or a gap in the radio, may pass."""
KEPT_S: Final = 120.0
"""How long the end of a visit can be read."""

VisitState = Literal["waiting", "coming", "ready", "leading", "arrived", "ended"]
DRIVING: Final = ("coming", "leading")
_HANDS: Final = frozenset({"INIT", "TELEOP", "EGRESS"})
"""Modes of a robot that somebody has taken out of service, or drives."""
_RESTS: Final = frozenset({ReasonCode.AT_REST, ReasonCode.ON_DOCK})
"""Why a robot holds that begins to drive once it has a mission."""


class VisitEnd(StrEnum):
    """Why a visit is over before it has arrived."""

    CANCELLED = "cancelled"
    """By the visitor."""
    OPERATOR = "operator"
    """Somebody stopped the robot, or sent it elsewhere."""
    ROBOT = "robot"
    """The robot can't go on: a fault, an empty battery, no radio."""
    NO_WAY = "no_way"
    EXPIRED = "expired"
    """The visitor did not come, or the way took too long."""
    PLACE = "place"
    """One of its places is not public any more."""
    FAILED = "failed"
    """The mission could not be stored."""


class VisitError(Exception):
    """A refused request; the message is for programs, the page has texts of its own for `code`."""

    def __init__(self, code: PlannerProblem, message: str, retry_s: float = 0.0) -> None:
        super().__init__(message)
        self.code = code
        self.retry_s = retry_s


@dataclass(eq=False)
class Visit:
    """One visit. `owner` is a session, `source` a client's address; `start` and `goal` are public places."""

    id: str
    owner: str
    source: str
    start: str
    goal: str
    since: float
    """Since when it is in its state."""
    seen_at: float
    """When its page last asked."""
    state: VisitState = "waiting"
    end: VisitEnd | None = None
    robot: str | None = None
    mission: str | None = None
    """The last mission that the robot got for it."""
    ordered: bool = False
    """Whether that is the mission of the way that `state` is about."""
    named: bool = False
    """Whether the robot has confirmed it."""
    trouble_since: float | None = None
    ended_by: str = ""
    """The operator who ended it by its id, for the audit trail of its mission's end."""

    @property
    def name(self) -> str:
        """The name of the token that it was begun with, without what tells browsers apart."""
        return self.owner.rpartition(" ")[0]

    @property
    def is_over(self) -> bool:
        """Whether it has arrived or ended."""
        return self.state in ("arrived", "ended")


class Facts(NamedTuple):
    """What is known of a robot: its mission in force, whether that is a visit's, and whether it has no path to it.

    `heard`: its state is fresh. `free`: it may be taken by a visit, if it has no mission. `x`, `y`: m, frame `map`.
    """

    mission: str | None = None
    of_visit: bool = False
    refused: bool = False
    heard: bool = True
    free: bool = False
    x: float = 0.0
    y: float = 0.0


class Act(NamedTuple):
    """What to do: send a robot to a place for a visit, or end the mission of that id, in somebody's name if any."""

    robot: str
    visit: Visit | None = None
    place: str = ""
    mission: str = ""
    who: str = ""


def why_out(state: RobotState) -> VisitEnd | None:
    """Return why a robot serves nobody now, by its state; None if it does."""
    if not state.enabled or state.mode in _HANDS:
        return VisitEnd.OPERATOR
    return VisitEnd.ROBOT if state.awaits_operator or state.wants_dock or state.mode == "FAULT" else None


def is_free(state: RobotState) -> bool:
    """Return whether a robot could drive now, had it a mission."""
    if why_out(state) is not None or ReasonCode.BATTERY_LOW in state.codes:
        return False
    return state.mode in ("NORMAL", "DEGRADED") or (state.mode == "HOLD" and _RESTS.issuperset(state.codes))


class Visits:
    """All visits, oldest first. Every method is called on one thread."""

    def __init__(self, robots: Sequence[str]) -> None:
        """`robots` are those that serve visitors."""
        self._robots = tuple(robots)
        self._visits: list[Visit] = []
        self._asked: dict[str, deque[float]] = {}
        self._busy: set[str] = set()
        """Robots for which an `Act` is under way."""

    # --- What visitors do -------------------------------------------------------------------------------------------

    def ask(self, owner: str, source: str, ends: tuple[str, str], public: Mapping[str, Place], now: float) -> Visit:
        """Begin a visit between two places, or return the same one again; raises `VisitError`."""
        self._check_places(ends, public)
        known = self.of(owner, now)
        if known is not None and not known.is_over:
            if (known.start, known.goal) == ends:
                return known
            raise VisitError(PlannerProblem.VISIT_OTHER, "this browser has another visit: end that one first")
        self._check_limits(source, now)
        visit = Visit(secrets.token_hex(8), owner, source, *ends, since=now, seen_at=now)
        self._visits = [other for other in self._visits if other is not known] + [visit]
        return visit

    def _check_places(self, ends: tuple[str, str], public: Mapping[str, Place]) -> None:
        if not self._robots:
            detail = "no robot serves visitors: name some as `robots` of [visitors] in site.toml, and restart"
            raise VisitError(PlannerProblem.VISITS_OFF, detail)
        for end in ends:
            if end not in public:
                raise VisitError(
                    PlannerProblem.PLACE_NOT_PUBLIC, f"no place {end} is public: choose one that visitors may see"
                )
        if ends[0] == ends[1]:
            raise VisitError(PlannerProblem.VISIT_SAME_PLACE, "the visitor is there already: choose another place")

    def _check_limits(self, source: str, now: float) -> None:
        open_ones = self.open
        if len(open_ones) >= WAITING_MAX or sum(visit.source == source for visit in open_ones) >= PER_SOURCE:
            raise VisitError(PlannerProblem.VISITS_FULL, "too many visitors wait: try again in a minute", 60.0)
        asked = self._asked.setdefault(source, deque(maxlen=ASKED_MAX))
        if len(asked) == ASKED_MAX and now - asked[0] < ASKED_S:
            wait = ASKED_S - (now - asked[0])
            raise VisitError(
                PlannerProblem.VISITS_TOO_OFTEN, f"too many visits at once: try again in {wait:.0f} s", wait
            )
        asked.append(now)
        self._asked = {each: times for each, times in self._asked.items() if now - times[-1] < ASKED_S}

    def of(self, owner: str, now: float) -> Visit | None:
        """Return the latest visit of a session, whose page looks at it now."""
        found = next((visit for visit in self._visits if visit.owner == owner), None)
        if found is not None:
            found.seen_at = now
        return found

    def go(self, owner: str, now: float) -> Visit:
        """Let the robot lead on; a second "go" changes nothing. Raises `VisitError`."""
        visit = self.known(owner, now)
        if visit.state == "ready":
            self._enter(visit, "leading", now)
        elif visit.state != "leading":
            raise VisitError(PlannerProblem.VISIT_NOT_READY, f"the robot does not wait for the visitor: {visit.state}")
        return visit

    def cancel(self, owner: str, now: float) -> None:
        """End a visit in the visitor's name; raises `VisitError` if there is none."""
        self._end(self.known(owner, now), VisitEnd.CANCELLED, now)

    def known(self, owner: str, now: float) -> Visit:
        """Return the latest visit of a session, whose page looks at it now; raises `VisitError` without one."""
        visit = self.of(owner, now)
        if visit is None:
            raise VisitError(PlannerProblem.NO_VISIT, "this browser has no visit: ask for one")
        return visit

    def ahead(self, visit: Visit) -> int:
        """Return how many wait before this visit."""
        return sum(other.state == "waiting" for other in self._visits[: self._visits.index(visit)])

    # --- What operators and robots do -------------------------------------------------------------------------------

    @property
    def open(self) -> list[Visit]:
        """The visits that are not over, oldest first."""
        return [visit for visit in self._visits if not visit.is_over]

    def end(self, visit: str, who: str, now: float) -> None:
        """End a visit in an operator's name, `who`; raises `VisitError` if there is no such open one."""
        found = next((each for each in self.open if each.id == visit), None)
        if found is None:
            raise VisitError(
                PlannerProblem.NO_VISIT, f"there is no open visit {visit}: choose one of GET /api/v1/visits"
            )
        found.ended_by = who
        self._end(found, VisitEnd.OPERATOR, now)

    def serves(self, robot: str) -> bool:
        """Whether a robot has a visit, if only to wait for its visitor."""
        return self._on(robot) is not None

    def commanded(self, robot: str, now: float) -> None:
        """End the visit of a robot that somebody has commanded or stopped, whatever becomes of the command."""
        if (visit := self._on(robot)) is not None:
            self._end(visit, VisitEnd.OPERATOR, now)

    def on_state(self, robot: str, state: RobotState, now: float) -> None:
        """Use a robot's state: it may have arrived, been stopped, or dropped its mission."""
        visit = self._on(robot)
        if visit is None:
            return
        if (why := why_out(state)) is not None:
            self._end(visit, why, now)
        elif not visit.ordered or visit.state not in DRIVING:
            return
        elif state.goal_id == visit.mission:
            visit.named = True
            if state.goal_reached:
                self._enter(visit, "ready" if visit.state == "coming" else "arrived", now)
        elif visit.named:
            self._end(visit, VisitEnd.OPERATOR, now)  # its mission was cancelled at the robot itself

    # --- Steps ------------------------------------------------------------------------------------------------------

    def step(self, now: float, fleet: Mapping[str, Facts], public: Mapping[str, Place]) -> list[Act]:
        """Return what is to be done now; each act is `done` before its robot gets another."""
        self._visits = [visit for visit in self._visits if not visit.is_over or now - visit.since < KEPT_S]
        acts: list[Act] = []
        for visit in self._visits:
            if not visit.is_over:
                self._check(visit, now, fleet, public)
            if visit.state == "waiting":
                self._take_robot(visit, now, fleet, public[visit.start])
            acts += self._order(visit, fleet)
        for robot, facts in fleet.items():
            if facts.of_visit and facts.mission and robot not in self._busy and not self._wanted(robot, facts.mission):
                who = next((each.ended_by for each in self._visits if each.mission == facts.mission), "")
                acts.append(Act(robot, mission=facts.mission, who=who))
        self._busy.update(act.robot for act in acts)
        return acts

    def done(self, act: Act, outcome: str | VisitEnd, now: float) -> None:
        """Note that an act is done. `outcome` of an order: the mission's id, or why there is none."""
        self._busy.discard(act.robot)
        visit = act.visit
        if visit is None or visit.is_over:
            return  # a mission that it got all the same is ended by the next step
        if not isinstance(outcome, VisitEnd):
            visit.mission, visit.ordered = outcome, True
        elif outcome == VisitEnd.OPERATOR and visit.state == "coming":
            visit.robot = None
            self._enter(visit, "waiting", now)
        else:
            self._end(visit, outcome, now)

    def clear(self) -> None:
        """Forget all visits: another process leads, which ends their missions."""
        self._visits.clear()

    def _check(self, visit: Visit, now: float, fleet: Mapping[str, Facts], public: Mapping[str, Place]) -> None:
        """End a visit that can't go on."""
        needed = (visit.goal,) if visit.state == "leading" else (visit.start, visit.goal)
        in_state = now - visit.since
        if not all(place in public for place in needed):
            self._end(visit, VisitEnd.PLACE, now)
        elif visit.robot is None:
            if now - visit.seen_at > UNSEEN_S:
                self._end(visit, VisitEnd.EXPIRED, now)
        elif in_state > (READY_S if visit.state == "ready" else DRIVE_S):
            self._end(visit, VisitEnd.EXPIRED, now)
        elif visit.robot not in self._busy:
            self._check_robot(visit, fleet.get(visit.robot, Facts(heard=False)), now)

    def _check_robot(self, visit: Visit, facts: Facts, now: float) -> None:
        expected = (visit.mission,) if visit.state in DRIVING and visit.ordered else (visit.mission, None)
        if facts.mission not in expected:
            self._end(visit, VisitEnd.OPERATOR, now)
            return
        why = VisitEnd.ROBOT if not facts.heard else VisitEnd.NO_WAY if facts.refused else None
        if why is None:
            visit.trouble_since = None
        elif visit.trouble_since is None:
            visit.trouble_since = now
        elif now - visit.trouble_since > TROUBLE_S:
            self._end(visit, why, now)

    def _take_robot(self, visit: Visit, now: float, fleet: Mapping[str, Facts], start: Place) -> None:
        """Take the nearest free robot, if there is one."""

        def is_free(robot: str) -> bool:
            facts = fleet.get(robot)
            unused = robot not in self._busy and self._on(robot) is None
            return facts is not None and unused and facts.free and facts.heard and facts.mission is None

        free = [robot for robot in self._robots if is_free(robot)]
        if free:
            visit.robot = min(free, key=lambda robot: math.hypot(fleet[robot].x - start.x, fleet[robot].y - start.y))
            self._enter(visit, "coming", now)

    def _order(self, visit: Visit, fleet: Mapping[str, Facts]) -> list[Act]:
        """Return the order of a way that has none yet, once the mission before it is over."""
        robot = visit.robot
        if visit.state not in DRIVING or visit.ordered or robot is None or robot in self._busy:
            return []
        if (facts := fleet.get(robot)) is None or facts.mission is not None:
            return []
        return [Act(robot, visit, visit.start if visit.state == "coming" else visit.goal)]

    def _wanted(self, robot: str, mission: str) -> bool:
        return any(v.robot == robot and v.mission == mission and v.state != "ended" for v in self._visits)

    def _on(self, robot: str) -> Visit | None:
        return next((visit for visit in self._visits if visit.robot == robot and not visit.is_over), None)

    def _enter(self, visit: Visit, state: VisitState, now: float) -> None:
        visit.state, visit.since, visit.ordered, visit.named, visit.trouble_since = state, now, False, False, None

    def _end(self, visit: Visit, why: VisitEnd, now: float) -> None:
        if not visit.is_over:
            visit.end = why
            self._enter(visit, "ended", now)
