"""The missions of all robots, and the order in which their paths are searched."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from planner.replanning.mission import Mission

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from fog_contracts.grid import GridGeometry
    from fog_contracts.messages import Refusal, RobotGoal
    from planner.config import PlannerConfig
    from planner.maps.planning_map import Cell
    from planner.replanning.mission import Explained, Plan, ReplanReason
    from planner.search.path_search import Question

_URGENCY: Final[dict[ReplanReason, int]] = {
    "map": 0, "off_path": 1, "epoch": 2, "goal": 3, "clearing": 4, "refused": 5,
}  # fmt: skip
"""Whose path is searched first; among equals the robot nearest to the change along its path."""


class Missions:
    """The missions by robot."""

    def __init__(self) -> None:
        self._missions: dict[str, Mission] = {}
        self._reached: list[tuple[str, str]] = []

    def of(self, robot: str) -> Mission:
        """Return a robot's mission, which may have no goal."""
        mission = self._missions.get(robot)
        if mission is None:
            mission = self._missions[robot] = Mission()
        return mission

    def items(self) -> list[tuple[str, Mission]]:
        """Return all robots with their missions."""
        return list(self._missions.items())

    def active(self) -> Iterator[tuple[str, Mission]]:
        """Yield the robots that have a goal, with their missions."""
        return ((robot, mission) for robot, mission in self.items() if mission.target is not None)

    def set_goal(self, robot: str, goal: RobotGoal, *, any_heading: bool) -> None:
        """Give a robot a mission; the same goal again changes nothing. `any_heading`: ignore the goal's theta."""
        if goal.pose is None:
            self.of(robot).end()
        else:
            self.of(robot).begin(goal, any_heading=any_heading)

    def goal(self, robot: str) -> RobotGoal | None:
        """Return the robot's goal, if it has one."""
        mission = self._missions.get(robot)
        return mission.goal if mission and mission.target else None

    def reach(self, robot: str, goal_id: str) -> None:
        """End a robot's mission because it has reached this goal; another goal of it stays."""
        goal = self.goal(robot)
        if goal is not None and goal.goal_id == goal_id:
            self.of(robot).end()
            self._reached.append((robot, goal_id))

    def publish_all_now(self) -> None:
        """Make all goals and paths due."""
        for mission in self._missions.values():
            mission.publish_all_now()

    def drop(self) -> None:
        """Forget all goals and plans, without telling the robots."""
        self._reached.clear()
        for mission in self._missions.values():
            mission.drop()

    def pop_reached(self) -> list[tuple[str, str]]:
        """Return (robot, goal id) of the goals that were reached since the last call."""
        reached, self._reached = self._reached, []
        return reached

    def located(self, now: float, config: PlannerConfig) -> set[str]:
        """Return the robots that have a goal and a recent pose."""
        return {
            robot
            for robot, mission in self.active()
            if mission.pose is not None and now - mission.pose_received <= config.max_pose_age_s
        }

    def to_replan(self, now: float, config: PlannerConfig) -> list[tuple[str, Mission, ReplanReason]]:
        """Return the located robots whose search is due now, most urgent first."""
        located = self.located(now, config)
        due = [
            (robot, mission, reason)
            for robot, mission in self.active()
            if robot in located and (reason := mission.replan_due(now, config)) is not None
        ]
        return sorted(due, key=lambda entry: (_URGENCY[entry[2]], entry[1].danger))

    def unexplained(self, now_known: Explained, now: float, config: PlannerConfig) -> dict[str, tuple[Plan, Question]]:
        """Return the refused plans whose reasons are unknown or may have changed, by robot, each with what is open.

        `now_known`: the newest versions of map and regions. While the map changes, reasons are not asked for all the
        time.
        """
        found = {}
        for robot, mission in self.active():
            plan = mission.plan
            if plan is None or plan.question is None:
                continue
            known = plan.explained_for
            new_regions = known is None or known[1] != now_known[1]
            new_map = known is not None and known[0] != now_known[0]
            if new_regions or (new_map and now - plan.explained_at >= config.explain_period_s):
                found[robot] = plan, plan.question
        return found

    def explain(
        self, plans: Mapping[str, Plan], answers: Mapping[str, Refusal], explained_for: Explained, now: float
    ) -> bool:
        """Use the explained refusals of these robots' plans; return whether one differs from what was published."""
        changed = False
        for robot, plan in plans.items():
            plan.explained_for, plan.explained_at = explained_for, now
            refusal, mission = answers.get(robot), self.of(robot)
            if refusal is not None and mission.plan is plan and refusal != plan.refusal:
                mission.replace_refusal(refusal)
                changed = True
        return changed

    def search_again(self, goal: Cell, geometry: GridGeometry) -> None:
        """Search again for the robots whose search for a path to a goal's cell took too long: it has a field now."""
        for _, mission in self.active():
            target = mission.target
            if target is None or not mission.search_ran_out:
                continue
            if geometry.cell(target.x, target.y) == goal:
                mission.request_replan("refused", [])

    def goal_cells(self, geometry: GridGeometry) -> Iterator[Cell]:
        """Yield the cells of all goals that lie on the map."""
        for _, mission in self.active():
            if mission.target is not None:
                cell = geometry.cell(mission.target.x, mission.target.y)
                if geometry.contains_cell(*cell):
                    yield cell
