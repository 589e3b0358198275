"""A client of the planner's REST API, for whoever acts as an operator: the demonstration, the robot unit."""

from __future__ import annotations

import http.client
from urllib.parse import urlsplit

from fog_supervisor import net


def put_goal(planner_url: str, robot: str, place: str, token: str) -> net.Response:
    """Give a robot a place of the site as its goal; return the planner's answer, which may be a refusal.

    Raises `OSError` if the planner can't be reached, `ValueError` for an address that is not like `http://host:8000`.
    """
    address = urlsplit(planner_url)
    if address.scheme != "http" or not address.hostname:
        raise ValueError(f"the planner's address must look like http://host:8000, not {planner_url}")
    try:
        return net.request(
            "PUT",
            address.port or http.client.HTTP_PORT,
            f"{address.path.rstrip('/')}/api/v1/robots/{robot}/goal",
            body={"place": place},
            token=token,
            host=address.hostname,
        )
    except http.client.HTTPException as error:
        raise ConnectionError(f"the planner closed the connection: {error!r}") from error
