"""The REST APIs as their OpenAPI describes them: schemathesis sends what fits and what does not to the real services.

It asks all of them under the console's address, by the merged document, as the page and other people's programs do.

Each route gets systematic requests, and sequences of requests follow a record from its creation to its end.
FOGNAV_SCHEMATHESIS_EXAMPLES=N adds N random requests to each route, and lengthens the sequences.
"""

import asyncio
import os
import re
import subprocess
import sys
from pathlib import Path

import httpx
import pytest

from console_service.forward import service_of

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
                    own = ["application/json"] if (path, status) == ("/readyz", "503") else []
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
