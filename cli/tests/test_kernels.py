"""The cache of compiled kernels is checked without importing them, and compiling shows its progress."""

import os
import threading
from pathlib import Path

import pytest

from fognav import kernels


def test_complete_cache_is_detected_and_prints_nothing() -> None:
    kernels.warm_cache(lambda _: None)
    assert kernels.is_warm()
    printed: list[str] = []
    kernels.warm_cache(printed.append)
    assert printed == []


def test_complete_cache_is_tried_out_once_for_a_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    kernels.warm_cache(lambda _: None)
    monkeypatch.setattr("sys.executable", "/bin/false")
    kernels.warm_cache(lambda _: None)
    monkeypatch.setenv("NUMBA_CPU_NAME", "generic")
    with pytest.raises(kernels.KernelsError):
        kernels.warm_cache(lambda _: None)


def test_module_newer_than_its_cache_is_stale(tmp_path: Path) -> None:
    (tmp_path / "__pycache__").mkdir()
    (tmp_path / "plain.py").write_text('"""Mentions njit only."""\n')
    (tmp_path / "ray.py").write_text("@njit(cache=True)\ndef cast(): ...\n")
    assert kernels._stale(tmp_path) == ["ray"]
    index = tmp_path / "__pycache__" / "ray.cast-1.py311.nbi"
    index.touch()
    assert kernels._stale(tmp_path) == []
    os.utime(index, (0, 0))
    assert kernels._stale(tmp_path) == ["ray"]


def test_module_that_imports_a_newer_one_is_stale(tmp_path: Path) -> None:
    (tmp_path / "__pycache__").mkdir()
    (tmp_path / "steps.py").write_text("LENGTH = 3\n")
    (tmp_path / "ray.py").write_text("from fog_kernels.steps import LENGTH\n@njit(cache=True)\ndef cast(): ...\n")
    index = tmp_path / "__pycache__" / "ray.cast-1.py311.nbi"
    index.touch()
    assert kernels._stale(tmp_path) == []
    os.utime(tmp_path / "steps.py", (index.stat().st_mtime + 1.0,) * 2)
    assert kernels._stale(tmp_path) == ["ray"]


def test_module_whose_source_was_only_touched_is_not_stale_after_a_check(tmp_path: Path) -> None:
    (tmp_path / "__pycache__").mkdir()
    (tmp_path / "ray.py").write_text("@njit(cache=True)\ndef cast(): ...\n")
    index = tmp_path / "__pycache__" / "ray.cast-1.py311.nbi"
    index.touch()
    os.utime(index, (0, 0))
    assert kernels._stale(tmp_path) == ["ray"]
    kernels._mark_checked(tmp_path)
    assert kernels._stale(tmp_path) == []


def test_progress_without_a_terminal_is_one_line_per_kernel() -> None:
    printed: list[str] = []
    with kernels._progress_display(printed.append) as show:
        show("3 of 9 kernels ready: astar.search\n")
    assert printed == ["3 of 9 kernels ready: astar.search"]


def test_command_that_is_interrupted_while_kernels_compile_leaves_no_thread_to_wait_for() -> None:
    def interrupt(_line: str) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        kernels._run(interrupt)
    timers = [thread for thread in threading.enumerate() if isinstance(thread, threading.Timer)]
    assert all(timer.finished.is_set() for timer in timers)
