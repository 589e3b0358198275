"""The import contracts in `pyproject.toml`: they know every module, and they see a forbidden import."""

import ast
import os
import shutil
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from fnmatch import fnmatchcase
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
    "fog_runtime",
    "fog_supervisor",
    "fognav.__main__", "fognav.commands", "fognav.checkout", "fognav.checks", "fognav.demo.attempt",
    "fognav.demo.background", "fognav.demo.operator", "fognav.demo.options", "fognav.demo.placement",
    "fognav.demo.preparation", "fognav.demo.presence", "fognav.demo.report", "fognav.demo.run", "fognav.demo.scene",
    "fognav.demo.servers", "fognav.demo.usage", "fognav.demo.view", "fognav.doctor",
    "fognav.generated", "fognav.kernels", "fognav.node_code",
    "fognav.locking", "fognav.operate", "fognav.output", "fognav.page.app", "fognav.hosting",
    "fognav.programs",
    "fognav.pytest_progress", "fognav.recording", "fognav.lidar_logs",
    "fognav.nodes.board_options", "fognav.nodes.on_broker", "fognav.nodes.provisioning", "fognav.nodes.simulated",
    "fognav.nodes.site_file", "fognav.nodes.updating", "fognav.stack", "fognav.stack_doors", "fognav.system",
    "fognav.testing",
    "fog_kernels.cache", "fog_kernels.warm",
    "hazard_aggregator.__main__", "hazard_aggregator.alert_keeper", "hazard_aggregator.api",
    "hazard_aggregator.publisher", "hazard_aggregator.records", "hazard_aggregator.registry",
    "hazard_aggregator.service", "hazard_aggregator.store", "hazard_aggregator.writers",
    "map_service.__main__", "map_service.api", "map_service.registry", "map_service.service", "map_service.settings",
    "map_service.publisher", "map_service.store", "map_service.times_keeper", "map_service.unusable_zones",
    "map_service.zone_writer",
    "planner.__main__", "planner.api", "planner.map_keeper", "planner.plan_records", "planner.query_queue",
    "planner.robot_commands", "planner.service", "planner.store",
    "robot_agent.__main__", "robot_agent.agent.edges", "robot_agent.agent.recording.input_writer",
    "robot_agent.agent.process", "robot_agent.agent.recording.replay", "robot_agent.agent.service",
    "robot_agent.agent.settings", "robot_agent.contradictions",
    "robot_agent.guardian.__main__", "robot_agent.guardian.process", "robot_agent.guardian.protection",
    "robot_agent.guardian.stop_base", "robot_agent.guardian.wakeups", "robot_agent.guardian.watchdog",
    "robot_agent.port_names", "robot_agent.registry",
    "robot_agent.serial_port",
    "fognav_sim.firmware", "fognav_sim.firmware_node", "fognav_sim.nodes", "fognav_sim.__main__", "fognav_sim.devices",
    "fognav_sim.live", "fognav_sim.planner_client", "fognav_sim.pty_port", "fognav_sim.robot_unit",
    "fognav_sim.settings",
}  # fmt: skip
"""What may touch the world: packages and modules of I/O, clocks, threads and processes."""

LABORATORY = "fognav_experiments."
"""Measures, and no system runs it: its modules are pure where the contract lists them, and may else do anything."""

PURE_LIBRARIES = {
    "__future__", "abc", "binascii", "bisect", "collections", "contextlib", "dataclasses", "enum", "functools",
    "hashlib", "heapq", "hmac", "html", "itertools", "json", "math", "msgspec", "numba", "numpy", "operator", "random",
    "re", "struct", "textwrap", "typing", "unicodedata", "zlib",
}  # fmt: skip
"""What pure modules may import besides each other: no clock, file, process or hidden state; `random` only seeded."""

PURE_IN = {"map_service.zone_times": {"datetime", "zoneinfo"}}
"""What single pure modules may import besides: calendars, whose clock of the wall the contract forbids all others."""

GENERATORS = {"random", "np.random", "numpy.random"}

CONCRETE_PARTS = {
    "Bases and lidars are found by name only": (
        "robot-agent", ("robot_agent.bases", "robot_agent.lidars.ld19", "robot_agent.lidars.rplidar_a1"),
    ),
    "Debounce rules are found by name only": ("services/hazard-aggregator", ("hazard_aggregator.debounce",)),
    "Cost layers are found by name only": ("services/map-service", ("map_service.layers",)),
}  # fmt: skip
"""Each contract on concrete parts: the member that registers them, and the folders inside which they may be known."""


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
    divided = [module for module in modules() if not module.startswith(LABORATORY)]
    undecided = [module for module in divided if covered(module, pure) == covered(module, EDGES)]
    assert undecided == [], (
        "each module is either listed in the contract 'Cores touch no world' (pyproject.toml) or in EDGES (here)"
    )


MOST_MODULES = 25
"""More than these in one folder, and nobody sees any more which of them belong together."""


def test_no_folder_holds_more_modules_than_one_sees_at_a_glance() -> None:
    folders = Counter(str(file.parent.relative_to(ROOT)) for package in SOURCES for file in package.rglob("*.py"))
    crowded = {folder: count for folder, count in folders.items() if count > MOST_MODULES}
    assert crowded == {}, "give those that belong together a folder of their own, named by what they do"


def sources(listed: set[str]) -> dict[str, ast.Module]:
    """The syntax trees of all listed modules and packages, by the modules' names."""
    found = {}
    for package in SOURCES:
        for file in package.rglob("*.py"):
            module = ".".join(file.relative_to(package.parent).with_suffix("").parts).removesuffix(".__init__")
            if covered(module, listed):
                found[module] = ast.parse(file.read_text("utf-8"))
    return found


def test_pure_modules_import_only_libraries_known_to_be_pure() -> None:
    allowed = PURE_LIBRARIES | {package.name for package in SOURCES}
    unknown = []
    for module, tree in sources(set(CONTRACTS["Cores touch no world"]["source_modules"])).items():
        for node in ast.walk(tree):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [node.module]
            known = allowed | PURE_IN.get(module, set())
            unknown += [f"{module}: {name}" for name in names if name.split(".")[0] not in known]
    assert unknown == [], "forbid the library in the contract 'Cores touch no world', or add it to PURE_LIBRARIES"


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


def test_pure_modules_draw_random_numbers_from_seeds_only() -> None:
    pure = sources(set(CONTRACTS["Cores touch no world"]["source_modules"]))
    assert {module: found for module, tree in pure.items() if (found := unseeded_randomness(tree))} == {}


@pytest.mark.parametrize(
    "code",
    ["random.uniform(0, 1)", "random.Random()", "np.random.default_rng()", "np.random.rand(3)", "from random import x"],
)
def test_unseeded_randomness_is_found(code: str) -> None:
    assert unseeded_randomness(ast.parse(code)) != []


@pytest.mark.parametrize("code", ["random.Random(seed).uniform(0, 1)", "np.random.default_rng(seed).random()"])
def test_seeded_randomness_is_accepted(code: str) -> None:
    assert unseeded_randomness(ast.parse(code)) == []


@pytest.mark.parametrize("name", CONCRETE_PARTS)
def test_registered_parts_may_be_imported_by_no_module_outside_their_folder(name: str) -> None:
    member, folders = CONCRETE_PARTS[name]
    contract = CONTRACTS[name]
    project = tomllib.loads((ROOT / member / "pyproject.toml").read_text("utf-8"))["project"]
    registered = {
        target.split(":")[0] for parts in project["entry-points"].values() for target in parts.values()
    }  # fmt: skip
    patterns = [pattern for module in contract["forbidden_modules"] for pattern in (module, f"{module}.*")]
    assert [part for part in sorted(registered) if not any(fnmatchcase(part, one) for one in patterns)] == []
    outside = [module for module in modules() if not covered(module, set(folders))]
    assert [module for module in outside if not covered(module, set(contract["source_modules"]))] == []


def test_every_listed_module_exists() -> None:
    known = {".".join(module.split(".")[:size]) for module in modules() for size in range(1, module.count(".") + 2)}
    known |= {package.name for package in SOURCES}
    assert sorted(EDGES - known) == []
    assert sorted(set(CONTRACTS["Cores touch no world"]["source_modules"]) - known) == []


@pytest.fixture(scope="module")
def copied_sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of all members' sources, with the contracts; each test plants an import, and removes it."""
    folder = tmp_path_factory.mktemp("sources")
    for package in SOURCES:
        shutil.copytree(
            package, folder / package.relative_to(ROOT), ignore=shutil.ignore_patterns("__pycache__", "static")
        )
    shutil.copy(ROOT / "pyproject.toml", folder)
    return folder


@contextmanager
def planted(file: Path, code: str) -> Iterator[None]:
    """Append code to a file for a while."""
    text = file.read_text("utf-8")
    file.write_text(f"{text}\n{code}\n", "utf-8")
    try:
        yield
    finally:
        file.write_text(text, "utf-8")


def check(folder: Path) -> subprocess.CompletedProcess[str]:
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
    "the guardian names a base": (
        "robot-agent/src/robot_agent/guardian/core.py", "robot_agent.bases.roomba600.driver", "Bases and lidars",
    ),
    "the agent names a lidar": (
        "robot-agent/src/robot_agent/agent/edges/lidar_edge.py", "robot_agent.lidars.ld19.driver", "Bases and lidars",
    ),
    "the simulator names an emulator": (
        "sim/src/fognav_sim/devices.py", "robot_agent.bases.diffdrive.emulator", "Bases and lidars",
    ),
    "the fusion names a debounce rule": (
        "services/hazard-aggregator/src/hazard_aggregator/fusion.py", "hazard_aggregator.debounce.consecutive",
        "Debounce rules",
    ),
    "the costmap names a layer": (
        "services/map-service/src/map_service/costmap.py", "map_service.layers.obstacles", "Cost layers",
    ),
    "one base imports another": (
        "robot-agent/src/robot_agent/bases/diffdrive/stop.py", "robot_agent.bases.roomba600.stop", "bases",
    ),
    "messages import the follower": (
        "libs/fog-contracts/src/fog_contracts/messages/maps.py", "fog_contracts.follower", "fog-contracts:",
    ),
    "channels import what is generated from them": (
        "libs/fog-contracts/src/fog_contracts/channels.py", "fog_contracts.generate.header", "fog-contracts:",
    ),
    "the clock imports an edge": (
        "libs/fog-runtime/src/fog_runtime/clock.py", "fog_runtime.transports.zenoh_edge", "fog-runtime:",
    ),
    "ports import the supervisor": (
        "libs/fog-supervisor/src/fog_supervisor/net.py", "fog_supervisor.supervisor", "fog-supervisor:",
    ),
    "array types import a kernel": (
        "libs/fog-kernels/src/fog_kernels/_arrays.py", "fog_kernels.dwa", "fog-kernels:",
    ),
    "output imports the demonstration": ("cli/src/fognav/output.py", "fognav.demo.run", "fognav:"),
    "the demonstration's scene imports its run": ("cli/src/fognav/demo/scene.py", "fognav.demo.run", "demonstration:"),
    "processes import rigs": (
        "experiments/src/fognav_experiments/processes.py", "fognav_experiments.rigs", "laboratory:",
    ),
    "a pose imports the localizer": (
        "robot-agent/src/robot_agent/localization/pose.py", "robot_agent.localization.localizer", "localization:",
    ),
    "the interface of layers imports one": (
        "services/map-service/src/map_service/layers/base.py", "map_service.layers.hazards", "cost layers:",
    ),
    "a core loads a C library": ("services/planner/src/planner/path_search.py", "ctypes", "planner.path_search"),
    "a proposal of a site logs": ("cli/src/fognav/site_proposal.py", "logging", "fognav.site_proposal"),
}  # fmt: skip


@pytest.mark.parametrize(("file", "imported", "named"), PLANTED.values(), ids=PLANTED.keys())
def test_forbidden_import_breaks_a_contract(copied_sources: Path, file: str, imported: str, named: str) -> None:
    with planted(copied_sources / file, f"import {imported} as _planted"):
        result = check(copied_sources)
    assert result.returncode == 1, result.stdout + result.stderr
    assert "BROKEN" in result.stdout
    assert named in result.stdout.split("Broken contracts")[-1]


PLANTED_TYPES = {
    "a core names its store": ("services/planner/src/planner/core.py", "planner.store", "Store", "planner:"),
    "a pure module names a type of an edge": (
        "sim/src/fognav_sim/barrier.py", "fog_runtime.clock", "Clock", "fognav_sim.barrier",
    ),
    "generic code names a concrete type": (
        "robot-agent/src/robot_agent/guardian/process.py", "robot_agent.bases.roomba600.driver", "FACTORY",
        "Bases and lidars",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("file", "module", "name", "named"), PLANTED_TYPES.values(), ids=PLANTED_TYPES.keys())
def test_import_for_the_type_checker_only_breaks_a_contract(
    copied_sources: Path, file: str, module: str, name: str, named: str
) -> None:
    code = f"from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from {module} import {name}"
    with planted(copied_sources / file, code):
        result = check(copied_sources)
    assert result.returncode == 1, result.stdout + result.stderr
    assert named in result.stdout.split("Broken contracts")[-1]


def test_forbidden_indirect_import_breaks_a_contract(copied_sources: Path) -> None:
    helper = copied_sources / "services/map-service/src/map_service/costmap.py"
    with planted(helper, "import fog_runtime.clock as _planted"):
        result = check(copied_sources)
    assert result.returncode == 1
    assert "map_service.core" in result.stdout.split("Broken contracts")[-1]


def test_unchanged_sources_keep_every_contract(copied_sources: Path) -> None:
    result = check(copied_sources)
    assert result.returncode == 0, result.stdout + result.stderr
