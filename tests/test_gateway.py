"""The gateway passes each request to the service that has its route."""

import json
import re
import shutil
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Final

import httpx
import pytest

from console_service.forward import ROUTES, URGENT, service_of
from fog_runtime.configuration.site import load_site
from fog_runtime.health import Health
from fog_runtime.http import Tokens, unused
from fog_runtime.http.openapi import merged
from fog_supervisor import child, net
from fognav.documentation import rest_routes
from planner.api import make_api as make_planner

ROOT: Final = Path(__file__).parents[1]
CADDYFILE: Final = (ROOT / "deploy" / "gateway" / "Caddyfile").read_text("utf-8")
EACH: Final = ("/api/v1/store", "/healthz", "/leads", "/readyz", "/metrics")
"""What every service has by itself, behind its own name."""
NAMES: Final = {
    "aggregator": "hazard-aggregator",
    "planner": "planner",
    "console": "console-service",
    "bridge": "bridge",
}
"""The Caddyfile's matchers."""


def test_each_route_is_passed_to_its_service():
    routes = {path: service for service, api in rest_routes().items() for path in api["paths"]}
    passed = {path: service_of(path) for path in routes if not path.startswith(EACH)}
    assert len(passed) > 20
    assert {path: service for path, service in passed.items() if service != routes[path]} == {}


def test_caddy_and_the_console_service_have_one_table_of_routes():
    matchers = dict(re.findall(r"@(\w+) path (.+)", CADDYFILE))
    expected = {
        name: " ".join(f"/api/v1/{route} /api/v1/{route}/*" for route in ROUTES[service])
        for name, service in NAMES.items()
    }
    assert matchers == expected
    assert re.search(r"handle /api/\* \{\s+import map-service", CADDYFILE), "and the map-service has the rest"


def test_services_have_no_route_in_common_but_what_the_gateway_keeps_apart():
    routes = [path for api in rest_routes().values() for path in api["paths"] if not path.startswith(EACH)]
    assert sorted(set(routes)) == sorted(routes)


def test_stops_have_places_of_their_own_at_the_console_s_address_too():
    services = unused()
    app = make_planner(services, load_site(ROOT / "sites" / "estig").site, Health(), Tokens())
    assert set(app.state.urgent) == set(URGENT)


def described(schema: dict[str, object], **others: dict[str, object]) -> dict[str, object]:
    """Return a document with one route that answers with the schema `Part`."""
    answer = {"content": {"application/json": {"schema": {"$ref": "#/components/schemas/Part"}}}}
    path = {"get": {"operationId": "part", "responses": {"200": answer}}}
    components = {"schemas": {"Part": schema, **others}}
    return {"openapi": "3.1.0", "info": {"version": "1"}, "paths": {"/readyz": path}, "components": components}


def schema_of(document: dict[str, Any], path: str) -> str:
    answer = document["paths"][path]["get"]["responses"]["200"]["content"]["application/json"]["schema"]
    return str(answer["$ref"].rpartition("/")[2])


def test_schemas_of_one_name_that_differ_have_distinct_names_in_the_merged_document():
    number, text = {"type": "number"}, {"type": "string"}
    document = merged({"map-service": described(number), "planner": described(text), "aggregator": described(text)})
    assert document["components"]["schemas"] == {
        "AggregatorPart": text, "MapServicePart": number, "PlannerPart": text,
    }  # fmt: skip
    assert schema_of(document, "/map-service/readyz") == "MapServicePart"
    assert schema_of(document, "/planner/readyz") == "PlannerPart"
    same = merged({"map-service": described(text), "planner": described(text)})
    assert same["components"]["schemas"] == {"Part": text}
    nested = {"anyOf": [{"$ref": "#/components/schemas/Inner"}]}
    document = merged({"a": described(nested, Inner=number), "b": described(nested, Inner=text)})
    assert document["components"]["schemas"]["BPart"] == {"anyOf": [{"$ref": "#/components/schemas/BInner"}]}


def test_merged_document_has_every_route_once_and_names_only_schemas_that_it_has():
    services = rest_routes()
    document = merged(services)
    assert document == merged(dict(reversed(services.items())))
    count = sum(len(operations) for api in services.values() for operations in api["paths"].values())
    operations = [operation for path in document["paths"].values() for operation in path.values()]
    assert len(operations) == count == len({operation["operationId"] for operation in operations})
    named = re.findall(r'"#/components/schemas/([^"]+)"', json.dumps(document))
    assert set(named) == set(document["components"]["schemas"])
    assert document["x-problems"].keys() == {code for api in services.values() for code in api["x-problems"]}


def test_each_problem_says_what_to_do() -> None:
    problems = {
        (service, code): each for service, api in rest_routes().items() for code, each in api["x-problems"].items()
    }
    assert len(problems) > 50
    assert [known for known, problem in problems.items() if len(problem["remedy"]) < 10] == []


class Service(BaseHTTPRequestHandler):
    """Tells the name of the service, and what it was asked."""

    name: str

    def do_GET(self) -> None:
        answer = json.dumps({"service": self.name, "path": self.path, "proto": self.headers["X-Forwarded-Proto"]})
        self.send_response(200)
        self.end_headers()
        self.wfile.write(answer.encode())

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def caddy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Run Caddy in front of services that tell their names; the planner does not run."""
    if shutil.which("caddy") is None:
        pytest.skip("caddy is not installed")
    port = net.free_port()
    # Without certificates, which only a fog node has; its other doors are not opened.
    plain = CADDYFILE.replace("tls /run/locks/server.pem /run/locks/server.key", "").replace(":8443 {", f":{port} {{")
    plain = plain[: plain.index("# The same services")].replace("planner:8000", f"127.0.0.1:{net.free_port()}")
    with ExitStack() as stack:
        for name in ("hazard-aggregator", "map-service", "console-service"):
            server = ThreadingHTTPServer(("127.0.0.1", 0), type(name, (Service,), {"name": name}))
            threading.Thread(target=server.serve_forever, daemon=True).start()
            stack.callback(server.server_close)
            stack.callback(server.shutdown)
            plain = plain.replace(f"{name}:8000", f"127.0.0.1:{server.server_port}")
        file, log = tmp_path / "Caddyfile", tmp_path / "log"
        file.write_text(plain, "utf-8")
        for variable in ("XDG_CONFIG_HOME", "XDG_DATA_HOME"):
            monkeypatch.setenv(variable, str(tmp_path))
        command = child.command("caddy", "run", "--config", str(file), "--adapter", "caddyfile")
        output = stack.enter_context(log.open("wb"))
        process = stack.enter_context(subprocess.Popen(command, stdout=output, stderr=output))
        stack.callback(process.terminate)
        deadline = time.monotonic() + 60.0
        while True:
            try:
                httpx.get(f"http://127.0.0.1:{port}/links")
                break
            except httpx.TransportError:
                assert time.monotonic() < deadline, log.read_text()
                assert process.poll() is None, log.read_text()
                time.sleep(0.05)
        yield f"http://127.0.0.1:{port}"


def test_caddy_passes_the_page_to_the_console_and_each_route_to_its_service(caddy: str) -> None:
    for path, service, seen in (
        ("/", "console-service", "/"),
        ("/assets/app.js", "console-service", "/assets/app.js"),
        ("/api/v1/session", "console-service", "/api/v1/session"),
        ("/api/v1/events?scan=r1", "console-service", "/api/v1/events?scan=r1"),
        ("/api/v1/areas/z1", "hazard-aggregator", "/api/v1/areas/z1"),
        ("/api/v1/zones", "map-service", "/api/v1/zones"),
        ("/map-service/api/v1/store", "map-service", "/api/v1/store"),
        ("/console-service/readyz", "console-service", "/readyz"),
    ):
        answer = httpx.get(caddy + path, headers={"X-Forwarded-Proto": "https"})
        assert answer.json() == {"service": service, "path": seen, "proto": "http"}, "and believes no client"
    assert httpx.get(f"{caddy}/api/v1/store").status_code == 404
    links = httpx.get(f"{caddy}/links")
    assert re.findall(r'href="(/[^"]*)"', links.text)[1:3] == ["/prometheus/consoles/robots.html", "/grafana/"]


def test_caddy_names_a_service_that_does_not_run(caddy: str) -> None:
    answer = httpx.get(f"{caddy}/api/v1/robots")
    assert (answer.status_code, answer.headers["content-type"]) == (502, "application/problem+json")
    assert answer.headers["retry-after"] == "1"
    problem = answer.json()
    assert (problem["type"], problem["service"], problem["status"]) == ("urn:fognav:service_away", "planner", 502)
    assert problem["detail"].startswith("planner does not run")
