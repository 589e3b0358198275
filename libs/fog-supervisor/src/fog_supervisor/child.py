"""Becomes another program that can't outlive its parent: `python -I -S child.py PARENT_PID PROGRAM ARGUMENTS...`.

A program of its own, because code between fork and exec in a process with threads (zenoh has some) may hang. It imports
next to nothing, for it stands before every start.
"""

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1


def main(arguments: list[str]) -> None:
    """Ask the kernel for a SIGKILL at the parent's death, then become the program."""
    parent = int(arguments[0])
    if sys.platform == "linux":
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0) != 0:
            raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG) failed")
    if os.getppid() != parent:
        # The parent died before the kernel knew: nobody would send the signal.
        raise SystemExit(1)
    os.execv(arguments[1], arguments[1:])  # noqa: S606  # becoming another program is what this one is for


if __name__ == "__main__":
    main(sys.argv[1:])
