"""`fognav bridge` and `fognav rosbag`: the bridges to other systems; and what `fognav up` has to know of them."""

import os
import shlex
import signal
import subprocess
import sys
import tomllib
from importlib.util import find_spec
from json import loads
from pathlib import Path
from typing import Annotated, Final

import typer

from fog_runtime.keys import BRIDGE_TOKEN, TOKENS
from fog_runtime.token_file import keep_token
from fognav.operate.fog import find_fog
from fognav.operate.options import JsonOption
from fognav.output import FailedError, WrongUseError, exit_codes, print_line, print_result
from fognav.programs import BRIDGE, BROKER, CONSOLE, MODULES, ROUTER, inherited_environment

_FILE: Final = "FOGNAV_BRIDGE_FILE"
_COMMAND: Final = (sys.executable, "-m", MODULES[BRIDGE])
_OF_FOG: Final = ("console_url", "mqtt_url", "zenoh_connect", "site", "token_file", "credentials_file")
"""Settings that a system on this machine answers by itself."""


def bridge_command(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Which systems, and how to reach them (TOML).")],
    *,
    check: Annotated[bool, typer.Option("--check", help="Only say whether the settings can be used.")] = False,
) -> None:
    """Tell other systems of robots, and take their orders.

    It runs until Ctrl-C, for the only demo or fog node of this machine, or for the one that FILE names. `fognav up
    --bridge FILE` keeps it running. What can be set is in docs/interop.md.
    """
    with exit_codes():
        require_bridge(file)
        if check:
            print_line(f"{file} can be used")
            return
        environment = {"FOGNAV_LOG_FORMAT": "text", **os.environ, _FILE: str(file.absolute())}
        given = {name for name in _OF_FOG if environment.get(f"FOGNAV_{name.upper()}")}
        if "console_url" not in given | tomllib.loads(file.read_text("utf-8")).keys():
            environment |= _of_this_machine()
        sys.stdout.flush()
        os.execve(sys.executable, _COMMAND, environment)  # noqa: S606  # no shell is wanted


def rosbag_command(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="MCAP file of a recording.")],
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A new folder for the rosbag2.")],
    *,
    json: JsonOption = False,
) -> None:
    """Write a recording as a rosbag2, for tools of ROS 2.

    `ros2 bag play DIR` plays it. Its topics are in docs/interop.md.
    """
    with exit_codes():
        _require_installed()
        command = [sys.executable, "-m", f"{MODULES[BRIDGE]}.ros2.rosbag2", str(file), str(folder)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise WrongUseError(f"{file} can't be converted: {done.stderr.strip().splitlines()[-1]}")
        counts: dict[str, int] = loads(done.stdout)
        lines = [f"{topic}: {count} messages" for topic, count in counts.items()]
        print_result({"folder": str(folder), "messages": counts}, f"wrote {folder}", *lines, json=json)


def _require_installed() -> None:
    if find_spec(MODULES[BRIDGE]) is None:
        raise FailedError(
            "the bridges are not installed: install the package fog-bridges beside this command (./fognav of a "
            "checkout has it), or leave them out: a floor runs without them"
        )


def require_bridge(file: Path) -> None:
    """Raise `FailedError` if the bridges are not installed, and `WrongUseError` for settings that can't be used."""
    _require_installed()
    environment = {**inherited_environment(), _FILE: str(file.absolute()), "FOGNAV_CONSOLE_URL": "https://localhost"}
    done = subprocess.run([*_COMMAND, "--check"], env=environment, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        says = done.stderr.strip().splitlines()
        if not says:
            raise FailedError(
                f"{file} was not checked: the bridges ended without a word, {_ended(done.returncode)}. Look why: "
                f"{_FILE}={shlex.quote(str(file))} {shlex.join(_COMMAND)}"
            )
        raise WrongUseError(f"{file} can't be used: {says[-1]}")


def _ended(code: int) -> str:
    return f"with exit code {code}" if code >= 0 else f"by signal {-code} ({signal.strsignal(-code)})"


def _of_this_machine() -> dict[str, str]:
    """Return the settings for the only system of this machine; raises as `find_fog`, and `WrongUseError`."""
    system = find_fog(None).system
    if system.token_file is None or system.credentials_file is None or CONSOLE not in system.urls:
        raise WrongUseError(
            f"{system.name} has no secrets for this user: set {', '.join(_OF_FOG)}, or in containers run "
            "`docker compose --profile bridges up` (docs/interop.md)"
        )
    token = Path(system.token_file).with_name(BRIDGE_TOKEN)
    keep_token(token.with_name(TOKENS), BRIDGE, "operator", token)
    found = {
        "console_url": system.urls[CONSOLE],
        "mqtt_url": system.urls[BROKER],
        "zenoh_connect": system.urls[ROUTER],
        "site": find_fog(None).site,
        "token_file": str(token),
        "credentials_file": str(Path(system.credentials_file).with_name(f"{BRIDGE}.toml")),
    }
    return {f"FOGNAV_{name.upper()}": found[name] for name in _OF_FOG}
