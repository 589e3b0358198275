"""The one table of channels: key, transport, message, encoding, rate, maximum age, size limit, who sends, who listens.

Freshness checks, access control lists, the docs and the firmware's header derive from it; nothing else spells a topic.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final, Literal

from fog_contracts import messages as m

Transport = Literal["mqtt", "zenoh"]
Kind = Literal["pub", "query", "liveliness"]
Encoding = Literal["json", "msgpack", "text"]

_ID = r"[a-z0-9][a-z0-9-]{0,31}"
_FIELDS: Final[Mapping[str, str]] = {"number": r"[0-9]{1,4}"}


@dataclass(frozen=True)
class Channel:
    """One row of the table.

    `template` names the variable parts in braces; `message` is what is published or, for a queryable, asked, and
    `reply` what it answers; `max_age_s` is when a receiver calls the latest value stale (None: it keeps).
    """

    name: str
    transport: Transport
    kind: Kind
    template: str
    message: type[m.Message] | None
    encoding: Encoding
    limit: int
    publishers: tuple[str, ...]
    subscribers: tuple[str, ...]
    reply: type[m.Message] | None = None
    reply_limit: int = 0
    rate_hz: float | None = None
    max_age_s: float | None = None
    qos: Literal[0, 1] = 0
    retained: bool = False
    recovered: bool = False
    about: str = ""
    fields: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "fields", tuple(re.findall(r"\{(\w+)\}", self.template)))

    def key(self, **ids: str) -> str:
        """Spell the topic or key with these ids; raises `ValueError` for a missing, unknown or malformed id."""
        if set(ids) != set(self.fields):
            raise ValueError(f"channel {self.name} needs the ids {sorted(self.fields)}, not {sorted(ids)}")
        for name, value in ids.items():
            if not re.fullmatch(_FIELDS.get(name, _ID), value):
                raise ValueError(f"channel {self.name}: {name} {value!r} is no id ({_FIELDS.get(name, _ID)})")
        return self.template.format(**ids)

    def pattern(self, **ids: str) -> str:
        """Spell the subscription for every id that is not given (`+` in MQTT, `*` in zenoh)."""
        wildcard = "+" if self.transport == "mqtt" else "*"
        if "number" in self.fields and "number" not in ids:
            raise ValueError(f"channel {self.name}: MQTT has no wildcard for a part of a level; subscribe per number")
        known = {name: ids.get(name, wildcard) for name in self.fields}
        return self.template.format(**known)

    @cached_property
    def _regex(self) -> re.Pattern[str]:
        parts = re.split(r"\{(\w+)\}", self.template)
        literal, names = parts[0::2], parts[1::2]
        groups = (f"(?P<{name}>{_FIELDS.get(name, _ID)})" for name in names)
        pairs = zip(literal, [*groups, ""], strict=True)
        return re.compile("".join(re.escape(text) + group for text, group in pairs))

    def match(self, key: str) -> dict[str, str] | None:
        """Return the ids in a topic or key of this channel, or None when it is not one."""
        found = self._regex.fullmatch(key)
        return found.groupdict() if found else None


KIB: Final = 1024
MIB: Final = 1024 * 1024
DELTA_LIMIT: Final = 64 * KIB

NODE_AVAILABILITY = Channel(
    "node_availability",
    "mqtt",
    "pub",
    "fog/v1/nodes/{node}/availability",
    None,
    "text",
    16,
    ("node",),
    ("hazard-aggregator",),
    qos=1,
    retained=True,
    about="`online`, or `offline` as the node's last will",
)
NODE_READING = Channel(
    "node_reading",
    "mqtt",
    "pub",
    "fog/v1/nodes/{node}/reading",
    m.NodeReading,
    "json",
    KIB,
    ("node",),
    ("hazard-aggregator",),
    rate_hz=10.0,
    max_age_s=3.0,
    about="one measurement of all sonars of a node",
)
NODE_VALUE = Channel(
    "node_value",
    "mqtt",
    "pub",
    "fog/v1/nodes/{node}/value",
    m.NodeValue,
    "json",
    KIB,
    ("node",),
    ("hazard-aggregator",),
    max_age_s=30.0,
    about="a danger that a number can tell",
)
NODE_CONFIG = Channel(
    "node_config",
    "mqtt",
    "pub",
    "fog/v1/nodes/{node}/config",
    m.NodeConfig,
    "json",
    KIB,
    ("hazard-aggregator",),
    ("node",),
    qos=1,
    retained=True,
    about="range limit per sonar, pause between measurements",
)
AREA_HAZARD = Channel(
    "area_hazard",
    "mqtt",
    "pub",
    "fog/v1/areas/{area}/hazard",
    m.AreaHazard,
    "json",
    4 * KIB,
    ("hazard-aggregator",),
    ("map-service",),
    qos=1,
    retained=True,
    about="the state of one area",
)
AREA_DEFINITION = Channel(
    "area_definition",
    "mqtt",
    "pub",
    "fog/v1/areas/{area}/definition",
    m.AreaDefinition,
    "json",
    32 * KIB,
    ("hazard-aggregator",),
    ("map-service",),
    qos=1,
    retained=True,
    about="where an area lies, who watches it, how it is judged",
)
THESIS_AREA = Channel(
    "thesis_area",
    "mqtt",
    "pub",
    "area {number}",
    None,
    "text",
    16,
    ("node",),
    ("hazard-aggregator",),
    about="`blocked` or `clear` from the thesis's nodes",
)
THESIS_WSN = Channel(
    "thesis_wsn",
    "mqtt",
    "pub",
    "WSN",
    None,
    "text",
    64,
    ("hazard-aggregator",),
    ("thesis-robot",),
    qos=1,
    about="`n,x,y`, or `n,-999,-999` when clear, for the thesis's robots",
)
HOME_ASSISTANT = Channel(
    "home_assistant",
    "mqtt",
    "pub",
    "homeassistant/device/{node}/config",
    None,
    "json",
    8 * KIB,
    ("hazard-aggregator", "node"),
    ("home-assistant",),
    qos=1,
    retained=True,
    about="Home Assistant's device discovery",
)

MAP_DELTA = Channel(
    "map_delta",
    "zenoh",
    "pub",
    "fog/{site}/map/delta",
    m.MapDelta,
    "msgpack",
    DELTA_LIMIT,
    ("map-service",),
    ("planner", "robot-agent", "console"),
    recovered=True,
    about="one window of a new map version",
)
MAP_HEARTBEAT = Channel(
    "map_heartbeat",
    "zenoh",
    "pub",
    "fog/{site}/map/heartbeat",
    m.MapHeartbeat,
    "msgpack",
    256,
    ("map-service",),
    ("planner", "robot-agent", "console"),
    rate_hz=10.0,
    max_age_s=1.0,
    about="the map version that holds now",
)
MAP_SNAPSHOT = Channel(
    "map_snapshot",
    "zenoh",
    "query",
    "fog/{site}/map/snapshot",
    None,
    "msgpack",
    0,
    ("map-service",),
    ("planner", "robot-agent", "console"),
    reply=m.MapSnapshot,
    reply_limit=64 * MIB,
    about="the whole map at one version",
)
HAZARD = Channel(
    "hazard",
    "zenoh",
    "pub",
    "fog/{site}/hazards/{area}",
    m.HazardArea,
    "msgpack",
    64 * KIB,
    ("map-service",),
    ("planner", "robot-agent", "console"),
    about="the reason behind cells: a hazard and its place; also queryable",
)
ZONES = Channel(
    "zones",
    "zenoh",
    "pub",
    "fog/{site}/zones",
    m.ZoneSet,
    "msgpack",
    4 * MIB,
    ("map-service",),
    ("planner", "robot-agent", "console"),
    about="the reason behind cells: all zones; also queryable",
)
PLANNER_PLAN = Channel(
    "planner_plan",
    "zenoh",
    "query",
    "fog/{site}/planner/plan",
    m.PlanRequest,
    "msgpack",
    KIB,
    ("planner",),
    ("robot-agent", "console"),
    reply=m.PlanReply,
    reply_limit=4 * MIB,
    about="goal to path or typed refusal, without side effects",
)
PLANNER_EGRESS = Channel(
    "planner_egress",
    "zenoh",
    "query",
    "fog/{site}/planner/egress",
    m.EgressRequest,
    "msgpack",
    KIB,
    ("planner",),
    ("robot-agent",),
    reply=m.PlanReply,
    reply_limit=4 * MIB,
    about="a way out for a robot inside a blocked area",
)
ROBOT_GOAL = Channel(
    "robot_goal",
    "zenoh",
    "pub",
    "fog/{site}/robots/{robot}/goal",
    m.RobotGoal,
    "msgpack",
    KIB,
    ("planner",),
    ("robot-agent", "console"),
    rate_hz=1.0,
    about="the mission",
)
ROBOT_PATH = Channel(
    "robot_path",
    "zenoh",
    "pub",
    "fog/{site}/robots/{robot}/path",
    m.RobotPath,
    "msgpack",
    MIB,
    ("planner",),
    ("robot-agent", "console"),
    rate_hz=2.0,
    max_age_s=1.5,
    about="the way with its released part, or the refusal",
)
ROBOT_POSE = Channel(
    "robot_pose",
    "zenoh",
    "pub",
    "fog/{site}/robots/{robot}/pose",
    m.RobotPose,
    "msgpack",
    KIB,
    ("robot-agent",),
    ("planner", "hazard-aggregator", "map-service", "console"),
    rate_hz=10.0,
    max_age_s=1.0,
    about="pose, covariance and twist",
)
ROBOT_STATE = Channel(
    "robot_state",
    "zenoh",
    "pub",
    "fog/{site}/robots/{robot}/state",
    m.RobotState,
    "msgpack",
    16 * KIB,
    ("robot-agent",),
    ("planner", "map-service", "console"),
    rate_hz=1.0,
    max_age_s=3.0,
    about="mode and reasons, on change and once a second",
)
ROBOT_OBSTACLES = Channel(
    "robot_obstacles",
    "zenoh",
    "pub",
    "fog/{site}/robots/{robot}/obstacles",
    m.RobotObstacles,
    "msgpack",
    64 * KIB,
    ("robot-agent",),
    ("map-service", "console"),
    rate_hz=1.0,
    max_age_s=3.0,
    about="what the lidar sees and the map doesn't know",
)
ROBOT_COMMAND = Channel(
    "robot_command",
    "zenoh",
    "query",
    "fog/{site}/robots/{robot}/command",
    m.RobotCommand,
    "msgpack",
    KIB,
    ("robot-agent",),
    ("console",),
    reply=m.CommandReply,
    reply_limit=2 * KIB,
    about="an operator's signed, single-use command",
)
LIVE = Channel(
    "live",
    "zenoh",
    "liveliness",
    "fog/{site}/live/{role}/{id}",
    None,
    "msgpack",
    0,
    ("hazard-aggregator", "map-service", "planner", "robot-agent"),
    ("console",),
    about="presence; no safety signal",
)

SIM_TRUTH = Channel(
    "sim_truth",
    "zenoh",
    "pub",
    "fog/{site}/sim/{robot}/truth",
    m.SimTruth,
    "msgpack",
    256 * KIB,
    ("sim",),
    ("console",),
    rate_hz=10.0,
    max_age_s=1.0,
    about="what is really so in the simulated world",
)
SIM_COMMAND = Channel(
    "sim_command",
    "zenoh",
    "query",
    "fog/{site}/sim/{robot}/command",
    m.SimCommand,
    "msgpack",
    256 * KIB,
    ("sim",),
    ("console",),
    reply=m.CommandReply,
    reply_limit=2 * KIB,
    about="change the simulated world",
)

CHANNELS: Final[Mapping[str, Channel]] = {
    channel.name: channel
    for channel in (
        NODE_AVAILABILITY, NODE_READING, NODE_VALUE, NODE_CONFIG, AREA_HAZARD, AREA_DEFINITION, THESIS_AREA,
        THESIS_WSN, HOME_ASSISTANT, MAP_DELTA, MAP_HEARTBEAT, MAP_SNAPSHOT, HAZARD, ZONES, PLANNER_PLAN,
        PLANNER_EGRESS, ROBOT_GOAL, ROBOT_PATH, ROBOT_POSE, ROBOT_STATE, ROBOT_OBSTACLES, ROBOT_COMMAND, LIVE,
        SIM_TRUTH, SIM_COMMAND,
    )
}  # fmt: skip


def find_channel(transport: Transport, key: str) -> tuple[Channel, dict[str, str]] | None:
    """Return the channel that a topic or key belongs to, with the ids in it."""
    for channel in CHANNELS.values():
        if channel.transport == transport and (ids := channel.match(key)) is not None:
            return channel, ids
    return None
