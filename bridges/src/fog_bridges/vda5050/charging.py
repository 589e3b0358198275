"""A robot's dock as a fleet control uses it: `startCharging` and `stopCharging`, on a node or at once. Pure.

They are the commands `dock` and `undock` of Fognav's operators; what became of them only the robot's state tells.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

from fog_bridges.floor import Request
from fog_bridges.vda5050.outgoing import ActionState
from fog_bridges.vda5050.uncertain import LATE_S, UNCERTAIN

if TYPE_CHECKING:
    from fog_bridges.floor import Answer
    from fog_bridges.vda5050.outgoing import ActionStatus

START: Final = "startCharging"
COMMANDS: Final = {START: "dock", "stopCharging": "undock"}
NO_DOCK: Final = "the site gives this robot no dock: set `dock` of its [[robots]] entry in site.toml"
_OVER: Final = ("no_mission", "mission_changed")
"""Problems of a mission's end that say that it has ended, or another has begun."""
INSTANT_MAX: Final = 50
"""Instant actions of which a state tells: the latest."""
IDLE_S: Final = 5.0
"""A robot that neither wants to its dock nor drives into or off it for so long has given that up."""
NEAR_M: Final = 1.0
"""A mission that ends so near the dock is the one that leads to it: it ends 0.7 m in front."""


def told(states: dict[str, ActionState], name: str, kind: str, status: ActionStatus, result: str = "") -> None:
    """Put an action's state in its place."""
    states[name] = ActionState(action_id=name, action_type=kind, action_status=status, action_result=result)


def remember_action(
    states: dict[str, ActionState], name: str, kind: str, status: ActionStatus, result: str = ""
) -> None:
    """Put an instant action's state behind all others, and drop what is done long ago."""
    states.pop(name, None)
    told(states, name, kind, status, result)
    if len(states) > INSTANT_MAX:
        done = (key for key, each in states.items() if each.action_status != "RUNNING")
        states.pop(next(done, next(iter(states))))


def drop_done(states: dict[str, ActionState]) -> None:
    """Drop all instant actions that are not under way."""
    for name in [name for name, each in states.items() if each.action_status != "RUNNING"]:
        del states[name]


class Charging:
    """The one action of a robot that has to do with its dock, if there is one. `now` is s of a monotonic clock."""

    def __init__(self, robot: str) -> None:
        self._path = f"/api/v1/robots/{robot}"
        self._states: dict[str, ActionState] = {}
        self._name = ""
        self.kind = ""
        """The action that is carried out; empty without one."""
        self.doubt = ""
        """Why nobody knows whether the last action is over, until somebody has read it; empty if it is."""
        self._command: Request | None = None
        """What was asked of the floor; None before that."""
        self._is_cancelled = self._is_answered = self._is_sure = False
        self._asked_at = self._seen_at = -math.inf

    def why_not(self, kind: str, mode: tuple[str, str], *, has_dock: bool, is_ordered: bool) -> str:
        """Return why an instant action can't be done in an operating mode; empty if it can."""
        checks = (
            (kind not in COMMANDS, f"a robot of Fognav can't {kind[:60]}"),
            (not has_dock, NO_DOCK),
            (mode[0] != "AUTOMATIC", f"the fleet is not in control: {mode[1]}"),
            (bool(self.kind), f"{self.kind} is carried out already"),
            (is_ordered, "an order is active: put the action on a node of it, or cancel the order first"),
        )
        return next((words for holds, words in checks if holds), "")

    def begin(self, states: dict[str, ActionState], name: str, kind: str) -> None:
        """Carry out an action, and keep its state in `states`."""
        self._states, self._name, self.kind, self.doubt = states, name, kind, ""
        self._command, self._is_cancelled, self._is_answered, self._is_sure = None, False, False, False
        told(states, name, kind, "RUNNING")

    def end(self, status: ActionStatus, result: str = "") -> None:
        """Tell what became of the action."""
        if self.kind:
            told(self._states, self._name, self.kind, status, result)
            self.kind = ""

    def cancel(self) -> None:
        """Give up the way to the dock: at once, or by ending the mission there. The last 0.7 m are the base's own."""
        if self._command is None:
            self.end("FAILED", "it was cancelled")
        self._is_cancelled = True

    def request(self, view: dict[str, Any], now: float) -> Request | None:
        """Return the next request to the floor; None: there is nothing to ask."""
        if not self.kind:
            return None
        if self._command is None:
            self._asked_at = now
            self._command = Request("POST", f"{self._path}/commands", {"kind": COMMANDS[self.kind]})
            return self._command
        if not self._is_cancelled or not self.is_way(view):
            return None
        self._is_cancelled = False
        return Request("DELETE", f"{self._path}/goal", headers={"If-Match": f'"{view["goal"]["goal_id"]}"'})

    def on_answer(self, request: Request, answer: Answer, now: float) -> None:
        """Take in the answer to a command; what nobody knows of, the robot's state shows."""
        if request is self._command:
            self._is_answered, self._is_sure, self._seen_at = True, self._is_sure or not answer.refusal, now
            if answer.refusal and answer.problem not in UNCERTAIN:
                self.end("FAILED", answer.refusal)
        elif request.method == "DELETE" and answer.refusal and answer.problem not in _OVER:
            self._is_cancelled = True  # and asked again

    def is_way(self, view: dict[str, Any]) -> bool:
        """Whether the robot's mission leads to the dock by this action."""
        goal, dock = view["goal"], view.get("dock")
        if self.kind != START or self._command is None or goal is None or dock is None:
            return False
        return math.dist((goal["pose"]["x"], goal["pose"]["y"]), (dock["x"], dock["y"])) < NEAR_M

    def advance(self, state: dict[str, Any], now: float) -> None:
        """Find out by the robot's state what became of the action."""
        is_moving = state["mode"] in ("DOCK", "INIT")  # until the lidar runs, a robot that leaves its dock is in INIT
        if not self.kind:
            return
        if bool(state.get("docked")) == (self.kind == START) and not is_moving:
            self.end("FINISHED")
        elif is_moving or state.get("wants_dock") or "docking" in state.get("codes", ()):
            self._is_sure, self._seen_at = self._command is not None, now
        elif self._is_answered and now - self._seen_at > IDLE_S:
            reasons = dict(zip(state.get("codes", ()), state.get("reasons", ()), strict=False))
            if self._is_sure:
                self.end("FAILED", reasons.get("docking_given_up", "the robot has given it up"))
            elif now - self._asked_at >= LATE_S:
                self.doubt = "the floor does not say whether the robot was told: look whether it begins after all"
                self.end("FAILED", self.doubt)
