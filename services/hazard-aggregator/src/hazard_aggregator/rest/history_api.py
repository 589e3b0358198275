"""REST: the history of areas, `/api/v1/areas/{area_id}/history`."""

from fog_contracts.handlers import Moment
from fog_runtime.clock import Clock
from fog_runtime.http import Answer, PageSize, ProblemError, Routes, next_page
from fog_runtime.stores.audit import CursorError
from hazard_aggregator.areas.area_history import PeriodView
from hazard_aggregator.service import Service
from hazard_aggregator.store import StoreError


def add_history(routes: Routes, service: Service, clock: Clock) -> None:
    """Add the route that reads histories; `routes` knows the errors of the store."""
    routes.raises(
        CursorError, {422: "The cursor is invalid"}, lambda error: ProblemError(422, str(error), field="query.cursor")
    )

    @routes.get(
        "/api/v1/areas/{area_id}/history", raises=[CursorError, StoreError], problems={404: "No area has this id"}
    )
    async def area_history(area_id: str, limit: PageSize, cursor: str | None = None) -> Answer[list[PeriodView]]:
        """Return an area's states and how long each lasted, newest first; the Link header has the next page's address.

        A period continues over restarts. The history goes back by 90 days, and 10,000 periods.
        """
        if not any(known.id == area_id for known in service.core.definitions()):
            raise ProblemError(404, f"there is no area {area_id}")
        page = await service.history.page(area_id, cursor, limit, Moment(clock.now(), clock.stamp(), clock=clock.id))
        return Answer(page.periods, next_page(f"/api/v1/areas/{area_id}/history", page.next, limit))
