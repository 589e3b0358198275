"""Sessions of people who use a browser: who gets one, what it allows, and when it ends."""

import contextlib
import ssl

import httpx
import pytest
from http_processes import running_http_process
from hypothesis import given
from hypothesis import strategies as st
from manual_clock import ManualClock

from fog_runtime.clock import SystemClock
from fog_runtime.credentials import ServerCertificate
from fog_runtime.health import Health
from fog_runtime.http import Operator, Routes, Viewer, add_session_routes, load_tokens, make_app
from fog_runtime.http.http_process import PROOF
from fog_runtime.http.sessions import ATTEMPT_S, ATTEMPTS, Attempts
from fog_runtime.http.tokens import PART, SESSION_S, Tokens
from fog_runtime.keys import KeyFileError
from fog_runtime.security.site_security import SiteSecurity
from fog_runtime.token_file import TokenEntry, create_token, revoke_token, token_hash

pytestmark = pytest.mark.live

KEY, OTHER_KEY = b"k" * 32, b"o" * 32
OWN_PAGE = {"Sec-Fetch-Site": "same-origin"}


class Site:
    """A site's tokens and its key of sessions."""

    def __init__(self, folder):
        self.folder = folder
        self.file = folder / "tokens.toml"
        self.file.write_text("")
        self.key = folder / "session.key"
        self.key.write_text(KEY.hex())
        self.operator = create_token(self.file, "anna", "operator")
        self.guest = create_token(self.file, "lobby", "guest")

    def app(self, *, key=True):
        """Return an app with login, and routes for a viewer and an operator."""
        tokens = load_tokens(self.file, self.key if key else None)
        made = make_app("Test", Health(), tokens)
        routes = Routes(made, "test")
        add_session_routes(routes, tokens, SystemClock())

        @routes.get("/robots")
        async def read(caller: Viewer) -> str:
            return caller.name

        @routes.get("/asker")
        async def asker(caller: Viewer) -> str:
            return caller.asker

        @routes.put("/zones/{zone}")
        async def write(zone: str, caller: Operator) -> str:
            return f"{caller.name} wrote {zone}"

        return made

    @contextlib.asynccontextmanager
    async def served(self, *, key=True, **options):
        """Serve the app; yield a browser that is at its address."""
        async with (
            running_http_process(lambda: self.app(key=key), self.folder, **options) as url,
            httpx.AsyncClient(base_url=url, timeout=60.0) as browser,
        ):
            yield browser


@pytest.fixture
def site(tmp_path):
    return Site(tmp_path)


async def log_in(browser, token):
    answer = await browser.post("/api/v1/session", json={"token": token}, headers=OWN_PAGE)
    assert answer.status_code == 200, answer.text
    return answer


def code(answer):
    assert answer.json()["detail"], "every refusal says what to do"
    return answer.status_code, answer.json()["type"].removeprefix("urn:fognav:")


async def test_browser_that_has_logged_in_reads_and_writes_by_its_cookie_until_it_logs_out(site):
    async with site.served() as browser:
        assert code(await browser.get("/robots")) == (401, "token_missing")
        assert code(await browser.get("/api/v1/session")) == (401, "token_missing")
        answer = await log_in(browser, site.operator)
        assert answer.json().items() >= {"name": "anna", "role": "operator"}.items()
        cookie = answer.headers["set-cookie"]
        assert {"HttpOnly", "SameSite=Strict", "Path=/", f"Max-Age={SESSION_S:.0f}"} <= set(cookie.split("; "))
        assert site.operator not in cookie
        assert (await browser.get("/robots")).json() == "anna"
        assert (await browser.put("/zones/wet", headers=OWN_PAGE)).json() == "anna wrote wet"
        assert (await browser.get("/api/v1/session")).json()["name"] == "anna"
        assert (await browser.delete("/api/v1/session", headers=OWN_PAGE)).status_code == 204
        assert code(await browser.get("/robots")) == (401, "token_missing")


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Sec-Fetch-Site": "same-origin"}, 200),
        ({"Origin": "OWN"}, 200),
        ({"Sec-Fetch-Site": "cross-site", "Origin": "OWN"}, 403),
        ({"Sec-Fetch-Site": "same-site"}, 403),
        ({"Sec-Fetch-Site": "none"}, 403),
        ({"Origin": "https://attacker.example"}, 403),
        ({"Origin": "null"}, 403),
        ({}, 403),
    ],
)
async def test_session_changes_things_from_its_own_page_only(site, headers, status):
    async with site.served() as browser:
        await log_in(browser, site.operator)
        origin = str(browser.base_url).rstrip("/")
        sent = {name: value.replace("OWN", origin) for name, value in headers.items()}
        answer = await browser.put("/zones/wet", headers=sent)
        assert answer.status_code == status
        if status == 403:
            assert code(answer) == (403, "foreign_origin")
        assert (await browser.get("/robots", headers=sent)).status_code == 200, "reading changes nothing"
        bearer = {"Authorization": f"Bearer {site.operator}"}
        assert (await browser.put("/zones/wet", headers=sent | bearer)).status_code == 200, "no browser adds a token"


async def test_another_site_s_page_logs_nobody_in(site):
    async with site.served() as browser:
        for headers in ({"Sec-Fetch-Site": "cross-site"}, {"Origin": "https://attacker.example"}):
            answer = await browser.post("/api/v1/session", json={"token": site.operator}, headers=headers)
            assert code(answer) == (403, "foreign_origin")
            assert "set-cookie" not in answer.headers


async def test_revoked_token_ends_its_sessions_at_once_and_another_of_the_same_name_does_not_bring_them_back(site):
    async with site.served() as browser:
        await log_in(browser, site.operator)
        revoke_token(site.file, "anna")
        assert code(await browser.get("/robots")) == (401, "session_ended")
        create_token(site.file, "anna", "admin")
        assert code(await browser.get("/robots")) == (401, "session_ended")


def test_browsers_of_one_token_are_told_apart_and_stay_the_same_when_their_sessions_are_renewed():
    tokens = Tokens([entry("lobby", "guest")], session_key=KEY)
    first, second = (tokens.caller_of_session(session(tokens, "lobby"), encrypted=False) for _ in range(2))
    assert len({"", first.session, second.session}) == 3
    value, _ = tokens.new_session(first)
    renewed = tokens.caller_of_session({tokens.cookie_name(encrypted=False): value}, encrypted=False)
    assert renewed.session == first.session


async def test_guest_logs_in_and_may_do_nothing_else(site):
    async with site.served() as browser:
        await log_in(browser, site.guest)
        assert (await browser.get("/api/v1/session")).json()["role"] == "guest"
        assert code(await browser.get("/robots")) == (403, "role_too_low")
        assert code(await browser.put("/zones/wet", headers=OWN_PAGE)) == (403, "role_too_low")


@pytest.mark.claim
async def test_admins_guest_token_is_the_same_each_time_and_ends_with_the_admins_own(site):
    admin = {"Authorization": f"Bearer {create_token(site.file, 'rui', 'admin')}"}
    path = "/api/v1/session/code"
    async with site.served() as browser:
        for other in (site.guest, site.operator):
            refused = await browser.post(path, headers={"Authorization": f"Bearer {other}"})
            assert code(refused) == (403, "role_too_low")
        token = (await browser.post(path, headers=admin)).json()["token"]
        assert (await browser.post(path, headers=admin)).json()["token"] == token
        assert token not in site.file.read_text()
        await log_in(browser, token)
        session = (await browser.get("/api/v1/session")).json()
        assert (session["name"], session["role"]) == ("codes of rui", "guest")
        assert code(await browser.get("/robots")) == (403, "role_too_low")
        revoke_token(site.file, "rui")
        assert code(await browser.get("/api/v1/session")) == (401, "session_ended")
        assert code(await browser.get("/robots", headers={"Authorization": f"Bearer {token}"})) == (
            401,
            "token_unknown",
        )


async def test_service_without_a_key_accepts_tokens_and_no_cookie(site):
    without = Tokens(session_key=None)
    empty = Tokens([entry("anna", "admin")], session_key=b"")
    (forged,) = session(empty).values()
    async with site.served(key=False) as browser:
        answer = await browser.post("/api/v1/session", json={"token": site.operator}, headers=OWN_PAGE)
        assert code(answer) == (503, "no_sessions")
        assert "FOGNAV_SESSION_KEY_FILE" in answer.json()["detail"]
        browser.cookies.set(without.cookie_name(encrypted=False), forged)
        assert code(await browser.get("/robots")) == (401, "session_ended")
        assert (await browser.get("/robots", headers={"Authorization": f"Bearer {site.operator}"})).status_code == 200


async def test_encrypted_session_is_sent_encrypted_only_and_one_that_was_not_is_not_accepted(site):
    security = SiteSecurity(site.folder / "locks", "test")
    security.make(["127.0.0.1"])
    http = security.folder("http")
    certificate = ServerCertificate(http / "server.pem", http / "server.key")
    trusted = ssl.create_default_context(cadata=security.authority.trusted)
    async with site.served(certificate=certificate) as plain:
        url = str(plain.base_url).replace("http:", "https:")
        async with httpx.AsyncClient(base_url=url, verify=trusted, timeout=60.0) as browser:
            answer = await log_in(browser, site.operator)
            cookie = answer.headers["set-cookie"]
            assert cookie.startswith("__Host-fognav-")
            assert "Secure" in cookie.split("; ")
            name, value = next(iter(browser.cookies.items()))
            assert (await browser.put("/zones/wet", headers={"Origin": url.rstrip("/")})).status_code == 200
            browser.cookies.clear()
            browser.cookies.set(name.removeprefix("__Host-"), value)
            assert code(await browser.get("/robots")) == (401, "token_missing")


async def test_gateway_says_whether_it_was_asked_encrypted_and_only_the_key_makes_a_gateway(site):
    proof = load_tokens(site.file, site.key).gateway_proof.decode()
    asked = {"X-Forwarded-For": "192.0.2.7", "X-Forwarded-Proto": "https", **OWN_PAGE}
    async with site.served() as browser:
        for sent, secure in ((proof, True), ("", False), ("0" * len(proof), False)):
            answer = await browser.post(
                "/api/v1/session", json={"token": site.operator}, headers={**asked, PROOF.decode(): sent}
            )
            assert answer.headers["set-cookie"].startswith("__Host-") is secure


def test_clients_that_guess_wait_and_others_do_not():
    clock = ManualClock()
    attempts = Attempts(clock)
    for _ in range(ATTEMPTS):
        assert attempts.wait_s("192.0.2.7") == 0.0
        attempts.failed("192.0.2.7")
    assert attempts.wait_s("192.0.2.7") == pytest.approx(ATTEMPT_S)
    assert attempts.wait_s("192.0.2.8") == 0.0
    clock.advance(ATTEMPT_S)
    assert attempts.wait_s("192.0.2.7") == 0.0


async def test_who_guesses_tokens_is_refused_for_a_while_and_who_has_one_at_the_same_address_is_not(site):
    async with site.served() as browser:
        for _ in range(ATTEMPTS):
            assert code(await browser.post("/api/v1/session", json={"token": "guess"})) == (401, "token_unknown")
        answer = await browser.post("/api/v1/session", json={"token": "guess"})
        assert code(answer) == (429, "too_many_attempts")
        assert 1 <= int(answer.headers["retry-after"]) <= ATTEMPT_S
        assert (
            await browser.post("/api/v1/session", json={"token": site.operator}, headers=OWN_PAGE)
        ).status_code == 200


def entry(name, role):
    return TokenEntry(name=name, role=role, sha256=token_hash(name))


class Time:
    """The time of day."""

    now = 1_800_000_000.0

    def __call__(self):
        return self.now


def session(tokens, name="anna"):
    value, _ = tokens.new_session(tokens.caller(name))
    return {tokens.cookie_name(encrypted=False): value}


def test_session_ends_after_twelve_hours_and_is_longer_for_who_asks_again():
    time = Time()
    tokens = Tokens([entry("anna", "operator")], session_key=KEY, now=time)
    cookies = session(tokens)
    time.now += SESSION_S - 1.0
    caller = tokens.caller_of_session(cookies, encrypted=False)
    assert caller is not None
    renewed, owner = tokens.new_session(caller)
    assert owner.until == time.now + SESSION_S
    time.now += 2.0
    assert tokens.caller_of_session(cookies, encrypted=False) is None
    cookies = {tokens.cookie_name(encrypted=False): renewed}
    assert tokens.caller_of_session(cookies, encrypted=False) is not None


def test_session_of_another_site_is_worth_nothing_even_under_this_one_s_name():
    tokens = Tokens([entry("anna", "operator")], session_key=KEY)
    other = Tokens([entry("anna", "operator")], session_key=OTHER_KEY)
    assert tokens.cookie_name(encrypted=False) != other.cookie_name(encrypted=False), "floors of one host"
    (value,) = session(other).values()
    assert tokens.caller_of_session({tokens.cookie_name(encrypted=False): value}, encrypted=False) is None


@given(at=st.integers(min_value=0), character=st.characters(min_codepoint=33, max_codepoint=126))
def test_changed_cookie_is_worth_nothing(at, character):
    tokens = Tokens([entry("anna", "viewer"), entry("ada", "admin")], session_key=KEY, now=lambda: 1.0)
    ((name, value),) = session(tokens).items()
    at %= len(value)
    changed = value[:at] + character + value[at + 1 :]
    caller = tokens.caller_of_session({name: changed}, encrypted=False)
    # The last bits of a part's last character are not part of what it encodes.
    assert caller is None or (changed == value or value[at + 1 : at + 2] in ("=", "."))
    assert caller is None or caller.name == "anna"


@pytest.mark.parametrize("value", ["", ".", "..", "a.b", "é.é", "====.====", "gA==.gA==", "x" * 10_000])
def test_nonsense_in_the_cookie_is_nobody_s_session(value):
    tokens = Tokens([entry("anna", "viewer")], session_key=KEY)
    assert tokens.caller_of_session({tokens.cookie_name(encrypted=False): value}, encrypted=False) is None


@pytest.mark.parametrize(
    ("text", "says"), [("", "only 0 bytes"), ("ab" * 8, "only 8 bytes"), ("no key", "not hexadecimal")]
)
def test_unusable_key_of_sessions_is_named_with_its_remedy(tmp_path, text, says):
    (tmp_path / "session.key").write_text(text)
    with pytest.raises(KeyFileError, match=rf"session\.key is {says}.*openssl rand -hex 32"):
        load_tokens(None, tmp_path / "session.key")


async def test_programs_that_share_a_token_are_told_apart_by_name_and_counted_together(site):
    async with site.served() as browser:
        token = {"Authorization": f"Bearer {site.operator}"}
        for headers, name in ((token, "anna"), (token | {PART: "ros2"}, "anna/ros2")):
            assert (await browser.get("/robots", headers=headers)).json() == name
            assert (await browser.get("/asker", headers=headers)).json() == "anna"
