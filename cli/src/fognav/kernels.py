"""The compiled kernels' cache: whether it is warm, and warming it, in a process of its own."""

import contextlib
import importlib.util
import re
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from fognav.output import console

_WARM_TIMEOUT_S: Final = 900.0
_COMPILES: Final = re.compile(r"^(@|\w+ = )njit\(", re.MULTILINE)
_PROGRESS: Final = re.compile(r"(\d+) of (\d+) kernels ready: (.*)")


class KernelsError(RuntimeError):
    """The kernels could not be compiled; the message holds what the compiler said."""


def _stale(folder: Path) -> list[str]:
    """Return the kernel modules that have no cache index as young as their source, in the folder of the package."""
    sources = [path for path in folder.glob("*.py") if _COMPILES.search(path.read_text("utf-8"))]
    indices = list((folder / "__pycache__").glob("*.nbi"))
    return sorted(
        source.stem
        for source in sources
        if not any(
            index.name.startswith(f"{source.stem}.") and index.stat().st_mtime >= source.stat().st_mtime
            for index in indices
        )
    )


def is_warm() -> bool:
    """Whether every kernel module lies compiled beside the sources; a look, which compiles and imports nothing."""
    spec = importlib.util.find_spec("fog_kernels")
    return spec is not None and spec.origin is not None and not _stale(Path(spec.origin).parent)


def make_warm(say: Callable[[str], None]) -> None:
    """Compile what is missing, for this CPU, and show how far it is; raises `KernelsError`."""
    if is_warm():
        _run(lambda _line: None)
    else:
        say("compiling the kernels (once, about a minute)")
        with _showing(say) as show:
            _run(show)


def _run(on_line: Callable[[str], None]) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "fog_kernels.warm"],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    overdue = threading.Timer(_WARM_TIMEOUT_S, process.kill)
    overdue.start()
    said: list[str] = []
    with process:
        assert process.stdout is not None
        for line in process.stdout:
            said.append(line)
            on_line(line)
    overdue.cancel()
    if process.returncode != 0:
        raise KernelsError(f"the kernels could not be compiled:\n{''.join(said).strip()[-2000:]}")


@contextlib.contextmanager
def _showing(say: Callable[[str], None]) -> Iterator[Callable[[str], None]]:
    """Give what shows a line of progress: a bar on a terminal, and otherwise the line itself."""
    if not console.is_terminal:
        yield lambda line: say(line.strip())
        return
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("kernels", total=None)

        def show(line: str) -> None:
            if (found := _PROGRESS.match(line)) is not None:
                progress.update(task, completed=int(found[1]), total=int(found[2]), description=found[3])

        yield show
