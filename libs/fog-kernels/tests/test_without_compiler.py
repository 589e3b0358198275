"""Every kernel's tests repeated as plain Python, where an overflow warns and a wrong index raises."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from compiler import Guarded, compiled_only

EXPECTED_OVERFLOW = "ignore:overflow encountered in scalar:RuntimeWarning:fog_kernels.amcl"
"""The random number generator computes modulo 2^64; nothing else may overflow."""


@compiled_only
@pytest.mark.long
@pytest.mark.timeout(600)
def test_kernels_pass_their_tests_as_plain_python() -> None:
    # In a separate process, because numba reads the setting at import. It takes a minute; the timeout is for a hang.
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-W", EXPECTED_OVERFLOW,
         str(Path(__file__).parent)],
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
        timeout=590,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-1000:]
    assert "failed" not in done.stdout
    assert " passed" in done.stdout


def test_guarded_arrays_refuse_indices_out_of_bounds() -> None:
    array = np.arange(6).reshape(2, 3).view(Guarded)
    assert array[1, np.int64(2)] == 5
    with pytest.raises(IndexError, match="negative"):
        array[0, -1]
    with pytest.raises(IndexError, match="negative"):
        array[1:][np.int64(-1)] = 0
    with pytest.raises(IndexError, match="out of bounds"):
        array[2, 0]
