"""REST: the active alerts, `/api/v1/alerts`, and their acknowledgement. Their history is in the audit trail."""

from fog_contracts.messages import Alert
from fog_runtime.http import Operator, ProblemError, Routes, add_store_errors
from hazard_aggregator.areas.alerts import AlertError
from hazard_aggregator.service import Service
from hazard_aggregator.store import StoreError


def add_alerts(routes: Routes, service: Service) -> None:
    """Add the routes of alerts."""
    add_store_errors(routes)
    routes.raises(AlertError, {404: "There is no such alert"}, lambda error: ProblemError(404, str(error)))

    @routes.get("/api/v1/alerts")
    async def alerts() -> list[Alert]:
        """Return the active alerts, oldest first: areas and nodes that people should look after.

        Those that began, ended or were acknowledged earlier are in the audit trail (kind `alert`).
        """
        return service.alerts.active()

    @routes.put("/api/v1/alerts/{alert_id}/acknowledgement", raises=[AlertError, StoreError])
    async def acknowledge(alert_id: str, caller: Operator) -> Alert:
        """Record that somebody looks after an alert; it stays until its condition ends."""
        return await service.alerts.acknowledge(alert_id, caller.name)
