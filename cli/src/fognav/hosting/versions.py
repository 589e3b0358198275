"""The versions of the checkout: which one is there, which are releases, which one is newest, and how to change it."""

import contextlib
import subprocess
from pathlib import Path
from typing import Final, NamedTuple

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
