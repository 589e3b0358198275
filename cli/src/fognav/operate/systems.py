"""The systems that run on this machine: registered demos and fog nodes, and the processes of a fog node or a robot.

The register is a private folder per user with one file for each demo and each fog node. A demo writes its file when it
is up, keeps it current, and removes it at its end. A killed demo leaves its file behind: whoever reads the register
notices, by process id and start time, that the demo is gone, and removes the file.
"""

import contextlib
import http.client
import os
import re
import ssl
import stat
import tempfile
import tomllib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Final, Literal, Self

import msgspec
import psutil

from fog_runtime.configuration.site import SITE_FILE
from fog_runtime.files import atomic_write
from fog_supervisor import net
from fognav.credentials import own_credentials
from fognav.output import FailedError, WrongUseError
from fognav.programs import AGGREGATOR, BROKER, CONSOLE, MAP_SERVICE, PLANNER, ROUTER

PRIVATE: Final = 0o700
RUNTIME: Final = Path("/run/user")
"""Where systemd makes a folder for each user who is logged in or lingers, which it names in `XDG_RUNTIME_DIR`."""

Kind = Literal["demo", "fog node", "robot"]


class System(msgspec.Struct, frozen=True, kw_only=True):
    """A system that runs on this machine, with all that an operator's commands need to reach it.

    `urls` has the address of each part, and `pids` the process ids, by the parts' names. `speed` is how many times
    faster than real time its clock runs. `data` is the folder of a fog node that `fognav up` runs.
    """

    name: str
    kind: Kind
    site: str
    urls: dict[str, str]
    pids: dict[str, int]
    token_file: str | None = None
    credentials_file: str | None = None
    robots: list[str] = []
    speed: float = 1.0
    data: str | None = None


class _Entry(msgspec.Struct, frozen=True, kw_only=True):
    """A file of the register: the system, and the process that keeps the file."""

    pid: int
    started: float
    system: System


def folder() -> Path:
    """Return this user's private folder, and create it; raises `FailedError` if it is not private."""
    # cron, su and sudo don't set the variable, and a node that systemd runs is registered there all the same.
    runtime = os.environ.get("XDG_RUNTIME_DIR") or RUNTIME / str(os.getuid())
    if os.access(runtime, os.W_OK):
        path = Path(runtime) / "fognav"
    else:
        path = Path(tempfile.gettempdir()) / f".fognav-{os.getuid()}"
    try:
        path.mkdir(mode=PRIVATE, exist_ok=True)
        found = path.lstat()
    except OSError as error:
        raise FailedError(
            f"the register of running systems, {path}, can't be used: {error.strerror}. "
            "Set XDG_RUNTIME_DIR to a folder of your own"
        ) from error
    # In a shared folder such as /tmp, somebody else could have put theirs there: commands would go to their system.
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise FailedError(
            f"{path} is not a private folder of yours, so the systems registered in it can't be trusted. "
            "Remove it, or set XDG_RUNTIME_DIR to a folder of your own"
        )
    return path


class Registration:
    """This process's entry in the register, from its first `update` to the end of the context."""

    def __init__(self, describe: Callable[[], System]) -> None:
        self._describe = describe
        self._written: System | None = None
        self._file: Path | None = None

    def update(self) -> None:
        """Write the entry if the system has changed; raises `FailedError` without a usable folder."""
        system = self._describe()
        if system == self._written:
            return
        own = psutil.Process()
        # Two fog nodes of one site have the same name, and each its own entry.
        self._file = folder() / f"{system.name}.{own.pid}.json"
        entry = _Entry(pid=own.pid, started=own.create_time(), system=system)
        atomic_write(self._file, msgspec.json.encode(entry))
        self._written = system

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._file is not None:
            self._file.unlink(missing_ok=True)


def registered() -> list[System]:
    """Return the registered systems that still run, and remove the entries of those that do not."""
    found = []
    for file in sorted(folder().glob("*.json")):
        try:
            entry = msgspec.json.decode(file.read_bytes(), type=_Entry)
        except FileNotFoundError:
            continue  # it has just ended
        except msgspec.DecodeError:
            entry = None  # of another version of this command, which would write it again
        if entry is not None and _runs(entry):
            found.append(entry.system)
        else:
            with contextlib.suppress(FileNotFoundError):
                file.unlink()
    return found


def _runs(entry: _Entry) -> bool:
    """Whether the process of an entry still runs: another one may have got its process id since."""
    try:
        return abs(psutil.Process(entry.pid).create_time() - entry.started) < 0.5
    except psutil.NoSuchProcess:
        return False


FOG_NODE: Final = "fog-node"
"""Name of the fog node of this machine."""

SERVICE_PORTS: Final = {
    AGGREGATOR: ("FOGNAV_AGGREGATOR_PORT", 8001),
    MAP_SERVICE: ("FOGNAV_MAP_PORT", 8002),
    PLANNER: ("FOGNAV_PLANNER_PORT", 8003),
    CONSOLE: ("FOGNAV_CONSOLE_PORT", 8004),
}
"""The ports of a fog node's REST APIs: the variables that docker-compose.yml reads, and its defaults."""
_LAST_PORT: Final = 65_535
ZENOH_PORT: Final = ("FOGNAV_ZENOH_PORT", 7447)
MQTT_PORT: Final = ("FOGNAV_MQTT_PORT", 1883)
MQTTS_PORT: Final = ("FOGNAV_MQTT_PORT", 8883)

_FOG_MODULES: Final = {
    "hazard_aggregator": AGGREGATOR,
    "map_service": MAP_SERVICE,
    "planner": PLANNER,
    "console_service": CONSOLE,
}
_ROBOT_MODULES: Final = {
    "robot_agent": "robot-agent",
    "robot_agent.guardian": "robot-guardian",
    "robot_agent.guardian.watchdog": "robot-watchdog",
}


def find_systems() -> list[System]:
    """Return every system on this machine, those of other users as far as they can be seen."""
    demos = registered()
    known = {pid for demo in demos for pid in demo.pids.values()}
    fog_node = _fog_node(_processes(_FOG_MODULES, known))
    return [*demos, *([fog_node] if fog_node else []), *_robots(_processes(_ROBOT_MODULES, known))]


def port(setting: tuple[str, int]) -> int:
    """Return the port that a variable of the environment gives, or its default; raises `WrongUseError` for no port."""
    variable, default = setting
    text = os.environ.get(variable) or str(default)
    if not re.fullmatch(r"[0-9]{1,5}", text) or not 0 < int(text) <= _LAST_PORT:
        raise WrongUseError(f"{variable} is {text!r}: set it to a port, 1 to {_LAST_PORT}")
    return int(text)


def addresses(host: str, *, secured: bool = False) -> dict[str, str]:
    """Return the addresses of a fog node's REST APIs, router and broker on a host; those of a locked one encrypt."""
    shown = f"[{host}]" if ":" in host else host  # IPv6
    http_scheme, zenoh_scheme, mqtt_scheme = ("https", "tls", "mqtts") if secured else ("http", "tcp", "mqtt")
    urls = {name: f"{http_scheme}://{shown}:{port(setting)}" for name, setting in SERVICE_PORTS.items()}
    mqtt_port = port(MQTTS_PORT if secured else MQTT_PORT)
    return {
        **urls,
        ROUTER: f"{zenoh_scheme}/{shown}:{port(ZENOH_PORT)}",
        BROKER: f"{mqtt_scheme}://{shown}:{mqtt_port}",
    }


def _module(process: psutil.Process) -> str:
    """Return the module of a `python -m MODULE`, else an empty text."""
    arguments = process.info["cmdline"] or []
    if len(arguments) > 2 and "-m" in arguments[1:-1] and "python" in Path(arguments[0]).name:
        return str(arguments[arguments.index("-m") + 1])
    return ""


def _processes(modules: Mapping[str, str], known: set[int]) -> list[tuple[str, psutil.Process]]:
    """Return the processes that run one of the modules, with their parts' names, without those of `known` systems."""
    found = []
    for process in psutil.process_iter(["cmdline", "pid"]):
        name = modules.get(_module(process))
        if name is not None and process.pid not in known and not _belongs(process, known):
            found.append((name, process))
    return found


def _belongs(process: psutil.Process, known: Iterable[int]) -> bool:
    try:
        return not {parent.pid for parent in process.parents()}.isdisjoint(known)
    except psutil.Error:
        return True  # it has just ended


def _setting(process: psutil.Process, name: str) -> str:
    try:
        return str(process.environ().get(f"FOGNAV_{name}", ""))
    except psutil.Error:
        return ""  # of another user, or in a container


def _fog_node(processes: list[tuple[str, psutil.Process]]) -> System | None:
    """Return the fog node whose REST APIs are at this machine's published ports.

    One with credentials is asked by HTTPS, if the environment names credentials. Raises `WrongUseError` for unusable
    ones.
    """
    own = own_credentials()
    tls = own.tls_context() if own.authority else None
    urls = addresses(net.LOOPBACK, secured=tls is not None)
    titles = {name: f"Fognav {name}" for name in SERVICE_PORTS}
    answering = {name for name, setting in SERVICE_PORTS.items() if _title(port(setting), tls) == titles[name]}
    if not answering:
        return None
    return System(
        name=FOG_NODE,
        kind="fog node",
        site=_site(port(SERVICE_PORTS[MAP_SERVICE]), tls) if MAP_SERVICE in answering else "",
        urls={name: url for name, url in urls.items() if name in answering or name in (ROUTER, BROKER)},
        pids={name: process.pid for name, process in processes},
    )


def _get(port: int, path: str, tls: ssl.SSLContext | None) -> dict[str, object]:
    try:
        response = net.request("GET", port, path, tls=tls)
    except (OSError, http.client.HTTPException):
        return {}
    return response.body if response.status == http.client.OK and isinstance(response.body, dict) else {}


def _title(port: int, tls: ssl.SSLContext | None) -> str:
    info = _get(port, "/openapi.json", tls).get("info")
    return str(info.get("title", "")) if isinstance(info, dict) else ""


def _site(port: int, tls: ssl.SSLContext | None) -> str:
    return str(_get(port, "/api/v1/map", tls).get("site", ""))


def _robots(processes: list[tuple[str, psutil.Process]]) -> list[System]:
    """Return one system for each robot whose processes run here: those that share a guardian's socket."""
    by_socket: dict[tuple[str, str], list[tuple[str, psutil.Process]]] = {}
    for name, process in processes:
        key = (_setting(process, "ROBOT"), _setting(process, "GUARDIAN_SOCKET"))
        by_socket.setdefault(key, []).append((name, process))
    return [
        System(
            name=f"robot-{robot}" if robot else "robot",
            kind="robot",
            site=next((site for _, process in own if (site := _site_of(process))), ""),
            urls={name: url for name, process in own if (url := _listening(process))},
            pids={name: process.pid for name, process in own},
            robots=[robot] if robot else [],
        )
        for (robot, _), own in by_socket.items()
    ]


def _site_of(process: psutil.Process) -> str:
    """Return the id of a process's site by its settings, or an empty text if they can't be seen."""
    if site := _setting(process, "SITE"):
        return site
    try:
        file = Path(_setting(process, "SITE_DIR")) / SITE_FILE
        return str(tomllib.loads(file.read_text("utf-8")).get("id", ""))
    except (OSError, ValueError):
        return ""


def _listening(process: psutil.Process) -> str:
    try:
        connections = process.net_connections("tcp")
    except psutil.Error:
        return ""
    ports = [c.laddr.port for c in connections if c.status == psutil.CONN_LISTEN]
    return f"http://{net.LOOPBACK}:{ports[0]}" if ports else ""
