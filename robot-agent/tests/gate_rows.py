"""Every condition of the safety gate and what follows of it, and a gate in any mode. All limits are literal here."""

from __future__ import annotations

import math
from typing import NamedTuple

from robot_agent.safety.conditions import SafetyInputs
from robot_agent.safety.gate import SafetyState, step

DT = 0.05
HEALTHY = {
    "map_loaded": True, "map_age": 0.1, "localization": "good", "lidar_age": 0.02, "scan_age": 0.1, "base_age": 0.02,
    "mission": True, "plan_age": 0.1, "released_remaining": 5.0,
}  # fmt: skip


class Row(NamedTuple):
    """A condition: inputs at which it holds, inputs at which it just does not, and what follows."""

    name: str
    holds: dict
    mode: str
    words: str
    not_yet: dict | None = None
    left: str = "alone"
    """By whom a robot in this mode is released: by an operator, or alone."""
    by_hand: str = "ends"
    """What becomes of driving by hand: it ends, goes on, waits, or is only not begun."""


ROWS = [
    Row(
        "position too uncertain",
        {"localization": "weak", "position_sigma": 0.81},
        "HOLD",
        "the robot may be 1.6 m from where it believes to be",
        not_yet={"position_sigma": 0.81},
        by_hand="goes on",
    ),
    Row(
        "may be in a blocked place",
        {"near_blocked": "the no-go zone wet", "position_sigma": 0.4},
        "HOLD",
        "the robot may already be in the no-go zone wet: it may be 0.8 m farther",
        by_hand="goes on",
    ),
    Row("base fault", {"base_fault": "OI mode"}, "FAULT", "base: OI mode", left="operator"),
    Row("bumper", {"bumper": True}, "FAULT", "the bumper is pressed", left="operator"),
    Row("cliff", {"cliff": True}, "FAULT", "a cliff sensor sees no floor", left="operator"),
    Row("wheel drop", {"wheel_drop": True}, "FAULT", "a wheel has dropped", left="operator"),
    Row("guardian lost", {"guardian_lost": "closed"}, "PROTECTIVE_STOP", "the guardian is not connected: closed"),
    Row(
        "guardian silent",
        {"base_age": 0.301},
        "PROTECTIVE_STOP",
        "no message from the guardian for 0.3 s",
        not_yet={"base_age": 0.3},
    ),
    Row(
        "guardian never heard",
        {"base_age": math.inf},
        "PROTECTIVE_STOP",
        "no message from the guardian for as long as the agent runs",
    ),
    Row(
        "wheels held",
        {"base_stopped": "no fresh command"},
        "PROTECTIVE_STOP",
        "the guardian holds the wheels: no fresh command",
    ),
    Row("other wheels", {"wheels_differ": True}, "PROTECTIVE_STOP", "the guardian counts with other wheels"),
    Row("on its dock", {"docked_for": 0.0, "mission": False}, "HOLD", "the robot is on its dock", by_hand="not begun"),
    Row(
        "on its dock, charging",
        {"docked_for": 5.0, "base_stopped": "the base is on its charger, where it does not drive", "mission": False},
        "HOLD",
        "the robot is on its dock",
        by_hand="not begun",
    ),
    Row(
        "wheels held on the dock",
        {"docked_for": 5.0, "base_stopped": "not ready"},
        "PROTECTIVE_STOP",
        "the guardian holds the wheels: not ready",
    ),
    Row(
        "lidar silent",
        {"lidar_age": 0.301},
        "PROTECTIVE_STOP",
        "the lidar has been silent for 0.3 s",
        not_yet={"lidar_age": 0.3},
    ),
    Row(
        "scan lost",
        {"scan_age": 0.451},
        "PROTECTIVE_STOP",
        "no complete scan of the lidar for 0.5 s",
        not_yet={"scan_age": 0.45},
    ),
    Row(
        "scans repeat",
        {"identical_scans": 3},
        "PROTECTIVE_STOP",
        "the lidar repeats itself",
        not_yet={"identical_scans": 2},
    ),
    Row(
        "scans are empty",
        {"empty_scans": 2},
        "PROTECTIVE_STOP",
        "the lidar turns and sees nothing",
        not_yet={"empty_scans": 1},
    ),
    Row("at rest", {"resting": "at rest"}, "HOLD", "at rest", by_hand="waits"),
    Row(
        "pose unknown",
        {"localization": "none"},
        "PROTECTIVE_STOP",
        "the pose is not known yet",
        left="operator",
        by_hand="goes on",
    ),
    Row(
        "pose lost",
        {"localization": "lost", "localization_detail": "no fit"},
        "PROTECTIVE_STOP",
        "the pose is lost: no fit",
        left="operator",
        by_hand="goes on",
    ),
    Row("pose weak", {"localization": "weak"}, "DEGRADED", "the pose is uncertain", by_hand="goes on"),
    Row(
        "in a zone",
        {"inside_blocked": "the zone x"},
        "PROTECTIVE_STOP",
        "the robot is in the zone x",
        left="operator",
        by_hand="goes on",
    ),
    Row(
        "in an area that only sensors block",
        {"inside_blocked": "the blocked area x", "inside_watched": True},
        "PROTECTIVE_STOP",
        "the robot is in the blocked area x",
        by_hand="goes on",
    ),
    Row("map lost", {"map_age": 3.01}, "HOLD", "the map is 3.0 s old", not_yet={"map_age": 0.99}, by_hand="goes on"),
    Row("map late", {"map_age": 1.01}, "DEGRADED", "the map is 1.0 s old", not_yet={"map_age": 1.0}, by_hand="goes on"),
    Row("map still late", {"map_age": 3.0}, "DEGRADED", "the map is 3.0 s old", by_hand="goes on"),
    Row(
        "map gap",
        {"map_gap": 1.01},
        "HOLD",
        "changes of the map have been missing for 1.0 s",
        not_yet={"map_gap": 1.0},
        by_hand="goes on",
    ),
    Row("caution", {"caution": "area z4 is unknown"}, "DEGRADED", "area z4 is unknown", by_hand="goes on"),
    Row(
        "path problem",
        {"path_problem": "goal blocked"},
        "HOLD",
        "goal blocked",
        not_yet={"path_problem": "goal blocked", "mission": False},
        by_hand="goes on",
    ),
    Row(
        "no progress",
        {"path_problem": "no progress along the path for 10 s: an obstacle is near"},
        "HOLD",
        "no progress along the path for 10 s: an obstacle is near",
        not_yet={"path_problem": None},
        by_hand="goes on",
    ),
    Row(
        "planner late",
        {"plan_age": 1.51},
        "DEGRADED",
        "the planner has been silent for 1.5 s",
        not_yet={"plan_age": 1.5},
        by_hand="goes on",
    ),
    Row(
        "planner late before the end",
        {"plan_age": 2.0, "released_remaining": 0.151},
        "DEGRADED",
        "the planner has been silent for 2.0 s",
        by_hand="goes on",
    ),
    Row(
        "planner lost",
        {"plan_age": 1.51, "released_remaining": 0.15},
        "HOLD",
        "and no released path is left",
        not_yet={"plan_age": 1.51, "released_remaining": 0.15, "mission": False},
        by_hand="goes on",
    ),
]
RANK = {"NORMAL": 0, "DEGRADED": 1, "HOLD": 2, "PROTECTIVE_STOP": 3, "FAULT": 4}
CAP = {"INIT": 0.0, "NORMAL": 0.30, "DEGRADED": 0.15, "HOLD": 0.0, "PROTECTIVE_STOP": 0.0, "FAULT": 0.0,
       "TELEOP": 0.15}  # fmt: skip
STOP = {"INIT": "immediate", "NORMAL": "none", "DEGRADED": "none", "HOLD": "ramp", "PROTECTIVE_STOP": "immediate",
        "FAULT": "immediate", "TELEOP": "none"}  # fmt: skip
TO = {
    "INIT": None, "NORMAL": {}, "DEGRADED": {"localization": "weak"}, "HOLD": {"path_problem": "x"},
    "PROTECTIVE_STOP": {"lidar_age": 9.0}, "FAULT": {"bumper": True},
    "TELEOP": {"request": "teleop"},
}  # fmt: skip


def inputs(**changes):
    return SafetyInputs(**{**HEALTHY, **changes})


class Gate:
    def __init__(self, mode="NORMAL"):
        self.state, self.now, self.out = SafetyState(), 100.0, None
        if mode == "INIT":
            self.run()
            return
        self.run(request="enable")
        self.run(2.2)
        assert self.out.mode == "NORMAL"
        if TO[mode]:
            self.run(**TO[mode])
        assert self.out.mode == mode

    def run(self, seconds=DT, **changes):
        for _ in range(max(1, round(seconds / DT))):
            self.now += DT
            self.state, self.out = step(self.state, inputs(**changes), self.now)
            changes.pop("request", None)
        return self.out
