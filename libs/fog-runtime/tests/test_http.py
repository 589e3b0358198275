"""The REST base over a real socket."""

import asyncio
import json
from collections.abc import AsyncIterator
from typing import Annotated

import httpx
import pytest
from http_processes import running_http_process
from pydantic import BaseModel, Field

from fog_contracts.messages import Zone
from fog_runtime.health import Health
from fog_runtime.http import (
    Admin,
    Answer,
    Body,
    HttpProblem,
    HttpProcess,
    IfMatch,
    Operator,
    ProblemCode,
    ProblemError,
    Routes,
    TokensError,
    etag,
    expected_version,
    load_tokens,
    make_app,
    token_hash,
)

pytestmark = pytest.mark.live


class BusyError(Exception):
    """What a service raises and knows no HTTP of."""


class OwnProblem(ProblemCode):
    BUSY = "busy", 503, "It is busy", "Wait"
    THERE = "there", 409, "It is there", "Take it"
    STALE = "stale", 412, "It has changed"


class Point(BaseModel):
    x: Annotated[float, Field(ge=0)]


@pytest.fixture
def tokens(tmp_path):
    file = tmp_path / "tokens.toml"
    file.write_text(
        "".join(
            f'[[tokens]]\nname = "{name}"\nrole = "{role}"\nsha256 = "{token_hash(name + "-token")}"\n'
            for name, role in (("vi", "viewer"), ("op", "operator"), ("ad", "admin"))
        )
    )
    return load_tokens(file)


@pytest.fixture
async def client(tokens, tmp_path):
    health = Health("store")
    app = make_app("Test", health, tokens, body_limit=1000, large={"/upload": 5000})
    app.state.health = health

    @app.post("/points")
    async def points(point: Point) -> Point:
        return point

    routes = Routes(app, "test")
    routes.raises(BusyError, [OwnProblem.BUSY], lambda error: ProblemError(OwnProblem.BUSY, f"busy: {error}"))

    @routes.put("/zones/{zone}")
    async def zones(zone: str, body: Body[Zone]) -> dict[str, str]:
        return {"kind": body.kind}

    @routes.post("/zones", status=201, raises=[BusyError], problems=[OwnProblem.THERE])
    async def make_zone(body: Body[Zone], caller: Operator, if_match: IfMatch = None) -> Answer[Zone]:
        """Make a zone."""
        if body.reason:
            raise BusyError(body.reason)
        return Answer(body, {**etag(body.version), "X-Expected": str(expected_version(if_match))})

    @routes.delete("/zones/{zone}")
    async def delete_zone(zone: str, caller: Operator) -> None:
        """Delete a zone."""

    @routes.post("/upload")
    async def upload(body: Body[list[str]], caller: Admin) -> str:
        return f"{len(body[0])} from {caller.name}"

    @routes.get("/secret")
    async def secret(caller: Operator) -> str:
        return caller.name

    @app.get("/stale")
    async def stale() -> None:
        headers = {"ETag": '"2"'}
        raise ProblemError(OwnProblem.STALE, "it has changed", field="header.if-match", headers=headers, code=2)

    @app.get("/bug")
    async def bug() -> None:
        raise RuntimeError("inner detail")

    async with (
        running_http_process(lambda: app, tmp_path) as url,
        httpx.AsyncClient(base_url=url, timeout=60.0) as http,
    ):
        http.health = health
        yield http


def is_problem(answer, status):
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    body = answer.json()
    assert body["status"] == status
    assert body["title"]
    assert body["type"].startswith("urn:fognav:")
    assert body["detail"]
    return body


async def test_the_first_page_says_what_answers_here(client):
    first = await client.get("/")
    assert first.status_code == 200
    assert "/openapi.json" in first.text


async def test_readiness_names_what_is_missing(client):
    assert (await client.get("/healthz")).json() == {"status": "ok"}
    answer = await client.get("/readyz")
    assert (answer.status_code, answer.json()["missing"]) == (503, ["store"])
    client.health.set("store", ok=True)
    assert (await client.get("/readyz")).status_code == 200
    assert "process_resident_memory_bytes" in (await client.get("/metrics")).text


async def test_validation_error_is_a_problem_with_field_path_and_sentence(client):
    assert (await client.post("/points", json={"x": 1})).json() == {"x": 1.0}
    body = is_problem(await client.post("/points", json={"x": -1}), 422)
    assert body["errors"] == [{"field": "body.x", "problem": "Input should be greater than or equal to 0"}]
    is_problem(await client.post("/points", content=b"{", headers={"Content-Type": "application/json"}), 422)


async def test_message_body_is_validated_by_its_type(client):
    zone = {"id": "z1", "kind": "BLOCKED", "shape": {"type": "circle", "centre": [1, 2], "radius": 1}}
    assert (await client.put("/zones/z1", json=zone)).json() == {"kind": "BLOCKED"}
    zone["shape"]["radius"] = -1
    body = is_problem(await client.put("/zones/z1", json=zone), 422)
    assert body["errors"][0]["field"] == "body.shape.radius"
    assert is_problem(await client.put("/zones/z1", content=b"\xff{"), 422)["errors"][0]["field"] == "body"


async def test_route_responds_by_its_signature_and_exceptions(client):
    zone = {"id": "z1", "kind": "BLOCKED", "shape": {"type": "circle", "centre": [1, 2], "radius": 1}, "version": 3}
    headers = {"Authorization": "Bearer op-token", "If-Match": '"7"'}
    made = await client.post("/zones", json=zone, headers=headers)
    assert (made.status_code, made.headers["etag"], made.headers["x-expected"]) == (201, '"3"', "7")
    assert made.json()["version"] == 3
    busy = await client.post("/zones", json={**zone, "reason": "lunch"}, headers=headers)
    assert is_problem(busy, 503)["detail"] == "busy: lunch"
    assert busy.json()["remedy"] == "Wait"
    gone = await client.delete("/zones/z1", headers=headers)
    assert (gone.status_code, gone.content) == (204, b"")
    # Who may not call is told so before the body is looked at.
    is_problem(await client.post("/zones", content=b"{"), 401)


@pytest.mark.parametrize(
    ("header", "version"), [(None, None), ("*", None), ('"12"', 12), ("12", -1), ('"x"', -1), ('W/"1"', -1)]
)
def test_if_match_header_gives_a_version_or_any_or_an_invalid_one(header, version):
    assert expected_version(header) == version


async def test_openapi_describes_responses_errors_and_tokens_by_the_signature(client):
    described = (await client.get("/openapi.json")).json()
    assert described["x-problems"]["there"] == {"status": 409, "says": "It is there", "remedy": "Take it"}
    assert set(HttpProblem) > described["x-problems"].keys() - set(OwnProblem) > {"failed", "token_missing"}
    paths = described["paths"]
    post = paths["/zones"]["post"]
    assert set(post["responses"]) == {"201", "401", "403", "408", "409", "413", "422", "500", "503"}
    assert post["responses"]["201"]["content"]["application/json"]["schema"] == {"$ref": "#/components/schemas/Zone"}
    problem = {"application/problem+json": {"schema": {"$ref": "#/components/schemas/Problem"}}}
    assert post["responses"]["503"]["description"].startswith("It is busy (`busy`); This process stands by")
    assert post["responses"]["409"]["description"] == "It is there (`there`)"
    assert post["responses"]["503"]["content"] == problem
    assert post["security"] == [{"HTTPBearer": []}]
    assert [parameter["name"] for parameter in post["parameters"]] == ["If-Match"]
    put = paths["/zones/{zone}"]["put"]
    assert set(put["responses"]) == {"200", "408", "413", "422", "500", "503"}
    assert "security" not in put
    assert set(paths["/zones/{zone}"]["delete"]["responses"]) == {"204", "401", "403", "422", "500", "503"}
    assert "content" not in paths["/zones/{zone}"]["delete"]["responses"]["204"]


async def test_refused_method_names_those_of_every_route_of_the_path(client):
    answer = await client.post("/zones/z1")
    is_problem(answer, 405)
    assert answer.headers["allow"] == "DELETE, PUT"


async def test_openapi_describes_message_bodies_and_resolves_all_references(client):
    described = (await client.get("/openapi.json")).json()
    put = described["paths"]["/zones/{zone}"]["put"]
    assert put["requestBody"]["content"]["application/json"]["schema"] == {"$ref": "#/components/schemas/Zone"}
    schemas = described["components"]["schemas"]

    def references(part):
        if isinstance(part, dict):
            yield from ([part["$ref"]] if "$ref" in part else [])
            part = part.values()
        if not isinstance(part, str | int | float | None):
            for inner in part:
                yield from references(inner)

    found = set(references(described))
    assert "#/components/schemas/CircleShape" in found
    assert all(ref.rsplit("/", 1)[1] in schemas for ref in found)
    assert "HTTPBearer" in described["components"]["securitySchemes"]


@pytest.mark.parametrize(
    ("header", "status", "code"),
    [
        (None, 401, "token_missing"),
        ("Bearer wrong", 401, "token_unknown"),
        ("Basic b3A6eA==", 401, "token_missing"),
        ("Bearer vi-token", 403, "role_too_low"),
    ],
)
async def test_missing_unknown_or_insufficient_token_is_refused(client, header, status, code):
    answer = await client.get("/secret", headers={"Authorization": header} if header else {})
    assert is_problem(answer, status)["type"] == f"urn:fognav:{code}"
    assert ("www-authenticate" in answer.headers) == (status == 401)


@pytest.mark.parametrize("name", ["op", "ad"])
async def test_sufficient_role_is_admitted(client, name):
    assert (await client.get("/secret", headers={"Authorization": f"Bearer {name}-token"})).json() == name


async def test_problems_contain_fields_headers_and_extra_members(client):
    answer = await client.get("/stale")
    body = is_problem(answer, 412)
    assert body["errors"] == [{"field": "header.if-match", "problem": "it has changed"}]
    assert (answer.headers["etag"], body["code"], body["type"]) == ('"2"', 2, "urn:fognav:stale")
    nowhere = is_problem(await client.get("/nowhere"), 404)
    assert "/nowhere" in nowhere["detail"]
    assert nowhere["type"] == "urn:fognav:no_route"
    assert "GET" in (await client.delete("/secret")).headers["allow"]
    assert "inner detail" not in is_problem(await client.get("/bug"), 500)["detail"]


async def test_oversized_bodies_are_refused_with_and_without_content_length(client):
    async def chunks():
        for _ in range(20):
            yield b"x" * 100

    is_problem(await client.post("/points", content=b"x" * 1001), 413)
    is_problem(await client.post("/points", content=chunks()), 413)
    assert (await client.get("/healthz")).status_code == 200


async def test_port_in_use_raises(client):
    port = client.base_url.port
    with pytest.raises(OSError, match="in use"):
        HttpProcess.fork(lambda: make_app("x", Health(), load_tokens(None)), port=port)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ('[[tokens]]\nname = "x"\nrole = "king"\nsha256 = ""', "king"),
        ('[[tokens]]\nname = "x"\nrole = "admin"\nsha256 = "abc"', "sha256"),
        ("tokens = ", "TOML"),
        ("[[token]]", "token"),
    ],
)
def test_invalid_tokens_file_is_refused_by_name(tmp_path, content, reason):
    file = tmp_path / "t.toml"
    file.write_text(content)
    with pytest.raises(TokensError, match=reason) as refused:
        load_tokens(file)
    assert str(file) in str(refused.value)


def test_tokens_file_with_a_repeated_hash_is_refused(tmp_path):
    entry = f'[[tokens]]\nname = "x"\nrole = "admin"\nsha256 = "{token_hash("t")}"\n'
    (tmp_path / "t.toml").write_text(entry * 2)
    with pytest.raises(TokensError, match="same sha256"):
        load_tokens(tmp_path / "t.toml")
    with pytest.raises(TokensError, match="can't be read"):
        load_tokens(tmp_path / "none.toml")


async def test_large_body_is_taken_of_an_administrator_only_and_one_at_a_time_of_each_client(client):
    def body(size: int) -> bytes:
        return json.dumps(["a" * size]).encode()

    admin = {"Authorization": "Bearer ad-token"}
    assert (await client.post("/upload", content=body(4000), headers=admin)).json() == "4000 from ad"
    for headers in ({}, {"Authorization": "Bearer op-token"}):
        assert (await client.post("/upload", content=body(4000), headers=headers)).status_code == 413
        assert (await client.post("/upload", content=body(10), headers=headers)).status_code in (401, 403)
    assert (await client.post("/upload", content=body(6000), headers=admin)).status_code == 413
    begun, go_on = asyncio.Event(), asyncio.Event()

    async def slowly() -> AsyncIterator[bytes]:
        yield body(3000)[:1000]
        begun.set()
        await go_on.wait()
        yield body(3000)[1000:]

    first = asyncio.create_task(client.post("/upload", content=slowly(), headers=admin))
    await begun.wait()
    second = await client.post("/upload", content=body(10), headers=admin)
    assert (second.status_code, "large requests" in second.json()["detail"]) == (503, True)
    go_on.set()
    assert (await first).json() == "3000 from ad"
