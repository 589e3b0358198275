"""The gateway passes each request to the service that has its route."""

import re
import shutil
import subprocess
import time
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Final

import httpx
import pytest

from fog_supervisor import child, net
from fognav.documentation import rest_routes

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


@pytest.mark.skipif(shutil.which("caddy") is None, reason="caddy is not installed")
def test_the_first_page_of_a_fog_node_leads_to_the_robots_cpu_and_what_it_does_not_have_is_404(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    port = net.free_port()
    # Without certificates, which only a fog node has; its other doors are not opened.
    plain = CADDYFILE.replace("tls /run/locks/server.pem /run/locks/server.key", "").replace(":8443 {", f":{port} {{")
    file = tmp_path / "Caddyfile"
    file.write_text(plain[: plain.index("# The same three services")], "utf-8")
    for name in ("XDG_CONFIG_HOME", "XDG_DATA_HOME"):
        monkeypatch.setenv(name, str(tmp_path))
    log = tmp_path / "log"
    command = child.command("caddy", "run", "--config", str(file), "--adapter", "caddyfile")
    with log.open("wb") as output, subprocess.Popen(command, stdout=output, stderr=output) as caddy:
        try:
            deadline = time.monotonic() + 60.0
            while True:
                try:
                    first = httpx.get(f"http://127.0.0.1:{port}/")
                    break
                except httpx.TransportError:
                    assert time.monotonic() < deadline, log.read_text()
                    assert caddy.poll() is None, log.read_text()
                    time.sleep(0.05)
            nothing = httpx.get(f"http://127.0.0.1:{port}/nothing")
        finally:
            caddy.terminate()
    assert (first.status_code, first.headers["content-type"]) == (200, "text/html; charset=utf-8")
    assert re.findall(r'href="(/[^"]*)"', first.text)[:2] == ["/prometheus/consoles/robots.html", "/grafana/"]
    assert nothing.status_code == 404
