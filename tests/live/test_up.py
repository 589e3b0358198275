"""A fog node without containers, as a person runs it: `fognav up`, `status`, `logs` and `down`, with real servers."""

import asyncio
import contextlib
import json
import os
import shutil
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import programs
import psutil
import pytest
from attacks import ATTACKS, few_files, running
from floor_ports import floor_ports
from lateness import Lateness
from websockets.asyncio.client import connect

from fog_contracts import channels as ch
from fog_contracts.grid import StaticMap
from fog_contracts.messages import RobotPose, RobotState
from fog_runtime.clock import SystemClock
from fog_runtime.configuration.maps import load_map, save_map
from fog_runtime.credentials import Credentials
from fog_runtime.transports.mqtt_connection import Broker
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fog_supervisor import child, net
from fognav.hosting.upgrading import Versions
from fognav.output import FailedError, WrongUseError

pytestmark = [pytest.mark.live, pytest.mark.timeout(300)]

ROOT = Path(__file__).parents[2]
START_S = 180.0
FIRST_START_S = 1200.0
"""Of a version that may have to compile its kernels first."""


class Node:
    """A fog node's data, ports and register, apart from those of other tests."""

    def __init__(self, folder: Path, *options: str) -> None:
        self.data = folder / "data"
        self.options = options
        self.source: Path | None = None
        """The checkout of another version, which runs instead of this one."""
        (folder / "runtime").mkdir(mode=0o700)
        self.printed = folder / "up.txt"
        inherited = {key: value for key, value in os.environ.items() if not key.startswith("FOGNAV_")}
        self.environment = {**inherited, **floor_ports(), "XDG_RUNTIME_DIR": str(folder / "runtime")}
        self.process: subprocess.Popen[bytes] | programs.Program | None = None

    def up(self) -> None:
        arguments = ("up", "--data", str(self.data), "--bind", "127.0.0.1", *self.options)
        self.printed.write_bytes(b"")
        if self.source is None:
            self.process = programs.start("fognav", self.environment, self.printed, *arguments, forks=True)
        else:
            found = [*self.source.glob("*/src"), *self.source.glob("*/*/src")]
            environment = {**self.environment, "PYTHONPATH": os.pathsep.join(map(str, found))}
            with self.printed.open("wb") as output:
                self.process = subprocess.Popen(
                    child.command(sys.executable, "-m", "fognav", *arguments), env=environment,
                    stdin=subprocess.DEVNULL, stdout=output, stderr=output,
                )  # fmt: skip
        self.wait(lambda: "is up:" in self.printed.read_text(), "it is up")

    def run(self, *arguments: str) -> str:
        done = programs.run(arguments, self.environment, ROOT, START_S)
        assert done.returncode == 0, f"{arguments}: {done.stdout}{done.stderr}\n{self.printed.read_text()}"
        return done.stdout + done.stderr

    def systems(self) -> dict[str, dict[str, Any]]:
        systems = self.json("status")["systems"]
        return {system["site"]: system for system in systems if system["name"].startswith("fog-")}

    def json(self, *arguments: str) -> Any:
        """Return the answer of a command, after which it may have a remark on standard error."""
        return json.JSONDecoder().raw_decode(self.run(*arguments, "--json"))[0]

    def wait(self, condition: Callable[[], object], what: str) -> None:
        deadline = time.monotonic() + (START_S if self.source is None else FIRST_START_S)
        assert self.process is not None
        while True:
            begun = time.monotonic()
            if condition():
                return
            assert self.process.poll() is None, self.printed.read_text()
            assert time.monotonic() < deadline, f"not in time: {what}\n{self.printed.read_text()}"
            # A condition that runs commands takes a whole core, which what it waits for needs.
            time.sleep(max(0.1, time.monotonic() - begun))

    def down(self) -> None:
        assert self.process is not None
        pids = [pid for system in self.systems().values() for pid in system["pids"].values()]
        assert "has ended" in self.run("down")
        assert self.process.wait(60) == 0, self.printed.read_text()
        assert not any(psutil.pid_exists(pid) for pid in pids)

    def end(self) -> None:
        if self.process is not None and self.process.poll() is None:
            self.process.terminate()
            self.process.wait(60)


@pytest.fixture
def node(tmp_path: Path) -> Iterator[Node]:
    made = Node(tmp_path)
    yield made
    made.end()


def require_refused(node: Node, data: Path, reason: str) -> None:
    again = subprocess.run(
        [sys.executable, "-m", "fognav", "up", "--data", str(data), "--bind", "127.0.0.1"],
        env=node.environment, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert again.returncode == 1
    assert reason in again.stderr


def admitted(port: int, user: str, password: str) -> bool:
    """Whether the broker accepts a connection (MQTT 3.1.1, sections 3.1 and 3.2)."""

    def text(words: str) -> bytes:
        return struct.pack(">H", len(words)) + words.encode()

    packet = text("MQTT") + struct.pack(">BBH", 4, 0xC2, 30) + text("test") + text(user) + text(password)
    with (
        socket.create_connection(("127.0.0.1", port), timeout=10) as plain,
        net.unverified().wrap_socket(plain) as connection,
    ):
        connection.sendall(bytes((0x10, len(packet))) + packet)
        return connection.recv(4) == b"\x20\x02\x00\x00"


def require_new_node_and_robot_admitted(node: Node, folder: Path) -> None:
    """Add a node and a robot to a running fog node, of which only the router may notice."""
    site, board = shutil.copytree(ROOT / "sites" / "estig", folder / "site"), folder / "board"
    before = node.systems()["estig"]["pids"]
    security = ("--locks", str(node.data / "locks"))
    place = ("--area", "z1", "--pose", "40.0,26.95,1.5708")
    network = ("--wifi", "Lab", "--wifi-password", "secret12", "--fog-host", "192.168.7.1")
    node.run("node", "add", "n8", *place, *network, "--site", str(site), "--out", str(board), *security)
    node.wait(lambda: "changed: mosquitto uses" in node.printed.read_text(), "the broker knows the node")
    password = json.loads((board / "node.json").read_bytes())["password"]
    port = int(node.environment["FOGNAV_MQTT_PORT"])
    node.wait(lambda: admitted(port, "n8", password), "the node is admitted")
    assert not admitted(port, "n8", "wrong")
    assert node.systems()["estig"]["pids"] == before

    node.run("robot", "add", "r2", *security)
    node.wait(lambda: "changed: zenoh-router uses" in node.printed.read_text(), "the router knows the robot")
    node.wait(lambda: "planner/estig" in (node.systems()["estig"]["connected"] or []), "it is connected again")
    after = node.systems()["estig"]["pids"]
    assert {name for name, pid in after.items() if before[name] != pid} == {"zenoh-router"}


@pytest.fixture
def simulated(tmp_path: Path) -> Iterator[Node]:
    made = Node(tmp_path, "--sim")
    yield made
    made.end()


def test_simulated_robot_and_nodes_are_connected_again_after_the_authority_was_replaced(simulated):
    node = simulated
    node.up()

    def connected():
        return set(node.systems()["estig"]["connected"] or [])

    def restarted(before):
        after = node.systems()["estig"]["pids"]
        return all(after.get(name, before[name]) != before[name] for name in ("simulator", "robot-agent", "planner"))

    def all_there():
        areas = node.json("area", "list")["areas"]
        states = [area["hazard"]["state"] for area in areas]
        return "robot-agent/r1" in connected() and set(states) == {"clear"}

    node.wait(all_there, "the robot is connected, and its nodes report")
    for options in ((), ("--finish",)):
        pids = node.systems()["estig"]["pids"]
        node.run("ca", "rotate", *options, "--locks", str(node.data / "locks"))
        node.wait(lambda pids=pids: restarted(pids), f"who has new credentials is started again {options}")
        node.wait(all_there, f"robot and nodes are back {options}")


async def told_home_assistant(node: Node, word: str) -> None:
    """Wait until the bridge tells Home Assistant, by its own user, that it knows the floor, or that it does not."""
    own = Credentials.read(node.data / "locks" / "credentials" / "home-assistant.toml")
    broker = Broker.of(f"mqtts://127.0.0.1:{node.environment['FOGNAV_MQTT_PORT']}", own)
    async with asyncio.timeout(START_S), broker.client("home-assistant", None) as client:
        await client.subscribe(ch.BRIDGE_AVAILABILITY.key(site="estig"))
        async for message in client.messages:
            if message.payload == word.encode():
                return


async def looked_on(node: Node) -> str:
    """Look on at the floor through the console, as Foxglove does; return what is shown."""
    own = Credentials.read(node.data / "locks" / "credentials" / "console.toml")
    token = (node.data / "keys" / "estig" / "admin.token").read_text().strip()
    address = f"wss://127.0.0.1:{node.environment['FOGNAV_CONSOLE_PORT']}/api/v1/foxglove"
    headers = {"Authorization": f"Bearer {token}"}
    async with (
        asyncio.timeout(START_S),
        connect(address, ssl=own.tls_context(), additional_headers=headers, subprotocols=["foxglove.sdk.v1"]) as viewer,
    ):
        return str(json.loads(await viewer.recv())["name"])


@pytest.fixture(scope="module")
def bridged(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Node]:
    """A node with a bridge, which is up."""
    folder = tmp_path_factory.mktemp("bridged")
    settings = folder / "bridge.toml"
    settings.write_text('adapters = "home-assistant, foxglove"\n')
    made = Node(folder, "--bridge", str(settings))
    try:
        made.up()
        yield made
    finally:
        made.end()


def test_bridge_is_kept_running_and_the_console_leads_to_it(bridged):
    node = bridged
    asyncio.run(told_home_assistant(node, ch.ONLINE))
    node.wait(lambda: "bridge" in node.systems()["estig"]["pids"], "it is registered")
    bridge = node.systems()["estig"]["pids"]["bridge"]
    os.kill(bridge, signal.SIGKILL)
    node.wait(lambda: node.systems()["estig"]["pids"].get("bridge", bridge) != bridge, "it is started again")
    asyncio.run(told_home_assistant(node, ch.ONLINE))
    assert asyncio.run(looked_on(node)) == "Fognav estig"
    assert node.run("logs", "bridge", "-n", "1000").count("settings_loaded") == 2
    assert "bridge: operator" in node.run("token", "list")


def test_zone_survives_a_killed_service_and_a_restart_of_the_node(bridged, tmp_path):
    node = bridged
    (system,) = node.systems().values()
    assert set(system["connected"]) >= {"map-service/estig", "planner/estig", "hazard-aggregator/estig"}
    node.run("zone", "add", "--circle", "90,20,1", "--reason", "wet floor")

    killed = system["pids"]["map-service"]
    os.kill(killed, signal.SIGKILL)
    node.wait(lambda: node.systems()["estig"]["pids"].get("map-service", killed) != killed, "a new map-service")
    node.wait(lambda: "map-service/estig" in node.systems()["estig"]["connected"], "it is connected again")
    assert "wet floor" in node.run("zone", "list")
    assert "settings_loaded" in node.run("logs", "map-service", "-n", "1000")

    require_new_node_and_robot_admitted(node, tmp_path)

    backup = node.data / "fog.tar.gz"
    saved = node.run("backup", str(backup), "--up", str(node.data))
    assert "backed up site estig" in saved
    node.run("zone", "add", "--circle", "80,20,1", "--reason", "after the backup")
    restoring = ("restore", str(backup), "--site", "sites/estig", "--up", str(node.data), "--replace")
    with pytest.raises(AssertionError, match="already runs with the data"):
        node.run(*restoring)

    require_refused(node, node.data, "already runs with the data")
    require_refused(node, node.data / "other", "can't listen on")

    node.down()
    assert node.run("down").startswith("no fog node")
    assert "restored site estig" in node.run(*restoring)
    node.up()
    zones = node.run("zone", "list")
    assert "wet floor" in zones
    assert "after the backup" not in zones
    node.down()


def walled(source: Path, target: Path, left: float, bottom: float, right: float, top: float) -> Path:
    """Write a map with one more wall (m); return its file."""
    static = load_map(source)
    cells, window = static.cells.copy(), static.geometry.window_around(left, bottom, right, top)
    cells[window.rows, window.columns] = 254
    save_map(target, StaticMap(static.geometry, cells))
    return target.with_suffix(".yaml")


@pytest.mark.long
def test_running_fog_gets_another_map_on_which_a_robot_plans_and_the_way_back(tmp_path):
    site = shutil.copytree(ROOT / "sites" / "estig", tmp_path / "site")
    node = Node(tmp_path, "--sim", "--site", str(site))
    change = ("map", "change", "--site", str(site))
    try:
        node.up()

        def planned(epoch: int) -> float:
            """Send the robot to B; return the path's length (m) once it drives there on the map of this epoch."""
            node.run("robot", "enable")
            node.run("robot", "goal", "b")
            found: dict[str, Any] = {}

            def on_its_way() -> bool:
                found.update(robot())
                state, goal, plan = found["state"], found["goal"], found["plan"]
                known = goal is not None and plan is not None and state["goal_id"] == goal["goal_id"]
                return known and plan["map_epoch"] == epoch and state["goal_distance"] is not None

            node.wait(on_its_way, "the robot has a path on the new map")
            return float(found["state"]["goal_distance"])

        def robot() -> dict[str, Any]:
            return node.json("robot", "status")

        node.wait(lambda: (robot()["pose"] or {}).get("localized"), "the robot knows where it is")
        in_wall = walled(site / "map.yaml", tmp_path / "in-wall", 58.0, 43.5, 60.0, 44.5)
        with pytest.raises(AssertionError, match=r"place b at \(59\.00, 44\.00\) lies in a wall"):
            node.run(*change, str(in_wall))
        shut = walled(site / "map.yaml", tmp_path / "shut", 50.0, 38.0, 50.5, 41.0)  # the upper corridor
        before = {name: node.systems()["estig"]["pids"][name] for name in ("map-service", "planner", "mosquitto")}
        folder = {file.name: file.read_bytes() for file in site.iterdir() if file.is_file()}
        changed = node.json(*change, str(shut))
        assert (changed["fog"], changed["findings"], changed["robots"]) == ("fog-estig", [], True)
        assert changed["epoch"] > changed["epoch_before"]
        assert changed["localized"]["r1"] is not None
        after = node.systems()["estig"]["pids"]
        assert {name for name, pid in before.items() if after[name] != pid} == {"map-service", "planner"}
        around = planned(changed["epoch"])

        back = node.json(*change, "--back")
        assert back["epoch"] > changed["epoch"]
        # It was driving: it has stopped with a reason, lost its goal, and knows the new map.
        stopped = robot()
        state = stopped["state"]
        assert (state["mode"] in ("HOLD", "INIT"), state["enabled"], stopped["goal"]) == (True, False, None), stopped
        assert state["goal_id"] is None
        assert (state["map_epoch"], bool(state["reasons"])) == (back["epoch"], True)
        assert planned(back["epoch"]) < around - 5.0

        # What the fog was given lies in its data: the site's folder is as it was.
        assert {file.name: file.read_bytes() for file in site.iterdir() if file.is_file()} == folder
    finally:
        node.end()


def second_floor(folder: Path) -> Path:
    """A copy of the floor estig with an id of its own."""
    site = folder / "upstairs"
    shutil.copytree(ROOT / "sites" / "estig", site)
    text = (site / "site.toml").read_text("utf-8")
    (site / "site.toml").write_text(text.replace('id = "estig"', 'id = "upstairs"', 1), "utf-8")
    return site


def test_two_floors_on_one_node_have_a_robot_each_and_share_no_hazard(tmp_path):
    floors = ("estig", "upstairs")
    node = Node(tmp_path, "--site", "estig", "--site", str(second_floor(tmp_path)), "--sim")

    def states(floor: str) -> dict[str, str]:
        answer = json.loads(node.run("area", "list", "--json", "--fog", f"fog-{floor}").partition("\nfognav:")[0])
        return {area["definition"]["id"]: area["hazard"]["state"] for area in answer["areas"]}

    try:
        node.up()
        systems = node.systems()
        servers = ("mosquitto", "redis", "zenoh-router")
        assert [systems["estig"]["pids"][name] for name in servers] == [
            systems["upstairs"]["pids"][name] for name in servers
        ]
        for floor in floors:
            node.wait(lambda floor=floor: set(states(floor).values()) == {"clear"}, f"{floor} is clear")
            assert "robot-agent/r1" in node.systems()[floor]["connected"]
            node.run("robot", "status", "--fog", f"fog-{floor}")
        node.run("area", "override", "z1", "--state", "blocked", "--for", "1h", "--reason", "box", "--fog", "fog-estig")
        node.wait(lambda: states("estig")["z1"] == "blocked", "the hazard is on its floor")
        node.run("zone", "add", "--circle", "90,20,1", "--reason", "wet floor", "--fog", "fog-upstairs")
        assert set(states("upstairs").values()) == {"clear"}
        assert "wet floor" not in node.run("zone", "list", "--fog", "fog-estig")
        node.down()
    finally:
        node.end()


def older_release() -> str:
    """Return the version to upgrade from: FOGNAV_UPGRADE_FROM, or the newest release before this commit.

    Raises `FailedError` and `WrongUseError` where git does not know it.
    """
    if chosen := os.environ.get("FOGNAV_UPGRADE_FROM"):
        return chosen
    versions = Versions(ROOT)
    current, releases = versions.current(), versions.releases()
    if not releases:
        raise FailedError("this history has no release: fetch it whole, or set FOGNAV_UPGRADE_FROM")
    # Before the first release, the version before it is known by its last commit only.
    return next((release.commit for release in releases if release.commit != current), f"{current}^")


def git(*arguments: str) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, check=False)


def no_older_release() -> str | None:
    """Return why there is no older release to upgrade from, or None."""
    try:
        found = git("cat-file", "-e", f"{older_release()}^{{tree}}")
    except (FailedError, WrongUseError) as error:
        return str(error)
    return None if found.returncode == 0 else f"git lacks the older release: {found.stderr.decode().strip()}"


COMPILED = "libs/fog-kernels/src/fog_kernels/__pycache__"
NO_OLDER_RELEASE = no_older_release()


@pytest.mark.long
@pytest.mark.timeout(1800)  # kernels that are not this version's are compiled once
@pytest.mark.skipif(NO_OLDER_RELEASE is not None, reason=NO_OLDER_RELEASE or "")
def test_data_of_an_older_version_is_used_by_this_one(node, tmp_path):
    node.source = tmp_path / "older"
    node.source.mkdir()
    subprocess.run(["tar", "-x", "-C", str(node.source)], input=git("archive", older_release()).stdout, check=True)
    (node.source / COMPILED).mkdir(exist_ok=True)
    for file in (ROOT / COMPILED).glob("*.nb[ic]"):  # named by their sources: those of other sources are not used
        shutil.copy(file, node.source / COMPILED)
    node.options = ("--site", str(node.source / "sites" / "estig"))
    node.up()
    node.run("zone", "add", "--circle", "90,20,1", "--reason", "wet floor")
    node.run("area", "override", "z1", "--state", "blocked", "--for", "1h", "--reason", "box")
    node.wait(lambda: "blocked" in node.run("area", "history", "z1"), "the history has it")
    kept = ("keys/estig/admin.token", "keys/estig/operator.key", "locks/authority.pem", "locks/credentials/r1.toml")
    before = {name: (node.data / name).read_bytes() for name in kept}
    node.down()
    site = node.source / "sites" / "estig" / "site.toml"
    if "radius" not in (text := site.read_text()):  # this version asks for it, and its operator adds it
        site.write_text(text.replace("[[robots]]\n", "[[robots]]\nradius = 0.17\n"))
    node.source = None
    node.up()
    assert "wet floor" in node.run("zone", "list")
    listed = json.loads(node.run("area", "list", "--json").partition("\nfognav:")[0])["areas"]
    (area,) = [each for each in listed if each["definition"]["id"] == "z1"]
    assert area["hazard"]["state"] == "blocked"
    assert area["override"]["reason"] == "box"
    assert node.run("area", "history", "z1").count("blocked") >= 1
    assert before == {name: (node.data / name).read_bytes() for name in kept}
    assert (node.data / "keys/estig/session.key").exists(), "which the older version may not have had"
    node.run("zone", "add", "--circle", "80,20,1", "--reason", "dry soon")
    node.down()


class Watched:
    """What a robot says of itself while it is watched, as an operator's tool hears it."""

    def __init__(self) -> None:
        self.modes: list[str] = []
        self.ages: list[float] = []
        self.at = time.monotonic()

    def on_state(self, _ids: dict[str, str], state: RobotState) -> None:
        self.modes.append(state.mode)

    def on_pose(self, _ids: dict[str, str], _pose: RobotPose) -> None:
        now = time.monotonic()
        self.ages.append(now - self.at)
        self.at = now


async def test_robot_drives_on_and_stops_while_strangers_attack_every_server(node: Node) -> None:
    """Silent connections beyond every usual number of descriptors, at broker, router and REST at once."""
    node.options = ("--site", "estig", "--sim")
    with few_files():
        await asyncio.to_thread(node.up)
    (system,) = (await asyncio.to_thread(node.systems)).values()
    credentials = Credentials.read(Path(system["credentials_file"]))
    planner, router = system["urls"]["planner"], system["urls"]["zenoh-router"]
    robot, watched = system["robots"][0], Watched()
    await asyncio.to_thread(node.run, "robot", "enable")
    await asyncio.to_thread(node.run, "robot", "goal", "b")
    async with (
        ZenohEdge.open(
            connect=[router], clock=SystemClock(), role="console", id="watch", site="estig", credentials=credentials
        ) as edge,
        httpx.AsyncClient(
            base_url=planner,
            timeout=60,
            transport=httpx.AsyncHTTPTransport(verify=credentials.tls_context(), retries=5),
        ) as client,
        contextlib.AsyncExitStack() as attacks,
    ):
        edge.subscribe(ch.ROBOT_STATE, RobotState, watched.on_state)
        edge.subscribe(ch.ROBOT_POSE, RobotPose, watched.on_pose)
        async with asyncio.timeout(60):
            while "NORMAL" not in watched.modes[-1:]:  # noqa: ASYNC110  # a robot sets no event
                await asyncio.sleep(0.05)
        watched.modes.clear()
        watched.ages.clear()
        for name in ("mosquitto", "zenoh-router", "planner"):
            port = int(system["urls"][name].rpartition(":")[2])
            await attacks.enter_async_context(running(ATTACKS["say nothing and stay"](port)))
        assert set(watched.modes) == {"NORMAL"}, watched.modes
        assert max(watched.ages) < 3.0
        late = Lateness(system["pids"].values)
        begun = time.monotonic()
        stopped = await client.post(f"/api/v1/robots/{robot}/stop", json={})
        assert stopped.status_code < 300, stopped.text
        async with asyncio.timeout(60):
            while watched.modes[-1] == "NORMAL":  # noqa: ASYNC110  # as above
                await asyncio.sleep(0.01)
        assert time.monotonic() - begun < 5.0 + late.seconds()  # on a computer that does nothing else less than 0.5
