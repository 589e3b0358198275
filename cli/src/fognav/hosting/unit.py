"""The systemd unit of a fog node, for the user who runs it."""

import os
import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from fognav import checkout
from fognav.output import FailedError, WrongUseError

NAME: Final = "fognav.service"
_TEXT: Final = """\
# Written by `fognav up --systemd`: run that again to change it.
[Unit]
Description=Fognav's fog node

[Service]
Type=notify
ExecStart={command}
{environment}\
# The programs are restarted by this one, and it by systemd.
Restart=on-failure
RestartSec=2
WatchdogSec=30
# The first start compiles the kernels.
TimeoutStartSec=600
TimeoutStopSec=60
KillMode=mixed

[Install]
WantedBy=default.target
"""


def unit_folder() -> Path:
    """Return where systemd looks for the units of this user."""
    home = os.environ.get("XDG_CONFIG_HOME", "")
    return (Path(home) if home.startswith("/") else Path.home() / ".config") / "systemd" / "user"


def unit_text(arguments: Sequence[str]) -> str:
    """Return the unit that runs `fognav` with these arguments and the settings (FOGNAV_*) of this shell."""
    settings = sorted((name, value) for name, value in os.environ.items() if name.startswith("FOGNAV_"))
    environment = "".join(f"Environment={_quoted(f'{name}={value}')}\n" for name, value in settings)
    # In a command line, unlike in the environment, `$` has a meaning, too (systemd.service(5)).
    command = " ".join(_quoted(word).replace("$", "$$") for word in [*_program(), *arguments])
    return _TEXT.format(command=command, environment=environment)


def write_unit(arguments: Sequence[str]) -> Path:
    """Write the unit; return its file."""
    file = unit_folder() / NAME
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(unit_text(arguments), "utf-8")
    file.chmod(0o600)  # settings may be secrets
    return file


def runs(pid: int) -> bool:
    """Whether this process is the one that systemd runs as the unit."""
    command = ["systemctl", "--user", "show", "--property=MainPID", "--value", NAME]
    try:
        done = subprocess.run(command, check=False, capture_output=True, text=True)
    except OSError:
        return False  # a computer without systemd
    return done.returncode == 0 and done.stdout.strip() == str(pid)


def start() -> None:
    """Let systemd start the unit; raises `FailedError`."""
    done = subprocess.run(["systemctl", "--user", "start", NAME], check=False, capture_output=True, text=True)
    if done.returncode != 0:
        raise FailedError(f"systemd did not start {NAME}: {done.stderr.strip()}. Look at: journalctl --user -u {NAME}")


def _program() -> list[str]:
    try:
        return [str(checkout.root() / "fognav")]
    except WrongUseError:
        return [sys.executable, "-m", "fognav"]


def _quoted(word: str) -> str:
    """Return a word as systemd reads it: `%` has a meaning there (systemd.syntax(7))."""
    escaped = word.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%")
    return escaped if shlex.quote(word) == word else f'"{escaped}"'
