"""Mosquitto's access control list (`acl_file`): what each role may publish and receive, by the channel table.

Topics that no line allows are denied. A node's user name is the node's id (`%u`), any other user name is a role.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final, Literal

from fog_contracts.channels import AGGREGATOR, CHANNELS, NODE, ROLES, Channel, Role
from fog_contracts.generate import NOTE

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

Access = Literal["read", "write"]

_HOME_ASSISTANTS_OWN: Final = ("homeassistant/status", "homeassistant/+/+/state")
"""Its birth and will messages, and the states of its entities (`mqtt_statestream` with the base `homeassistant`)."""
_HEAD: Final = f"""\
# Who may publish and receive what through the MQTT broker: Mosquitto's `acl_file`.
# {NOTE}
#
# A sensor node's user name is the node's id, any other user name is a role. Topics that no line allows are denied.
# A `pattern` line holds for every user, with the user name for %u, so no node's id may be a role's name.
# Mosquitto 2.0 accepts every subscription and checks each message when it is delivered.
"""


def mqtt_acl(
    site: str = "+",
    *,
    unrestricted: Sequence[str] = (),
    floors: Mapping[str, Sequence[str]] | None = None,
    devices: Mapping[str, Sequence[str]] | None = None,
) -> str:
    """Return the list for one site, or, without a site's id, for all sites that share the broker.

    The users named in `unrestricted` may publish and receive everything. `floors` are further sites with their own
    users, named `SITE.NAME`, and their nodes: each may only use topics that name its site, and so none of the thesis.
    The first site's Home Assistant is the building's: it reads what is for it on all floors, and may write its states.
    `devices` are sensors and gateways of others with the topics that they may use.
    """
    sections = [_HEAD]
    sections += [_section(role, site, floors or {}) for role in ROLES if role != NODE and _lines(role, site)]
    sections += [f"user {user}\ntopic readwrite #\ntopic read $SYS/#\n" for user in unrestricted]
    for device, topics in (devices or {}).items():
        lines = [f"topic readwrite {topic}" for topic in topics]
        sections.append("\n".join(["# A device of others: only its own topics", f"user {device}", *lines, ""]))
    for floor, nodes in (floors or {}).items():
        sections += [_floor_section(role, floor) for role in ROLES if role != NODE and _floor_lines(role, floor)]
        sections += [_floor_node(floor, node) for node in nodes]
    sections.append(_nodes(site))
    return "\n".join(sections)


def _section(role: Role, site: str, floors: Iterable[str]) -> str:
    lines = _lines(role, site)
    if role == AGGREGATOR:
        lines.append("read  #")  # a source of an area may publish on any topic
    if role == "home-assistant":
        lines += [line for floor in floors for line in _floor_lines(role, floor)]
        lines += [f"write {topic}" for topic in _HOME_ASSISTANTS_OWN]
    return "\n".join([f"# {ROLES[role]}", f"user {role}", *(f"topic {line}" for line in lines), ""])


def _floor_section(role: Role, floor: str) -> str:
    lines = _floor_lines(role, floor)
    if role == AGGREGATOR:
        # The thesis's topics, of one level, belong to the first site.
        lines += ["deny  +", "read  #"]
    return "\n".join([f"# {ROLES[role]} ({floor})", f"user {floor}.{role}", *(f"topic {line}" for line in lines), ""])


def _floor_node(floor: str, node: str) -> str:
    lines = [f"topic {access:5} {_topic(row, floor, node)}" for access, row in _rights(NODE) if "site" in row.fields]
    return "\n".join([f"# {ROLES[NODE]} ({floor})", f"user {floor}.{node}", *lines, ""])


def _floor_lines(role: Role, floor: str) -> list[str]:
    return [f"{access:5} {_topic(row, floor)}" for access, row in _rights(role) if "site" in row.fields]


def _nodes(site: str) -> str:
    lines = [f"pattern {access} {_topic(row, site, '%u')}" for access, row in _rights(NODE)]
    return "\n".join([f"# {ROLES[NODE]}: only its own topics", *lines, ""])


def _lines(role: Role, site: str) -> list[str]:
    rights = _rights(role)
    lines = [f"{access:5} {_topic(row, site)}" for access, row in rights]
    allowed = {row for _, row in rights}
    # MQTT has no wildcard for part of a level: `area 3` needs `+`, so all other topics that match `+` are denied.
    one_level = [re.compile("[^/]+") for _, row in rights if "number" in row.fields]
    return lines + [
        f"deny  {row.template}"
        for row in CHANNELS.values()
        if row.transport == "mqtt" and row not in allowed and any(each.fullmatch(row.template) for each in one_level)
    ]


def _rights(role: Role) -> list[tuple[Access, Channel]]:
    rights: list[tuple[Access, Channel]] = []
    for row in CHANNELS.values():
        if row.transport == "mqtt":
            if role in row.publishers:
                rights.append(("write", row))
            if role in row.subscribers or role == "recorder":
                rights.append(("read", row))
    return rights


def _topic(row: Channel, site: str, node: str = "+") -> str:
    if "number" in row.fields:
        return "+"
    return row.template.format(**{name: {"site": site, "node": node}.get(name, "+") for name in row.fields})
