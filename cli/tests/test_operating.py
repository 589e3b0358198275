"""The operator's commands against a stand-in for the REST APIs; tests/live runs them against a real demo."""

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import msgspec
import psutil
import pytest
from typer.testing import CliRunner

from fognav.__main__ import app
from fognav.operate import systems
from fognav.operate.systems import Registration, System, registered
from fognav.output import FailedError

ZONE = {
    "id": "z-1", "kind": "BLOCKED", "shape": {"type": "circle", "centre": [1, 2], "radius": 0.5}, "factor": None,
    "speed": None, "reason": "wet floor", "author": "anna", "starts_at": None, "expires_at": None, "enabled": True,
    "version": 1,
}  # fmt: skip
ROBOT = {
    "id": "r1", "configured": True, "pose": None, "goal": None, "plan": None,
    "state": {"mode": "NORMAL", "reasons": [], "goal_distance": None},
}  # fmt: skip


NOT_SENT = {"id", "author", "version", "expires_at"}
"""What the map-service sets itself; the end follows from the time to live."""


class Service:
    """Answers every request with what `answers` holds for its method and path, and records the requests."""

    def __init__(self) -> None:
        self.requests: list[tuple[str, str, object, str | None]] = []
        self.answers: dict[tuple[str, str], tuple[int, object]] = {}
        service = self

        class Handler(BaseHTTPRequestHandler):
            def answer(self) -> None:
                body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
                token = self.headers.get("Authorization")
                while service.hanging.is_set():
                    time.sleep(0.01)
                service.requests.append((self.command, self.path, json.loads(body or b"null"), token))
                status, value = service.answers.get((self.command, self.path), (404, {"detail": "there is no such"}))
                data = json.dumps(value).encode() if status != 204 else b""
                self.send_response(status)
                self.send_header("Content-Length", str(len(data)))
                self.end_headers()
                self.wfile.write(data)

            do_GET = do_POST = do_PUT = do_DELETE = answer  # noqa: N815  # the names are http.server's

            def log_message(self, *_: object) -> None:
                pass

        self._handler = Handler
        self.hanging = threading.Event()
        """While it is set, no request is answered."""
        self.listen(0)

    def listen(self, port: int) -> None:
        """Begin to answer at a port (0: any free one)."""
        self.server = ThreadingHTTPServer(("127.0.0.1", port), self._handler)
        threading.Thread(target=self.server.serve_forever, args=(0.02,), daemon=True).start()

    def close(self) -> int:
        """End, and return the port, at which connections are refused from now on."""
        self.server.shutdown()
        self.server.server_close()
        return self.server.server_port

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server.server_port}"


@pytest.fixture(autouse=True)
def runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A register of its own, and a machine without a fog node."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    for name in ("AGGREGATOR_PORT", "MAP_PORT", "PLANNER_PORT", "CONSOLE_PORT"):
        monkeypatch.setenv(f"FOGNAV_{name}", "1")
    for name in ("FOG", "TOKEN", "TOKEN_FILE", "TOKENS_FILE"):
        monkeypatch.delenv(f"FOGNAV_{name}", raising=False)
    return tmp_path / "fognav"


@pytest.fixture
def service() -> Iterator[Service]:
    running = Service()
    yield running
    running.close()


def system(name: str, url: str, **others: object) -> System:
    urls = dict.fromkeys(("map-service", "planner", "hazard-aggregator"), url)
    given = {
        "site": "here",
        "urls": {**urls, "zenoh-router": "tcp/127.0.0.1:1"},
        "pids": {},
        "robots": ["r1"],
        **others,
    }
    return System(name=name, kind="demo", **given)


@pytest.fixture
def demo(service: Service, tmp_path: Path) -> Iterator[Service]:
    """A registered demo whose services are all this one."""
    (tmp_path / "token").write_text("secret\n")
    with Registration(lambda: system("demo-1", service.url, token_file=str(tmp_path / "token"))) as registration:
        registration.update()
        yield service


def run(*arguments: str, code: int = 0) -> str:
    """Run a command that must end with this exit code; return its answer in one line, or its JSON text.

    What was asked for is on standard output, so that it can be filtered; errors are not.
    """
    done = CliRunner().invoke(app, list(arguments))
    assert done.exit_code == code, done.output
    if code != 0:
        return " ".join(done.output.split())
    return done.stdout if "--json" in arguments else " ".join(done.stdout.split())


def test_register_lists_a_demo_until_its_end(runtime: Path) -> None:
    with Registration(lambda: system("demo-1", "http://x")) as registration:
        assert registered() == []
        registration.update()
        assert [found.name for found in registered()] == ["demo-1"]
        (file,) = runtime.iterdir()
        assert [file.stat().st_mode & 0o777, runtime.stat().st_mode & 0o777] == [0o600, 0o700]
    assert registered() == []


def test_register_forgets_a_demo_that_was_killed(runtime: Path) -> None:
    code = (
        "import sys; from fognav.operate.systems import *\n"
        "Registration(lambda: System(name='demo-9', kind='demo', site='', urls={}, pids={})).update()\n"
        "print('up', flush=True); sys.stdin.read()"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline() == b"up\n"
    assert [found.name for found in registered()] == ["demo-9"]
    process.kill()
    process.communicate()
    assert registered() == []
    assert list(runtime.iterdir()) == []


def test_register_keeps_the_systems_of_one_name_of_two_processes_apart(runtime: Path) -> None:
    code = (
        "import sys; from fognav.operate.systems import *\n"
        "with Registration(lambda: System(name='fog-estig', kind='fog node', site='', urls={}, pids={})) as entry:\n"
        "    entry.update(); print('up', flush=True); sys.stdin.read()"
    )
    with Registration(lambda: system("fog-estig", "http://x")) as registration:
        registration.update()
        process = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        assert process.stdout is not None
        assert process.stdout.readline() == b"up\n"
        assert sorted(found.kind for found in registered()) == ["demo", "fog node"]
        assert "several systems of this machine are named fog-estig" in run(
            "zone", "list", "--fog", "fog-estig", code=2
        )
        process.communicate()  # it ends
        assert [found.kind for found in registered()] == ["demo"]
    assert list(runtime.iterdir()) == []


def test_register_forgets_a_demo_whose_process_id_belongs_to_another_process(runtime: Path) -> None:
    with Registration(lambda: system("demo-1", "http://x")) as registration:
        registration.update()
        (file,) = runtime.iterdir()
        entry = json.loads(file.read_text())
        file.write_text(json.dumps({**entry, "started": entry["started"] - 60}))
        assert registered() == []
        assert not file.exists()


def test_unreadable_entry_is_removed(runtime: Path) -> None:
    systems.folder()
    (runtime / "demo-1.json").write_text('{"pid": 1')
    assert registered() == []
    assert list(runtime.iterdir()) == []


@pytest.mark.parametrize("prepare", ["open to others", "a link"])
def test_folder_that_is_not_private_is_not_trusted(runtime: Path, tmp_path: Path, prepare: str) -> None:
    if prepare == "a link":
        (tmp_path / "elsewhere").mkdir(mode=0o700)
        runtime.symlink_to(tmp_path / "elsewhere")
    else:
        runtime.mkdir()
        runtime.chmod(0o755)
    with pytest.raises(FailedError, match="is not a private folder of yours"):
        registered()


def test_without_a_runtime_folder_the_register_is_in_the_temporary_folder(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path))
    monkeypatch.setattr(systems, "RUNTIME", tmp_path / "run")
    assert systems.folder() == tmp_path / f".fognav-{os.getuid()}"


def test_system_that_systemd_runs_is_found_by_who_has_no_variable_such_as_cron(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setattr(systems, "RUNTIME", tmp_path)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / str(os.getuid())))
    (tmp_path / str(os.getuid())).mkdir()
    with Registration(lambda: system("demo-1", "http://127.0.0.1:1")) as registration:
        registration.update()
        monkeypatch.delenv("XDG_RUNTIME_DIR")
        assert [found.name for found in registered()] == ["demo-1"]


@pytest.mark.parametrize("text", ["abc", "0", "65536", "-1", "1_9"])
def test_port_that_is_none_is_named_with_its_variable(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FOGNAV_MAP_PORT", text)
    assert f"FOGNAV_MAP_PORT is '{text}': set it to a port, 1 to 65535" in run("status", code=2)


def test_command_without_a_system_fails_with_the_remedy() -> None:
    assert "no demo or fog node runs on this machine. Start one (fognav demo" in run("zone", "list", code=1)


def test_command_with_several_systems_asks_for_one(demo: Service, tmp_path: Path) -> None:
    (tmp_path / "tokens.toml").touch()
    demo.answers["GET", "/api/v1/zones"] = (200, {"zones": [], "active": [], "epoch": 1, "seq": 1})
    with Registration(lambda: system("demo-2", demo.url)) as registration:
        registration.update()
        assert "choose one with --fog (demo-1, demo-2)" in run("zone", "list", code=2)
        assert run("zone", "list", "--fog", "demo-2") == "no zones"
        assert "choose one with --fog" in run("token", "create", "anna", code=2)
        run("token", "create", "anna", "--fog", "demo-1")
        assert "anna: viewer" in run("token", "list", "--fog", "demo-1")
        run("token", "revoke", "anna", "--fog", "demo-1")


def test_status_shows_addresses_token_and_processes(demo: Service, tmp_path: Path) -> None:
    found = json.loads(run("status", "--json"))
    (shown,) = [entry for entry in found["systems"] if entry["name"] == "demo-1"]
    assert (shown["kind"], shown["site"], shown["token_file"]) == ("demo", "here", str(tmp_path / "token"))
    assert shown["urls"]["planner"] == demo.url
    assert shown["pids"] == {}
    assert shown["connected"] is None, "its router can't be reached"
    told = run("status")
    assert ("connected not visible" in " ".join(told.split()), "router_unreachable" in told) == (True, False)


def test_status_of_a_fog_node_that_does_not_answer_fails() -> None:
    output = run("status", "--fog", "127.0.0.1", code=1)
    assert "the hazard-aggregator does not answer at http://127.0.0.1:1" in output


def test_fog_node_elsewhere_is_found_by_its_address_and_asked_with_the_token(service, monkeypatch) -> None:
    for name in ("AGGREGATOR_PORT", "MAP_PORT", "PLANNER_PORT", "CONSOLE_PORT"):
        monkeypatch.setenv(f"FOGNAV_{name}", str(service.server.server_port))
    monkeypatch.setenv("FOGNAV_FOG", "localhost")
    monkeypatch.setenv("FOGNAV_TOKEN", "mine")
    service.answers["GET", "/healthz"] = (200, {"status": "ok"})
    service.answers["GET", "/api/v1/map"] = (200, {"site": "there"})
    (shown,) = json.loads(run("status", "--json"))["systems"]
    assert (shown["kind"], shown["site"]) == ("fog node", "there")
    assert {token for _, _, _, token in service.requests} == {"Bearer mine"}


@pytest.mark.parametrize("address", ["http://host", "host:8001"])
def test_address_with_scheme_or_port_is_refused(address: str) -> None:
    assert "give a host's name or address, without scheme and port" in run("zone", "list", "--fog", address, code=2)


@pytest.mark.parametrize(
    ("options", "shape"),
    [
        (["--circle", "-1.5,2,0.5"], {"type": "circle", "centre": [-1.5, 2.0], "radius": 0.5}),
        (["--rectangle", "0,0,2,1"], {"type": "rectangle", "corner": [0, 0], "opposite": [2, 1]}),
        (["--polygon", "0,0 1,0 1,1"], {"type": "polygon", "points": [[0, 0], [1, 0], [1, 1]]}),
        (["--corridor", "0,0 5,0", "--width", "1"], {"type": "corridor", "line": [[0, 0], [5, 0]], "width": 1}),
    ],
)
def test_zone_is_added_with_the_shape_of_its_option(demo: Service, options: list[str], shape: object) -> None:
    demo.answers["POST", "/api/v1/zones"] = (201, ZONE)
    made = json.loads(run("zone", "add", *options, "--reason", "wet floor", "--for", "1m", "--json"))
    assert {key: made[key] for key in ZONE} == ZONE
    ((method, path, body, token),) = demo.requests
    assert (method, path, token) == ("POST", "/api/v1/zones", "Bearer secret")
    assert isinstance(body, dict)
    assert body.pop("id").startswith("z-")
    assert body == {"kind": "BLOCKED", "shape": shape, "reason": "wet floor", "ttl_s": 60.0}


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ([], "give the zone one shape"),
        (["--circle", "1,2,3", "--polygon", "0,0 1,0 1,1"], "give the zone one shape"),
        (["--circle", "1,2"], "'1,2' is not X,Y,R, such as 12.5,3,0.5"),
        (["--circle", "1,2,nan"], "'1,2,nan' is not X,Y,R"),
        (["--polygon", "0,0 1,0"], "has 2 points, but a polygon needs at least 3"),
        (["--corridor", "0,0 1,0"], "--corridor needs --width"),
        (["--circle", "1,2,3", "--width", "1"], "--corridor needs --width"),
        (["--circle", "1,2,3", "--kind", "lava"], "lava"),
        (["--circle", "1,2,3", "--for", "10"], "--for 10: give a number and its unit: 90s, 15m, 2h or 3d"),
        (["--circle", "1,2,3", "--for", "10m", "--until", "+1h"], "give either --for or --until"),
        (["--circle", "1,2,3", "--from", "tomorrow"], "--from tomorrow: give a time, such as 2026-11-24T18:30"),
        (["--circle", "1,2,3", "--each", "mon-fri 18:00-20:00"], "--each needs --time-zone"),
        (["--circle", "1,2,3", "--each", "noon", "--time-zone", "UTC"], "--each 'noon': give days and times"),
        (["--circle", "1,2,3", "--each", "mon-fre 18:00-20:00", "--time-zone", "UTC"], "give days and times"),
        (["--circle", "1,2,3", "--replace"], "--replace needs the --id"),
    ],
)
def test_zone_with_an_impossible_shape_is_refused_before_it_is_sent(demo: Service, options, problem: str) -> None:
    assert problem in run("zone", "add", *options, code=2)
    assert demo.requests == []


def test_zone_has_all_the_times_that_rest_knows(demo: Service) -> None:
    demo.answers["PUT", "/api/v1/zones/fire"] = (200, ZONE)
    options = ["--circle", "1,2,3", "--id", "fire", "--replace", "--disabled"]
    times = ["--time-zone", "Europe/Lisbon", "--from", "2026-11-24T18:30+01:00", "--until", "2026-12-24T00:00Z"]
    run("zone", "add", *options, *times, "--each", "fri-mon,wed 18:00-20:30", "--each", "tue 08:00-07:00")
    ((_, _, body, _),) = demo.requests
    assert {name: body[name] for name in ("starts_at", "expires_at", "enabled", "schedule")} == {
        "starts_at": 1795541400.0,
        "expires_at": 1798070400.0,
        "enabled": False,
        "schedule": {
            "time_zone": "Europe/Lisbon",
            "times": [
                {"days": ["fri", "sat", "sun", "mon", "wed"], "begin": "18:00", "end": "20:30"},
                {"days": ["tue"], "begin": "08:00", "end": "07:00"},
            ],
        },
    }
    run("zone", "add", *options, "--from", "+90s")
    assert demo.requests[-1][2]["starts_at"] == pytest.approx(time.time() + 90.0, abs=60.0)


def test_zone_is_switched_off_and_on_without_a_change_of_anything_else(demo: Service) -> None:
    timed = ZONE | {"ttl_s": 600.0, "expires_at": 1795541400.0, "version": 7}
    demo.answers["GET", "/api/v1/zones/z-1"] = (200, timed)
    demo.answers["PUT", "/api/v1/zones/z-1"] = (200, timed | {"enabled": False})
    assert "disabled" in run("zone", "disable", "z-1")
    _, (method, _, body, _) = demo.requests
    assert method == "PUT"
    assert body == {name: value for name, value in timed.items() if name not in NOT_SENT} | {"enabled": False}
    run("zone", "enable", "z-1")
    assert demo.requests[-1][2]["enabled"] is True


def test_set_of_zones_is_added_and_switched_with_what_it_has(demo: Service) -> None:
    made = {"id": "night", "name": "at night", "schedule": None, "version": 3, "on": False, "zones": ["z-1"]}
    demo.answers["GET", "/api/v1/zone-sets"] = (200, [made])
    for name in ("night", "fair"):
        demo.answers["PUT", f"/api/v1/zone-sets/{name}"] = (200, made)
    assert run("zone", "set", "night", "off") == "set night is off; its zones: z-1"
    assert demo.requests[-1][2] == {"name": "at night", "schedule": None, "enabled": False}
    run("zone", "set", "fair", "on")
    assert demo.requests[-1][2] == {"enabled": True}
    demo.answers["POST", "/api/v1/zones"] = (201, ZONE | {"sets": ["night"]})
    assert "in night" in run("zone", "add", "--circle", "1,2,3", "--set", "night")
    assert demo.requests[-1][2]["sets"] == ["night"]


def test_zones_are_listed_shown_and_removed(demo: Service) -> None:
    demo.answers["GET", "/api/v1/zones"] = (200, {"zones": [ZONE], "active": [], "epoch": 1, "seq": 1})
    demo.answers["GET", "/api/v1/zones/z-1"] = (200, ZONE)
    demo.answers["DELETE", "/api/v1/zones/z-1"] = (204, None)
    assert run("zone", "list") == "z-1: BLOCKED circle, wet floor, by anna (has no effect now)"
    clock = {"parts": {"clock": {"detail": "nothing keeps the time of day synchronized"}}}
    demo.answers["GET", "/readyz"] = (503, clock)
    for end, told in (({"ttl_s": 60.0}, False), ({}, True)):  # a time to live needs no time of day
        ended = {**ZONE, "expires_at": 1.0, **end}
        demo.answers["GET", "/api/v1/zones"] = (200, {"zones": [ended], "active": ["z-1"], "epoch": 1, "seq": 1})
        assert ("nothing keeps the time of day synchronized" in run("zone", "list")) is told
    assert run("zone", "show", "z-1") == "z-1: BLOCKED circle, wet floor, by anna"
    assert json.loads(run("zone", "remove", "z-1", "--json"))["removed"] is True


def test_refusal_gives_reason_and_remedy_of_the_problem_document(demo: Service) -> None:
    remedy = "Choose one of GET /api/v1/zones, or POST a new one"
    problem = {"detail": "there is no zone nix: PUT one first", "remedy": remedy}
    demo.answers["GET", "/api/v1/zones/nix"] = (404, problem)
    said = "there is no zone nix. Choose one of `fognav zone list`, or add one"  # a command, and not a route
    assert f"the map-service refused it: {said}" in run("zone", "show", "nix", code=1)
    demo.answers["DELETE", "/api/v1/zones/z-1"] = (401, {"detail": "the token is unknown"})
    assert "the token is unknown. Set FOGNAV_TOKEN to an operator's token" in run("zone", "remove", "z-1", code=1)


def test_missing_token_file_is_named(demo: Service, monkeypatch) -> None:
    monkeypatch.setenv("FOGNAV_TOKEN_FILE", "/nowhere/token")
    assert "the token file /nowhere/token can't be read" in run("zone", "list", code=2)


def test_areas_are_listed_with_their_state(demo: Service) -> None:
    definition = {"id": "hall", "label": "the hall"}
    areas = [{"definition": definition, "hazard": {"state": "clear", "cause": "n1 sees nothing"}, "withheld": False}]
    override = {"state": "blocked", "author": "ann", "rest_s": 5400.4}
    areas = [{**areas[0], "override": None}, {**areas[0], "override": override}]
    demo.answers["GET", "/api/v1/areas"] = (200, areas)
    plain = "hall (the hall): clear, n1 sees nothing"
    assert run("area", "list") == f"{plain} {plain} [blocked by ann for another 1 h 30 min]"
    assert json.loads(run("area", "list", "--json"))["areas"] == areas
    half = {"state": "blocked", "cause": "n1 sees a box", "free": [[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]]}
    demo.answers["GET", "/api/v1/areas"] = (200, [{**areas[0], "hazard": half}])
    assert "blocked, n1 sees a box; a part of it is free, which robots pass slowly" in run("area", "list")


def test_history_of_an_area_is_listed_with_how_long_each_state_lasted(demo: Service) -> None:
    path = "/api/v1/areas/hall/history?limit="
    period = {"began": 1_700_000_000.0, "state": "clear", "penalty": 0, "cause": "n1 sees nothing", "overridden": False}
    blocked = {**period, "state": "blocked", "cause": "something at 0.62 m"}
    periods = [
        {"period": period, "ended": None, "lasted_s": 61.0},
        {"period": blocked, "ended": 1_700_000_000.0, "lasted_s": 7260.0},
    ]
    demo.answers["GET", path + "20"] = (200, periods)
    printed = run("area", "history", "hall")
    assert ": clear until now, for 1 min 1 s, n1 sees nothing" in printed
    assert ": blocked for 2 h 1 min, something at 0.62 m" in printed
    assert json.loads(run("area", "history", "hall", "--json"))["periods"] == periods
    demo.answers["GET", path + "1"] = (200, [])
    assert run("area", "history", "hall", "--limit", "1") == "area hall has no history yet"


def test_alerts_are_listed_and_acknowledged(demo: Service) -> None:
    alert = {
        "id": "node-unknown.hall.n1", "kind": "node-unknown", "area": "hall", "node": "n1", "reason": "it went offline",
        "since": 1_700_000_000.0, "raised": 1_700_000_120.0, "acknowledged_by": None, "acknowledged_at": None,
    }  # fmt: skip
    demo.answers["GET", "/api/v1/alerts"] = (200, [alert])
    assert run("alert", "list").startswith("node-unknown.hall.n1: since 2023-11-1")
    seen = {**alert, "acknowledged_by": "ann"}
    demo.answers["PUT", "/api/v1/alerts/node-unknown.hall.n1/acknowledgement"] = (200, seen)
    assert run("alert", "acknowledge", "node-unknown.hall.n1") == "node-unknown.hall.n1 is acknowledged by ann"
    demo.answers["GET", "/api/v1/alerts"] = (200, [seen])
    assert run("alert", "list").endswith("it went offline [ann looks after it]")
    assert json.loads(run("alert", "list", "--json"))["alerts"] == [seen]
    demo.answers["GET", "/api/v1/alerts"] = (200, [])
    assert run("alert", "list") == "no alerts"


def test_source_is_added_to_an_area_listed_and_removed(demo: Service) -> None:
    definition = {"id": "hall", "polygon": [[0, 0], [1, 0], [1, 1]], "nodes": ["n1"], "version": 3}
    demo.answers["GET", "/api/v1/areas/hall"] = (200, {"definition": definition})
    demo.answers["PUT", "/api/v1/areas/hall"] = (200, definition)
    options = ["--area", "hall", "--profile", "tasmota-distance", "--device", "corridor", "--below", "120"]
    assert run("source", "add", "sonar", *options) == "source sonar watches area hall"
    body = demo.requests[-1][2]
    assert isinstance(body, dict)
    assert body["nodes"] == ["n1"]
    (source,) = body["sources"]
    assert (source["id"], source["profile"], source["device"]) == ("sonar", "tasmota-distance", "corridor")
    assert source["number"]["below"] == 120
    assert "version" not in body
    with_source = {**definition, "sources": body["sources"]}
    demo.answers["GET", "/api/v1/areas/hall"] = (200, {"definition": with_source})
    demo.answers["GET", "/api/v1/areas"] = (200, [{"definition": with_source}])
    node = {"id": "sonar", "area": "hall", "state": "blocked", "reason": "62 is below 120"}
    demo.answers["GET", "/api/v1/nodes"] = (200, [node])
    assert run("source", "list") == "hall/sonar: blocked, 62 is below 120"
    assert json.loads(run("source", "list", "--json"))["sources"][0]["health"] == node
    assert "area hall has no source other (it has: sonar)" in run("source", "remove", "other", "--area", "hall", code=1)
    assert run("source", "remove", "sonar", "--area", "hall") == "source sonar no longer watches area hall"
    removed = demo.requests[-1][2]
    assert isinstance(removed, dict)
    assert removed["sources"] == []


def test_source_may_be_given_as_json_and_wrong_ones_are_refused_before_anything_is_asked(demo: Service) -> None:
    definition = {"id": "hall", "polygon": [[0, 0], [1, 0], [1, 1]], "version": 3}
    demo.answers["GET", "/api/v1/areas/hall"] = (200, {"definition": definition})
    demo.answers["PUT", "/api/v1/areas/hall"] = (200, definition)
    text = '{"topic": "t", "pointer": "/gas", "number": {"above": 400}, "period_s": 5}'
    added = json.loads(run("source", "add", "gas", "--area", "hall", "--source", text, "--penalty", "120", "--json"))
    assert (added["source"]["pointer"], added["source"]["penalty"]) == ("/gas", 120)
    asked = len(demo.requests)
    assert "--source is no JSON object" in run("source", "add", "gas", "--area", "hall", "--source", "[", code=2)
    aimless = run("source", "add", "gas", "--area", "hall", "--source", text, "--hysteresis", "2", code=2)
    assert "--hysteresis needs the limit that it is of" in aimless
    assert "source gas: Expected" in run("source", "add", "gas", "--area", "hall", "--source", '{"topic": 7}', code=2)
    assert len(demo.requests) == asked
    assert "zigbee2mqtt-contact: zigbee2mqtt/{device}" in run("source", "profiles")
    assert "home-assistant" in json.loads(run("source", "profiles", "--json"))["profiles"]


def test_area_is_overridden_for_a_time_and_the_override_removed(demo: Service) -> None:
    path = "/api/v1/areas/hall/override"
    demo.answers["PUT", path] = (200, {"state": "blocked", "author": "ann", "rest_s": 59.9})
    demo.answers["DELETE", path] = (204, None)
    words = ["--state", "blocked", "--reason", "wax"]
    assert run("area", "override", "hall", *words, "--for", "1m") == (
        "area hall is overridden: blocked by ann for another 1 min"
    )
    assert demo.requests[-1][2] == {"state": "blocked", "reason": "wax", "ttl_s": 60.0}
    assert run("area", "override", "hall", "--remove") == "area hall is no longer overridden"
    assert json.loads(run("area", "override", "hall", "--remove", "--json"))["override"] is None
    demo.answers["PUT", path] = (403, {"detail": "to declare an area clear needs the role admin"})
    refused = run("area", "override", "hall", "--state", "clear", "--reason", "x", "--for", "2h", code=1)
    assert "needs the role admin" in refused


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["--state", "blocked", "--reason", "wax"], "needs --state, --for and --reason"),
        (["--state", "blocked", "--reason", "wax", "--for", "60"], "--for 60: give a number and its unit"),
        (["--state", "blocked", "--reason", "wax", "--for", "0s"], "--for 0s"),
        (["--remove", "--reason", "wax"], "--remove goes without"),
    ],
)
def test_incomplete_override_is_refused_with_the_remedy(demo: Service, options: list[str], problem: str) -> None:
    assert problem in run("area", "override", "hall", *options, code=2)


@pytest.mark.parametrize(
    ("goal", "body"),
    [
        ("b", {"place": "b"}),
        ("-1,2.5", {"pose": {"x": -1.0, "y": 2.5}}),
        ("1,2,0.5", {"pose": {"x": 1.0, "y": 2.0, "theta": 0.5}}),
    ],
)
def test_goal_is_a_place_or_a_position(demo: Service, goal: str, body: object) -> None:
    demo.answers["PUT", "/api/v1/robots/r1/goal"] = (200, {})
    demo.answers["GET", "/api/v1/robots"] = (200, [ROBOT])
    answer = json.loads(run("robot", "goal", goal, "--json"))
    assert {key: answer[key] for key in ("accepted", "mode")} == {"accepted": True, "mode": "NORMAL"}
    assert demo.requests[0][2] == body


def test_goal_on_another_floor_is_a_way_by_the_lift(demo: Service) -> None:
    demo.answers["PUT", "/api/v1/robots/r1/floor"] = (200, {})
    demo.answers["GET", "/api/v1/robots"] = (200, [ROBOT])
    assert run("robot", "goal", "desk", "--floor", "upstairs") == (
        "accepted: robot r1 goes to desk on upstairs, by the lift (mode NORMAL)"
    )
    assert demo.requests[0][2] == {"place": "desk", "floor": "upstairs"}


def test_stops_of_a_mission_may_be_on_other_floors(demo: Service) -> None:
    stops = [
        {"place": "desk", "pose": None, "floor": "upstairs", "state": "present"},
        {"place": None, "pose": {"x": 1.0, "y": 2.0}, "floor": "cellar", "state": "ahead"},
        {"place": None, "pose": None, "floor": "attic", "state": "ahead"},
    ]
    made = {"robot": "r1", "stops": stops, "deadline": None, "aside": None}
    demo.answers["PUT", "/api/v1/robots/r1/mission"] = (201, made)
    demo.answers["GET", "/api/v1/robots"] = (200, [ROBOT])
    told = run("mission", "send", "upstairs:desk", "cellar:1,2")
    assert told == "r1: upstairs:desk (on the way), cellar:(1.00, 2.00), the lift to attic"
    assert demo.requests[0][2]["stops"] == [  # type: ignore[index]  # a mission's
        {"place": "desk", "floor": "upstairs"}, {"pose": {"x": 1.0, "y": 2.0}, "floor": "cellar"},
    ]  # fmt: skip
    assert "'': an id has only" in run("mission", "send", ":desk", code=2)


def test_mission_by_the_clock_says_what_is_asked_for_and_what_became_of_the_last_one(demo: Service) -> None:
    times = [{"days": ["mon", "tue"], "begin": "08:00", "end": "09:00"}]
    last = {"begin": 0.0, "outcome": "missed", "reason": "robot r1 has another mission"}
    made: tuple[int, dict[str, object]] = 201, {
        "id": "post", "robot": "r1",
        "mission": {"stops": [{"place": "desk"}, {"place": None, "pose": {"x": 1, "y": 2}}]},
        "weekly": {"time_zone": "Europe/Lisbon", "times": times}, "enabled": True, "waits": "", "next": None,
        "last": last, "version": "v1",
    }  # fmt: skip
    demo.answers["PUT", "/api/v1/schedules/post"] = made
    told = run(
        "mission", "schedule", "post", "desk", "1,2", "--each", "mon,tue 08:00-09:00", "--time-zone", "Europe/Lisbon",
        "--when-cut", "nearest", "--limit", "10m", "--best",
    )  # fmt: skip
    assert demo.requests[0][2] == {
        "robot": "r1",
        "mission": {
            "stops": [{"place": "desk"}, {"pose": {"x": 1.0, "y": 2.0}}],
            "order": "best",
            "priority": 0,
            "when_cut": {"do": "nearest", "limit_s": 600.0},
        },
        "weekly": {"time_zone": "Europe/Lisbon", "times": times},
        "enabled": True,
    }
    assert told.startswith(
        "post: r1 to desk, (1.00, 2.00), mon,tue 08:00-09:00 Europe/Lisbon; none is due within a week"
    )
    assert "install chrony; the one of " in told, "a clock that nothing keeps right begins nothing"
    assert told.endswith("was missed (robot r1 has another mission)")
    demo.answers["GET", "/api/v1/schedules/post"] = made
    run("mission", "disable", "post")
    assert demo.requests[-1][:2] == ("PUT", "/api/v1/schedules/post")
    sent = demo.requests[-1][2]
    assert isinstance(sent, dict)
    assert (sent["enabled"], sent["weekly"]) == (False, made[1]["weekly"])
    wrong = run("mission", "schedule", "post", "desk", "--each", "always", "--time-zone", "UTC", code=2)
    assert "give days and times" in wrong


@pytest.mark.parametrize("goal", ["5.0", "Meeting room", ""])
def test_goal_that_is_neither_a_place_nor_a_position_is_wrong_use(demo: Service, goal: str) -> None:
    assert "is neither a place" in run("robot", "goal", goal, code=2)
    assert demo.requests == []


@pytest.mark.parametrize(
    ("mode", "said"),
    [
        ("NORMAL", "robot r1 goes to b"),
        ("INIT", "robot r1 goes to b; it waits to be enabled (fognav robot enable)"),
        ("FAULT", "robot r1 goes to b; it waits to be reset and enabled (fognav robot reset, fognav robot enable)"),
    ],
)
def test_accepted_goal_says_what_a_robot_that_stands_waits_for(demo: Service, mode: str, said: str) -> None:
    demo.answers["PUT", "/api/v1/robots/r1/goal"] = (200, {})
    demo.answers["GET", "/api/v1/robots"] = (200, [{**ROBOT, "state": {**ROBOT["state"], "mode": mode}}])
    assert json.loads(run("robot", "goal", "b", "--json"))["reason"] == said
    assert ("fognav robot reset" in run("robot", "status")) is (mode == "FAULT")


def test_refused_goal_is_reported_with_its_reason_and_exit_code_1(demo: Service) -> None:
    demo.answers["PUT", "/api/v1/robots/r1/goal"] = (422, {"detail": "the goal is in a wall"})
    demo.answers["GET", "/api/v1/robots"] = (200, [ROBOT])
    done = CliRunner().invoke(app, ["robot", "goal", "1,2", "--json"])
    assert done.exit_code == 1
    answer = json.loads(done.stdout)
    assert (answer["accepted"], answer["mode"]) == (False, "NORMAL")
    assert "the goal is in a wall" in answer["reason"]


def test_robot_must_be_named_where_there_are_several(service: Service) -> None:
    with Registration(lambda: system("demo-1", service.url, robots=["r1", "r2"])) as registration:
        registration.update()
        assert "name a robot with --robot; demo-1 has: r1, r2" in run("robot", "goal", "b", code=2)
        assert "an id has only a to z" in run("robot", "goal", "b", "--robot", "R 2", code=2)


@pytest.mark.parametrize("command", ["disable", "stop"])
def test_stop_needs_neither_key_nor_token_and_takes_the_way_that_works(service: Service, runtime, command) -> None:
    with Registration(lambda: system("demo-1", service.url)) as registration:
        registration.update()
        output = run("robot", command, code=1)
        assert "the zenoh router tcp/127.0.0.1:1 can't be reached" in output
        assert "the planner refused it" in output
        answer = {"accepted": True, "reason": "disabled; the mode is INIT", "mode": "NORMAL"}
        service.answers["POST", "/api/v1/robots/r1/stop"] = (200, answer)
        stopped = run("robot", command)
        assert (stopped.startswith("accepted: disabled; the mode is INIT"), "NORMAL" in stopped) == (True, False)


def test_stop_without_a_valid_token_names_no_robot_says_how_and_stops_the_floor(demo: Service) -> None:
    unknown = (401, {"detail": "the token is unknown"})
    demo.answers["GET", "/api/v1/robots"] = demo.answers["POST", "/api/v1/floors/stop"] = unknown
    urls = {"planner": demo.url, "console-service": demo.url, "zenoh-router": "tcp/127.0.0.1:1"}
    with Registration(lambda: system("demo-2", demo.url, robots=[], urls=urls)) as registration:
        registration.update()
        assert "name the robot with --robot: then no token is needed" in run("robot", "stop", "--fog", "demo-2", code=2)
        stopped = {"id": "here", "acknowledged": True, "robots": [{"id": "r1", "stopped": True}], "detail": ""}
        demo.answers["POST", "/api/v1/floors/here/stop"] = (200, stopped)
        done = CliRunner().invoke(app, ["floor", "stop", "--fog", "demo-2"])
        assert (done.exit_code, done.stdout) == (1, "here: stopped: r1\n")
        assert "no other floor was told" in done.stderr


STOP = "/api/v1/robots/r1/stop"
STOPPED = (200, {"accepted": True, "reason": "disabled", "mode": "INIT"})


class StopTold:
    """Runs `robot disable` with a robot that only the planner reaches, and lets `then` happen when it is told of."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, then: Callable[[], None]) -> None:
        self.told: list[tuple[float, str]] = []
        begun = time.monotonic()

        def tell(text: str) -> None:
            self.told.append((time.monotonic() - begun, text))
            then()

        monkeypatch.setattr("fognav.commands.robot.print_line", tell)
        self.answer = run("robot", "disable")


@pytest.mark.parametrize("status", [500, 503, 504, 429])
def test_stop_that_the_planner_can_not_carry_out_is_told_and_tried_until_it_is_through(
    demo: Service, monkeypatch: pytest.MonkeyPatch, status: int
) -> None:
    demo.answers["POST", STOP] = (status, {"detail": "the store does not answer"})

    done = StopTold(monkeypatch, lambda: demo.answers.update({("POST", STOP): STOPPED}))

    assert done.answer.startswith("accepted: disabled")
    ((_, told),) = done.told
    assert "the robot is not known to have stopped yet" in told
    assert "the store does not answer" in told


def test_stop_is_tried_again_after_the_planner_was_restarted(demo: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    demo.answers["POST", STOP] = STOPPED
    port = demo.close()

    done = StopTold(monkeypatch, lambda: demo.listen(port))

    assert done.answer.startswith("accepted: disabled")
    assert ["Connection refused" in told for _, told in done.told] == [True]


def test_stop_is_told_to_be_open_while_the_planner_hangs(demo: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    demo.answers["POST", STOP] = STOPPED
    demo.hanging.set()

    done = StopTold(monkeypatch, demo.hanging.clear)

    assert done.answer.startswith("accepted: disabled")
    assert len(done.told) == 1


def test_commands_go_through_the_planner_which_signs_them(demo: Service) -> None:
    path = "/api/v1/robots/r1/commands"
    demo.answers["POST", path] = (200, {"accepted": True, "reason": "enabled; the mode is NORMAL", "mode": "INIT"})
    demo.answers["GET", "/api/v1/robots/r1"] = (200, {"state": {"mode": "NORMAL"}})
    done = json.loads(run("robot", "enable", "--json"))
    assert (done["accepted"], done["reason"], done["mode"]) == (True, "enabled; the mode is NORMAL", "NORMAL")
    demo.answers["POST", path] = (409, {"detail": "there is no fault to reset", "mode": "INIT"})
    assert run("robot", "reset", code=1) == "refused: there is no fault to reset (mode INIT)"
    demo.answers["POST", path] = (403, {"detail": "this request needs the role operator"})
    assert "needs the role operator" in run("robot", "egress", code=1)
    assert "needs the role operator" in run("robot", "pose", "1,2,0", code=1)


def test_command_needs_a_token_that_the_planner_signs_for(demo: Service, tmp_path: Path) -> None:
    (tmp_path / "token").unlink()
    assert "the token file" in run("robot", "enable", code=2)


def test_pose_needs_a_heading(demo: Service) -> None:
    demo.answers["GET", "/api/v1/places"] = (200, {"b": {"x": 1, "y": 2, "theta": None, "label": ""}})
    assert "place b has no heading: give 1,2,THETA" in run("robot", "pose", "b", code=2)
    assert "there is no place c; known places: b" in run("robot", "pose", "c", code=2)
    assert "'1,2' is not X,Y,THETA" in run("robot", "pose", "1,2", code=2)


def test_processes_of_a_robot_are_shown_as_one_system(tmp_path: Path) -> None:
    package = tmp_path / "robot_agent"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "__main__.py").write_text("import sys; print('up', flush=True); sys.stdin.read()")
    environment = {
        **os.environ, "PYTHONPATH": str(tmp_path), "FOGNAV_ROBOT": "r9", "FOGNAV_SITE": "there",
        "FOGNAV_GUARDIAN_SOCKET": str(tmp_path / "socket"),
    }  # fmt: skip
    process = subprocess.Popen(
        [sys.executable, "-m", "robot_agent"], env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == b"up\n"
        shown = [entry for entry in json.loads(run("status", "--json"))["systems"] if entry["robots"] == ["r9"]]
        assert [(entry["kind"], entry["site"], entry["pids"]) for entry in shown] == [
            ("robot", "there", {"robot-agent": process.pid})
        ]
    finally:
        process.kill()
        process.communicate()


def test_register_is_written_again_only_when_the_system_changes(runtime: Path) -> None:
    current = system("demo-1", "http://x")
    with Registration(lambda: current) as registration:
        registration.update()
        (file,) = runtime.iterdir()
        before = file.stat().st_mtime_ns
        registration.update()
        assert file.stat().st_mtime_ns == before
        current = msgspec.structs.replace(current, pids={"planner": psutil.Process().pid})
        registration.update()
        assert [found.pids for found in registered()] == [{"planner": psutil.Process().pid}]


def test_tokens_of_a_running_demo_are_created_listed_and_revoked(demo: Service, tmp_path: Path) -> None:
    (tmp_path / "tokens.toml").touch()
    token = json.loads(run("token", "create", "anna", "--role", "operator", "--json"))["token"]
    assert len(token) > 30
    assert run("token", "list").startswith("anna: operator, since 20")
    assert "anna has a token already" in run("token", "create", "anna", code=1)
    assert run("token", "revoke", "anna") == "the token of anna is revoked"
    assert json.loads(run("token", "list", "--json"))["tokens"] == []
    assert "anna has no token" in run("token", "revoke", "anna", code=1)


def test_tokens_file_must_be_named_without_a_running_demo() -> None:
    assert "name the services' tokens file with --file or FOGNAV_TOKENS_FILE" in run("token", "list", code=2)
