"""The import contracts in `pyproject.toml` see what they forbid, and what they can't see: randomness without a seed."""

import ast
import os
import shutil
import subprocess
import sys
import tomllib
from collections import Counter
from pathlib import Path

import grimp

ROOT = Path(__file__).parents[1]
LINTER = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"]
CONTRACTS = {contract["name"]: contract for contract in LINTER["contracts"]}
SOURCES = sorted({path.parent for path in ROOT.glob("*/src/*/__init__.py")} | {
    path.parent for path in ROOT.glob("*/*/src/*/__init__.py")
})  # fmt: skip

GENERATORS = {"random", "np.random", "numpy.random"}

MOST_MODULES = 30
"""More than these in one folder, and nobody sees any more which of them belong together."""


def test_no_folder_holds_more_modules_than_one_sees_at_a_glance() -> None:
    folders = Counter(str(file.parent.relative_to(ROOT)) for package in SOURCES for file in package.rglob("*.py"))
    crowded = {folder: count for folder, count in folders.items() if count > MOST_MODULES}
    assert crowded == {}, "give those that belong together a folder of their own, named by what they do"


def pure() -> dict[str, ast.Module]:
    """The syntax trees of the cores, and of all that they import."""
    graph = grimp.build_graph(*LINTER["root_packages"])
    found = set()
    for pattern in CONTRACTS["Cores touch no world"]["source_modules"]:
        for module in graph.find_matching_modules(pattern):
            found |= {module} | graph.find_descendants(module)
            found |= graph.find_upstream_modules(module, as_package=True)
    folder = {package.name: package.parent for package in SOURCES}
    files = {module: folder[module.split(".")[0]].joinpath(*module.split(".")) for module in found}
    return {
        module: ast.parse((path / "__init__.py" if path.is_dir() else path.with_suffix(".py")).read_text("utf-8"))
        for module, path in files.items()
    }


def unseeded_randomness(tree: ast.Module) -> list[str]:
    """Every use of the shared generators of `random` and `numpy.random`, and every generator made without a seed."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module in GENERATORS:
            found.append(f"line {node.lineno}: from {node.module} import")
        used = ast.unparse(node.value) if isinstance(node, ast.Attribute) else ""
        if used in GENERATORS and node.attr not in {"Random", "default_rng", "Generator"}:
            found.append(f"line {node.lineno}: {ast.unparse(node)}")
        made = ast.unparse(node.func) if isinstance(node, ast.Call) and not node.args and not node.keywords else ""
        if made.rpartition(".")[0] in GENERATORS:
            found.append(f"line {node.lineno}: {made} without a seed")
    return found


def test_cores_draw_random_numbers_from_seeds_only() -> None:
    modules = pure()
    assert {"robot_agent.localization.particle_filter", "planner.core"} < modules.keys()
    assert {module: found for module, tree in modules.items() if (found := unseeded_randomness(tree))} == {}


def copy_sources(folder: Path) -> None:
    """Copy all members' sources, and the contracts."""
    for package in SOURCES:
        ignored = shutil.ignore_patterns("__pycache__", "static")
        shutil.copytree(package, folder / package.relative_to(ROOT), ignore=ignored)
    shutil.copy(ROOT / "pyproject.toml", folder)


def check(folder: Path) -> subprocess.CompletedProcess[str]:
    """Check the contracts on the sources in a folder instead of the checkout's own."""
    paths = os.pathsep.join(str(folder / package.parent.relative_to(ROOT)) for package in SOURCES)
    command = [Path(sys.executable).parent / "lint-imports", "--no-cache"]
    return subprocess.run(
        command, cwd=folder, env={**os.environ, "PYTHONPATH": paths}, capture_output=True, text=True, check=False
    )


PLANTED = {
    "Members stand in layers": ("services/planner/src/planner/service.py", "import map_service.core as _planted"),
    "No modules or packages import each other in a circle": (
        "libs/fog-contracts/src/fog_contracts/messages/maps.py", "import fog_contracts.follower as _planted",
    ),
    "In a program imports point inwards, from its process to its core": (
        "robot-agent/src/robot_agent/agent/core.py",
        # A type alone is an import, too.
        "if TYPE_CHECKING:\n    from robot_agent.agent.service import Service as _Planted",
    ),
    # Which its core imports, and so is as pure.
    "Cores touch no world": ("services/map-service/src/map_service/costmap.py", "import time as _planted"),
    "Exchangeable parts are found by name only": (
        "robot-agent/src/robot_agent/guardian/core.py", "import robot_agent.bases.roomba600.driver as _planted",
    ),
    "An emulator shares no code with its driver": (
        "robot-agent/src/robot_agent/lidars/ld19/emulator.py", "import robot_agent.lidars.ld19.driver as _planted",
    ),
    "The oracle knows nothing of what it watches": (
        "experiments/src/fognav_experiments/hunt/oracle.py", "import planner.core as _planted",
    ),
}  # fmt: skip


def test_each_contract_is_broken_by_an_import_that_it_forbids(tmp_path: Path) -> None:
    assert PLANTED.keys() == CONTRACTS.keys()
    copy_sources(tmp_path)
    for file, code in PLANTED.values():
        with (tmp_path / file).open("a") as source:
            source.write(f"\n{code}\n")
    result = check(tmp_path)
    assert result.returncode == 1, result.stdout + result.stderr
    assert {name for name in CONTRACTS if f"{name} BROKEN" in result.stdout} == CONTRACTS.keys(), result.stdout
