"""The zenoh router's access control: what each role may send to it and is sent by it, by the channel table.

Everything that no rule allows is denied. A client says who it is by its user name or by its certificate's common name.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Literal

from fog_contracts.channels import CHANNELS, ROBOT, ROLES, Channel, Role
from fog_contracts.generate import NOTE

if TYPE_CHECKING:
    from collections.abc import Sequence

Flow = Literal["ingress", "egress"]

_HEAD: Final = f"""\
// Who may publish, subscribe, ask and answer through the zenoh router: a part of its configuration.
// {NOTE}
//
// A client is known by its user name (transport/auth/usrpwd) or by its certificate's common name (mutual TLS).
// %s
// What no rule allows is denied.
// ingress: what the router accepts from a client; egress: what it passes on to one. `@adv` is zenoh's own: by it an
// advanced publisher offers what it keeps, and an advanced subscriber recovers what it missed.
"""
_ROLES_ONLY: Final = "Each is named like its role; any robot may speak for any other: name the robots to forbid that."
_ROBOTS: Final = "Each is named like its role, but robots like their ids, and each speaks for itself only."


@dataclass
class _Rights:
    """Key expressions by flow and kind of message, for one subject."""

    keys: dict[tuple[Flow, str], list[str]] = field(default_factory=dict)

    def allow(self, flow: Flow, messages: str, *keys: str) -> None:
        for message in messages.split():
            known = self.keys.setdefault((flow, message), [])
            known += [key for key in keys if key not in known]

    def rules(self, name: str) -> list[dict[str, object]]:
        """Return the rules, with those messages in one that have the same keys."""
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


def zenoh_acl(site: str = "*", robots: Sequence[str] = ()) -> str:
    """Return the router's `access_control` as JSON5: for one site and its robots by id, or for all sites by role."""
    subjects: list[tuple[str, Role]] = []
    for role in ROLES:
        names = robots if role == ROBOT and robots else (role,)
        subjects += [(name, role) for name in names]
    rules: list[dict[str, object]] = []
    known: list[dict[str, object]] = []
    policies: list[dict[str, object]] = []
    for name, role in subjects:
        robot = name if role == ROBOT and robots else "*"
        found = _rights(role, site, robot).rules(name)
        if not found:
            continue
        rules += found
        by_user, by_certificate = f"{name} by user name", f"{name} by certificate"
        known += [{"id": by_user, "usernames": [name]}, {"id": by_certificate, "cert_common_names": [name]}]
        policies.append({"subjects": [by_user, by_certificate], "rules": [rule["id"] for rule in found]})
    return "".join(
        [
            _HEAD % (_ROBOTS if robots else _ROLES_ONLY),
            '{\n  "access_control": {\n    "enabled": true,\n    "default_permission": "deny",\n',
            *(_array(title, rows) for title, rows in (("rules", rules), ("subjects", known), ("policies", policies))),
            "  },\n}\n",
        ]
    )


def _array(title: str, rows: Sequence[dict[str, object]]) -> str:
    return f'    "{title}": [\n' + "".join(f"{_row(row)},\n" for row in rows) + "    ],\n"


def _row(row: dict[str, object]) -> str:
    keys = row.get("key_exprs")
    if not isinstance(keys, list):
        return f"      {json.dumps(row)}"
    head = json.dumps({name: value for name, value in row.items() if name != "key_exprs"}).removesuffix("}")
    listed = "".join(f"        {json.dumps(key)},\n" for key in keys)
    return f'      {head}, "key_exprs": [\n{listed}      ]}}'


def _rights(role: Role, site: str, robot: str) -> _Rights:
    rights = _Rights()
    for row in CHANNELS.values():
        if row.transport != "zenoh":
            continue
        key = _key(row, site, robot, role)
        offers = role in row.publishers
        takes = role in row.subscribers or (role == "recorder" and row.kind == "pub")
        if row.kind == "liveliness":
            if offers:
                rights.allow("ingress", "liveliness_token", key)
            if takes:
                rights.allow("ingress", "declare_liveliness_subscriber liveliness_query", key)
                rights.allow("egress", "liveliness_token", key)
            continue
        if offers:
            _allow_offering(rights, row, key)
        if takes:
            _allow_taking(rights, row, key)
    return rights


def _allow_offering(rights: _Rights, row: Channel, key: str) -> None:
    if row.kind == "query":
        rights.allow("ingress", "declare_queryable reply", key)
        rights.allow("egress", "query", key)
        return
    rights.allow("ingress", "put", key)
    rights.allow("egress", "declare_subscriber", key)
    if row.durability != "volatile":
        kept = f"{key}/@adv/**"
        rights.allow("ingress", "put declare_queryable reply liveliness_token", kept)
        rights.allow("ingress", "declare_queryable reply", key)
        rights.allow("egress", "declare_subscriber", kept)
        rights.allow("egress", "query", key, kept)


def _allow_taking(rights: _Rights, row: Channel, key: str) -> None:
    if row.kind == "query":
        rights.allow("ingress", "query", key)
        rights.allow("egress", "declare_queryable reply", key)
        return
    rights.allow("ingress", "declare_subscriber", key)
    rights.allow("egress", "put", key)
    if row.durability != "volatile":
        kept = f"{key}/@adv/**"
        rights.allow("ingress", "declare_subscriber declare_liveliness_subscriber liveliness_query", kept)
        rights.allow("ingress", "query", key, kept)
        rights.allow("egress", "put liveliness_token", kept)
        rights.allow("egress", "declare_queryable reply", key, kept)


def _key(row: Channel, site: str, robot: str, role: Role) -> str:
    own = {"site": site, "robot": robot}
    if row.kind == "liveliness" and role in row.publishers:
        own |= {"role": role, "id": robot}
    return row.template.format(**{name: own.get(name, "*") for name in row.fields})
