"""Programs that no Python package provides: finds them, and installs the missing ones."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fog_supervisor.servers import find_program
from fognav.output import FailedError

_INSTALL_TIMEOUT_S: Final = 600.0


@dataclass(frozen=True)
class Tool:
    """A program: its possible names, the Debian packages that contain it, and its purpose."""

    name: str
    executables: tuple[str, ...]
    package: str
    purpose: str
    required: bool = True


MOSQUITTO: Final = Tool("mosquitto", ("mosquitto",), "mosquitto", "MQTT broker between sensor nodes and fog")
REDIS: Final = Tool("redis-server", ("redis-server",), "redis-server", "store of zones, goals and areas")
CHROMIUM: Final = Tool(
    "chromium", ("chromium", "chromium-browser", "google-chrome"), "chromium", "tests of the page", required=False
)
COMPILER: Final = Tool(
    "g++", ("g++", "clang++"), "g++", "sensor nodes that run their firmware on this computer", required=False
)
BOARD_COMPILER: Final = Tool(
    "xtensa-lx106-elf-g++", ("xtensa-lx106-elf-g++",), "gcc-xtensa-lx106 picolibc-xtensa-lx106-elf",
    "compiling the firmware's core for the ESP8266", required=False,
)  # fmt: skip
FIRMWARE_CHECKER: Final = Tool(
    "cppcheck", ("cppcheck",), "cppcheck libbearssl-dev libmbedtls-dev",
    "checking the firmware, and its signatures with the boards' own libraries", required=False,
)  # fmt: skip
PROMETHEUS: Final = Tool("prometheus", ("prometheus",), "prometheus", "tests of alerts and dashboards", required=False)
TOOLS: Final = (MOSQUITTO, REDIS, CHROMIUM, COMPILER, BOARD_COMPILER, FIRMWARE_CHECKER, PROMETHEUS)


class MissingToolsError(FailedError):
    """Programs are missing and were not installed; the message names them and how to install them."""


class NoAttemptError(MissingToolsError):
    """Nobody tried to install the missing programs: there is no consent, or no way to install them."""


def _run(arguments: Sequence[str], environment: Mapping[str, str]) -> tuple[int, str]:
    done = subprocess.run(
        arguments,
        check=False,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, **environment},
        timeout=_INSTALL_TIMEOUT_S,
    )
    return done.returncode, done.stdout


class Apt:
    """The distribution's packages by apt-get, as root or by sudo without a password."""

    def __init__(self, run: Callable[[Sequence[str], Mapping[str, str]], tuple[int, str]] = _run) -> None:
        self._run = run

    def _prefix(self) -> list[str] | None:
        if shutil.which("apt-get") is None:
            return None
        if os.geteuid() == 0:
            return []
        if shutil.which("sudo") is not None and self._run(["sudo", "-n", "true"], {})[0] == 0:
            return ["sudo", "-n"]
        return None

    def available(self) -> bool:
        """Whether apt-get is installed and this user may use it."""
        return self._prefix() is not None

    def install(self, tools: Sequence[Tool]) -> None:
        """Update the package lists, then install the packages; raises `MissingToolsError` with the reason."""
        prefix = self._prefix()
        if prefix is None:
            raise MissingToolsError("apt-get can't be used here: it needs root, or sudo without a password")
        environment = {"DEBIAN_FRONTEND": "noninteractive"}
        install = [*prefix, "apt-get", "install", "-y", "-q", "--no-install-recommends"]
        code, output = self._run([*prefix, "apt-get", "update", "-q"], environment)
        if code == 0:
            code, output = self._run(
                [*install, *(name for tool in tools for name in tool.package.split())], environment
            )
        if code != 0:
            last = "\n".join(output.strip().splitlines()[-8:])
            raise MissingToolsError(f"{install_command(tools)} failed with code {code}:\n{last}")


APT: Final = Apt()


def find_uv(root: Path | None) -> Path | None:
    """Return the installer of Python packages: that which ./fognav got into the checkout `root`, or one on the PATH."""
    own = [root / ".fognav" / folder / "bin" / "uv" for folder in ("uv", "uv-env")] if root else []
    found = next((str(candidate) for candidate in own if candidate.is_file()), None) or shutil.which("uv")
    return Path(found) if found else None


def find(tool: Tool) -> Path | None:
    """Return the path of the program, from PATH or from the system's folders for servers."""
    return find_program(*tool.executables)


def install_command(tools: Sequence[Tool]) -> str:
    """Return the command that installs the programs."""
    return "apt-get install --no-install-recommends " + " ".join(tool.package for tool in tools)


def has_consent(yes: bool) -> bool:  # noqa: FBT001  # its only argument
    """Whether system packages may be installed without asking: `--yes` or CI=true."""
    return yes or os.environ.get("CI", "").lower() == "true"


def _ask_user(question: str) -> bool:
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        return False
    sys.stderr.write(f"{question} [y/N] ")
    sys.stderr.flush()
    return sys.stdin.readline().strip().lower() in {"y", "yes"}


def ensure(
    tools: Sequence[Tool],
    *,
    yes: bool,
    print_line: Callable[[str], None],
    ask: Callable[[str], bool] = _ask_user,
    apt: Apt | None = None,
) -> dict[str, Path]:
    """Return the path of each program, after installing the missing ones by apt-get.

    Raises `NoAttemptError` with the missing programs and the command to install them, without consent or where it can't
    be used, and `MissingToolsError` if their installation fails.
    """
    missing = [tool for tool in tools if find(tool) is None]
    if missing:
        names, command = " and ".join(tool.name for tool in missing), install_command(missing)
        apt = apt or APT
        if not apt.available():
            raise NoAttemptError(f"missing: {names}. Install with: sudo {command}")
        if not (has_consent(yes) or ask(f"Missing: {names}. Run '{command}' now?")):
            raise NoAttemptError(f"missing: {names}. Install with: {command}  (or run again with --yes)")
        print_line(f"installing {names} (apt-get)")
        apt.install(missing)
    paths = {tool.name: find(tool) for tool in tools}
    if still := [name for name, path in paths.items() if path is None]:
        raise MissingToolsError(f"{' and '.join(still)} can't be found although the installation succeeded")
    return {name: path for name, path in paths.items() if path is not None}


def prepare_node_code(print_line: Callable[[str], None], *, yes: bool = False) -> None:
    """Compile the firmware's core; where that can't be, print one line with the reason.

    A missing compiler is installed if the user agrees (`yes`: without asking).
    """
    from fognav_sim.nodes import why_model  # noqa: PLC0415  # keeps the other commands fast

    reason = why_model()
    if reason is not None and _lacks_compiler():
        try:
            ensure([COMPILER], yes=yes, print_line=print_line)
        except NoAttemptError:
            pass  # the reason says how to install it
        except MissingToolsError as error:
            print_line(str(error))
        else:
            reason = why_model()
    if reason is not None:
        print_line(f"simulated sensor nodes run a model in Python, not the firmware: {reason.splitlines()[0]}")


def _lacks_compiler() -> bool:
    """Whether there are sources to compile, and nothing that could."""
    from fognav_sim.nodes import FirmwareError, find_compiler, find_firmware  # noqa: PLC0415  # same

    try:
        find_firmware()
    except FirmwareError:
        return False
    try:
        find_compiler()
    except FirmwareError:
        return True
    return False


def find_tool(root: Path, pins: str, program: str) -> Path | None:
    """Return a program of the environment of requirements/`pins`.txt, if it is installed as pinned."""
    stamp = root / ".fognav" / pins / "venv" / "requirements.txt"
    current = stamp.is_file() and stamp.read_bytes() == (root / "requirements" / f"{pins}.txt").read_bytes()
    return stamp.parent / "bin" / program if current else None


def install_tool(root: Path, pins: str, program: str) -> Path:
    """Install what requirements/`pins`.txt names into an environment of its own; return a program of it.

    Raises `FailedError`.
    """
    if (uv := find_uv(root)) is None:
        raise FailedError(f"uv, which installs {program}, is not found: python3 -m pip install uv")
    venv, wanted = root / ".fognav" / pins / "venv", root / "requirements" / f"{pins}.txt"
    create: list[str | Path] = ["venv", "--clear", "--no-project", "--python", sys.executable, venv]
    install = ["pip", "install", "--python", venv / "bin" / "python", "--require-hashes", "-r", wanted]
    for step in (create, install):
        done = subprocess.run([uv, "--quiet", *step], check=False, capture_output=True, text=True)
        if done.returncode != 0:
            raise FailedError(f"{program} could not be installed: {done.stderr.strip()}")
    shutil.copyfile(wanted, venv / "requirements.txt")
    return venv / "bin" / program
