"""The REST APIs as their OpenAPI describes them: schemathesis sends what fits and what does not to the real services.

It asks all of them under the console's address, by the merged document, as the page and other people's programs do.

Each route gets systematic requests, and sequences of requests follow a record from its creation to its end.
FOGNAV_SCHEMATHESIS_EXAMPLES=N adds N random requests to each route, and lengthens the sequences.
"""

import asyncio
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import httpx
import pytest

from console_service.forward import service_of
from fog_runtime.credentials import Credentials

pytestmark = [pytest.mark.live, pytest.mark.timeout(1800)]

EXAMPLES = os.environ.get("FOGNAV_SCHEMATHESIS_EXAMPLES", "")
CONFIGURATION = Path(__file__).with_name("schemathesis.toml")
SETTINGS = {"hazard_aggregator": "AGGREGATOR_URL", "map_service": "MAP_URL", "planner": "PLANNER_URL"}
CONSOLE = "console_service"
ENDLESS = ("/api/v1/events",)
"""Routes whose answers do not end."""


def run_schemathesis(url: str, paths: list[str], token: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Check these paths; `folder` gets what schemathesis keeps between runs."""
    chosen = f"^({'|'.join(re.escape(path) for path in paths)})$"
    command = [
        sys.executable, "-m", "schemathesis.cli", "--config-file", str(CONFIGURATION), "run",
        f"{url}/api/v1/openapi.json", "--include-path-regex", chosen,
        "--header", f"Authorization: {token}", "--checks", "all", "--max-examples", EXAMPLES or "2",
        "--phases", "coverage,fuzzing,stateful" if EXAMPLES else "coverage,stateful", "--seed", "1", "--no-shrink",
        "--warnings", "off",
    ]  # fmt: skip
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder)


@pytest.fixture(scope="module")
def urls(all_services) -> dict[str, str]:
    """The addresses of the services, which run once for all tests here."""
    found = {service: asyncio.run(all_services.ready(service)) for service in SETTINGS}
    all_services.start(CONSOLE, **{f"FOGNAV_{SETTINGS[service]}": url for service, url in found.items()})
    return found | {CONSOLE: asyncio.run(all_services.ready(CONSOLE))}


def test_openapi_declares_a_type_for_every_answer_and_a_problem_for_every_error(urls):
    undescribed = []
    for url in urls.values():
        for path, operations in httpx.get(f"{url}/openapi.json").json()["paths"].items():
            for method, operation in operations.items():
                route, responses = f"{method.upper()} {path}", operation["responses"]
                if "default" in responses or {"500", "503"} - responses.keys():
                    undescribed.append(f"{route}: every status is listed, and none stands for all others")
                for status, response in responses.items():
                    kinds = response.get("content", {})
                    own = ["application/json"] if path in ("/leads", "/readyz") and status == "503" else []
                    if status >= "400" and list(kinds) != [*own, "application/problem+json"]:
                        undescribed.append(f"{route} {status}: {list(kinds)} is no problem document")
                    if not kinds.get("application/json", {"schema": True}).get("schema"):
                        undescribed.append(f"{route} {status}: has no type")
    assert undescribed == []


@pytest.mark.parametrize("service", [*SETTINGS, CONSOLE])
def test_service_answers_as_the_merged_document_says(urls, tokens, tmp_path, service):
    document, name = httpx.get(f"{urls[CONSOLE]}/api/v1/openapi.json", timeout=60.0).json(), service.replace("_", "-")
    paths = [
        path
        for path in document["paths"]
        if path not in ENDLESS
        and (service_of(path) == name if path.startswith("/api/") else path.startswith(f"/{name}/"))
    ]
    assert len(paths) >= 5
    done = run_schemathesis(urls[CONSOLE], paths, tokens["admin"]["Authorization"], tmp_path)
    assert done.returncode == 0, done.stdout
    assert httpx.get(f"{urls[service]}/readyz").json()["missing"] == [], "no request may end a service's readiness"


ROLES = ("nobody", "guest", "viewer", "operator", "admin")
DENIED = ("token_missing", "token_unknown", "role_too_low")


def who_may() -> dict[str, str]:
    """Return the lowest role that may use each route, by the table in docs/security.md."""
    text = (Path(__file__).parents[2] / "docs" / "security.md").read_text("utf-8")
    rows = re.findall(rf"^\| ({'|'.join(ROLES)}) \| (`.*`) \|$", text, re.MULTILINE)
    routes = ((role, route.split()) for role, cell in rows for route in re.findall("`([^`]+)`", cell))
    return {f"{method} {path}": role for role, (*methods, path) in routes for method in methods}


def in_table(method: str, path: str) -> str:
    """Return how the table writes a route: without /api/v1, and those that each service has once."""
    return f"{method} {re.sub(r'^/[a-z-]+(?=/(api/v1/store|healthz|leads|readyz|metrics))', '/SERVICE', path)}".replace(
        "/api/v1", ""
    )


def is_denied(client: httpx.Client, method: str, path: str, headers: dict[str, str]) -> bool:
    """Ask with ids that nothing has, and without a body: the role is looked at before both."""
    with client.stream(method, re.sub(r"\{\w+\}", "nothing", path), headers=headers) as answer:
        if answer.status_code not in {401, 403}:
            return False
        return json.loads(answer.read())["type"].rpartition(":")[2] in DENIED


def test_each_route_is_open_to_whom_the_table_of_roles_names_and_to_nobody_else(urls, tokens, all_services):
    document = httpx.get(f"{urls[CONSOLE]}/api/v1/openapi.json", timeout=60.0).json()
    users = (all_services.security.directory / "credentials").rglob("*.toml")
    passwords = [word for user in users for word in list(Credentials.read(user).passwords.values())[:1]]
    assert len(passwords) >= 8
    lowest = {}
    with httpx.Client(base_url=urls[CONSOLE], timeout=60.0) as client:
        for path, method in ((path, method.upper()) for path, found in document["paths"].items() for method in found):
            let_in = [role for role in ROLES if not is_denied(client, method, path, tokens.get(role, {}))]
            assert let_in == list(ROLES[-len(let_in) :]), f"{method} {path}: a higher role may less"
            assert lowest.setdefault(in_table(method, path), let_in[0]) == let_in[0], "services differ"
            if let_in[0] != "nobody":  # what lets a robot, a node or the bridge into the broker is no token
                own = [{"Authorization": f"Bearer {password}"} for password in passwords]
                assert all(is_denied(client, method, path, headers) for headers in own), (method, path)
    assert lowest == who_may()
