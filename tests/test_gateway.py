"""The gateway passes each request to the service that has its route."""

import json
import re
import shutil
import subprocess
import time
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Final

import httpx
import pytest

from fog_runtime.http.openapi import merged
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
