"""A fog node in containers for tests: a compose project with a name, images and ports of its own.

It publishes free ports on the loopback address only. Third-party images that neither the engine nor a registry has are
replaced by those of `tests/compose/stand_ins.sh`.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import secrets
import shutil
import subprocess
import time
from contextlib import asynccontextmanager, contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import httpx
from lateness import Lateness

from fog_runtime.clock import SystemClock
from fog_runtime.credentials import Credentials
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fognav.hosting.compose_floors import BASE, OVERRIDE
from fognav.hosting.compose_floors import override as floors_override

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterator, Sequence

ROOT: Final = Path(__file__).parents[2]
STAND_INS: Final = ROOT / "tests" / "compose" / "stand_ins.sh"
SERVICES: Final = ("hazard-aggregator", "map-service", "planner", "console-service")
FOG: Final = {*SERVICES, "zenoh", "mosquitto", "mosquitto-relay", "redis", "prometheus", "gateway"}
ONCE: Final = {"credentials", "kernels", "sim-credentials"}
"""The containers that do something and end."""
PORTS: Final = {
    "FOGNAV_HTTPS_PORT": ("gateway", 8443),
    "FOGNAV_AGGREGATOR_PORT": ("gateway", 8001),
    "FOGNAV_MAP_PORT": ("gateway", 8002),
    "FOGNAV_PLANNER_PORT": ("gateway", 8003),
    "FOGNAV_CONSOLE_PORT": ("gateway", 8004),
    "FOGNAV_ZENOH_PORT": ("zenoh", 7447),
    "FOGNAV_MQTT_PORT": ("mosquitto-relay", 8883),
}
HEALTHY_S: Final = 180.0
"""On a busy machine of two cores; an idle one needs 20 s, most of it for compiling the kernels."""
BUILD_S: Final = 2400.0
"""Commands that install packages: a limit for what hangs, not for a slow machine."""
COMMAND_S: Final = 300.0
"""All other commands, and an answer of the gateway: the same."""
ENGINE: Final = {"dockerd", "containerd", "containerd-shim", "docker-proxy"}
MEGABYTES: Final = {
    "planner": 600,
    "map-service": 600,
    "sim-robot": 600,
    "hazard-aggregator": 300,
    "console-service": 330,
    "zenoh": 300,
}
"""How large our images may be: those with numba, and those without."""
FAKETIME: Final = sorted(Path("/usr/lib").glob("*/faketime/libfaketime.so.1"))
CAP_SYS_RESOURCE: Final = 1 << 24


def base_image(*, pinned: bool = True) -> str:
    """Return the base of our images, by its digest or (what an engine without a registry has) by its name only."""
    (line,) = re.findall(
        "^ARG BASE=(.+)$", (ROOT / "deploy" / "images" / "Dockerfile").read_text("utf-8"), re.MULTILINE
    )
    return str(line if pinned else line.partition("@")[0])


@cache
def skip_reason() -> str | None:
    """Return what these tests lack on this machine and the remedy, or None if they can run.

    They need an engine that responds and has the base images; FOGNAV_COMPOSE=1 lets it pull those, FOGNAV_COMPOSE=0
    skips these tests.
    """
    choice = os.environ.get("FOGNAV_COMPOSE", "")
    if choice == "0":
        return "FOGNAV_COMPOSE=0 is set: unset it to run them"
    if shutil.which("docker") is None:
        return "needs a Docker engine: install docker with its compose plugin"
    commands = [
        (("info", "--format", "{{.ServerVersion}}"), "needs a Docker engine, and none responds"),
        (("compose", "version"), "needs docker's compose plugin"),
    ]
    if choice != "1":
        remedy = f"FOGNAV_COMPOSE=1 ./fognav test tests/compose, or docker pull {base_image()}"
        commands.append((("image", "inspect", base_image()), f"needs the base image {base_image()} ({remedy})"))
    for command, requirement in commands:
        try:
            done = subprocess.run(["docker", *command], capture_output=True, text=True, timeout=20, check=False)
        except subprocess.TimeoutExpired:
            return f"{requirement} within 20 s"
        if done.returncode != 0:
            return f"{requirement}: {(done.stderr.strip() or 'no error output').splitlines()[-1]}"
    return None


def run(command: list[str], timeout_s: float, env: dict[str, str] | None = None) -> str:
    """Run a command and return its output; raises AssertionError with all its output if it fails."""
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False, env=env, cwd=ROOT)
    assert done.returncode == 0, f"{' '.join(command)} ended with {done.returncode}:\n{done.stdout}\n{done.stderr}"
    return done.stdout


def docker(*arguments: str, timeout_s: float = COMMAND_S) -> str:
    return run(["docker", *arguments], timeout_s)


def has(kind: str, name: str) -> bool:
    return subprocess.run(["docker", kind, "inspect", name], capture_output=True, check=False).returncode == 0


def available(image: str) -> bool:
    """Return whether the engine has an image, pulled if necessary."""
    pull = ["docker", "pull", "--quiet", image]
    return (
        has("image", image) or subprocess.run(pull, capture_output=True, timeout=BUILD_S, check=False).returncode == 0
    )


def third_party(image: str) -> str:
    """Return the name of the image, or that of its stand-in."""
    if available(image):
        return image
    run([str(STAND_INS)], BUILD_S)
    return f"fognav-stand-in/{image.rpartition('/')[2].partition(':')[0].removeprefix('eclipse-')}"


def may_raise_limits() -> bool:
    """Return whether the engine may give containers higher limits than its own; one inside a container may not."""
    effective = re.search(r"CapEff:\s*(\w+)", Path("/proc/self/status").read_text("ascii"))
    return effective is not None and bool(int(effective[1], 16) & CAP_SYS_RESOURCE)


class Project:
    """A compose project with a name, images and ports of its own."""

    def __init__(self, folder: Path, floors: Sequence[Path] = ()) -> None:
        """Prepare it in an empty folder; `floors` are the sites of further floors."""
        self.name = f"fognav-test-{secrets.token_hex(4)}"
        self.start_log = ""
        self._folder = folder
        self._credentials: dict[str, Credentials] = {}
        self._env = {k: v for k, v in os.environ.items() if not k.startswith(("FOGNAV_", "COMPOSE_"))}
        self._env |= {"FOGNAV_BIND": "127.0.0.1", "FOGNAV_GRAFANA": "0"} | dict.fromkeys(PORTS, "0")
        if not may_raise_limits():
            self._env |= {"FOGNAV_SIM_RTPRIO": "0", "FOGNAV_SIM_NICE": "0"}
        self._command = ["docker", "compose", "--project-name", self.name, "--env-file", os.devnull]
        self._command += ["--file", BASE]
        if floors:
            self._env |= {f"{variable}_{floor.name.upper()}": "0" for variable in PORTS for floor in floors}
            file = folder / OVERRIDE
            file.write_text(floors_override(floors, (ROOT / BASE).read_text("utf-8")), "utf-8")
            self._command += ["--file", str(file)]
        self._command += ["--project-directory", str(ROOT)]
        services = json.loads(self("--profile", "bridges", "config", "--format", "json"))["services"]
        override: dict[str, Any] = {}
        base = base_image(pinned=available(base_image()))
        for service, config in services.items():
            if (own := config["image"].removeprefix("fognav/")) != config["image"]:
                override[service] = {"image": f"fognav-compose-test/{own}"}
            elif service.startswith("grafana"):
                # There is no stand-in of it, and nothing of ours in it but files, which other tests read.
                override[service] = {"image": base}
            else:
                override[service] = {"image": third_party(config["image"])}
            if "build" in config:
                override[service]["build"] = {"args": {"BASE": base}}
                if not has("network", "bridge"):
                    override[service]["build"]["network"] = "host"
        file = folder / "override.json"
        file.write_text(json.dumps({"services": override}), "utf-8")
        self._command += ["--file", str(file)]

    def __call__(self, *arguments: str, profile: str = "sim", timeout_s: float = COMMAND_S) -> str:
        """Run compose, by default with the profile `sim`, so that its container is always included."""
        return run([*self._command, "--profile", profile, *arguments], timeout_s, self._env)

    @contextmanager
    def clocks_behind(self) -> Iterator[Path]:
        """Make the services' clocks readable from a file while entered, without changing them; yield the file.

        A container has the clock of its engine's machine; this one is a library's that stands between (libfaketime).
        """
        folder = self._folder / "clock"
        folder.mkdir()
        (folder / "offset").write_text("+0\n")
        setting = {
            "volumes": [f"{FAKETIME[0]}:/opt/faketime.so:ro", f"{folder}:/opt/clock:ro"],
            "environment": {
                "LD_PRELOAD": "/opt/faketime.so",
                "FAKETIME_TIMESTAMP_FILE": "/opt/clock/offset",
                "FAKETIME_DONT_FAKE_MONOTONIC": "1",
            },
        }
        file = self._folder / "clock.json"
        file.write_text(json.dumps({"services": dict.fromkeys(SERVICES, setting)}), "utf-8")
        usual = self._command
        self._command = [*usual, "--file", str(file)]
        try:
            self._recreate_services()
            yield folder / "offset"
        finally:
            self._command = usual
            self._recreate_services()

    def _recreate_services(self) -> None:
        self("up", "--detach", "--no-build", "--no-deps", *SERVICES)
        self.wait_healthy(FOG, {name: container["RestartCount"] for name, container in self.containers().items()})

    def containers(self) -> dict[str, dict[str, Any]]:
        """Return the engine's description of each service's container."""
        label = f"label=com.docker.compose.project={self.name}"
        ids = docker("ps", "--all", "--quiet", "--filter", label).split()
        found = json.loads(docker("inspect", *ids)) if ids else []
        return {container["Config"]["Labels"]["com.docker.compose.service"]: container for container in found}

    def address(self, variable: str, floor: str = "") -> str:
        """Return the address at which a port is published now; a restart changes it."""
        service, port = PORTS[variable]
        return self("port", f"{service}-{floor}" if floor else service, str(port)).strip()

    def get(self, path: str, **options: Any) -> httpx.Response:
        """Ask the gateway."""
        return self.request("GET", path, **options)

    def request(self, method: str, path: str, *, floor: str = "", **options: Any) -> httpx.Response:
        url = f"https://{self.address('FOGNAV_HTTPS_PORT', floor)}{path}"
        with httpx.Client(verify=self.credentials("console").tls_context(), timeout=COMMAND_S) as client:
            return client.request(method, url, **options)

    def run_credentials(self, *arguments: str) -> str:
        """Run a command of the container that has all secrets."""
        return self("run", "--rm", "--no-TTY", "--no-deps", "credentials", *arguments)

    def credentials(self, user: str) -> Credentials:
        if user not in self._credentials:
            file = self._folder / f"{user.replace('/', '.')}.toml"
            file.write_text(self.run_credentials("show", f"credentials/{user}.toml"), "utf-8")
            self._credentials[user] = Credentials.read(file)
        return self._credentials[user]

    def image(self, service: str) -> str:
        """Return the name of a service's image."""
        return f"fognav-compose-test/{service}"

    def inside(self, service: str, script: str) -> str:
        """Run a shell command inside a service's container."""
        return self("exec", "--no-TTY", service, "sh", "-c", script)

    def wait_healthy(self, services: set[str], restarts: dict[str, int] | None = None) -> None:
        """Wait until these services run and are healthy, each after this number of restarts (default 0)."""

        def missing() -> str | None:
            containers = self.containers()
            unhealthy = {
                service: state.get("Health", {}).get("Status", state["Status"])
                for service in services
                if (state := containers[service]["State"]).get("Health", {}).get("Status") != "healthy"
                or state["Status"] != "running"
                or containers[service]["RestartCount"] != (restarts or {}).get(service, 0)
            }
            return f"not healthy yet: {unhealthy}" if unhealthy else None

        try:
            wait(missing, HEALTHY_S)
        except TimeoutError as error:
            log = self("logs", "--no-color", "--tail", "30")
            raise AssertionError(f"{error}\n{self('ps', '--all')}\n{log}") from error


def engine_pids() -> Iterator[int]:
    """Yield the processes of the engine and in its containers, and this one, which asks them."""
    yield os.getpid()
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it has just ended
            if (
                re.search("docker[/-][0-9a-f]{64}", (process / "cgroup").read_text("utf-8"))
                or (process / "comm").read_text("utf-8").strip() in ENGINE
            ):
                yield int(process.name)


def wait(missing: Callable[[], str | None], timeout_s: float) -> None:
    """Wait until `missing` returns None, checking twice a second; raises TimeoutError with what is still missing.

    The limit is longer by the time for which the kernel let the containers' processes wait for a core, up to four
    times as long: all their threads' times are added, though only some wait for each other.
    """
    late, waited, started = Lateness(engine_pids), 0.0, time.monotonic()
    while (problem := missing()) is not None:
        waited = max(waited, late.seconds())
        if (passed := time.monotonic() - started) > timeout_s + min(waited, 3.0 * timeout_s):
            raise TimeoutError(f"after {passed:.0f} s (limit {timeout_s:.0f} s, late by {waited:.0f} s): {problem}")
        time.sleep(0.5)


def leftovers(project: str) -> list[str]:
    label = f"label=com.docker.compose.project={project}"
    return [
        *docker("ps", "--all", "--quiet", "--filter", label).split(),
        *docker("volume", "ls", "--quiet", "--filter", label).split(),
        *docker("network", "ls", "--quiet", "--filter", label).split(),
    ]


def health(project: Project, service: str) -> str:
    return str(project.containers()[service]["State"]["Health"]["Status"])


def wait_health(project: Project, service: str, expected: str, timeout_s: float = HEALTHY_S) -> None:
    """Wait until a service's container calls itself `healthy` or `unhealthy`."""

    def other() -> str | None:
        found = health(project, service)
        return None if found == expected else f"{service} is {found}, not {expected}"

    wait(other, timeout_s)


def wrong_targets(fog: Project, *expected: str, floor: str = "") -> str | None:
    """Return what a floor's Prometheus asks, unless it is just these processes and robots, and each of them answers."""
    answer = fog.get("/prometheus/api/v1/query", params={"query": "up"}, floor=floor).json()
    up = [
        (each["metric"].get("process") or each["metric"]["robot"], each["value"][1])
        for each in answer["data"]["result"]
    ]
    return None if sorted(up) == sorted((name, "1") for name in expected) else f"up: {up}"


@asynccontextmanager
async def watching(sim: Project, floor: str = "") -> AsyncIterator[ZenohEdge]:
    """Connect to the router from outside; its certificate is for 127.0.0.1, where the port is published."""
    async with ZenohEdge.open(
        connect=[f"tls/{sim.address('FOGNAV_ZENOH_PORT')}"],
        clock=SystemClock(),
        role="console",
        id="compose",
        site=floor or "estig",
        credentials=sim.credentials(f"{floor}/console" if floor else "console"),
    ) as edge:
        yield edge


def token(fog: Project, floor: str = "") -> dict[str, str]:
    """Return the header with the administrator's token of a floor, by default the first one."""
    file = f"floors/{floor}/admin.token" if floor else "admin.token"
    return {"Authorization": f"Bearer {fog.run_credentials('show', file).strip()}"}
