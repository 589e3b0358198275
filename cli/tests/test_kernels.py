"""Whether the kernels are warm is seen without importing them, and compiling them shows how far it is."""

import os
from pathlib import Path

from fognav import kernels


def test_kernels_that_are_warm_are_found_so_and_not_announced() -> None:
    kernels.make_warm(lambda _: None)
    assert kernels.is_warm()
    said: list[str] = []
    kernels.make_warm(said.append)
    assert said == []


def test_a_module_is_stale_whose_source_is_younger_than_its_cache(tmp_path: Path) -> None:
    (tmp_path / "__pycache__").mkdir()
    (tmp_path / "plain.py").write_text('"""Mentions njit only."""\n')
    (tmp_path / "ray.py").write_text("@njit(cache=True)\ndef cast(): ...\n")
    assert kernels._stale(tmp_path) == ["ray"]
    index = tmp_path / "__pycache__" / "ray.cast-1.py311.nbi"
    index.touch()
    assert kernels._stale(tmp_path) == []
    os.utime(index, (0, 0))
    assert kernels._stale(tmp_path) == ["ray"]


def test_without_a_terminal_each_step_of_the_compilation_is_a_line() -> None:
    said: list[str] = []
    with kernels._showing(said.append) as show:
        show("3 of 9 kernels ready: astar.search\n")
    assert said == ["3 of 9 kernels ready: astar.search"]
