"""Generated texts agree with the channel table, the header compiles, and each role gets its own rights."""

import ctypes
import datetime as dt
import json
import re
import shutil
import subprocess
from typing import Any

import pytest

from fog_contracts import channels as ch
from fog_contracts import messages as m
from fog_contracts.channels import CHANNELS
from fog_contracts.generate import message_fields, type_text
from fog_contracts.generate.acl import mqtt_acl, zenoh_acl
from fog_contracts.generate.header import firmware_header
from fog_contracts.generate.markdown import channels_markdown

OPENAPI = {
    "paths": {
        "/api/v1/zones/{zone_id}": {
            "delete": {
                "description": "Remove a zone | for good.\n\nMore.",
                "parameters": [{"name": "If-Match", "in": "header"}, {"name": "zone_id", "in": "path"}],
                "responses": {"204": {}, "412": {}, "422": {}, "default": {}},
                "security": [{"bearer": []}],
            },
            "get": {
                "summary": "One zone",
                "responses": {
                    "200": {"content": {"application/json": {"schema": {"$ref": "#/components/schemas/Zone"}}}}
                },
            },
        }
    }
}


def field(kind, name):
    return next(each for each in message_fields(kind) if each.name == name)


# --- Fields ---------------------------------------------------------------------------------------------------------


def test_a_type_without_a_word_is_named():
    class Odd(m.Message, frozen=True, kw_only=True):
        at: dt.time
        free: dict[str, Any]

    with pytest.raises(TypeError, match=r"TimeType.*give it one"):
        type_text(field(Odd, "at").type)
    assert type_text(field(Odd, "free").type) == "map of text to anything"


# --- The document ---------------------------------------------------------------------------------------------------


def test_document_lists_every_channel_and_describes_every_linked_message():
    text = channels_markdown({})
    for row in CHANNELS.values():
        assert "`" + row.template.replace("{", "<").replace("}", ">") + "`" in text
    headings = set(re.findall(r"^### (\w+)$", text, re.MULTILINE))
    linked = dict(re.findall(r"\[([A-Z]\w+)\]\(#(\w+)\)", text))
    assert all(anchor == name.lower() for name, anchor in linked.items())
    assert set(linked) <= headings
    assert {row.message.__name__ for row in CHANNELS.values() if row.message} <= headings


def test_document_row_shows_the_channels_properties():
    line = next(line for line in channels_markdown({}).splitlines() if "map/heartbeat`" in line)
    assert line == (
        "| `fog/<site>/map/heartbeat` | [MapHeartbeat](#mapheartbeat) | map-service → planner, robot-agent, "
        "console-service, bridge | `volatile` | 10 Hz | 1 s | 256 B |"
    )


def test_routes_are_listed_with_parameters_responses_and_token():
    lines = channels_markdown({"map-service": OPENAPI}).splitlines()
    assert (
        "| `DELETE /api/v1/zones/{zone_id}` | Remove a zone \\| for good. | `If-Match` |  | 204 | 412, 422 | yes |"
        in lines
    )
    assert "| `GET /api/v1/zones/{zone_id}` | One zone |  |  | 200 Zone |  |  |" in lines


# --- The firmware's header ------------------------------------------------------------------------------------------

PROGRAM = r"""
#include "fognav_contract.h"
#include "fognav_contract.h"
#include <stdio.h>
#include <string.h>
int main(void) {
    char topic[FOGNAV_NODE_READING_TOPIC_SIZE];
    const char *id = "abcdefghijklmnopqrstuvwxyz012345";
    int ranges[FOGNAV_NODE_READING_RANGE_M_ITEMS_MAX];
    if ((int)strlen(id) != FOGNAV_ID_MAX) return 1;
    if (snprintf(topic, sizeof topic, FOGNAV_NODE_READING_TOPIC, id, id) != (int)sizeof topic - 1) return 2;
    printf("%s\n%s\n%s\n", topic, FOGNAV_NODE_READING_STATUS_NO_ECHO, FOGNAV_NODE_AVAILABILITY_OFFLINE);
    printf("%d %d %d %d %d %d\n", FOGNAV_NODE_READING_LIMIT, FOGNAV_NODE_CONFIG_QOS, FOGNAV_NODE_CONFIG_RETAINED,
           (int)(sizeof ranges / sizeof *ranges), 1 - FOGNAV_NODE_READING_RSSI_MIN,
           FOGNAV_NODE_CONFIG_PAUSE_MS_DEFAULT);
    printf("%.1f %lld\n", FOGNAV_NODE_READING_RANGE_M_MAX, (long long)FOGNAV_NODE_READING_SEQ_MAX);
    return 0;
}
"""


@pytest.mark.parametrize(
    ("compiler", "suffix", "standard"), [("gcc", "c", "c99"), ("gcc", "c", "c17"), ("g++", "cpp", "c++17")]
)
def test_header_compiles_and_agrees_with_the_channel_table(tmp_path, compiler, suffix, standard):
    if shutil.which(compiler) is None:
        pytest.skip(f"{compiler} is not installed: apt-get install -y g++")
    (tmp_path / "fognav_contract.h").write_text(firmware_header())
    (tmp_path / f"main.{suffix}").write_text(PROGRAM)
    flags = [f"-std={standard}", "-Wall", "-Wextra", "-pedantic", "-Werror"]
    subprocess.run([compiler, *flags, f"main.{suffix}", "-o", "main"], cwd=tmp_path, check=True)
    done = subprocess.run([tmp_path / "main"], capture_output=True, text=True, check=True)
    longest = "abcdefghijklmnopqrstuvwxyz012345"
    assert done.stdout.splitlines() == [
        ch.NODE_READING.key(site=longest, node=longest), "no_echo", "offline", "1024 1 1 8 201 10",
        f"20.0 {2**53}",
    ]  # fmt: skip


def test_header_has_every_channel_of_a_node_and_no_other():
    topics = set(re.findall(r"#define FOGNAV_(\w+)_TOPIC ", firmware_header()))
    expected = {row.name.upper() for row in CHANNELS.values() if "node" in (*row.publishers, *row.subscribers)}
    assert topics == expected


def test_header_numbers_have_a_suffix_where_int_has_16_bits():
    for name, text in re.findall(r"#define (\w+) \(?(-?\d+)\)?(?= |$)", firmware_header(), re.MULTILINE):
        assert abs(int(text)) <= ctypes.c_int16(2**15 - 1).value, f"{name} needs a suffix where int has 16 bits"


# --- Access control -------------------------------------------------------------------------------------------------


def test_mqtt_acl_gives_each_role_the_rights_of_its_channels():
    sections = re.split(r"^user ", mqtt_acl("lab").partition("# a sensor node on the wall")[0], flags=re.MULTILINE)[1:]
    rights = {
        s.split("\n")[0]: [tuple(x.split()[1:3]) for x in s.splitlines() if x.startswith("topic")] for s in sections
    }
    assert rights["map-service"] == [
        ("read", "fog/v1/lab/areas/+/hazard"),
        ("read", "fog/v1/lab/areas/+/definition"),
        ("read", "fog/v1/lab/aggregator/heartbeat"),
        ("write", "fog/v1/lab/aggregator/request"),
        ("write", "fog/v1/lab/zone-sources/+/zones/+"),
        ("read", "fog/v1/lab/zone-sources/+/zones/+"),
        ("read", "fog/v1/lab/zone-sources/+/sets/+"),
        ("write", "fog/v1/lab/zone-sources/+/problem"),
    ]
    assert {access for access, _ in rights["recorder"]} == {"read"}
    assert rights["thesis-node"] == [("write", "+"), ("deny", "WSN")]
    assert ("write", "fog/v1/lab/areas/+/hazard") in rights["hazard-aggregator"]
    assert [role for role, lines in rights.items() if ("write", "fog/v1/lab/areas/+/hazard") in lines] == [
        "hazard-aggregator"
    ]


def rules(text):
    """Parse the router's list (JSON with comments and trailing commas) to keys by subject, flow and kind of message."""
    plain = re.sub(r",(\s*[\]}])", r"\1", re.sub(r"^//.*$", "", text, flags=re.MULTILINE))
    acl = json.loads(plain)["access_control"]
    assert acl["enabled"]
    assert acl["default_permission"] == "deny"
    by_id = {rule["id"]: rule for rule in acl["rules"]}
    assert len(by_id) == len(acl["rules"])
    subjects = {s["id"]: (s.get("usernames") or s["cert_common_names"])[0] for s in acl["subjects"]}
    assert all(len(s) == 2 for s in acl["subjects"]), (
        "a subject with both kinds of name would match only clients that have both"
    )
    rights = {}
    for policy in acl["policies"]:
        (name,) = {subjects[each] for each in policy["subjects"]}
        for rule in (by_id[each] for each in policy["rules"]):
            assert rule["permission"] == "allow"
            for flow in rule["flows"]:
                for message in rule["messages"]:
                    rights.setdefault((name, flow, message), set()).update(rule["key_exprs"])
    return rights


@pytest.mark.parametrize("row", [r for r in CHANNELS.values() if r.transport == "zenoh"], ids=lambda r: r.name)
def test_zenoh_acl_accepts_each_channel_from_its_publishers_only(row):
    message = {"pub": "put", "query": "reply", "liveliness": "liveliness_token"}[row.kind]
    key = row.pattern().replace("live/*/*", "live/{}/*")
    rights = rules(zenoh_acl())
    senders = {name for (name, flow, kind), keys in rights.items()
               if flow == "ingress" and kind == message and key.format(name) in keys}  # fmt: skip
    assert senders == set(row.publishers)


def test_console_watches_the_liveliness_of_all_roles_and_a_service_declares_only_its_own():
    rights = rules(zenoh_acl())
    for flow, message in (
        ("ingress", "declare_liveliness_subscriber"), ("ingress", "liveliness_query"), ("egress", "liveliness_token"),
    ):  # fmt: skip
        assert "fog/*/live/*/*" in rights["console", flow, message]
    declared = {key for key in rights["map-service", "ingress", "liveliness_token"] if "/live/" in key}
    assert declared == {"fog/*/live/map-service/*"}


def test_named_robots_may_publish_only_as_themselves():
    rights = rules(zenoh_acl("lab", ["r1", "r2"]))
    assert "fog/lab/robots/r1/pose" in rights["r1", "ingress", "put"]
    r1 = {key for (name, flow, _), keys in rights.items() if name == "r1" and flow == "ingress" for key in keys}
    assert not any("robots/r2" in key or "robots/*" in key for key in r1)
    learned = {kind for (name, flow, kind), keys in rights.items()
               if name == "r1" and flow == "egress" and any("robots/*" in key for key in keys)}  # fmt: skip
    assert learned <= {"declare_subscriber", "query"}, "of other robots, who listens and asks; nothing they publish"
    assert rights["r1", "ingress", "liveliness_token"] == {"fog/lab/live/robot-agent/r1"}
    assert not any(name == "robot-agent" for name, _, _ in rights)


@pytest.mark.parametrize("generate", [mqtt_acl, zenoh_acl, firmware_header, lambda: channels_markdown({"x": OPENAPI})])
def test_generated_text_is_deterministic_and_ends_with_a_newline(generate):
    assert generate() == generate()
    assert generate().endswith("\n")
    assert "fognav channels --write" in generate().split("#ifndef")[0][:400]
