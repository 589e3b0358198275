"""Compiled kernels that are kept are used as long as nothing changes that they were compiled from, and no longer."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from compiler import compiled_only

import fog_kernels
from fog_kernels.sources import digest_of, sources_of

FACTOR = "FACTOR = {}\n"
CALLED = """
from numba import int64, njit

from fog_kernels import _arrays

@njit(int64(int64), cache=True)
def added(value):
    return value + {}
"""
CALLING = """
from numba import int64, njit

from fog_kernels import _arrays, factor
from fog_kernels.called import (
    added,
)

TIMES = factor.FACTOR

@njit(int64(int64), cache=True)
def calling(value):
    return TIMES * added(value)
"""
RUN = "from fog_kernels import warm\nfrom fog_kernels.calling import calling\nprint(calling(1), warm.cache_misses())"
WARM = "from fog_kernels import warm\nwarm.PROFILES['two'] = 'called', 'calling'\nwarm.warm('two')\n"
KILLED = """
import os
from numba.core import caching
caching.IndexDataCacheFile._save_data = lambda *_: os._exit(9)
"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A copy of the package, without its kernels, and with a kernel that calls one of another module."""
    source, copy = Path(fog_kernels.__file__).parent, tmp_path / "fog_kernels"
    copy.mkdir()
    for name in ("__init__", "_arrays", "cache", "sources", "warm"):
        shutil.copy(source / f"{name}.py", copy)
    (copy / "factor.py").write_text(FACTOR.format(10))
    (copy / "called.py").write_text(CALLED.format(1))
    (copy / "calling.py").write_text(CALLING)
    return copy


def python(package: Path, code: str) -> subprocess.CompletedProcess[str]:
    environment = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    environment["PYTHONPATH"] = str(package.parent)
    # Python tells sources apart by size and second: these change faster.
    environment["PYTHONDONTWRITEBYTECODE"] = "1"
    return subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=60, check=False
    )


def run(package: Path, first: str = "") -> tuple[int, int]:
    """Return the kernel's result in a new process, and how many kernels were compiled."""
    done = python(package, first + RUN)
    assert done.returncode == 0, done.stderr
    result, compiled = done.stdout.split()
    return int(result), int(compiled)


def kept(package: Path) -> set[str]:
    """Return the names of the files in numba's cache."""
    return {file.name for file in (package / "__pycache__").glob("*.nb[ic]*")}


@pytest.mark.drive
@compiled_only
def test_kernel_is_compiled_anew_when_what_it_calls_or_a_constant_of_another_module_changes(package: Path) -> None:
    assert run(package) == (20, 2)
    (package / "called.py").write_text(CALLED.format(2))
    assert run(package) == (30, 2)
    (package / "factor.py").write_text(FACTOR.format(100))
    assert run(package) == (300, 1)
    assert run(package) == (300, 0)


@pytest.mark.drive
@compiled_only
def test_process_that_dies_while_it_saves_a_kernel_leaves_no_old_one_in_its_place(package: Path) -> None:
    assert run(package) == (20, 2)
    (package / "called.py").write_text(CALLED.format(2))
    assert python(package, KILLED + RUN).returncode == 9
    assert run(package) == (30, 2)
    assert run(package) == (30, 0)


@pytest.mark.drive
@compiled_only
def test_warming_removes_kernels_of_older_sources_and_nothing_else(package: Path) -> None:
    assert run(package) == (20, 2)
    other = package / "__pycache__" / "called_too.added-4.py311.1.nbc"
    other.touch()
    older = kept(package) - {other.name}
    (package / "called.py").write_text(CALLED.format(2))
    assert run(package, WARM) == (30, 2)
    assert other.name in kept(package)
    assert not older & kept(package)
    assert len(kept(package)) == 1 + len(older)
    assert run(package) == (30, 0)


def test_sources_are_those_imported_directly_and_by_way_of_others() -> None:
    folder = Path(fog_kernels.__file__).parent
    names = {f"{source.parent.name}/{source.stem}" for source in sources_of(folder / "astar.py")}
    assert {"fog_kernels/astar", "fog_kernels/_arrays", "fog_kernels/flood", "fog_kernels/steps"} < names
    assert "fog_contracts/costs" in names
    assert not {"fog_kernels/dwa", "fog_kernels/amcl", "fog_kernels/warm"} & names


def test_digest_does_not_depend_on_the_folder(package: Path, tmp_path: Path) -> None:
    moved = tmp_path / "elsewhere" / "fog_kernels"
    shutil.copytree(package, moved)
    assert digest_of(moved / "calling.py") == digest_of(package / "calling.py")
    assert digest_of(moved / "called.py") != digest_of(package / "calling.py")


@compiled_only
def test_kernel_that_is_kept_is_loaded_without_what_only_its_compilation_needs(package: Path) -> None:
    modules = "import sys\nprint('numba.np.npyimpl' in sys.modules)"
    assert python(package, RUN + "\n" + modules).stdout.split() == ["20", "2", "True"]
    assert python(package, RUN + "\n" + modules).stdout.split() == ["20", "0", "False"]


@compiled_only
def test_kernel_that_calls_numbas_own_functions_is_loaded_without_linear_algebra_and_one_is_compiled_beside_it(
    package: Path,
) -> None:
    (package / "called.py").write_text(
        CALLED.format("np.arange(4).sum() - 5").replace("from numba import", "import numpy as np\nfrom numba import", 1)
    )
    loaded = "import sys\nprint('numba.np.arraymath' in sys.modules, 'scipy.linalg' in sys.modules)"
    assert python(package, RUN + "\n" + loaded).stdout.split() == ["20", "2", "True", "True"]
    assert python(package, RUN + "\n" + loaded).stdout.split() == ["20", "0", "False", "False"]
    (package / "calling.py").write_text(CALLING.replace("TIMES *", "2 * TIMES *"))
    assert run(package) == (40, 1)


@compiled_only
def test_kernel_is_compiled_beside_one_that_was_loaded(package: Path) -> None:
    assert run(package) == (20, 2)
    (package / "calling.py").write_text(CALLING.replace("TIMES *", "2 * TIMES *"))
    assert run(package) == (40, 1)


@compiled_only
def test_kernel_runs_without_its_bitcode(package: Path) -> None:
    released = """
import gc
from llvmlite.binding import ModuleRef
from fog_kernels.cache import release_bitcode
held = lambda: sum(isinstance(known, ModuleRef) for known in gc.get_objects())
before = held()
release_bitcode()
print(before - held(), calling(1))
"""
    run(package)
    assert python(package, RUN + released).stdout.split() == ["20", "0", "2", "20"], "two kernels, each with its own"
