"""REST: missions that begin by the clock."""

from __future__ import annotations

import secrets
from typing import TYPE_CHECKING, Protocol

import msgspec

from fog_contracts.messages import Code, Id, Message, Stamp, WeeklySchedule
from fog_contracts.weekly import Windows, is_time_zone
from fog_runtime.http import (
    Answer,
    Body,
    HttpProblem,
    IfMatch,
    Operator,
    ProblemError,
    Routes,
    Viewer,
    etag,
    expected_tag,
)
from fog_runtime.http.store_routes import IfNoneMatch, must_be_new
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.stores.redis_store import ANY
from planner.problems import PlannerProblem
from planner.schedules.occasions import SCHEDULES_MAX
from planner.stops import MissionBody, ScheduledMission
from planner.tours.api import check_best, stop_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from planner.api_commands import KnownPlaces
    from planner.schedules.persistence import SchedulePersistence
    from planner.schedules.scheduling import Scheduling


class ScheduleBody(Message, frozen=True, kw_only=True):
    """A mission that a robot gets once in each window of `weekly`, if it is free within that window."""

    robot: Id
    mission: MissionBody
    weekly: WeeklySchedule
    enabled: bool = True


class ScheduleView(ScheduledMission, frozen=True, kw_only=True):
    """A scheduled mission; `next`: when its next window begins. `waits`: why the one that is due was not given yet.

    `waits_code` identifies that (`ScheduleCode`, a problem, `PlanRefusal` or `ReasonCode`), where it has an identifier.
    """

    next: Stamp | None
    waits: str
    waits_code: Code


class Planner(Protocol):
    """What the routes need of the planner's service."""

    missions: SchedulePersistence
    scheduling: Scheduling

    def stamp(self) -> float:
        """Return the time, s since the epoch."""


class _Schedules:
    """The schedules of the service that leads; its methods raise a `ProblemError` for what can't be done."""

    def __init__(self, service: Planner, standby: Callable[[], str], check: Callable[[str], None]) -> None:
        self._service = service
        self._standby = standby
        self._check_robot = check

    @property
    def known(self) -> dict[str, ScheduledMission]:
        """All of them by id."""
        if reason := self._standby():
            raise ProblemError(HttpProblem.STANDS_BY, f"{reason}; send the request there")
        return self._service.missions.schedules

    def find(self, name: str) -> ScheduledMission:
        """Return the one of this id."""
        found = self.known.get(name)
        if found is None:
            known = ", ".join(sorted(self.known)) or "none"
            raise ProblemError(PlannerProblem.NO_SCHEDULE, f"there is no schedule {name}; there are: {known}")
        return found

    def view(self, schedule: ScheduledMission) -> ScheduleView:
        """Return one as it is shown."""
        fields = {name: getattr(schedule, name) for name in schedule.__struct_fields__}
        scheduling = self._service.scheduling
        waits = scheduling.waits_for(schedule)
        return ScheduleView(**fields, next=scheduling.following(schedule), waits=str(waits), waits_code=waits.code)

    def check(self, name: str, body: ScheduleBody, places: KnownPlaces) -> None:
        """Check what does not change by itself: ids, goals, the time zone, and how many there are."""
        try:
            msgspec.convert(name, Id)
        except msgspec.ValidationError:
            detail = f"{name!r} is no valid id: use a to z, 0 to 9 and -, at most 32"
            raise ProblemError(HttpProblem.REQUEST_INVALID, detail, field="path") from None
        self._check_robot(body.robot)
        for number, stop in enumerate(body.mission.stops):
            stop_of(stop, places(), self._service.missions.site, f"body.mission.stops.{number}")
        if not is_time_zone(zone := body.weekly.time_zone):
            detail = f"{zone!r} is no time zone that this machine knows: name one such as Europe/Lisbon"
            raise ProblemError(HttpProblem.REQUEST_INVALID, detail, field="body.weekly.time_zone")
        window = Windows(body.weekly).latest(self._service.stamp())
        if window is not None and not window.is_one:
            detail = "the windows leave no gap in a week, so that none ever begins: let a minute pass between two"
            raise ProblemError(HttpProblem.REQUEST_INVALID, detail, field="body.weekly.times")
        check_best(body.mission, self._service.missions.site, "body.mission")
        if name not in self.known and len(self.known) >= SCHEDULES_MAX:
            detail = f"there are {SCHEDULES_MAX} schedules already, which is the limit: delete one that is not needed"
            raise ProblemError(HttpProblem.REQUEST_INVALID, detail, field="body")

    async def write(self, name: str, record: ScheduledMission | None, who: str, expected: str) -> None:
        """Store one, or delete it (None)."""
        action = "delete" if record is None else "put"
        outcome = await self._service.missions.put_schedule(name, record, who, action, expected=expected)
        if outcome != "ok" and not (record is None and outcome == "missing"):
            detail = f"schedule {name} is not the one that was expected: read it again, then retry"
            raise ProblemError(PlannerProblem.SCHEDULE_CHANGED, detail)


def add_schedules(
    routes: Routes, service: Planner, check: Callable[[str], None], places: KnownPlaces, standby: Callable[[], str]
) -> None:
    """Add the routes; `check` raises for an unknown robot. While `standby` returns a reason, none can be read."""
    schedules = _Schedules(service, standby, check)

    def answer(schedule: ScheduledMission, status: int = 200) -> Answer[ScheduleView]:
        return Answer(schedules.view(schedule), etag(schedule.version), status=status)

    @routes.get("/api/v1/schedules", problems=[HttpProblem.STANDS_BY])
    async def list_schedules(_caller: Viewer) -> list[ScheduleView]:
        """List the missions that begin by the clock, and what became of the last one of each."""
        return [schedules.view(one) for _, one in sorted(schedules.known.items())]

    @routes.get("/api/v1/schedules/{schedule}", problems=[HttpProblem.STANDS_BY, PlannerProblem.NO_SCHEDULE])
    async def get_schedule(schedule: str, _caller: Viewer) -> Answer[ScheduleView]:
        """Return one of them with its ETag."""
        return answer(schedules.find(schedule))

    @routes.put(
        "/api/v1/schedules/{schedule}",
        status=(200, 201),
        raises=[StoreError],
        problems=[PlannerProblem.NO_ROBOT, PlannerProblem.NO_PLACE, PlannerProblem.SCHEDULE_CHANGED],
    )
    async def put_schedule(
        schedule: str,
        body: Body[ScheduleBody],
        caller: Operator,
        if_match: IfMatch = None,
        if_none_match: IfNoneMatch = None,
    ) -> Answer[ScheduleView]:
        """Add or replace a mission that begins by the clock. It counts from the next window on: nothing starts at once.

        With If-Match, only if it is still the one that was read; with `If-None-Match: *`, only if there is none.
        """
        schedules.check(schedule, body, places)
        before = schedules.known.get(schedule)
        record = ScheduledMission(
            id=schedule, robot=body.robot, mission=body.mission, weekly=body.weekly, enabled=body.enabled,
            author=caller.name, since=service.scheduling.written_at(), version=secrets.token_hex(8),
            last=None if before is None else before.last,
        )  # fmt: skip
        expected = "0" if must_be_new(if_none_match) else expected_tag(if_match) or ANY
        await schedules.write(schedule, record, caller.name, expected)
        return answer(record, status=201 if before is None else 200)

    @routes.delete(
        "/api/v1/schedules/{schedule}",
        raises=[StoreError],
        problems=[PlannerProblem.NO_SCHEDULE, PlannerProblem.SCHEDULE_CHANGED],
    )
    async def delete_schedule(schedule: str, caller: Operator, if_match: IfMatch = None) -> None:
        """Remove one of them; a mission that it has begun goes on."""
        schedules.find(schedule)
        await schedules.write(schedule, None, caller.name, expected_tag(if_match) or ANY)
