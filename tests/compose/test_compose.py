"""The fog node as users run it: `docker compose up` on a real engine, also when processes are killed.

The tests use a project and images of their own, publish free ports on the loopback address only, and remove everything
but the images (the next run reuses their layers). Third-party images that neither the engine nor a registry has are
replaced by those of `stand_ins.sh`.
"""

from __future__ import annotations

import asyncio
import json
import math
import os
import re
import signal
import time
from collections import Counter
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

import pytest
from aiomqtt import MqttError
from compose_project import (
    BUILD_S,
    COMMAND_S,
    FAKETIME,
    FOG,
    HEALTHY_S,
    MEGABYTES,
    ONCE,
    PORTS,
    ROOT,
    SERVICES,
    Project,
    docker,
    health,
    leftovers,
    skip_reason,
    token,
    wait,
    wait_health,
    watching,
    wrong_targets,
)

from fog_contracts import channels as ch
from fog_contracts.messages import CommandReply, RobotPose, RobotState, SimCommand, SimObstacle
from fog_runtime.credentials import Credentials
from fog_runtime.transports.mqtt_connection import Broker

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

KILLED: Final = 128 + signal.SIGKILL
"""How a container ends that has not stopped within the engine's 10 s."""
GOAL: Final = (12.0, 28.4)
"""Some 10 m from where the simulated robot starts, in its first corridor."""
FAR: Final = (58.0, 28.4)
"""At the other end of that corridor."""
GOAL_AGAIN_S: Final = 30.0
NEAR_M: Final = 0.5
ARRIVAL_S: Final = 300.0
PI_CPUS: Final = "0.2"
"""What a core of a Raspberry Pi 4 is of one of a desktop computer: each container's share, which needs one core."""
ZONE: Final = {"kind": "BLOCKED", "shape": {"type": "circle", "centre": [9.0, 42.6], "radius": 0.5}, "reason": "wet"}

SKIP_REASON: Final = skip_reason()
pytestmark = [
    pytest.mark.compose,
    # The first run installs the packages of nine images; each step has a limit of its own.
    pytest.mark.timeout(2 * BUILD_S + 1800),
    pytest.mark.skipif(SKIP_REASON is not None, reason=SKIP_REASON or ""),
]


@pytest.fixture(scope="module")
def fog(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Project]:
    """The fog node, healthy, without the simulated robot."""
    project = Project(tmp_path_factory.mktemp("compose"))
    project("--profile", "bridges", "build", timeout_s=BUILD_S)
    try:
        project("up", "--detach", "--no-build", profile="", timeout_s=BUILD_S)
        project.wait_healthy(FOG)
        project.start_log = project("logs", "--no-color", "--no-log-prefix", *sorted(FOG))
        yield project
    finally:
        project("--profile", "bridges", "down", "--volumes", "--remove-orphans", "--timeout", "10")
        assert leftovers(project.name) == []


@pytest.fixture(scope="module")
def sim(fog: Project) -> Project:
    """The fog node with the simulated robot."""
    fog("up", "--detach", "--no-build")
    wait_health(fog, "sim-robot", "healthy")
    return fog


def test_one_up_makes_every_service_healthy_and_creates_the_secrets(fog: Project) -> None:
    containers = fog.containers()
    assert set(containers) == FOG | {"credentials", "kernels"}
    assert [containers[name]["State"]["ExitCode"] for name in ("credentials", "kernels")] == [0, 0]
    assert {name: fog.containers()[name]["State"]["Health"]["Status"] for name in FOG} == dict.fromkeys(FOG, "healthy")


def test_images_are_small(fog: Project, record_property: Callable[[str, object], None]) -> None:
    sizes = {
        name: int(docker("image", "inspect", "--format", "{{.Size}}", fog.image(name))) / 1e6 for name in MEGABYTES
    }
    for name, megabytes in sizes.items():
        record_property(f"{name} MB", round(megabytes))
    print({name: f"{megabytes:.0f} MB" for name, megabytes in sizes.items()})  # noqa: T201  # shown by `pytest -s`
    assert {name: megabytes for name, megabytes in sizes.items() if megabytes > MEGABYTES[name]} == {}


@pytest.mark.parametrize("service", ["planner", "zenoh"])
def test_image_says_what_it_contains(fog: Project, service: str) -> None:
    bill = json.loads(fog.inside(service, "cat /opt/fognav/sbom.json"))
    assert (bill["bomFormat"], bill["metadata"]["component"]["name"]) == ("CycloneDX", "fognav")
    pins = {"planner": "planner", "zenoh": "router"}[service]
    pinned = set(re.findall(r"^([\w.-]+==[\w.]+)", (ROOT / "requirements" / f"{pins}.txt").read_text(), re.MULTILINE))
    found = [each for each in bill["components"] if "pypi" in each.get("purl", "")]
    python = {f"{each['name'].lower().replace('_', '-')}=={each['version']}" for each in found}
    assert len(python) >= 8
    assert python <= pinned
    assert {each["name"] for each in bill["components"] if "pkg:deb" in each.get("purl", "")} >= {"libc6", "libssl3"}


def test_first_start_logs_no_warning(fog: Project) -> None:
    lines = fog.start_log.splitlines()
    events = [json.loads(line) for line in lines if line.startswith("{")]
    listening = {event["process"] for event in events if event.get("event") == "listening"}
    assert listening >= {*SERVICES, "router"}, "the log is not complete"
    problems = [event for event in events if event["level"] not in {"info", "debug"}]
    # With the default settings of a host Redis warns that it may be unable to fork. Prometheus waits for nobody, and
    # asks the map-service for the robots until that answers. Where the engine knows no name server, nobody can tell it
    # that there is no bridge.
    expected = re.compile("Memory overcommit|/api/v1/prometheus/robots|config=bridge")
    plain_lines = [line for line in lines if not line.startswith("{") and not expected.search(line)]
    problems += [line for line in plain_lines if re.search(r"warn|error|denied|fail", line, re.IGNORECASE)]
    assert problems == [], "\n".join(map(str, problems))


def test_ports_are_published_only_on_the_configured_address(fog: Project) -> None:
    published = {
        name: [(port, binding["HostIp"]) for port, bindings in ports.items() for binding in bindings or []]
        for name, container in fog.containers().items()
        if any((ports := container["NetworkSettings"]["Ports"]).values())
    }
    expected: dict[str, list[tuple[str, str]]] = {}
    for service, port in PORTS.values():
        expected.setdefault(service, []).append((f"{port}/tcp", "127.0.0.1"))
    assert {name: sorted(ports) for name, ports in published.items()} == {
        name: sorted(ports) for name, ports in expected.items()
    }


def test_prometheus_sees_every_service_up(fog: Project) -> None:
    wait(lambda: wrong_targets(fog, *SERVICES), 60)


def test_zone_created_with_the_admin_token_survives_a_restart_of_the_map_service(fog: Project) -> None:
    admin = token(fog)
    assert fog.request("POST", "/api/v1/zones", json=ZONE).status_code == 401
    created = fog.request("POST", "/api/v1/zones", json=ZONE, headers=admin)
    assert created.status_code == 201, created.text
    zone = created.json()

    fog("restart", "map-service")
    wait_health(fog, "map-service", "healthy")

    listed = fog.get("/api/v1/zones").json()
    assert zone in listed["zones"]
    assert zone["id"] in listed["active"]
    deleted = fog.request("DELETE", f"/api/v1/zones/{zone['id']}", headers=admin)
    assert deleted.status_code == 204, deleted.text


def test_new_node_is_let_in_and_removed_without_a_restart_of_the_broker(fog: Project, tmp_path: Path) -> None:
    started = fog.containers()["mosquitto"]["State"]["StartedAt"]
    file = tmp_path / "n99.toml"
    file.write_text(fog.run_credentials("node", "n99"), "utf-8")
    broker = Broker.of(f"mqtts://{fog.address('FOGNAV_MQTT_PORT')}", Credentials.read(file))

    async def admitted() -> bool:
        try:
            async with broker.client("n99", None):
                return True
        except MqttError:
            return False

    wait(lambda: None if asyncio.run(admitted()) else "the new node is refused", 30)
    fog.run_credentials("remove", "n99")
    wait(lambda: "the former node is let in" if asyncio.run(admitted()) else None, 30)
    assert fog.containers()["mosquitto"]["State"]["StartedAt"] == started


async def test_simulated_robot_is_enabled_and_drives(sim: Project) -> None:
    async with watching(sim) as edge:
        states = edge.latest(ch.ROBOT_STATE, RobotState, robot="r1")
        poses = edge.latest(ch.ROBOT_POSE, RobotPose, robot="r1")
        start: RobotPose | None = None

        def missing() -> str | None:
            nonlocal start
            state, pose = states.get(), poses.get()
            if state is None or pose is None:
                return "the robot publishes nothing"
            start = start or pose
            moved = math.hypot(pose.x - start.x, pose.y - start.y)
            if state.mode == "NORMAL" and state.enabled and pose.v > 0.0 and moved > 1.0:
                return None
            return f"{state.mode} {state.reasons}, moved {moved:.2f} m"

        await asyncio.to_thread(wait, missing, 90)


async def test_simulated_robot_drives_to_a_goal_that_an_operator_sets(sim: Project) -> None:
    reached = asyncio.Event()
    modes: Counter[str] = Counter()
    latest: RobotPose | None = None

    def on_pose(_ids: dict[str, str], pose: RobotPose) -> None:
        nonlocal latest
        latest = pose

    def on_state(_ids: dict[str, str], state: RobotState) -> None:
        modes[f"{state.mode} {'; '.join(state.reasons)}".strip()] += 1
        # An arrival is told for a tenth of a second only; one elsewhere is that of the goal before.
        if state.goal_reached and latest is not None and math.dist((latest.x, latest.y), GOAL) < NEAR_M:
            reached.set()

    async with watching(sim) as edge:
        edge.subscribe(ch.ROBOT_POSE, RobotPose, on_pose, robot="r1")
        edge.subscribe(ch.ROBOT_STATE, RobotState, on_state, robot="r1")
        body = {"pose": {"x": GOAL[0], "y": GOAL[1]}}
        answer = sim.request("PUT", "/api/v1/robots/r1/goal", json=body, headers=token(sim))
        assert answer.status_code < 300, answer.text

        def missing() -> str | None:
            return None if reached.is_set() else f"at {latest}: {modes.most_common(8)}"

        await asyncio.to_thread(wait, missing, ARRIVAL_S)


def test_no_process_is_root_or_has_a_capability_or_can_write_to_its_image(sim: Project) -> None:
    for service, container in sim.containers().items():
        if service in ONCE:
            continue
        users = docker("top", container["Id"], "-eo", "uid,pid").split()[2::2]
        assert users, service
        assert "0" not in users, service
        assert re.search(r"CapEff:\s*0+\n", sim.inside(service, "cat /proc/1/status")), service
        if service == "sim-robot":  # its programs write their logs to files
            continue
        refused = sim.inside(service, "touch /usr/fognav 2>&1 || echo refused")
        assert "Read-only file system" in refused, f"{service}: {refused}"


@contextmanager
def hanging(sim: Project, service: str, program: str) -> Iterator[None]:
    """Stop a service's first process whose command line ends so, while entered."""
    found = docker("top", sim.containers()[service]["Id"], "-eo", "pid,args").splitlines()[1:]
    pid = min(int(line.split()[0]) for line in found if re.search(f"{program}$", line))
    os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(pid, signal.SIGCONT)


@pytest.mark.parametrize(
    ("service", "program"),
    [
        ("planner", r"python -m planner"),
        ("map-service", r"python -m map_service"),
        ("hazard-aggregator", r"python -m hazard_aggregator"),
        ("zenoh", r"python -m fog_runtime\.router .*"),
        ("mosquitto", r"mosquitto .*"),
        ("redis", r"redis-server .*"),
        ("gateway", r"caddy run .*"),
        ("prometheus", r"prometheus .*"),
        ("sim-robot", r"-m robot_agent"),
    ],
)
def test_container_whose_program_hangs_is_unhealthy_until_it_goes_on(sim: Project, service: str, program: str) -> None:
    with hanging(sim, service, program):
        wait_health(sim, service, "unhealthy")
    wait_health(sim, service, "healthy")


def test_service_whose_fog_is_not_ready_is_unhealthy_until_it_is(sim: Project) -> None:
    stored = [service for service in SERVICES if service != "console-service"]
    sim("pause", "redis")
    try:
        for service in stored:
            wait_health(sim, service, "unhealthy")
    finally:
        sim("unpause", "redis")
    for service in stored:
        wait_health(sim, service, "healthy")


def has_bumped(state: RobotState | None) -> bool:
    return state is not None and state.mode == "FAULT" and not {"bumper", "base_fault"}.isdisjoint(state.codes)


def send_far(sim: Project, pose: RobotPose, admin: dict[str, str]) -> str:
    """Give the robot the farther one of two goals; return the answer."""
    x, y = max((GOAL, FAR), key=lambda place: math.dist(place, (pose.x, pose.y)))
    answer = sim.request("PUT", "/api/v1/robots/r1/goal", json={"pose": {"x": x, "y": y}}, headers=admin)
    return f"{answer.status_code} {answer.text}"


def box_before(pose: RobotPose) -> SimObstacle:
    """Return a box so near before a driving robot that it can't stop."""
    ahead, left = (math.cos(pose.theta), math.sin(pose.theta)), (-math.sin(pose.theta), math.cos(pose.theta))
    near = pose.radius + 0.06
    corners = [(near, -0.2), (near + 0.2, -0.2), (near + 0.2, 0.2), (near, 0.2)]
    outline = [(pose.x + a * ahead[0] + b * left[0], pose.y + a * ahead[1] + b * left[1]) for a, b in corners]
    return SimObstacle(id="box", polygon=outline, height=1.0)


async def test_container_of_a_robot_in_fault_is_unhealthy_until_the_fault_is_reset(sim: Project) -> None:
    async with watching(sim) as edge:
        states = edge.latest(ch.ROBOT_STATE, RobotState, robot="r1")
        poses = edge.latest(ch.ROBOT_POSE, RobotPose, robot="r1")

        async def simulate(command: SimCommand) -> bool:
            reply = await edge.query(ch.SIM_COMMAND, command, CommandReply, COMMAND_S, robot="r1")
            assert reply is not None
            return reply.accepted

        admin, sent_at, answer = token(sim), -math.inf, "not asked"

        async def step_in_front() -> str | None:
            """Put a box before the driving robot, too near for it to stop, and say what came of it."""
            nonlocal sent_at, answer
            pose = poses.get()
            if pose is None or pose.v < 0.2:
                # A robot that a busy machine has stopped may wait for another goal.
                if pose is not None and time.monotonic() > sent_at + GOAL_AGAIN_S:
                    answer = await asyncio.to_thread(send_far, sim, pose, admin)
                    sent_at = time.monotonic()
                return f"the robot does not drive: {pose}, {states.get()}; its last goal: {answer}"
            if not await simulate(SimCommand(place=[box_before(pose)])):
                return "the robot is already where the box would stand"
            for _ in range(40):
                if has_bumped(states.get()):
                    return None
                await asyncio.sleep(0.05)
            await simulate(SimCommand(remove=["box"]))
            return f"the robot has stopped before the box: {states.get()}"

        loop = asyncio.get_running_loop()
        try:
            await asyncio.to_thread(
                wait, lambda: asyncio.run_coroutine_threadsafe(step_in_front(), loop).result(), ARRIVAL_S
            )
            await asyncio.to_thread(wait_health, sim, "sim-robot", "unhealthy")
            assert has_bumped(states.get()), "the unit's resets are refused while the bumper is pressed"
        finally:
            await simulate(SimCommand(remove=["box"]))
        body = {"kind": "back_off"}

        def unhealthy() -> str | None:
            answer = ""
            if has_bumped(states.get()):  # the unit resets the fault, and it does not back off by itself
                answer = sim.request("POST", "/api/v1/robots/r1/commands", json=body, headers=admin).text
            found = health(sim, "sim-robot")
            return None if found == "healthy" else f"{found}: {states.get()} {answer}"

        await asyncio.to_thread(wait, unhealthy, HEALTHY_S)


def test_every_target_of_prometheus_is_up_also_the_robot(sim: Project) -> None:
    wait(lambda: wrong_targets(sim, *SERVICES, "r1"), 60)


def test_prometheus_records_the_robots_cpu_time(sim: Project) -> None:
    def seconds() -> float | None:
        query = {"query": 'process_cpu_seconds_total{robot="r1"}'}
        found = sim.get("/prometheus/api/v1/query", params=query).json()["data"]["result"]
        return float(found[0]["value"][1]) if found else None

    wait(lambda: "no sample of the robot" if seconds() is None else None, 60)
    before = seconds()
    assert before is not None
    wait(lambda: None if (seconds() or 0.0) > before else f"stays at {before} s", 30)


def test_bridge_runs_beside_the_fog_node_and_is_found_by_prometheus(sim: Project) -> None:
    sim("--profile", "bridges", "up", "--detach", "--no-build", "bridge")
    try:
        wait_health(sim, "bridge", "healthy")
        wait(lambda: wrong_targets(sim, *SERVICES, "r1", "bridge"), 90)
    finally:
        sim("--profile", "bridges", "rm", "--stop", "--force", "bridge", "bridge-credentials")


def test_killed_containers_are_restarted(sim: Project) -> None:
    services = {*FOG, "sim-robot"}
    before = {name: container["RestartCount"] for name, container in sim.containers().items()}
    for name, container in sim.containers().items():
        if name in services:
            # A container's first process can't be killed from inside, unless it handles the signal: kill init's child.
            init = container["HostConfig"].get("Init")
            sim.inside(name, "kill -9 $(cat /proc/1/task/1/children)" if init else "kill 1")
    sim.wait_healthy(services, {name: before[name] + 1 for name in services})


def test_fog_node_needs_less_than_a_gigabyte(sim: Project, record_property: Callable[[str, object], None]) -> None:
    unit = {"B": 2**-20, "KiB": 2**-10, "MiB": 1.0, "GiB": 2.0**10}
    services = {c["Name"].lstrip("/"): name for name, c in sim.containers().items() if c["State"]["Running"]}
    used = {}
    for line in docker("stats", "--no-stream", "--format", "{{.Name}} {{.MemUsage}}", *services).splitlines():
        found = re.match(r"(\S+) ([\d.]+)([A-Za-z]+) / ", line)
        assert found is not None, line
        used[services[found[1]]] = float(found[2]) * unit[found[3]]
    for name, mebibytes in used.items():
        record_property(f"{name} MiB", round(mebibytes))
    print({name: f"{mebibytes:.0f} MiB" for name, mebibytes in sorted(used.items())})  # noqa: T201  # shown by `pytest -s`
    assert set(used) == {*FOG, "sim-robot"}
    assert sum(used[name] for name in FOG) < 1024


def test_stop_ends_every_container_cleanly_and_up_restarts_them(sim: Project) -> None:
    sim("stop")
    exit_codes = {name: container["State"]["ExitCode"] for name, container in sim.containers().items()}
    assert exit_codes == dict.fromkeys([*FOG, *ONCE, "sim-robot"], 0), "an engine kills what has not stopped after 10 s"
    sim("up", "--detach", "--no-build")
    restarts = {name: container["RestartCount"] for name, container in sim.containers().items()}
    sim.wait_healthy({*FOG, "sim-robot"}, restarts)


def test_reboot_on_the_share_of_a_pi_that_starts_everything_at_once_and_redis_last_loses_nothing(
    fog: Project, record_property: Callable[[str, object], None]
) -> None:
    zone = fog.request("POST", "/api/v1/zones", json=ZONE, headers=token(fog)).json()
    seconds = reboot(fog)
    record_property("seconds until ready", seconds)
    print(f"ready {seconds} s after the boot, with {PI_CPUS} processors for each container")  # noqa: T201  # `pytest -s`
    assert zone["id"] in fog.get("/api/v1/zones").json()["active"]


@pytest.mark.skipif(not FAKETIME, reason="needs another clock for the services: apt-get install libfaketime")
def test_reboot_with_a_clock_that_is_an_hour_behind_loses_nothing(fog: Project) -> None:
    with fog.clocks_behind() as offset:
        zone = fog.request("POST", "/api/v1/zones", json=ZONE, headers=token(fog)).json()
        offset.write_text("-1h\n")
        reboot(fog)
        behind = time.time() - float(fog.inside("map-service", "date +%s"))
        assert 3590 < behind < 3700
        assert zone["id"] in fog.get("/api/v1/zones").json()["active"]
        created = fog.request("POST", "/api/v1/zones", json=ZONE, headers=token(fog))
        assert created.status_code == 201, created.text


def reboot(fog: Project) -> int:
    """Do what an engine does when a slow machine boots: no order, no dependencies, nothing that runs once; Redis last.

    Returns how long (s) after the boot everything was healthy.
    """
    containers = {name: container["Id"] for name, container in fog.containers().items() if name in FOG}
    docker("kill", *containers.values())
    docker("update", "--cpus", PI_CPUS, *containers.values())
    try:
        booted = time.monotonic()
        docker("start", *(id_ for name, id_ in containers.items() if name != "redis"))
        wait(lambda: None if health(fog, "map-service") != "healthy" else "the map-service is ready without Redis", 5)
        docker("start", containers["redis"])
        restarts = {name: container["RestartCount"] for name, container in fog.containers().items()}
        assert {fog.containers()[name]["HostConfig"]["NanoCpus"] for name in FOG} == {round(1e9 * float(PI_CPUS))}
        fog.wait_healthy(FOG, restarts)
        return round(time.monotonic() - booted)
    finally:  # a failure here must not slow the tests that follow
        docker("update", "--cpus", str(os.cpu_count()), *containers.values())


def test_container_stops_while_it_compiles_its_kernels(fog: Project) -> None:
    name = f"{fog.name}-cold"
    fog("run", "--detach", "--no-deps", "--name", name, "--env", "NUMBA_CACHE_DIR=/tmp/numba", "planner")
    try:
        wait(lambda: None if "fog_kernels.warm" in docker("top", name) else "it does not compile yet", 10)
        docker("stop", name)
        ended = int(docker("inspect", "--format", "{{.State.ExitCode}}", name))
        assert "kernels and helpers ready" not in docker("logs", name), "it was ready before the stop"
    finally:
        docker("rm", "--force", name)
    assert ended != KILLED
