"""All services behind locked doors: encrypted connections, and credentials of their own."""

import asyncio

import httpx
import pytest

from fog_runtime.credentials import Credentials
from fog_runtime.security.site_security import SiteSecurity

pytestmark = pytest.mark.live

READY_S = 60.0
SERVICES = {"hazard_aggregator": "hazard-aggregator", "map_service": "map-service", "planner": "planner"}


async def test_services_work_over_https_with_their_own_credentials(fog):
    http = fog.security.folder("http")
    certificate = {
        "FOGNAV_HTTP_CERTIFICATE_FILE": str(http / "server.pem"),
        "FOGNAV_HTTP_KEY_FILE": str(http / "server.key"),
    }
    for module in SERVICES:
        fog.start(module, **certificate)
    async with httpx.AsyncClient(
        verify=Credentials.read(fog.security.credentials("console")).tls_context(), timeout=60
    ) as client:
        for module, user in SERVICES.items():
            url = (await fog.url(module)).replace("http:", "https:")
            async with asyncio.timeout(READY_S):
                while (await client.get(f"{url}/readyz")).status_code != 200:
                    assert fog.processes[module].poll() is None, fog.log(module)
                    await asyncio.sleep(0.05)
            with pytest.raises(httpx.HTTPError):
                await client.get(f"{url.replace('https:', 'http:')}/healthz")
            assert '"url": "https://' in fog.log(module)
            for secret in Credentials.read(fog.security.credentials(user)).passwords.values():
                assert secret not in fog.log(module)


async def test_service_without_credentials_gets_in_nowhere(fog, until):
    fog.start("map_service", FOGNAV_CREDENTIALS_FILE="")
    url = await fog.url("map_service")
    async with httpx.AsyncClient(timeout=60) as client:
        report = (await client.get(f"{url}/readyz")).json()
    assert {"store", "mqtt"} <= set(report["missing"])
    await until(lambda: "router_unreachable" in fog.log("map_service"), "it says that the router refuses it")
    assert "FOGNAV_CREDENTIALS_FILE is not set" in fog.log("map_service")


async def test_service_whose_certificate_is_unusable_says_which_file(fog):
    key = fog.security.folder("http") / "server.key"
    other = SiteSecurity(fog.folder / "other", "test")
    other.make(["127.0.0.1"])
    certificate = other.folder("http") / "server.pem"
    fog.start("planner", FOGNAV_HTTP_CERTIFICATE_FILE=str(certificate), FOGNAV_HTTP_KEY_FILE=str(key))
    fog.processes["planner"].wait(60)
    assert f"with the key {key} can't be used" in fog.log("planner")
    assert "fognav ca issue" in fog.log("planner")
