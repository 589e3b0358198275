"""Simulation and operators' tools use exactly the channels that the table gives their roles; no row lists more."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from fog_contracts import channels as ch

if TYPE_CHECKING:
    from fog_contracts.channels import Role

SERVICES: dict[Role, str] = {
    "hazard-aggregator": "services/hazard-aggregator/src",
    "map-service": "services/map-service/src",
    "planner": "services/planner/src",
    "robot-agent": "robot-agent/src",
}
OPERATOR_COMMANDS = "libs/fog-runtime/src/fog_runtime/robot_commands.py"
"""Used by the operators' tools alone."""
TOOLS = ("cli/src", "sim/src", "experiments/src")


def module(path: Path) -> Any:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


usage = module(Path(__file__).parent / "channel_usage.py")


def role_of(use: Any) -> Role:
    """Return the role in which the simulation and the operators' tools make a call."""
    if use.place.startswith("sim/") and "robot_unit.py" not in use.place:
        return "node" if use.channel.transport == "mqtt" else "sim"
    return "console"


def used_by_tools() -> set[tuple[str, str, Role]]:
    return {
        (use.channel.name, use.side, role_of(use))
        for folder in ("cli/src", "sim/src", OPERATOR_COMMANDS)
        for use in usage.uses(folder)
    }


def in_table(*roles: Role) -> set[tuple[str, str, Role]]:
    return {
        (row.name, side, role)
        for row in ch.CHANNELS.values()
        for side in ("publishers", "subscribers")
        for role in getattr(row, side)
        if role in roles and row.kind != "liveliness" and (role, row) not in usage.NOT_YET
    }


def test_simulation_and_operators_tools_use_exactly_the_channels_that_the_table_gives_them():
    found = {use for use in used_by_tools() if use[2] != "node"}
    assert found == in_table("console", "sim")
    assert len(found) > 10


def test_simulated_nodes_use_channels_that_the_table_gives_to_nodes():
    found = {use for use in used_by_tools() if use[2] == "node"}
    assert found <= in_table("node")
    assert ("node_reading", "publishers", "node") in found


@pytest.mark.drive
def test_exactly_the_services_that_the_table_names_declare_liveliness_and_read_it():
    declaring = {role for role, folder in SERVICES.items() if usage.liveliness_declared(folder) == {role}}
    assert declaring == set(ch.LIVE.publishers)
    assert not any(usage.liveliness_declared(tool) for tool in TOOLS)
    reading = {folder for folder in (*SERVICES.values(), *TOOLS) if usage.liveliness_read(folder)}
    assert reading == {"cli/src", SERVICES["map-service"], SERVICES["planner"]}
    assert set(ch.LIVE.subscribers) == {"console", "map-service", "planner"}


@pytest.mark.drive
def test_every_session_is_opened_in_the_role_of_its_program():
    opened = {folder: usage.session_roles(folder) for folder in (*SERVICES.values(), *TOOLS)}
    assert {role: set(opened[folder].values()) for role, folder in SERVICES.items()} == {r: {r} for r in SERVICES}
    assert opened["cli/src"] == {
        "cli/src/fognav/recording.py:record": "recorder",
        # It publishes what other roles published, for which no role has the right.
        "cli/src/fognav/recording.py:play": "console",
        "cli/src/fognav/demo/attempt.py:_open": "console",
        "cli/src/fognav/operate/robot_commands.py:connect": "console",
        "cli/src/fognav/commands/status.py:_connected": "console",
    }
    assert set(opened["sim/src"].values()) == {"console", "sim"}


def test_every_exception_from_the_table_is_a_right_in_it():
    assert all(role in (*row.publishers, *row.subscribers) for role, row in usage.NOT_YET)
