"""The fog nodes of this user that run on this machine without containers, by the register."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

import psutil

from fognav.operate.registry import System, registered
from fognav.output import FailedError, WrongUseError

KIND: Final = "fog node"
UP: Final = "up"
"""The name of the process that runs the others."""
_STOP_S: Final = 60.0
_POLL_S: Final = 0.05


class RunningNode(NamedTuple):
    """A fog node: the process that runs the others, its data folder, and its sites' names in `fognav status`."""

    pid: int
    data: Path
    names: Sequence[str]

    def __str__(self) -> str:
        return f"{', '.join(self.names)} (--data {self.data})"


def running_nodes() -> list[RunningNode]:
    """Return all of them."""
    systems: dict[int, list[System]] = {}
    for each in registered():
        if each.kind == KIND and UP in each.pids and each.data is not None:
            systems.setdefault(each.pids[UP], []).append(each)
    return [
        RunningNode(pid, Path(str(sites[0].data)), sorted(each.name for each in sites))
        for pid, sites in systems.items()
    ]


def systems_of(checkout: Path) -> list[System]:
    """Return the registered systems, fog nodes and others, with a program that runs the code of a checkout."""
    environment = checkout / ".venv"
    return [
        each for each in registered() if any(_program(pid).is_relative_to(environment) for pid in each.pids.values())
    ]


def _program(pid: int) -> Path:
    try:
        return Path(next(iter(psutil.Process(pid).cmdline()), ""))
    except (psutil.NoSuchProcess, psutil.AccessDenied):
        return Path()


def named_node(name: str | None, data: Path | None) -> RunningNode | None:
    """Return the node with a site's name in `fognav status` and this data folder, or the only one; None without any.

    Raises `WrongUseError` when several match, or when nodes run, but none of them matches.
    """
    nodes = running_nodes()
    folder = None if data is None else data.absolute()
    found = [node for node in nodes if folder in (None, node.data) and (name is None or name in node.names)]
    if len(found) > 1:
        raise WrongUseError(f"several fog nodes run: {'; '.join(map(str, found))}. Name one of them")
    if nodes and not found:
        raise WrongUseError(f"no such fog node runs, only: {'; '.join(map(str, nodes))}. Name one of these")
    return found[0] if found else None


def end_node(pid: int) -> None:
    """End a fog node by the process that runs the others; raises `FailedError` if it does not end."""
    try:
        process = psutil.Process(pid)
        process.terminate()
        deadline = time.monotonic() + _STOP_S
        # One that has ended stays a zombie until its parent looks.
        while process.is_running() and process.status() != psutil.STATUS_ZOMBIE:
            if time.monotonic() > deadline:
                raise FailedError(
                    f"process {pid} has not ended within {_STOP_S:.0f} s: look at its terminal, or kill it"
                )
            time.sleep(_POLL_S)
    except psutil.NoSuchProcess:
        pass
