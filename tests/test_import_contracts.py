"""The import contracts in `pyproject.toml`: they know every module, and they see a forbidden import."""

import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
CONTRACTS = {
    contract["name"]: contract
    for contract in tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"]["contracts"]
}
SOURCES = sorted({path.parent for path in ROOT.glob("*/src/*/__init__.py")} | {
    path.parent for path in ROOT.glob("*/*/src/*/__init__.py")
})  # fmt: skip

EDGES = {
    "fog_runtime", "fog_supervisor", "fognav", "fognav_experiments.lockstep", "fognav_experiments.rigs",
    "fog_kernels.warm",
    "hazard_aggregator.__main__", "hazard_aggregator.api", "hazard_aggregator.registry", "hazard_aggregator.service",
    "hazard_aggregator.settings", "hazard_aggregator.store",
    "map_service.__main__", "map_service.api", "map_service.registry", "map_service.service", "map_service.settings",
    "map_service.store",
    "planner.__main__", "planner.api", "planner.service", "planner.settings", "planner.store",
    "robot_agent.__main__", "robot_agent.agent.guardian_client", "robot_agent.agent.input_writer",
    "robot_agent.agent.lidar_edge", "robot_agent.agent.replay", "robot_agent.agent.service",
    "robot_agent.agent.settings", "robot_agent.agent.store", "robot_agent.guardian.__main__",
    "robot_agent.guardian.process", "robot_agent.guardian.watchdog", "robot_agent.registry", "robot_agent.serial_port",
    "fognav_sim.__main__", "fognav_sim.devices", "fognav_sim.live", "fognav_sim.pty_port", "fognav_sim.robot_unit",
    "fognav_sim.settings",
}  # fmt: skip
"""What may touch the world: packages and modules of I/O, clocks, threads and processes."""


def modules() -> list[str]:
    """Every module of every member that holds code, by its full name."""
    found = []
    for package in SOURCES:
        for file in package.rglob("*.py"):
            parts = file.relative_to(package.parent).with_suffix("").parts
            if parts[-1] != "__init__":
                found.append(".".join(parts))
    return sorted(found)


def covered(module: str, listed: set[str]) -> bool:
    """Whether a module or one of the packages above it is listed."""
    parts = module.split(".")
    return any(".".join(parts[:size]) in listed for size in range(1, len(parts) + 1))


def test_every_module_is_listed_as_pure_or_as_an_edge() -> None:
    pure = set(CONTRACTS["Cores touch no world"]["source_modules"])
    undecided = [module for module in modules() if covered(module, pure) == covered(module, EDGES)]
    assert undecided == [], (
        "each module is either listed in the contract 'Cores touch no world' (pyproject.toml) or in EDGES (here)"
    )


def test_every_listed_module_exists() -> None:
    known = {".".join(module.split(".")[:size]) for module in modules() for size in range(1, module.count(".") + 2)}
    known |= {package.name for package in SOURCES}
    assert sorted(EDGES - known) == []
    assert sorted(set(CONTRACTS["Cores touch no world"]["source_modules"]) - known) == []


@pytest.fixture
def copied_sources(tmp_path: Path) -> Path:
    """A copy of all members' sources, with the contracts."""
    for package in SOURCES:
        shutil.copytree(
            package, tmp_path / package.relative_to(ROOT), ignore=shutil.ignore_patterns("__pycache__", "static")
        )
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


def checked(folder: Path) -> subprocess.CompletedProcess[str]:
    """Check the contracts on the sources in a folder instead of the checkout's own."""
    paths = os.pathsep.join(str(folder / package.parent.relative_to(ROOT)) for package in SOURCES)
    command = [Path(sys.executable).parent / "lint-imports", "--no-cache"]
    return subprocess.run(
        command, cwd=folder, env={**os.environ, "PYTHONPATH": paths}, capture_output=True, text=True, check=False
    )


PLANTED = {
    "a core imports its store": ("services/planner/src/planner/core.py", "planner.store", "planner.core"),
    "a core reads a clock": ("services/hazard-aggregator/src/hazard_aggregator/fusion.py", "time", "fusion"),
    "a contract opens sockets": ("libs/fog-contracts/src/fog_contracts/replica.py", "asyncio", "fog_contracts"),
    "a layer imports its service": (
        "services/map-service/src/map_service/layers/zones.py", "map_service.service", "zones",
    ),
    "a driver touches the runtime": (
        "robot-agent/src/robot_agent/bases/diffdrive/driver.py", "fog_runtime.clock", "diffdrive",
    ),
    "a driver imports its emulator": (
        "robot-agent/src/robot_agent/lidars/ld19/driver.py", "robot_agent.lidars.ld19.emulator", "ld19",
    ),
    "a service imports another": ("services/planner/src/planner/service.py", "map_service.core", "planner.service"),
    "the runtime imports a service": (
        "libs/fog-runtime/src/fog_runtime/health.py", "planner.core", "fog_runtime.health",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("file", "imported", "named"), PLANTED.values(), ids=PLANTED.keys())
def test_forbidden_import_breaks_a_contract(copied_sources: Path, file: str, imported: str, named: str) -> None:
    target = copied_sources / file
    target.write_text(f"{target.read_text('utf-8')}\nimport {imported} as _planted\n", "utf-8")
    result = checked(copied_sources)
    assert result.returncode == 1, result.stdout + result.stderr
    assert "BROKEN" in result.stdout
    assert named in result.stdout.split("Broken contracts")[-1]


def test_forbidden_indirect_import_breaks_a_contract(copied_sources: Path) -> None:
    helper = copied_sources / "services/map-service/src/map_service/costmap.py"
    helper.write_text(f"{helper.read_text('utf-8')}\nimport fog_runtime.clock as _planted\n", "utf-8")
    result = checked(copied_sources)
    assert result.returncode == 1
    assert "map_service.core" in result.stdout.split("Broken contracts")[-1]


def test_unchanged_sources_keep_every_contract(copied_sources: Path) -> None:
    result = checked(copied_sources)
    assert result.returncode == 0, result.stdout + result.stderr
