"""The compiled kernels' cache: whether it is warm, and warming it, in a process of its own."""

import importlib.util
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Final

_WARM_TIMEOUT_S: Final = 900.0


class KernelsError(RuntimeError):
    """The kernels could not be compiled; the message holds what the compiler said."""


def _stale(folder: Path) -> list[str]:
    """Return the kernel modules that have no cache index as young as their source, in the folder of the package."""
    sources = [path for path in folder.glob("*.py") if "njit" in path.read_text("utf-8")]
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
    """Compile what is missing, for this CPU; raises `KernelsError`."""
    if not is_warm():
        say("compiling the kernels (once, about a minute)")
    done = subprocess.run(
        [sys.executable, "-m", "fog_kernels.warm"],
        check=False,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=_WARM_TIMEOUT_S,
    )
    if done.returncode != 0:
        raise KernelsError(f"the kernels could not be compiled:\n{done.stdout.strip()[-2000:]}")
