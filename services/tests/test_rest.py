"""The REST APIs as their OpenAPI describes them: schemathesis sends what fits and what does not to the real services.

Each route gets systematic requests, and sequences of requests follow a record from its creation to its end.
FOGNAV_SCHEMATHESIS_EXAMPLES=N adds N random requests to each route, and lengthens the sequences.
"""

import asyncio
import os
import subprocess
import sys
from pathlib import Path

import httpx
import pytest

pytestmark = [pytest.mark.live, pytest.mark.timeout(1800)]

EXAMPLES = os.environ.get("FOGNAV_SCHEMATHESIS_EXAMPLES", "")
CONFIGURATION = Path(__file__).with_name("schemathesis.toml")
SERVICES = ("hazard_aggregator", "map_service", "planner")


def run_schemathesis(url: str, token: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Check a service; `folder` gets what schemathesis keeps between runs."""
    command = [
        sys.executable, "-m", "schemathesis.cli", "--config-file", str(CONFIGURATION), "run", f"{url}/openapi.json",
        "--header", f"Authorization: {token}", "--checks", "all", "--max-examples", EXAMPLES or "2",
        "--phases", "coverage,fuzzing,stateful" if EXAMPLES else "coverage,stateful", "--seed", "1", "--no-shrink",
        "--warnings", "off",
    ]  # fmt: skip
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder)


@pytest.fixture(scope="module")
def urls(all_services) -> dict[str, str]:
    """The addresses of the three services, which run once for all tests here."""
    return {service: asyncio.run(all_services.ready(service)) for service in SERVICES}


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


@pytest.mark.parametrize("service", SERVICES)
def test_service_answers_as_its_openapi_says(urls, tokens, tmp_path, service):
    done = run_schemathesis(urls[service], tokens["admin"]["Authorization"], tmp_path)
    assert done.returncode == 0, done.stdout
    assert httpx.get(f"{urls[service]}/readyz").json()["missing"] == [], "no request may end a service's readiness"
