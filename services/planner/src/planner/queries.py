"""Answers that change nothing and may take long: plans on request, ways out of blocked areas, reasons of refusals.

They work on a `View`, a copy of what the core knows, so they run on another thread than the core.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from fog_contracts.messages import PlanReply
from planner.path_search import PathSearch, find_egress
from planner.refusals import Cuts, goal_occupied, nearest_reachable, no_map, no_path, start_occupied
from planner.regions import Regions

if TYPE_CHECKING:
    from collections.abc import Mapping

    from fog_contracts.messages import EgressRequest, PlanRequest, Refusal
    from fog_kernels.guides import GoalField
    from fog_kernels.landmarks import Landmarks
    from planner.config import PlannerConfig
    from planner.missions import Plan
    from planner.path_search import Covers, Question, SearchResult
    from planner.planning_map import Cell, PlanningMap
    from planner.regions import Region, Source


@dataclass(frozen=True)
class View:
    """What the core knows at one moment, unchanged by later messages."""

    planning_map: PlanningMap
    sources: tuple[Source, ...]
    """The hazards and zones that make cells lethal."""
    revision: int
    """The version of `sources`."""
    covers: Covers
    fields: Mapping[Cell, GoalField]
    landmarks: Landmarks | None = None
    """What guides searches to goals without fields; it holds on this map."""


class Answerer:
    """Answers on views; owns the memory of its searches. One thread may use it."""

    def __init__(self, config: PlannerConfig) -> None:
        self._config = config
        self._search: PathSearch | None = None
        self._regions = Regions(config.inflation)
        self._on: tuple[PlanningMap, int, list[Region]] | None = None
        self._cuts: tuple[PlanningMap, int, Cuts] | None = None

    def plan(self, view: View | None, request: PlanRequest) -> PlanReply:
        """Return the path between two poses, or an explained refusal; None as view: there is no map yet."""
        if view is None:
            return PlanReply(refusal=no_map())
        start, goal = (request.start.x, request.start.y), (request.goal.x, request.goal.y)
        field = view.fields.get(view.planning_map.geometry.cell(*goal))
        found = self.search(view).find(
            view.planning_map, view.covers, start, goal, field, landmarks=view.landmarks, thorough=True
        )
        explained = None if found.question is None else self.explain(view, found.question)
        return _reply(found, explained, view.planning_map)

    def egress(self, view: View | None, request: EgressRequest) -> PlanReply:
        """Return the path out of the blocked area in which a robot stands; None as view: there is no map yet."""
        if view is None:
            return PlanReply(refusal=no_map())
        start = (request.pose.x, request.pose.y)
        found = find_egress(view.planning_map, self._regions_on(view), start, self._config, self.search(view).planner)
        return _reply(found, None, view.planning_map)

    def release(self) -> None:
        """Free the memory of searches and the copy of the map; call it when no more queries wait."""
        self._search = self._cuts = self._on = None

    def explain(self, view: View, question: Question) -> Refusal | None:
        """Return the refusal that names what blocks; None if, on this map, nothing does."""
        planning_map = view.planning_map
        start, goal = question.start_cell, question.goal_cell
        closing = question.start_cell if question.kind == "start" else question.goal_cell
        if question.kind != "path":
            inside = [region for region in self._regions_on(view) if region.closes(*closing)]
            if question.kind == "start":
                return start_occupied(question.start, inside)
            if planning_map.components.of(*start) < 0:
                return None
            return goal_occupied(question.goal, nearest_reachable(planning_map, start, goal), inside)
        components = planning_map.components
        if min(components.of(*start), components.of(*goal)) < 0 or components.connected(start, goal):
            return None
        cut = self._cuts_on(view).between(start, goal)
        return no_path(nearest_reachable(planning_map, start, goal), cut)

    def search(self, view: View) -> PathSearch:
        """Return what searches paths on a view's map."""
        geometry = view.planning_map.geometry
        if self._search is None or self._search.geometry != geometry:
            self._search = PathSearch(self._config, geometry)
        return self._search

    def _regions_on(self, view: View) -> list[Region]:
        """Return the regions that are on; the same list for the same map and sources."""
        if self._on is None or self._on[0] is not view.planning_map or self._on[1] != view.revision:
            self._on = view.planning_map, view.revision, self._regions.on(view.planning_map, view.sources)
        return self._on[2]

    def _cuts_on(self, view: View) -> Cuts:
        if self._cuts is None or self._cuts[0] is not view.planning_map or self._cuts[1] != view.revision:
            geometry = view.planning_map.geometry
            regions = self._regions.of(geometry, view.sources)
            reach = self._config.inflation.inscribed_radius / geometry.resolution
            cuts = Cuts(view.planning_map, regions, lambda: self.search(view).planner, reach)
            self._cuts = view.planning_map, view.revision, cuts
        return self._cuts[2]


class ExplainJob:
    """Explains the refusals of some robots, given as their plans and questions."""

    thread = "query"

    def __init__(self, view: View, questions: Mapping[str, tuple[Plan, Question]], answerer: Answerer) -> None:
        self.view = view
        self.questions = questions
        self.answers: dict[str, Refusal] = {}
        """By robot, once `run` has returned; a robot that is no longer cut off has none."""
        self._answerer = answerer

    def run(self) -> None:
        """Find the answers (some 20 ms for all robots together with 300 zones on 2000 x 1200 cells)."""
        for robot, (_, question) in self.questions.items():
            refusal = self._answerer.explain(self.view, question)
            if refusal is not None:
                self.answers[robot] = refusal


def _reply(found: SearchResult, explained: Refusal | None, planning_map: PlanningMap) -> PlanReply:
    route = found.route
    return PlanReply(
        points=[(float(x), float(y)) for x, y in route.points.tolist()] if route else [],
        length=route.length if route else 0.0,
        cost=found.cost if route else 0.0,
        map_epoch=planning_map.version.epoch,
        map_seq=planning_map.version.seq,
        refusal=explained or found.refusal,
    )
