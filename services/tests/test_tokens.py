"""Who may do and see what in the running services: tokens made and revoked by command, and which reads need one."""

import asyncio
import json
import os
from pathlib import Path

import httpx
import programs
import pytest

pytestmark = pytest.mark.live

SERVICES = ("hazard_aggregator", "map_service", "planner")
PUBLIC = {
    "/healthz", "/leads", "/readyz", "/metrics", "/openapi.json",
    "/api/v1/alerts", "/api/v1/prometheus/robots",
    "/api/v1/areas", "/api/v1/areas/{area_id}", "/api/v1/areas/{area_id}/history",
    "/api/v1/areas/{area_id}/override", "/api/v1/nodes",
    "/api/v1/hazards", "/api/v1/map", "/api/v1/map.png", "/api/v1/map.yaml", "/api/v1/costmap.png", "/api/v1/places",
    "/api/v1/zones", "/api/v1/zones/{zone_id}", "/api/v1/zones.geojson", "/api/v1/unusable-zones",
    "/api/v1/masks/keepout.png", "/api/v1/masks/keepout.yaml", "/api/v1/masks/speed.png", "/api/v1/masks/speed.yaml",
    "/api/v1/places/{place}", "/api/v1/zone-sets", "/api/v1/zone-sets/{set_id}",
}  # fmt: skip
"""Reads for everybody on the floor (docs/security.md); whatever else is read tells about people."""

HIGHER = {"/api/v1/map/previews/{preview}.png": "admin", "/api/v1/visits": "operator"}


@pytest.fixture(scope="module")
def urls(all_services) -> dict[str, str]:
    return {service: asyncio.run(all_services.ready(service)) for service in SERVICES}


def token_command(fog, *arguments: str) -> str:
    """Run `fognav token` as on the computer of the services; return what it printed."""
    environment = {**os.environ, "FOGNAV_TOKENS_FILE": fog.environment["FOGNAV_TOKENS_FILE"]}
    done = programs.run(["token", *arguments], environment, Path.cwd(), 120.0)
    assert done.returncode == 0, done.stderr
    return done.stdout


def listed(fog) -> list[tuple[str, str]]:
    found = json.loads(token_command(fog, "list", "--json"))["tokens"]
    return [(entry["name"], entry["role"]) for entry in found]


def bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


def statuses(urls: dict[str, str], token: str) -> list[int]:
    """What each service answers to a write with this token, one that asks for nothing that exists."""
    writes = {
        "hazard_aggregator": ("DELETE", "/api/v1/areas/none/override"),
        "map_service": ("DELETE", "/api/v1/zones/none"),
        "planner": ("DELETE", "/api/v1/robots/none/goal"),
    }
    return [
        httpx.request(method, f"{urls[service]}{path}", headers=bearer(token)).status_code
        for service, (method, path) in writes.items()
    ]


def test_created_token_writes_at_once_and_a_revoked_one_is_refused_by_all_services(all_services, urls):
    pids = {name: process.pid for name, process in all_services.processes.items()}
    token = token_command(all_services, "create", "caretaker", "--role", "operator").strip()
    assert ("caretaker", "operator") in listed(all_services)
    assert statuses(urls, token) == [404, 404, 404]
    weak = token_command(all_services, "create", "display", "--role", "viewer").strip()
    assert statuses(urls, weak) == [403, 403, 403]
    token_command(all_services, "revoke", "caretaker")
    assert statuses(urls, token) == [401, 401, 401]
    assert "caretaker" not in dict(listed(all_services))
    assert statuses(urls, weak) == [403, 403, 403], "the other tokens stay"
    assert {name: process.pid for name, process in all_services.processes.items()} == pids
    assert all(process.poll() is None for process in all_services.processes.values())


def test_every_read_that_tells_about_people_needs_a_token(urls, tokens):
    seen, wrong = set(), []
    for url in urls.values():
        for path, operations in httpx.get(f"{url}/openapi.json").json()["paths"].items():
            if "get" not in operations:
                continue
            seen.add(path)
            address = f"{url}{path.replace('{robot}', 'r1').replace('{', '').replace('}', '')}"
            without = httpx.get(address).status_code
            if (without == 401) == (path in PUBLIC):
                wrong.append(f"{path} without a token: {without}")
            role = HIGHER.get(path, "viewer")
            if httpx.get(address, headers=tokens[role]).status_code in (401, 403):
                wrong.append(f"{path} is refused to the role {role}")
    assert wrong == []
    assert seen > PUBLIC - {"/openapi.json"}
