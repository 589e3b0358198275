"""The one table of channels: key, message, size limit, who publishes, who subscribes, durability, rate, maximum age.

Both edges, the freshness limits of every receiver, `docs/channels.md`, the brokers' access control lists and the
firmware's header derive from it; no other file contains a topic or key.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property, partial
from typing import Final, Literal

from fog_contracts import messages as m

Transport = Literal["mqtt", "zenoh"]
Kind = Literal["pub", "query", "liveliness"]
Encoding = Literal["json", "msgpack", "text"]
Durability = Literal["volatile", "latest", "recovered"]
Role = Literal[
    "node", "thesis-node", "thesis-robot", "zone-source", "home-assistant", "hazard-aggregator", "map-service",
    "planner", "robot-agent", "console-service", "bridge", "console", "sim", "recorder",
]  # fmt: skip

ROLES: Final[Mapping[Role, str]] = {
    "node": "a sensor node",
    "thesis-node": "a sensor node that publishes on the thesis's topics",
    "thesis-robot": "a robot that subscribes to the thesis's topic",
    "zone-source": "a system of others that puts zones on the map",
    "home-assistant": "Home Assistant, which discovers nodes, areas and robots",
    "hazard-aggregator": "turns readings into the state of each area",
    "map-service": "maintains the costmap",
    "planner": "plans paths and stores missions",
    "robot-agent": "a robot's agent",
    "console-service": "shows the state of everything to people's browsers, and changes nothing",
    "bridge": "`fognav bridge`: tells other systems of robots, and takes orders from them",
    "console": "operators' tools: the `fognav` command, the demo and its page, the simulated robot's operator",
    "sim": "the simulated world",
    "recorder": "`fognav record`: subscribes to everything and publishes nothing",
}
"""The processes that may publish on a channel or subscribe to it."""

DURABILITIES: Final[Mapping[Durability, str]] = {
    "volatile": "a late subscriber waits for the next message; a lost one stays lost",
    "latest": "a late subscriber is given the latest message of each key at once; older ones may be lost",
    "recovered": "a late subscriber is given the recent messages; from the first one that arrives, lost ones are sent "
    "again and all arrive in order",
}
"""How messages reach a subscriber that missed them. MQTT: `latest` is retained, `recovered` does not exist.

Zenoh passes over what is recent if a newer message overtakes it while publisher and subscriber get to know each other:
messages of a recovered channel carry a version by which this is noticed.
"""

BROKER_NAME: Final = "mosquitto"
"""A name in the certificate of every broker of ours: a node that is told an address checks this instead of it.

The TLS library of the ESP8266 compares names only, never addresses.
"""

ID_MAX: Final = 32
"""Characters of the longest id."""
_ID: Final = rf"[a-z0-9][a-z0-9-]{{0,{ID_MAX - 1}}}"
_FIELDS: Final[Mapping[str, str]] = {"number": r"[0-9]{1,4}", "robot_device": f"robot_{_ID}"}


@dataclass(frozen=True, eq=False)
class Channel:
    """One row of the table. Channels are compared and hashed by identity: they are keys of tables of handlers.

    `template` names the variable parts in braces. `message` is the type of what is published or, for a query, of the
    request (None: text, or a query without a request), and `reply` the type of the reply; publishers of a query answer
    it, subscribers send it. A published zenoh channel of durability `latest` can also be queried for its latest
    message, without a request.
    `limit` and `reply_limit` are in bytes. `rate_hz` is the rate in normal operation (None: on change), `idle_hz` that
    of a publisher with nothing new to tell (None: the same). A value that arrived more than `max_age_s` ago is stale
    (infinite: it holds until the next, or the message says how long).
    """

    name: str
    template: str
    message: type[m.Message] | None
    _: KW_ONLY
    transport: Transport
    kind: Kind
    encoding: Encoding
    limit: int = 0
    publishers: tuple[Role, ...]
    subscribers: tuple[Role, ...]
    durability: Durability
    reply: type[m.Message] | None = None
    reply_limit: int = 0
    rate_hz: float | None = None
    idle_hz: float | None = None
    max_age_s: float = math.inf
    qos: Literal[0, 1] = 0
    values: tuple[str, ...] = ()
    """The payloads of a text channel with a fixed set of them."""
    about: str = ""
    """Description of the payload of a channel without a message type."""
    epoch: str = ""
    """The message's field with its publisher's epoch: one copy leads at a time, and receivers refuse the others."""
    fields: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "fields", tuple(re.findall(r"\{(\w+)\}", self.template)))

    @property
    def retained(self) -> bool:
        """Whether the MQTT broker keeps the latest message."""
        return self.transport == "mqtt" and self.durability == "latest"

    @property
    def period_s(self) -> float:
        """Seconds between two messages in normal operation; infinite for what is published on change only."""
        return math.inf if self.rate_hz is None else 1.0 / self.rate_hz

    @property
    def idle_period_s(self) -> float:
        """Seconds between two messages of a publisher with nothing new to tell."""
        return self.period_s if self.idle_hz is None else 1.0 / self.idle_hz

    def key(self, **ids: str) -> str:
        """Return the topic or key with these ids; raises `ValueError` for a missing, unknown or malformed id."""
        if set(ids) != set(self.fields):
            raise ValueError(f"channel {self.name} needs the ids {sorted(self.fields)}, not {sorted(ids)}")
        for name, value in ids.items():
            if not re.fullmatch(_FIELDS.get(name, _ID), value):
                raise ValueError(f"channel {self.name}: {name} {value!r} is not a valid id ({_FIELDS.get(name, _ID)})")
        return self.template.format(**ids)

    def pattern(self, **ids: str) -> str:
        """Return the subscription with a wildcard (`+` in MQTT, `*` in zenoh) for every id that is not given."""
        wildcard = "+" if self.transport == "mqtt" else "*"
        if "number" in self.fields and "number" not in ids:
            raise ValueError(f"channel {self.name}: MQTT has no wildcard for part of a level: give the number")
        parts = {name: ids.get(name, wildcard) for name in self.fields}
        return self.template.format(**parts)

    @cached_property
    def _regex(self) -> re.Pattern[str]:
        parts = re.split(r"\{(\w+)\}", self.template)
        literal, names = parts[0::2], parts[1::2]
        groups = (f"(?P<{name}>{_FIELDS.get(name, _ID)})" for name in names)
        pairs = zip(literal, [*groups, ""], strict=True)
        return re.compile("".join(re.escape(text) + group for text, group in pairs))

    def match(self, key: str) -> dict[str, str] | None:
        """Return the ids in a topic or key, or None when it does not belong to this channel."""
        found = self._regex.fullmatch(key)
        return found.groupdict() if found else None


KIB: Final = 1024
MIB: Final = 1024 * 1024
DELTA_LIMIT: Final = 64 * KIB

# --- The table ------------------------------------------------------------------------------------------------------

V1: Final = "fog/v1/{site}/"
FOG: Final = "fog/{site}/"

NODE: Final = "node"
AGGREGATOR: Final = "hazard-aggregator"
MAP: Final = "map-service"
PLANNER: Final = "planner"
ROBOT: Final = "robot-agent"
CONSOLE: Final = "console"
WEB: Final = "console-service"
BRIDGE: Final = "bridge"
SIM: Final = "sim"
ZONE_SOURCE: Final = "zone-source"

VOLATILE: Final = "volatile"
LATEST: Final = "latest"
RECOVERED: Final = "recovered"

ONLINE: Final = "online"
OFFLINE: Final = "offline"
BLOCKED: Final = "blocked"
CLEAR: Final = "clear"
ON: Final = "on"
OFF: Final = "off"
REPUBLISH: Final = "republish"
CALIBRATE: Final = "calibrate"
LEARN_NO_ECHO: Final = "learn-no-echo"
KEEP: Final = "keep"

_mqtt = partial(Channel, transport="mqtt", kind="pub", encoding="json")
_text = partial(Channel, transport="mqtt", kind="pub", encoding="text", message=None)
_pub = partial(Channel, transport="zenoh", kind="pub", encoding="msgpack")
_query = partial(Channel, transport="zenoh", kind="query", encoding="msgpack", durability=VOLATILE)
_live = partial(Channel, transport="zenoh", kind="liveliness", encoding="msgpack", message=None, durability=LATEST)

# fmt: off
# Sensor nodes and areas: MQTT, JSON or text
NODE_AVAILABILITY = _text( "node_availability", V1 + "nodes/{node}/availability",                       limit=16,
    publishers=(NODE,),          subscribers=(AGGREGATOR, CONSOLE, WEB), durability=LATEST,   qos=1,
    values=(ONLINE, OFFLINE), about="whether a node is connected; `offline` is its last will")
NODE_READING      = _mqtt( "node_reading",      V1 + "nodes/{node}/reading",          m.NodeReading,    limit=KIB,
    publishers=(NODE,),          subscribers=(AGGREGATOR, CONSOLE), durability=VOLATILE, qos=0, rate_hz=10,
    idle_hz=1, max_age_s=m.UnknownPolicy().silent_after_s)
NODE_VALUE        = _mqtt( "node_value",        V1 + "nodes/{node}/value",            m.NodeValue,      limit=KIB,
    publishers=(NODE,),          subscribers=(AGGREGATOR,),       durability=VOLATILE, qos=0)
NODE_CONFIG       = _mqtt( "node_config",       V1 + "nodes/{node}/config",           m.NodeConfig,     limit=KIB,
    publishers=(AGGREGATOR,),    subscribers=(NODE,),             durability=LATEST,   qos=1)
NODE_COMMAND      = _text( "node_command",      V1 + "nodes/{node}/command",                            limit=32,
    publishers=(CONSOLE,),       subscribers=(NODE,),             durability=VOLATILE, qos=1,
    values=(CALIBRATE, LEARN_NO_ECHO, KEEP),
    about="what a node is to learn while nobody is in its sonars' way, and that what it learned is to count")
NODE_CALIBRATION  = _mqtt( "node_calibration",  V1 + "nodes/{node}/calibration",      m.NodeCalibration, limit=KIB,
    publishers=(NODE,),          subscribers=(CONSOLE,),          durability=LATEST,   qos=1)
NODE_UPDATE       = _mqtt( "node_update",       V1 + "nodes/{node}/update",           m.NodeUpdate,     limit=KIB,
    publishers=(CONSOLE,),       subscribers=(NODE,),             durability=LATEST,   qos=1)
NODE_PROBLEM      = _text( "node_problem",      V1 + "nodes/{node}/problem",                            limit=256,
    publishers=(NODE,),          subscribers=(CONSOLE,),          durability=LATEST,   qos=1,
    about="why a node refused its latest configuration, command or update, in words; empty: nothing refused")
AREA_HAZARD       = _mqtt( "area_hazard",       V1 + "areas/{area}/hazard",           m.AreaHazard,     limit=16 * KIB,
    publishers=(AGGREGATOR,),    subscribers=(AGGREGATOR, MAP, "home-assistant", WEB), durability=LATEST, qos=1,
    epoch="epoch")
AREA_DEFINITION   = _mqtt( "area_definition",   V1 + "areas/{area}/definition",       m.AreaDefinition, limit=32 * KIB,
    publishers=(AGGREGATOR,),    subscribers=(MAP, WEB),          durability=LATEST,   qos=1, epoch="epoch")
AGGREGATOR_HEARTBEAT = _mqtt("aggregator_heartbeat", V1 + "aggregator/heartbeat", m.AggregatorHeartbeat,
    limit=64 * KIB,
    publishers=(AGGREGATOR,),    subscribers=(AGGREGATOR, MAP),   durability=VOLATILE, qos=0, rate_hz=5,
    max_age_s=1.3, epoch="epoch")
AGGREGATOR_AVAILABILITY = _text("aggregator_availability", V1 + "aggregator/availability",              limit=16,
    publishers=(AGGREGATOR,),    subscribers=(AGGREGATOR, "home-assistant"), durability=LATEST, qos=1,
    values=(ONLINE, OFFLINE), about="whether the aggregator is connected; `offline` is its last will")
AGGREGATOR_ALERTS = _mqtt( "aggregator_alerts", V1 + "aggregator/alerts",             m.AlertList,      limit=64 * KIB,
    publishers=(AGGREGATOR,),    subscribers=("home-assistant", WEB), durability=LATEST,   qos=1, epoch="epoch")
AGGREGATOR_REQUEST = _text("aggregator_request", V1 + "aggregator/request",                             limit=16,
    publishers=(MAP,),           subscribers=(AGGREGATOR,),       durability=VOLATILE, qos=0,
    values=(REPUBLISH,), about="asks the aggregator to publish all areas again: a subscriber has missed some")
ZONE_REQUEST      = _mqtt( "zone_request",      V1 + "zone-sources/{source}/zones/{zone}", m.ZoneRequest,
    limit=16 * KIB,
    publishers=(ZONE_SOURCE, MAP), subscribers=(MAP,),            durability=LATEST,   qos=1)
ZONE_SET_SWITCH   = _text( "zone_set_switch",   V1 + "zone-sources/{source}/sets/{set}",                limit=16,
    publishers=(ZONE_SOURCE,),   subscribers=(MAP,),              durability=VOLATILE, qos=1,
    values=(ON, OFF), about="switches a set of zones that `site.toml` names for the source")
ZONE_SOURCE_PROBLEM = _text("zone_source_problem", V1 + "zone-sources/{source}/problem",                limit=KIB,
    publishers=(MAP,),           subscribers=(ZONE_SOURCE,),      durability=LATEST,   qos=1,
    about="why the map-service refused the source's latest message, in words; empty: it did not")
THESIS_AREA       = _text( "thesis_area",       "area {number}",                                        limit=16,
    publishers=("thesis-node",), subscribers=(AGGREGATOR,),       durability=VOLATILE, qos=0,
    values=(BLOCKED, CLEAR), about="state of a thesis node's area")
THESIS_WSN        = _text( "thesis_wsn",        "WSN",                                                  limit=64,
    publishers=(AGGREGATOR,),    subscribers=("thesis-robot",),   durability=VOLATILE, qos=1,
    about="`n,x,y` for a blocked area, `n,-999,-999` for a clear one")
HOME_ASSISTANT    = _text( "home_assistant",    "homeassistant/device/{node}/config",                   limit=8 * KIB,
    publishers=(NODE,),          subscribers=("home-assistant",), durability=LATEST,   qos=1,
    about="Home Assistant's device discovery of a node (JSON)")
HOME_ASSISTANT_AREA = _text("home_assistant_area", "homeassistant/device/{site}/{area}/config",         limit=8 * KIB,
    publishers=(AGGREGATOR,),    subscribers=("home-assistant",), durability=LATEST,   qos=1,
    about="Home Assistant's device discovery of an area (JSON)")

# Robots and the map for Home Assistant: MQTT, text
HOME_ASSISTANT_ROBOT = _text("home_assistant_robot", "homeassistant/device/{site}/{robot_device}/config", limit=8 * KIB,
    publishers=(BRIDGE,),        subscribers=("home-assistant",), durability=LATEST,   qos=1,
    about="Home Assistant's device discovery of a robot, `robot_` and its id (JSON)")
ROBOT_REPORT      = _text( "robot_report",      V1 + "robots/{robot}/report",                           limit=2 * KIB,
    publishers=(BRIDGE,),        subscribers=("home-assistant", BRIDGE), durability=LATEST, qos=1,
    about="what a robot does, why it stands, its battery and goal (JSON)")
ROBOT_ORDER       = _text( "robot_order",       V1 + "robots/{robot}/order",                            limit=64,
    publishers=("home-assistant",), subscribers=(BRIDGE,),        durability=VOLATILE, qos=1,
    about="`stop`, `cancel`, `return_to_base`, or `goal ` and a place's id")
ROBOT_REFUSAL     = _text( "robot_refusal",     V1 + "robots/{robot}/refusal",                          limit=KIB,
    publishers=(BRIDGE,),        subscribers=("home-assistant",), durability=LATEST,   qos=1,
    about="why the robot's latest order was refused, in words; empty: it was not")
MAP_PICTURE       = _text( "map_picture",       V1 + "map/picture",                                     limit=192 * KIB,
    publishers=(BRIDGE,),        subscribers=("home-assistant",), durability=LATEST,   qos=1,
    about="the floor with what is blocked and the robots on it (PNG in base64)")
MAP_PICTURE_PLACE = _text( "map_picture_place", V1 + "map/picture/place",                               limit=KIB,
    publishers=(BRIDGE,),        subscribers=("home-assistant",), durability=LATEST,   qos=1,
    about="where the picture's pixels lie on the floor (JSON)")
BRIDGE_AVAILABILITY = _text("bridge_availability", V1 + "bridge/availability",                          limit=16,
    publishers=(BRIDGE,),        subscribers=("home-assistant",), durability=LATEST,   qos=1,
    values=(ONLINE, OFFLINE), about="whether the bridge knows the floor's state; `offline` is its last will")

# The map, and the hazards and zones in it: zenoh, msgpack
MAP_DELTA         = _pub(  "map_delta",         FOG + "map/delta",      m.MapDelta,     limit=DELTA_LIMIT,
    publishers=(MAP,), subscribers=(PLANNER, ROBOT, WEB, BRIDGE), durability=RECOVERED, epoch="epoch")
MAP_HEARTBEAT     = _pub(  "map_heartbeat",     FOG + "map/heartbeat",  m.MapHeartbeat, limit=256,
    publishers=(MAP,), subscribers=(PLANNER, ROBOT, WEB, BRIDGE), durability=VOLATILE, rate_hz=10, max_age_s=1,
    epoch="epoch")
MAP_SNAPSHOT      = _query("map_snapshot",      FOG + "map/snapshot",   None,           limit=0,
    publishers=(MAP,), subscribers=(PLANNER, ROBOT, WEB, BRIDGE), reply=m.MapSnapshot, reply_limit=64 * MIB)
HAZARD            = _pub(  "hazard",            FOG + "hazards/{area}", m.HazardArea,   limit=64 * KIB,
    publishers=(MAP,), subscribers=(PLANNER, ROBOT, CONSOLE, WEB, BRIDGE), durability=LATEST, epoch="epoch")
ZONES             = _pub(  "zones",             FOG + "zones",          m.ZoneSet,      limit=4 * MIB,
    publishers=(MAP,), subscribers=(PLANNER, ROBOT, WEB, BRIDGE), durability=LATEST, epoch="epoch")

PLACES            = _pub(  "places",            FOG + "places",         m.PlaceSet,     limit=MIB,
    publishers=(MAP,), subscribers=(PLANNER, WEB), durability=LATEST, epoch="epoch")

# Planner and robots, and what other systems report: zenoh, msgpack
PLANNER_PLAN      = _query("planner_plan",      FOG + "planner/plan",             m.PlanRequest,    limit=KIB,
    publishers=(PLANNER,), subscribers=(CONSOLE,),         reply=m.PlanReply, reply_limit=4 * MIB)
PLANNER_EGRESS    = _query("planner_egress",    FOG + "planner/egress",           m.EgressRequest,  limit=KIB,
    publishers=(PLANNER,), subscribers=(ROBOT,),           reply=m.PlanReply, reply_limit=4 * MIB)
PLANNER_DRY_RUN   = _query("planner_dry_run",   FOG + "planner/dry_run",          m.DryRunRequest,  limit=MIB,
    publishers=(PLANNER,), subscribers=(MAP,),             reply=m.DryRunReply, reply_limit=4 * MIB)
ROBOT_GOAL        = _pub(  "robot_goal",        FOG + "robots/{robot}/goal",      m.RobotGoal,      limit=2 * KIB,
    publishers=(PLANNER,), subscribers=(ROBOT, CONSOLE, WEB), durability=VOLATILE, rate_hz=0.2, epoch="planner_epoch")
ROBOT_PATH        = _pub(  "robot_path",        FOG + "robots/{robot}/path",      m.RobotPath,      limit=MIB,
    publishers=(PLANNER,), subscribers=(ROBOT, CONSOLE, WEB, BRIDGE), durability=LATEST, epoch="planner_epoch")
ROBOT_RELEASE     = _pub(  "robot_release",     FOG + "robots/{robot}/release",   m.RobotRelease,   limit=128,
    publishers=(PLANNER,), subscribers=(ROBOT, CONSOLE, WEB), durability=VOLATILE, rate_hz=2, max_age_s=1.5,
    epoch="planner_epoch")
ROBOT_POSE        = _pub(  "robot_pose",        FOG + "robots/{robot}/pose",      m.RobotPose,      limit=KIB,
    publishers=(ROBOT,), subscribers=(AGGREGATOR, MAP, PLANNER, CONSOLE, WEB, BRIDGE), durability=VOLATILE,
    rate_hz=10, idle_hz=2.5, max_age_s=1)
ROBOT_STATE       = _pub(  "robot_state",       FOG + "robots/{robot}/state",     m.RobotState,     limit=16 * KIB,
    publishers=(ROBOT,), subscribers=(MAP, PLANNER, CONSOLE, WEB, BRIDGE), durability=VOLATILE, rate_hz=1, max_age_s=3)
ROBOT_OBSTACLES   = _pub(  "robot_obstacles",   FOG + "robots/{robot}/obstacles", m.RobotObstacles, limit=64 * KIB,
    publishers=(ROBOT,),   subscribers=(MAP, CONSOLE, WEB, BRIDGE), durability=VOLATILE, rate_hz=1)
ROBOT_VITALS      = _pub(  "robot_vitals",      FOG + "robots/{robot}/vitals",    m.RobotVitals,    limit=512,
    publishers=(ROBOT,),   subscribers=(WEB,), durability=VOLATILE, rate_hz=0.5, max_age_s=6)
ROBOT_COMMAND     = _query("robot_command",     FOG + "robots/{robot}/command",   m.RobotCommand,   limit=8 * KIB,
    publishers=(ROBOT,),   subscribers=(PLANNER, CONSOLE), reply=m.CommandReply, reply_limit=2 * KIB)
LIFT_STATE        = _pub(  "lift_state",        FOG + "lifts/{lift}/state",       m.LiftState,      limit=16 * KIB,
    publishers=(SIM,), subscribers=(PLANNER,), durability=VOLATILE, rate_hz=1, max_age_s=3)
LIFT_REQUEST      = _pub(  "lift_request",      FOG + "lifts/{lift}/request",     m.LiftRequest,    limit=KIB,
    publishers=(PLANNER,), subscribers=(SIM,), durability=VOLATILE)
LEADER            = _pub(  "leader",            FOG + "leaders/{role}", m.Leader, limit=KIB,
    publishers=(AGGREGATOR, MAP, PLANNER), subscribers=(AGGREGATOR, MAP, PLANNER), durability=VOLATILE, rate_hz=4,
    max_age_s=1.5)
LIVE              = _live( "live",              FOG + "live/{role}/{id}", about="presence, no safety signal",
    publishers=(AGGREGATOR, MAP, PLANNER, ROBOT), subscribers=(MAP, PLANNER, CONSOLE))

REPORTED          = _pub(  "reported",          FOG + "reported/{thing}",         m.Reported,       limit=16 * KIB,
    publishers=(BRIDGE,), subscribers=(AGGREGATOR, MAP), durability=VOLATILE)

# The simulated world: zenoh, msgpack
SIM_TRUTH         = _pub(  "sim_truth",         FOG + "sim/{robot}/truth",   m.SimTruth,   limit=256 * KIB,
    publishers=(SIM,), subscribers=(CONSOLE,), durability=VOLATILE, rate_hz=10)
SIM_COMMAND       = _query("sim_command",       FOG + "sim/{robot}/command", m.SimCommand, limit=256 * KIB,
    publishers=(SIM,), subscribers=(CONSOLE,), reply=m.CommandReply, reply_limit=2 * KIB)
# fmt: on

CHANNELS: Final[Mapping[str, Channel]] = {row.name: row for row in list(globals().values()) if isinstance(row, Channel)}
"""All rows above by their names, in the table's order: a new row need not be listed anywhere else."""
