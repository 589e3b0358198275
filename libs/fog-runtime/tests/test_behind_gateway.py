"""Who asks, for a service behind a gateway: the gateway is believed, and nobody else."""

import asyncio

import httpx
import pytest
from http_processes import running_http_process

from fog_runtime.health import Health
from fog_runtime.http import ClientHost, Routes, Tokens, make_app
from fog_runtime.http.http_process import AGAIN_S, KNOWN_S, BehindGateway, addresses_of

CLIENT, LIAR = "192.0.2.7", "198.51.100.9"


def telling_app():
    """Make an app that tells who asks."""
    made = make_app("Test", Health(), Tokens())

    @Routes(made, "test").get("/who")
    async def who(client: ClientHost) -> str:
        return client

    return made


@pytest.mark.parametrize(
    ("gateway", "said", "believed"),
    [
        ("localhost", CLIENT, CLIENT),
        ("127.0.0.1", f"{LIAR}, {CLIENT}", CLIENT),
        ("127.0.0.1", None, "127.0.0.1"),
        ("", CLIENT, "127.0.0.1"),
        ("192.0.2.1", CLIENT, "127.0.0.1"),
        ("gateway.invalid", CLIENT, "127.0.0.1"),
    ],
)
async def test_service_believes_its_gateway_only(tmp_path, gateway, said, believed):
    headers = {} if said is None else {"X-Forwarded-For": said}
    async with running_http_process(telling_app, tmp_path, gateway=gateway) as url, httpx.AsyncClient() as client:
        assert (await client.get(f"{url}/who", headers=headers)).json() == believed


class Names:
    """A directory whose only name moves; counts how often it is asked."""

    def __init__(self):
        self.addresses, self.asked = {"10.0.0.2"}, 0

    async def resolve(self, _):
        self.asked += 1
        return self.addresses


class Asking:
    """Requests to an app behind a gateway, at times of the loop."""

    def __init__(self, monkeypatch):
        self.names = Names()
        self.now = 100.0
        self.seen = ""
        self._behind = BehindGateway(self._app, "gateway", self.names.resolve)
        monkeypatch.setattr(asyncio.get_running_loop(), "time", lambda: self.now)

    async def _app(self, scope, _receive, _send):
        self.seen = scope["client"][0]

    async def who(self, peer):
        headers = [(b"x-forwarded-for", CLIENT.encode())]
        await self._behind({"type": "http", "client": (peer, 1), "headers": headers}, None, None)
        return self.seen


async def test_gateway_that_got_another_address_is_believed_and_its_former_one_no_longer(monkeypatch):
    asking = Asking(monkeypatch)
    assert await asking.who("10.0.0.2") == CLIENT
    asking.names.addresses = {"10.0.0.3"}
    asking.now += AGAIN_S + 0.1
    assert await asking.who("10.0.0.3") == CLIENT
    assert await asking.who("10.0.0.2") == "10.0.0.2"
    asking.names.addresses = {"10.0.0.4"}
    asking.now += KNOWN_S + 0.1
    assert await asking.who("10.0.0.3") == "10.0.0.3"


async def test_name_is_looked_up_once_a_second_however_often_others_ask(monkeypatch):
    asking = Asking(monkeypatch)
    for _ in range(50):
        assert await asking.who(LIAR) == LIAR
    assert asking.names.asked == 1


async def test_name_without_an_address_is_nobody():
    assert await addresses_of("gateway.invalid") == set()
