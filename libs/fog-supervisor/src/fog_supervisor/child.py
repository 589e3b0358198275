"""Replaces itself with a program that ends with its parent: `python -I -S child.py PARENT_PID PROGRAM ARGUMENTS...`.

A separate program, because code between fork and exec may hang in a process with threads (zenoh has some). It imports
little, because it delays every start.

To the kernel the parent is the thread that started the program: start it from one that lives as long as the process.
"""

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1


def command(*arguments: str) -> list[str]:
    """Return the command line of a program that ends with this process, even when that is killed."""
    return [sys.executable, "-I", "-S", __file__, str(os.getpid()), *arguments]


def main(arguments: list[str]) -> None:
    """Request a SIGKILL at the parent's death from the kernel, then execute the program."""
    parent = int(arguments[0])
    if sys.platform == "linux":
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0) != 0:
            raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG) failed")
    if os.getppid() != parent:
        # The parent died before the request: the kernel will not send the signal.
        raise SystemExit(1)
    os.execvp(arguments[1], arguments[1:])  # noqa: S606  # executing the given program is the purpose


if __name__ == "__main__":
    main(sys.argv[1:])
