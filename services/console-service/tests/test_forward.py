"""All services under the console's address, as a browser uses them: real services, and a service that misbehaves."""

import asyncio
import re
import socket
import threading
from contextlib import closing, contextmanager, suppress

import httpx
import pytest

from fog_runtime.credentials import Credentials
from fog_runtime.http.app import MAP_UPLOAD, MAX_OF_CLIENT
from fog_runtime.token_file import create_token, revoke_token

pytestmark = pytest.mark.live

SERVICES = {"hazard_aggregator": "AGGREGATOR_URL", "map_service": "MAP_URL", "planner": "PLANNER_URL"}
CIRCLE = {
    "id": "wet",
    "kind": "BLOCKED",
    "shape": {"type": "circle", "centre": [6.0, 2.0], "radius": 0.3},
    "reason": "wet floor",
}
OWN_PAGE = {"Sec-Fetch-Site": "same-origin"}


async def start_console(fog, *modules, **environment):
    """Start these services and the console-service before them; return its address."""
    for module in modules:
        fog.start(module)
    urls = {f"FOGNAV_{SERVICES[module]}": await fog.ready(module) for module in modules}
    fog.start("console_service", **urls, **environment)
    return await fog.ready("console_service")


async def answered(browser, path, status):
    """Return the answer to a GET once it has this status."""
    async with asyncio.timeout(60):
        while True:
            answer = await browser.get(path)
            if answer.status_code == status:
                return answer
            await asyncio.sleep(0.05)


@pytest.fixture
def tokens_file(fog):
    return fog.folder / "tokens.toml"


@pytest.mark.smoke
async def test_browser_logs_in_and_writes_at_each_service_by_one_address_until_its_token_is_revoked(fog, tokens_file):
    token = create_token(tokens_file, "caretaker", "operator")
    async with httpx.AsyncClient(base_url=await start_console(fog, *SERVICES), timeout=60.0) as browser:
        assert (await browser.post("/api/v1/zones", json=CIRCLE, headers=OWN_PAGE)).status_code == 401
        login = await browser.post("/api/v1/session", json={"token": token}, headers=OWN_PAGE)
        assert login.status_code == 200, login.text
        foreign = await browser.post("/api/v1/zones", json=CIRCLE, headers={"Sec-Fetch-Site": "cross-site"})
        assert (foreign.status_code, foreign.json()["type"]) == (403, "urn:fognav:foreign_origin")
        zone = await browser.post("/api/v1/zones", json=CIRCLE, headers=OWN_PAGE)
        assert zone.status_code == 201, zone.text
        assert zone.json()["author"] == "caretaker"
        assert zone.headers["etag"]
        origin = {"Origin": str(browser.base_url).rstrip("/")}
        override = {"state": "blocked", "ttl_s": 60, "reason": "box"}
        answer = await browser.put("/api/v1/areas/hall/override", json=override, headers=origin)
        assert answer.status_code < 300, answer.text
        assert (await browser.get("/api/v1/robots")).json() == []
        assert (await browser.delete("/api/v1/robots/none/goal", headers=OWN_PAGE)).status_code == 404
        assert (await browser.get("/planner/readyz")).json()["ready"]
        assert (await browser.get("/api/v1/store")).status_code == 404
        assert (await browser.get("/map-service/api/v1/store")).status_code == 200
        assert (await browser.get("/console-service/healthz")).json() == {"status": "ok"}
        assert (await browser.put("/api/v1/session", headers=OWN_PAGE)).headers["allow"] == "DELETE, GET, POST"
        picture = await browser.get("/api/v1/costmap.png")
        assert picture.content.startswith(b"\x89PNG")
        revoke_token(tokens_file, "caretaker")
        for answer in (
            await browser.get("/api/v1/robots"),
            await browser.delete("/api/v1/zones/wet", headers=OWN_PAGE),
            await browser.delete("/api/v1/areas/hall/override", headers=OWN_PAGE),
        ):
            assert (answer.status_code, answer.json()["type"]) == (401, "urn:fognav:session_ended")


async def test_merged_document_has_the_routes_of_all_services_as_they_are_under_the_address(fog):
    async with httpx.AsyncClient(base_url=await start_console(fog, *SERVICES), timeout=60.0) as browser:
        document = (await browser.get("/api/v1/openapi.json")).json()
        assert {"/api/v1/zones", "/api/v1/areas", "/api/v1/robots", "/api/v1/session"} <= document["paths"].keys()
        assert {"502", "504"} <= document["paths"]["/api/v1/robots"]["get"]["responses"].keys()
        for path, operations in document["paths"].items():
            if "get" in operations and "{" not in path and "events" not in path:
                answer = await browser.get(path)
                problem = answer.headers["content-type"] == "application/problem+json"
                assert not problem or answer.json()["type"] != "urn:fognav:no_route", path


async def test_service_that_does_not_run_is_named_and_the_others_answer(fog):
    async with httpx.AsyncClient(base_url=await start_console(fog, *SERVICES), timeout=60.0) as browser:
        assert (await browser.get("/api/v1/robots")).status_code == 401
        fog.kill("planner")
        answer = await answered(browser, "/api/v1/robots", 502)  # its process for requests ends a moment later
        assert (answer.status_code, answer.headers["content-type"]) == (502, "application/problem+json")
        assert (answer.json()["type"], answer.json()["service"]) == ("urn:fognav:service_away", "planner")
        assert "fognav logs planner" in answer.json()["detail"]
        assert answer.headers["retry-after"] == "1"
        described = await browser.get("/api/v1/openapi.json")
        assert (described.status_code, described.json()["service"]) == (502, "planner")
        assert (await browser.get("/api/v1/map")).status_code == 200
        assert (await browser.get("/healthz")).status_code == 200


async def test_services_are_asked_encrypted_where_they_have_certificates(fog, tokens_file):
    token = create_token(tokens_file, "caretaker", "operator")
    http = fog.security.folder("http")
    certificate = {
        "FOGNAV_HTTP_CERTIFICATE_FILE": str(http / "server.pem"),
        "FOGNAV_HTTP_KEY_FILE": str(http / "server.key"),
    }
    fog.start("map_service", **certificate)
    url = (await fog.url("map_service")).replace("http:", "https:")
    fog.start("console_service", FOGNAV_MAP_URL=url, **certificate)
    own = (await fog.url("console_service")).replace("http:", "https:")
    trusted = Credentials.read(fog.security.credentials("console")).tls_context()
    async with httpx.AsyncClient(base_url=own, verify=trusted, timeout=60.0) as browser:
        await answered(browser, "/map-service/readyz", 200)
        login = await browser.post("/api/v1/session", json={"token": token}, headers=OWN_PAGE)
        assert login.headers["set-cookie"].startswith("__Host-")
        answer = await browser.post("/api/v1/zones", json=CIRCLE, headers={"Origin": own})
        assert answer.status_code == 201, answer.text


@contextmanager
def service_that(answers):
    """Listen as a service that reads each request's head and sends what `answers` returns for it."""
    heads = []
    with closing(socket.create_server(("127.0.0.1", 0), backlog=256)) as listener:

        def answer(connection):
            with connection:
                head = b""
                while b"\r\n\r\n" not in head:
                    head += connection.recv(65536)
                heads.append(head)
                length = re.search(rb"content-length: ([0-9]+)", head.lower())
                rest = int(length[1]) - len(head.partition(b"\r\n\r\n")[2]) if length else 0
                while rest > 0 and (part := connection.recv(65536)):
                    rest -= len(part)
                connection.sendall(answers(head))

        def serve():
            with suppress(OSError):
                while True:
                    threading.Thread(target=answer, args=listener.accept()[:1], daemon=True).start()

        threading.Thread(target=serve, daemon=True).start()
        yield f"http://127.0.0.1:{listener.getsockname()[1]}", heads
        listener.shutdown(socket.SHUT_RDWR)


async def test_headers_of_one_connection_and_claims_of_the_client_are_not_passed_on(fog):
    answer = b"HTTP/1.1 200 OK\r\nConnection: close, X-Hop\r\nX-Hop: 1\r\nX-End: 1\r\nContent-Length: 2\r\n\r\nok"
    with service_that(lambda _: answer) as (url, heads):
        fog.start("console_service", FOGNAV_PLANNER_URL=url)
        claims = {
            "X-Forwarded-For": "192.0.2.9", "X-Forwarded-Proto": "https", "X-Fognav-Gateway": "0" * 64,
            "Connection": "keep-alive, X-Mine", "X-Mine": "1", "TE": "trailers", "X-Kept": "1",
        }  # fmt: skip
        async with httpx.AsyncClient(base_url=await fog.ready("console_service"), timeout=60.0) as browser:
            passed = await browser.get("/api/v1/robots/a%2Fb?q=%20x", headers=claims)
    assert (passed.status_code, passed.text, passed.headers["x-end"]) == (200, "ok", "1")
    assert "x-hop" not in passed.headers
    head = heads[0].decode().lower().split("\r\n")
    assert head[0] == "get /api/v1/robots/a%2fb?q=%20x http/1.1"
    sent = dict(line.split(": ", 1) for line in head[1:] if line)
    assert (sent["x-forwarded-for"], sent["x-forwarded-proto"], sent["x-kept"]) == ("127.0.0.1", "http", "1")
    assert sent["x-fognav-gateway"] != "0" * 64
    assert {"x-mine", "te"} & sent.keys() == set()
    assert sent["host"].startswith("127.0.0.1:"), "that of the console: the origin is compared with it"


async def test_service_that_breaks_off_leaves_open_whether_it_has_made_the_change(fog):
    with service_that(lambda _: b"") as (url, _):
        fog.start("console_service", FOGNAV_PLANNER_URL=url)
        async with httpx.AsyncClient(base_url=await fog.ready("console_service"), timeout=60.0) as browser:
            answer = await browser.put("/api/v1/robots/r1/goal", json={"place": "a"})
    assert (answer.status_code, answer.json()["type"]) == (504, "urn:fognav:service_silent")
    assert "look whether the change was made" in answer.json()["detail"]


async def test_robot_is_stopped_while_a_service_hangs_and_its_requests_take_all_places(fog, until):
    hangs = threading.Event()

    def answers(_):
        hangs.wait()
        return b"HTTP/1.1 204 No Content\r\nConnection: close\r\n\r\n"

    stopped = b"HTTP/1.1 204 No Content\r\nConnection: close\r\n\r\n"
    with service_that(answers) as (slow, waiting), service_that(lambda _: stopped) as (planner, _):
        fog.start("console_service", FOGNAV_MAP_URL=slow, FOGNAV_PLANNER_URL=planner)
        async with httpx.AsyncClient(
            base_url=await fog.ready("console_service"), timeout=60.0, limits=httpx.Limits(max_connections=200)
        ) as browser:
            requests: list[asyncio.Task[httpx.Response]] = []

            def all_arrived() -> bool:
                return len(waiting) == len(requests)

            while len(requests) < MAX_OF_CLIENT:  # not all at once: admission lets 50 wait
                requests += [asyncio.create_task(browser.get("/api/v1/zones")) for _ in range(MAX_OF_CLIENT // 4)]
                await until(all_arrived, "the service has them")
            assert (await browser.get("/api/v1/robots")).json()["type"] == "urn:fognav:overloaded"
            assert (await browser.post("/api/v1/robots/r1/stop")).status_code == 204
            hangs.set()
            assert {answer.status_code for answer in await asyncio.gather(*requests)} == {204}


async def test_body_that_is_too_large_reaches_no_service_and_a_map_does(fog, tokens):
    with service_that(lambda _: b"HTTP/1.1 204 No Content\r\n\r\n") as (url, heads):
        fog.start("console_service", FOGNAV_MAP_URL=url)
        async with httpx.AsyncClient(base_url=await fog.ready("console_service"), timeout=60.0) as browser:
            assert (await browser.post("/api/v1/zones", content=b"x" * 2_000_000)).status_code == 413
            assert (await browser.post(MAP_UPLOAD, content=b"x" * 2_000_000)).status_code == 413
            assert heads == []
            uploaded = await browser.post(MAP_UPLOAD, content=b"x" * 2_000_000, headers=tokens["admin"])
            assert (uploaded.status_code, len(heads)) == (204, 1)
