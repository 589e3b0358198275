"""The cache of compiled kernels: checks whether it is complete, and fills it in a process of its own."""

import contextlib
import hashlib
import importlib.metadata
import importlib.util
import os
import re
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from fog_kernels.sources import sources_of
from fognav.output import FailedError, console

_WARM_TIMEOUT_S: Final = 900.0
_COMPILES: Final = re.compile(r"^(@|\w+ = )njit\(", re.MULTILINE)
_CPU: Final = ("model name", "flags", "CPU implementer", "CPU part", "Features")
_PROGRESS: Final = re.compile(r"(\d+) of (\d+) kernels ready: (.*)")


class KernelsError(FailedError):
    """The kernels could not be compiled; the message contains the compiler's output."""


def _stale(folder: Path) -> list[str]:
    """Return the kernel modules in the package's folder whose cache index is missing or older than their sources."""
    return sorted(
        module.stem
        for module in folder.glob("*.py")
        if _COMPILES.search(module.read_text("utf-8"))
        and _compiled_at(module) < max(source.stat().st_mtime for source in sources_of(module))
    )


def _indices(module: Path) -> list[Path]:
    """Return numba's indices of a module's compiled kernels."""
    return list((module.parent / "__pycache__").glob(f"{module.stem}.*.nbi"))


def _compiled_at(module: Path) -> float:
    return max((index.stat().st_mtime for index in _indices(module)), default=0.0)


def is_warm() -> bool:
    """Whether every kernel module is compiled and cached; this check compiles and imports nothing."""
    return not _stale(_package())


def _package() -> Path:
    spec = importlib.util.find_spec("fog_kernels")
    assert spec is not None
    assert spec.origin is not None
    return Path(spec.origin).parent


def warm_cache(print_line: Callable[[str], None]) -> None:
    """Compile the missing kernels for this CPU, showing the progress; raises `KernelsError`.

    Whether numba takes what is there, a process tries out that needs a second, so only once for each cache.
    """
    folder = _package()
    if is_warm():
        if _was_checked(folder):
            return
        _run(lambda _line: None)
    else:
        print_line("compiling the kernels (once, about a minute)")
        with _progress_display(print_line) as show:
            _run(show)
    _mark_checked(folder)


def _checked(folder: Path) -> Path:
    return folder / "__pycache__" / "checked.sha256"


def _was_checked(folder: Path) -> bool:
    with contextlib.suppress(FileNotFoundError):
        return _checked(folder).read_text("ascii") == _state(folder)
    return False


def _mark_checked(folder: Path) -> None:
    """Note that the cache fits, in the times of its indices, too: numba takes those whose sources were only touched."""
    with contextlib.suppress(OSError):  # another user's: it stays as it is
        for module in folder.glob("*.py"):
            for index in _indices(module):
                os.utime(index)
        _checked(folder).write_text(_state(folder), "ascii")


def _state(folder: Path) -> str:
    """Return a hash of what decides whether numba takes the cache: files, versions, settings and CPU."""
    files = sorted((file.name, file.stat().st_size) for file in (folder / "__pycache__").glob("*.nb[ic]*"))
    versions = sys.version, *map(importlib.metadata.version, ("numba", "llvmlite"))
    settings = sorted(item for item in os.environ.items() if item[0].startswith("NUMBA_"))
    cpu = sorted({line for line in Path("/proc/cpuinfo").read_text("utf-8").splitlines() if line.startswith(_CPU)})
    return hashlib.sha256(repr((files, versions, settings, cpu)).encode()).hexdigest()


def _run(on_line: Callable[[str], None]) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "fog_kernels.warm"],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    timeout = threading.Timer(_WARM_TIMEOUT_S, process.kill)
    timeout.start()
    output: list[str] = []
    try:
        with process:
            assert process.stdout is not None
            for line in process.stdout:
                output.append(line)
                on_line(line)
    except BaseException:
        process.kill()
        process.wait()
        raise
    finally:  # who is interrupted would wait at the end for the timer's thread
        timeout.cancel()
    if process.returncode != 0:
        raise KernelsError(f"the kernels could not be compiled:\n{''.join(output).strip()[-2000:]}")


@contextlib.contextmanager
def _progress_display(print_line: Callable[[str], None]) -> Iterator[Callable[[str], None]]:
    """Yield a function that shows a line of progress: as a bar on a terminal, otherwise as the line itself."""
    if not console.is_terminal:
        yield lambda line: print_line(line.strip())
        return
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("kernels", total=None)

        def show(line: str) -> None:
            if (found := _PROGRESS.match(line)) is not None:
                progress.update(task, completed=int(found[1]), total=int(found[2]), description=found[3])

        yield show
