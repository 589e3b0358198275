"""Upgrades a fog node of `fognav up` in its checkout: with a backup first, and back again if the new version fails."""

import asyncio
import contextlib
import glob
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Final, NamedTuple, NoReturn

import msgspec

from fog_runtime import machine
from fog_supervisor import net
from fognav.aside import BACKUPS, TRIAL, Aside
from fognav.hosting import backups, local_nodes
from fognav.hosting.folders import NodeFolder, NodeSettings, recall
from fognav.hosting.local_nodes import end_node, running_nodes, systems_of
from fognav.output import FailedError, WrongUseError

_SET_UP_S: Final = 1800.0
_GIT_S: Final = 300.0
_SHOWN: Final = 5
"""Releases that an error names."""
_HEADING: Final = "## ["
"""Begins a release's changes in the changelog, before its version."""


class Release(NamedTuple):
    """A release: its version, such as 0.2.0, and its commit."""

    version: str
    commit: str


class Versions:
    """The versions of one checkout."""

    def __init__(self, root: Path) -> None:
        self._root = root

    def current(self) -> str:
        """Return the commit that is there; raises `WrongUseError` if this is no checkout of git."""
        try:
            return self._git("rev-parse", "HEAD")
        except FailedError as error:
            raise WrongUseError(f"{self._root} is no checkout of git, so it can't be upgraded: {error}") from error

    def newest(self) -> str:
        """Fetch, and return the newest release, or without any the branch that this one follows.

        Raises `FailedError`.
        """
        self._fetch()
        if tagged := self._tagged():
            return tagged[0].commit
        followed = self._commit("@{upstream}")
        released = self.releases(followed)
        return released[0].commit if released else followed

    def releases(self, revision: str = "HEAD") -> list[Release]:
        """Return the releases in a revision's history, newest first: by tags, or without any by the changelog.

        A copy of a repository may lack its tags; what `.ci/release` has written is in every one. Raises `FailedError`.
        """
        return self._tagged("--merged", revision) or self._recorded(revision)

    def _tagged(self, *which: str) -> list[Release]:
        tags = self._git("tag", "--list", "v*", "--sort=-version:refname", *which).split()
        return [Release(tag.removeprefix("v"), self._commit(f"refs/tags/{tag}")) for tag in tags]

    def _recorded(self, revision: str) -> list[Release]:
        """Return the commits with which VERSION and a heading of the changelog began to name the same version."""
        pattern = f"^{_HEADING}[0-9]".replace("[", "\\[", 1)
        log = ("log", "--topo-order", "--format=%H", f"-G{pattern}", revision, "--", "CHANGELOG.md")
        found: dict[str, str] = {}
        for commit in self._git(*log).splitlines():
            version = self._git("show", f"{commit}:VERSION")
            if f"\n{_HEADING}{version}]" in self._git("show", f"{commit}:CHANGELOG.md"):
                found[version] = commit  # an older commit replaces one that only corrected the heading
        return [Release(version, commit) for version, commit in found.items()]

    def named(self, version: str) -> str:
        """Fetch, and return the commit of a tag, of a branch as it is at its remote, or of another revision.

        Raises `FailedError`.
        """
        self._fetch()
        remotes = [f"refs/remotes/{remote}/{version}" for remote in self._git("remote").split()]
        for revision in (f"refs/tags/{version}", *remotes, version):
            # What a name is not, it may still be in another way.
            with contextlib.suppress(FailedError):
                return self._commit(revision)
        tags = [f"v{release.version}" for release in self._tagged()]
        raise FailedError(
            f"no version {version}: name one of the releases ({', '.join(tags[:_SHOWN]) or 'there is no tag yet'}), "
            "a branch or a commit"
        )

    def _fetch(self) -> None:
        if self._git("remote"):
            self._git("fetch", "--quiet", "--tags")

    def _commit(self, revision: str) -> str:
        return self._git("rev-parse", "--verify", "--quiet", "--end-of-options", f"{revision}^{{commit}}")

    def contains(self, commit: str) -> bool:
        """Whether what is there has a commit in its history."""
        return self._git("merge-base", self.current(), commit) == commit

    def changes(self, to: str) -> list[str]:
        """Return the subjects of what a version adds, newest first; raises `WrongUseError` if it is not a newer one."""
        current = self.current()
        if self._git("merge-base", current, to) != current:
            raise WrongUseError(
                f"{to[:12]} is not newer than {current[:12]}, which is here: only newer versions can use its data"
            )
        return self._git("log", "--no-merges", "--format=%s", f"{current}..{to}").splitlines()

    def go_to(self, commit: str) -> None:
        """Change to a version, and set its environment up; own changes of files stay.

        Raises `FailedError` if they are in the way, and then nothing has changed, or if the set-up fails.
        """
        self._git("reset", "--quiet", "--keep", commit)
        self._run([str(self.launcher), "--version"], _SET_UP_S)

    @property
    def root(self) -> Path:
        """The folder of the checkout."""
        return self._root

    @property
    def launcher(self) -> Path:
        """The command of the version that is there."""
        return self._root / "fognav"

    def _git(self, *arguments: str) -> str:
        return self._run(["git", "-C", str(self._root), *arguments], _GIT_S)

    def _run(self, command: list[str], timeout_s: float) -> str:
        try:
            done = subprocess.run(
                command, check=False, capture_output=True, text=True, timeout=timeout_s, stdin=subprocess.DEVNULL
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise FailedError(f"{' '.join(command)} failed: {error}") from error
        if done.returncode != 0:
            raise FailedError(f"{' '.join(command)} failed: {done.stderr.strip() or f'exit code {done.returncode}'}")
        return done.stdout.strip()


_KEPT_BACKUPS: Final = 10
"""Of each site, of those that upgrades have made."""
_STAMP: Final = "%Y-%m-%dT%H-%M-%S"
_STAMPED: Final = "[0-9]" * 4 + "-[0-9][0-9]" * 2 + "T[0-9][0-9]" + "-[0-9][0-9]" * 2
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
        self._aside = Aside(folder.path)

    def run(self, to: str) -> None:
        """Upgrade to a commit; a signal ends it as a failure does.

        Raises `FailedError` after everything is as it was before, or says what is not.
        """
        self._require_nothing_else_runs()
        before = self._versions.current()
        for file in self._back_up():
            self._say(f"backup: {file}")
        nodes = [node for node in running_nodes() if node.data == self._folder.path]
        by_systemd = any(local_nodes.systemd_runs(node.pid) for node in nodes)
        with _on_signals(_exit):
            try:
                for node in nodes:
                    end_node(node.pid)
                self._lay_aside()
                self._versions.go_to(to)
                self._try_start()
                with _on_signals(signal.SIG_IGN):
                    self._aside.discard()
            except (FailedError, OSError, SystemExit) as error:
                # Whoever has lost the connection, or hits Ctrl-C again, does not want half of the way back.
                with _on_signals(signal.SIG_IGN):
                    failure = self._undo(before, to, error)
                    self._start_again(by_systemd=by_systemd)
                    self._remove()
                raise failure from error
            with _on_signals(signal.SIG_IGN):
                self._say(f"upgraded to {to[:12]}; it starts with all data")
                self._start_again(by_systemd=by_systemd)
                self._remove()

    def _say(self, line: str) -> None:
        # A connection that was lost must not keep the fog down.
        with contextlib.suppress(OSError):
            self._print_line(line)

    def _lay_aside(self) -> None:
        with self._folder.in_use():
            try:
                self._aside.lay()
            except OSError as error:
                raise FailedError(
                    f"{self._folder.path} can't be copied beside itself, and nothing was changed; make room for it, "
                    f"and repeat the upgrade: {error}"
                ) from error

    def _undo(self, before: str, to: str, error: BaseException) -> FailedError:
        """Go back after an error, and return what to tell; raises `FailedError` if that fails, too."""
        if not self._aside.laid:
            if isinstance(error, FailedError):
                return error
            return FailedError(f"{_reason(error)}, and nothing was changed: repeat the upgrade")
        self._go_back(before)
        return FailedError(
            f"version {to[:12]} failed; version and data are those of before, {before[:12]}, and what was changed "
            f"after {self._aside.since} is undone: {_reason(error)}"
        )

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
        stamp = time.strftime(_STAMP)
        files = []
        for site, directory in self._settings.sites.items():
            files.append(folder / f"{stamp}-{site}.tar.gz")
            made = asyncio.run(backups.create(files[-1], self._folder, Path(directory)))
            if made.no_index is not None:  # its data is copied aside, too
                self._say(f"{files[-1]} lacks the index of the recordings: {made.no_index}")
            # The new one stays whatever the clock says: it is what an upgrade that fails may need.
            others = {*folder.glob(f"{_STAMPED}-{glob.escape(site)}.tar.gz")} - {files[-1]}
            for old in sorted(others)[: 1 - _KEPT_BACKUPS]:
                old.unlink()
        return files

    def _try_start(self) -> None:
        """Let the version that is there now start everything, and end it when it is ready; raises `FailedError`."""
        data = ["--data", str(self._folder.path), "--check"]
        # Nobody else's nodes, robots and people reach it: what it would tell them may be undone.
        here = msgspec.structs.replace(self._settings, address=net.LOOPBACK)
        command = [str(self._versions.launcher), "up", *here.arguments, *data]
        environment = {**os.environ, **self._settings.environment, TRIAL: "1"}
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
            self._aside.put_back()
        except (FailedError, OSError) as error:
            raise FailedError(
                f"going back to {to[:12]} failed, too: {error}. Check it out by hand; the data is in {self._aside.copy}"
                f": move it to {self._folder.path}"
            ) from error

    def _remove(self) -> None:
        try:
            self._aside.remove()
        except OSError as error:
            self._say(f"what is no longer needed can't be removed, and takes room until the next upgrade: {error}")

    def _start_again(self, *, by_systemd: bool) -> None:
        if by_systemd:
            local_nodes.start_unit()
            self._say(f"{local_nodes.UNIT} runs again")
        else:
            self._say(f"start it: {self._settings.command(self._folder.path)}")


def _reason(error: BaseException) -> str:
    return "it was interrupted" if isinstance(error, SystemExit) else str(error)


def _exit(number: int, _: FrameType | None) -> NoReturn:
    # Unlike after KeyboardInterrupt, `subprocess` then waits for the end of the program that it kills.
    raise SystemExit(128 + number)


@contextlib.contextmanager
def _on_signals(handler: Callable[[int, FrameType | None], object] | signal.Handlers) -> Iterator[None]:
    """Let the signals that end a process do this meanwhile; programs that are started inherit that they are ignored."""
    before = {number: signal.signal(number, handler) for number in machine.ending()}
    try:
        yield
    finally:
        for number, each in before.items():
            signal.signal(number, each)
