"""Mosquitto's access control list (`acl_file`): what each role may publish and what it is given, by the channel table.

A topic that no line allows is denied. A node's user is named like the node (`%u`); all other users like their role.
"""

from __future__ import annotations

import re
from typing import Final, Literal

from fog_contracts.channels import CHANNELS, NODE, ROLES, Channel, Role
from fog_contracts.generate import NOTE

Access = Literal["read", "write"]

_HEAD: Final = f"""\
# Who may publish what on the MQTT broker, and is given what: Mosquitto's `acl_file`.
# {NOTE}
#
# A sensor node's user is named like the node, all other users like their role. What no line allows is denied.
# A `pattern` line holds for every user, with its name for %u, so no node may be named like a role.
# Mosquitto 2.0 lets anybody subscribe and checks each message when it is delivered.
"""


def mqtt_acl(site: str = "+") -> str:
    """Return the list for one site, or without its id for all sites that share the broker."""
    sections = [_HEAD]
    sections += [_section(role, site) for role in ROLES if role != NODE and _lines(role, site)]
    sections.append(_nodes(site))
    return "\n".join(sections)


def _section(role: Role, site: str) -> str:
    lines = _lines(role, site)
    return "\n".join([f"# {ROLES[role]}", f"user {role}", *(f"topic {line}" for line in lines), ""])


def _nodes(site: str) -> str:
    lines = [f"pattern {access} {_topic(row, site, '%u')}" for access, row in _rights(NODE)]
    return "\n".join([f"# {ROLES[NODE]}: itself only", *lines, ""])


def _lines(role: Role, site: str) -> list[str]:
    rights = _rights(role)
    lines = [f"{access:5} {_topic(row, site)}" for access, row in rights]
    own = {row for _, row in rights}
    # MQTT knows no wildcard for a part of a level: `area 3` needs `+`, which must not let other topics in.
    broad = [re.compile("[^/]+") for _, row in rights if "number" in row.fields]
    return lines + [
        f"deny  {row.template}"
        for row in CHANNELS.values()
        if row.transport == "mqtt" and row not in own and any(each.fullmatch(row.template) for each in broad)
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
