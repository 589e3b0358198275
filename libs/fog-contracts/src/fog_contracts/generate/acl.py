"""Access control of Mosquitto and the zenoh router: what each role may send and receive, by the channel table.

What no line or rule allows is denied. For Mosquitto a node's user name is the node's id (`%u`), any other is a role;
the router identifies a client by its user name or by its certificate's common name.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Literal

from fog_contracts.channels import AGGREGATOR, CHANNELS, NODE, ROBOT, ROLES, ZONE_SOURCE, Channel, Role
from fog_contracts.generate import NOTE

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

Access = Literal["read", "write"]

_BY_NAME: Final[Mapping[Role, str]] = {NODE: "node", ZONE_SOURCE: "source"}
"""Roles whose users have names of their own, and the variable part of topics that is this name."""

_HOME_ASSISTANTS_OWN: Final = ("homeassistant/status", "homeassistant/+/+/state")
"""Its birth and will messages, and the states of its entities (`mqtt_statestream` with the base `homeassistant`)."""
_MQTT_HEAD: Final = f"""\
# Who may publish and receive what through the MQTT broker: Mosquitto's `acl_file`.
# {NOTE}
#
# The user name of a sensor node, or a source of zones, is its id, any other user name is a role. Topics that no line
# allows are denied. A `pattern` line holds for every user, with the user name for %u, so no id may be a role's name.
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
    sections = [_MQTT_HEAD]
    roles = [role for role in ROLES if role not in _BY_NAME]
    sections += [_section(role, site, floors or {}) for role in roles if _lines(role, site)]
    sections += [f"user {user}\ntopic readwrite #\ntopic read $SYS/#\n" for user in unrestricted]
    for device, topics in (devices or {}).items():
        lines = [f"topic readwrite {topic}" for topic in topics]
        sections.append("\n".join(["# A device of others: only its own topics", f"user {device}", *lines, ""]))
    for floor, nodes in (floors or {}).items():
        sections += [_floor_section(role, floor) for role in roles if _floor_lines(role, floor)]
        sections += [_floor_member(floor, name) for name in nodes]
    sections += [_pattern(role, site) for role in _BY_NAME]
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


def _floor_member(floor: str, name: str) -> str:
    rights = [(*right, part) for role, part in _BY_NAME.items() for right in _mqtt_rights(role)]
    lines = [
        f"topic {access:5} {_topic(row, floor, **{part: name})}" for access, row, part in rights if "site" in row.fields
    ]
    about = " or ".join(ROLES[role] for role in _BY_NAME)
    return "\n".join([f"# {about} ({floor})", f"user {floor}.{name}", *lines, ""])


def _floor_lines(role: Role, floor: str) -> list[str]:
    return [f"{access:5} {_topic(row, floor)}" for access, row in _mqtt_rights(role) if "site" in row.fields]


def _pattern(role: Role, site: str) -> str:
    own = {_BY_NAME[role]: "%u"}
    lines = [f"pattern {access} {_topic(row, site, **own)}" for access, row in _mqtt_rights(role)]
    return "\n".join([f"# {ROLES[role]}: only its own topics", *lines, ""])


def _lines(role: Role, site: str) -> list[str]:
    rights = _mqtt_rights(role)
    lines = [f"{access:5} {_topic(row, site)}" for access, row in rights]
    allowed = {row for _, row in rights}
    # MQTT has no wildcard for part of a level: `area 3` needs `+`, so all other topics that match `+` are denied.
    one_level = [re.compile("[^/]+") for _, row in rights if "number" in row.fields]
    return lines + [
        f"deny  {row.template}"
        for row in CHANNELS.values()
        if row.transport == "mqtt" and row not in allowed and any(each.fullmatch(row.template) for each in one_level)
    ]


def _mqtt_rights(role: Role) -> list[tuple[Access, Channel]]:
    rights: list[tuple[Access, Channel]] = []
    for row in CHANNELS.values():
        if row.transport == "mqtt":
            if role in row.publishers:
                rights.append(("write", row))
            if role in row.subscribers or role == "recorder":
                rights.append(("read", row))
    return rights


def _topic(row: Channel, site: str, **own: str) -> str:
    if "number" in row.fields:
        return "+"
    return row.template.format(**{name: {"site": site, **own}.get(name, "+") for name in row.fields})


Flow = Literal["ingress", "egress"]

_ZENOH_HEAD: Final = f"""\
// Who may publish, subscribe, query and reply through the zenoh router: a part of its configuration.
// {NOTE}
//
// A client is identified by its user name (transport/auth/usrpwd) or by its certificate's common name (mutual TLS).
// %s
// What no rule allows is denied.
// ingress: what the router accepts from a client; egress: what it forwards to one. Below `@adv`, zenoh's own suffix, an
// advanced publisher serves its cache, from which an advanced subscriber recovers missed messages.
"""
_ROLES_ONLY: Final = (
    "The name is the role; a robot may publish as any other robot: generate with the robots' ids to forbid that."
)
_ROBOTS: Final = "The name is the role, for a robot its id; a robot may publish only as itself."

_EVERYTHING: Final[dict[str, object]] = {
    "id": "everything",
    "permission": "allow",
    "flows": ["ingress", "egress"],
    "messages": [
        "put", "delete", "declare_subscriber", "query", "declare_queryable", "reply", "liveliness_token",
        "liveliness_query", "declare_liveliness_subscriber",
    ],
    "key_exprs": ["**", "**/@adv/**"],  # a chunk that begins with @ is no part of **
}  # fmt: skip


@dataclass
class _Rights:
    """Key expressions by flow and kind of message, for one subject."""

    keys: dict[tuple[Flow, str], list[str]] = field(default_factory=dict)

    def allow(self, flow: Flow, messages: str, *keys: str) -> None:
        for message in messages.split():
            expressions = self.keys.setdefault((flow, message), [])
            expressions += [key for key in keys if key not in expressions]

    def rules(self, name: str) -> list[dict[str, object]]:
        """Return the rules; messages with the same keys share one."""
        merged: dict[tuple[Flow, tuple[str, ...]], list[str]] = {}
        for (flow, message), keys in self.keys.items():
            merged.setdefault((flow, tuple(keys)), []).append(message)
        return [
            {
                "id": f"{name} {number}",
                "permission": "allow",
                "flows": [flow],
                "messages": messages,
                "key_exprs": list(keys),
            }
            for number, ((flow, keys), messages) in enumerate(merged.items(), 1)
        ]


def zenoh_acl(
    site: str = "*",
    robots: Sequence[str] = (),
    *,
    unrestricted: Sequence[str] = (),
    floors: Mapping[str, Sequence[str]] | None = None,
    meshed: bool = False,
) -> str:
    """Return the router's `access_control` as JSON5: for one site and its robots by id, or for all sites by role.

    The users named in `unrestricted` may do everything. `floors` are further sites with their own users, named
    `SITE.NAME`, and their robots. With `meshed`, so may the router at the other end of a connection that this one has
    opened, which has checked its own clients: all that connect to this one come over a relay's Unix socket.
    """
    clients = _clients(site, robots)
    for floor, floor_robots in (floors or {}).items():
        clients += _clients(floor, floor_robots, f"{floor}.")
    rules: list[dict[str, object]] = []
    subjects: list[dict[str, object]] = []
    policies: list[dict[str, object]] = []
    if unrestricted:
        rules.append(_EVERYTHING)
        mesh: list[dict[str, object]] = [{"id": "other routers", "link_protocols": ["tls"]}] if meshed else []
        subjects += [{"id": "unrestricted", "usernames": list(unrestricted)}, *mesh]
        policies.append(
            {"subjects": ["unrestricted", *(str(each["id"]) for each in mesh)], "rules": [_EVERYTHING["id"]]}
        )
    for name, rights in clients:
        client_rules = rights.rules(name)
        if not client_rules:
            continue
        rules += client_rules
        by_user, by_certificate = f"{name} by user name", f"{name} by certificate"
        subjects += [{"id": by_user, "usernames": [name]}, {"id": by_certificate, "cert_common_names": [name]}]
        policies.append({"subjects": [by_user, by_certificate], "rules": [rule["id"] for rule in client_rules]})
    return "".join(
        [
            _ZENOH_HEAD % (_ROBOTS if robots else _ROLES_ONLY),
            '{\n  "access_control": {\n    "enabled": true,\n    "default_permission": "deny",\n',
            *(
                _array(title, rows)
                for title, rows in (("rules", rules), ("subjects", subjects), ("policies", policies))
            ),
            "  },\n}\n",
        ]
    )


def _clients(site: str, robots: Sequence[str], prefix: str = "") -> list[tuple[str, _Rights]]:
    """Return the users of a site, their names with a prefix, and what each may do."""
    clients = []
    for role in ROLES:
        if role == ROBOT and robots:
            clients += [(f"{prefix}{robot}", _zenoh_rights(role, site, robot)) for robot in robots]
        else:
            clients.append((f"{prefix}{role}", _zenoh_rights(role, site, "*")))
    return clients


def _array(title: str, rows: Sequence[dict[str, object]]) -> str:
    return f'    "{title}": [\n' + "".join(f"{_row(row)},\n" for row in rows) + "    ],\n"


def _row(row: dict[str, object]) -> str:
    keys = row.get("key_exprs")
    if not isinstance(keys, list):
        return f"      {json.dumps(row)}"
    head = json.dumps({name: value for name, value in row.items() if name != "key_exprs"}).removesuffix("}")
    listed = "".join(f"        {json.dumps(key)},\n" for key in keys)
    return f'      {head}, "key_exprs": [\n{listed}      ]}}'


def _zenoh_rights(role: Role, site: str, robot: str) -> _Rights:
    rights = _Rights()
    for row in CHANNELS.values():
        if row.transport != "zenoh":
            continue
        key = _key(row, site, robot)
        publishes = role in row.publishers
        subscribes = role in row.subscribers or (role == "recorder" and row.kind == "pub")
        if row.kind == "liveliness":
            if publishes:
                # A process declares its own presence only, even if it may watch that of all.
                rights.allow("ingress", "liveliness_token", _key(row, site, robot, role=role, id=robot))
            if subscribes:
                rights.allow("ingress", "declare_liveliness_subscriber liveliness_query", key)
                rights.allow("egress", "liveliness_token", key)
            continue
        if publishes:
            _allow_publishing(rights, row, key, _key(row, site, "*"))
        if subscribes:
            _allow_subscribing(rights, row, key)
    return rights


def _allow_publishing(rights: _Rights, row: Channel, key: str, all_keys: str) -> None:
    """Allow to publish or answer on `key`, to those who subscribe to or ask for `all_keys` (the same of all robots).

    A publisher sends only after it was told of a subscription that meets its key. The fog subscribes to all robots at
    once, and a rule for one robot's key does not cover that subscription.
    """
    if row.kind == "query":
        rights.allow("ingress", "declare_queryable reply", key)
        rights.allow("egress", "query", all_keys)
        return
    rights.allow("ingress", "put", key)
    rights.allow("egress", "declare_subscriber", all_keys)
    if row.durability != "volatile":
        cache, all_caches = f"{key}/@adv/**", f"{all_keys}/@adv/**"
        rights.allow("ingress", "put declare_queryable reply liveliness_token", cache)
        rights.allow("ingress", "declare_queryable reply", key)
        rights.allow("egress", "declare_subscriber", all_caches)
        rights.allow("egress", "query", all_keys, all_caches)


def _allow_subscribing(rights: _Rights, row: Channel, key: str) -> None:
    if row.kind == "query":
        rights.allow("ingress", "query", key)
        rights.allow("egress", "declare_queryable reply", key)
        return
    rights.allow("ingress", "declare_subscriber", key)
    rights.allow("egress", "put", key)
    if row.durability != "volatile":
        cache = f"{key}/@adv/**"
        rights.allow("ingress", "declare_subscriber declare_liveliness_subscriber liveliness_query", cache)
        rights.allow("ingress", "query", key, cache)
        rights.allow("egress", "put liveliness_token", cache)
        rights.allow("egress", "declare_queryable reply", key, cache)


def _key(row: Channel, site: str, robot: str, **other_ids: str) -> str:
    ids = {"site": site, "robot": robot, **other_ids}
    return row.template.format(**{name: ids.get(name, "*") for name in row.fields})
