"""The gateway passes each request to the service that has its route."""

import re
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Final

from fognav.generated import rest_routes

CADDYFILE: Final = (Path(__file__).parents[1] / "deploy" / "gateway" / "Caddyfile").read_text("utf-8")
EACH: Final = ("/api/v1/store", "/healthz", "/readyz", "/metrics")
"""What every service has by itself, behind its own name."""


def answering(path: str) -> str:
    """Return the service to which the gateway's matchers pass a path; `map-service` gets the rest of the API."""
    named = {"aggregator": "hazard-aggregator", "planner": "planner"}
    for name, patterns in re.findall(r"@(\w+) path (.+)", CADDYFILE):
        if any(fnmatchcase(path, pattern) for pattern in patterns.split()):
            return named[name]
    return "map-service"


def test_each_route_is_passed_to_its_service():
    routes = {path: service for service, api in rest_routes().items() for path in api["paths"]}
    wrong = {
        path: (service, answering(path))
        for path, service in routes.items()
        if not path.startswith(EACH) and answering(path) != service
    }
    assert len(routes) > 20
    assert wrong == {}


def test_services_have_no_route_in_common_but_what_the_gateway_keeps_apart():
    seen: dict[str, str] = {}
    common = []
    for service, api in rest_routes().items():
        for path in api["paths"]:
            if path in seen and not path.startswith(EACH):
                common.append((path, seen[path], service))
            seen[path] = service
    assert common == []
