"""Upgrades a fog node of `fognav up` in its checkout: with a backup first, and back again if the new version fails."""

import asyncio
import os
import shutil
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from fognav.hosting import backups, unit
from fognav.hosting.folders import NodeFolder
from fognav.hosting.local_nodes import end_node, running_nodes, systems_of
from fognav.hosting.settings import NodeSettings, recall
from fognav.hosting.versions import Versions
from fognav.output import FailedError

BACKUPS: Final = "backups"
_START_S: Final = 1800.0
"""For the first start of a version: a Raspberry Pi compiles the kernels for minutes."""


class Upgrade:
    """The upgrade of one node to one version; all of this version's code that it needs is loaded before."""

    def __init__(self, folder: NodeFolder, versions: Versions, print_line: Callable[[str], None]) -> None:
        """Take a node's folder and its checkout.

        Raises `FailedError` for a folder with which no node was started, or whose last upgrade was cut short.
        """
        self._folder = folder
        self._versions = versions
        self._print_line = print_line
        self._settings: NodeSettings = recall(folder.path)
        self._kept = folder.path.with_name(f"{folder.path.name}.before-upgrade")
        if self._kept.exists():
            raise FailedError(
                f"an upgrade was cut short: {self._kept} has the data of before. Check out the version that wrote it, "
                f"and move it to {folder.path}; or remove it, if the fog node runs well"
            )

    def run(self, to: str) -> None:
        """Upgrade to a commit. Raises `FailedError` after everything is as it was before, or says what is not."""
        self._require_nothing_else_runs()
        before = self._versions.current()
        for file in self._back_up():
            self._print_line(f"backup: {file}")
        by_systemd = False
        for node in running_nodes():
            if node.data == self._folder.path:
                by_systemd = by_systemd or unit.runs(node.pid)
                end_node(node.pid)
        try:
            with self._folder.in_use():
                self._keep()
        except FailedError:
            self._start_again(by_systemd=by_systemd)
            raise
        try:
            self._versions.go_to(to)
            self._try_start()
        except (FailedError, OSError, KeyboardInterrupt) as error:
            self._go_back(before)
            self._start_again(by_systemd=by_systemd)
            raise FailedError(
                f"version {to[:12]} failed; version and data are those of before, {before[:12]}: {_reason(error)}"
            ) from error
        shutil.rmtree(self._kept)
        self._print_line(f"upgraded to {to[:12]}; it starts with all data")
        self._start_again(by_systemd=by_systemd)

    def _keep(self) -> None:
        """Copy the data aside; raises `FailedError` and leaves no copy behind if it can't be."""
        try:
            shutil.copytree(self._folder.path, self._kept, symlinks=True)
        except (OSError, KeyboardInterrupt) as error:
            shutil.rmtree(self._kept, ignore_errors=True)
            raise FailedError(
                f"{self._folder.path} can't be copied beside itself, and nothing was changed; make room for it, and "
                f"repeat the upgrade: {_reason(error)}"
            ) from error

    def _require_nothing_else_runs(self) -> None:
        """Raise `FailedError` if the files of other systems would change while they run."""
        others = [each.name for each in systems_of(self._versions.root) if each.data != str(self._folder.path)]
        if others:
            raise FailedError(
                f"{', '.join(others)} would run on with parts of both versions: nothing was changed. End first what "
                f"else runs from {self._versions.root} (fognav down, Ctrl-C), or give it a checkout of its own"
            )

    def _back_up(self) -> list[Path]:
        folder = self._folder.path / BACKUPS
        folder.mkdir(mode=0o700, exist_ok=True)
        stamp = time.strftime("%Y-%m-%dT%H-%M-%S")
        files = []
        for site, directory in self._settings.sites.items():
            files.append(folder / f"{stamp}-{site}.tar.gz")
            made = asyncio.run(backups.create(files[-1], self._folder, Path(directory)))
            if made.no_index is not None:  # its data is copied aside, too
                self._print_line(f"{files[-1]} lacks the index of the recordings: {made.no_index}")
        return files

    def _try_start(self) -> None:
        """Let the version that is there now start everything, and end it when it is ready; raises `FailedError`."""
        data = ["--data", str(self._folder.path), "--check"]
        command = [str(self._versions.launcher), "up", *self._settings.arguments, *data]
        environment = {**os.environ, **self._settings.environment}
        try:
            done = subprocess.run(
                command, check=False, capture_output=True, text=True, timeout=_START_S, env=environment,
                stdin=subprocess.DEVNULL,
            )  # fmt: skip
        except subprocess.TimeoutExpired as error:
            raise FailedError(f"it was not ready within {_START_S:.0f} s") from error
        if done.returncode != 0:
            raise FailedError(f"it does not start: {done.stderr.strip()}")

    def _go_back(self, to: str) -> None:
        try:
            self._versions.go_to(to)
        except FailedError as error:
            raise FailedError(
                f"going back to {to[:12]} failed, too: {error}. Check it out by hand; the data is in {self._kept}: "
                f"move it to {self._folder.path}"
            ) from error
        shutil.rmtree(self._folder.path)
        self._kept.rename(self._folder.path)

    def _start_again(self, *, by_systemd: bool) -> None:
        if by_systemd:
            unit.start()
            self._print_line(f"{unit.NAME} runs again")
        else:
            self._print_line(f"start it: {self._settings.command(self._folder.path)}")


def _reason(error: BaseException) -> str:
    return "it was interrupted" if isinstance(error, KeyboardInterrupt) else str(error)
