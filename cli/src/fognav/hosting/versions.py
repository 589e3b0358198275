"""The versions of the checkout: which one is there, which one is newest, and how to change it."""

import subprocess
from pathlib import Path
from typing import Final

from fognav.output import FailedError, WrongUseError

_SET_UP_S: Final = 1800.0
_GIT_S: Final = 300.0


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
        """Fetch, and return the newest release (tag `v*`), or without one the branch that this one follows.

        Raises `FailedError`.
        """
        if self._git("remote"):
            self._git("fetch", "--quiet", "--tags")
        tags = self._git("tag", "--list", "v*", "--sort=-version:refname").split()
        return self.commit(tags[0]) if tags else self.commit("@{upstream}")

    def commit(self, revision: str) -> str:
        """Return the commit of a tag, branch or commit; raises `FailedError` if it is unknown."""
        return self._git("rev-parse", "--verify", "--quiet", "--end-of-options", f"{revision}^{{commit}}")

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
