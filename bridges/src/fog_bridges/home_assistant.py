"""Each robot as a device of Home Assistant, by MQTT discovery: a vacuum with battery, mission, goals, stop and map.

Home Assistant may stop a robot, end its mission, send it to a place or to its dock. It may not enable or reset one:
whoever does that has looked at the robot, and an automation has not. Topics: Home Assistant's documentation of
`vacuum.mqtt`, `select.mqtt`, `button.mqtt`, `image.mqtt` and "MQTT discovery". Pure.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

import msgspec

from fog_bridges.floor import Request
from fog_bridges.heard import SILENT, SILENT_S, Heard
from fog_contracts import channels as ch
from fog_contracts.handlers import Publication

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping, Sequence

STOP: Final = "stop"
CANCEL: Final = "cancel"
DOCK: Final = "return_to_base"
GOAL: Final = "goal "
"""What Home Assistant sends: a place's id follows."""
_NO_GOAL: Final = "no goal"
"""No place's id has a space, and Home Assistant takes "none" for an unknown choice."""
_ERRORS: Final = ("FAULT", "PROTECTIVE_STOP")
_CHARGING: Final = ("reconditioning", "bulk", "trickle")
_LOST: Final = "nobody knows the floor's state at the moment: send the goal again once the robot is available"
FORGET_S: Final = 600.0
"""A device of a robot of which the floor has told nothing for so long is deleted: it is no robot of the site any more.

A console that was started anew hears of robots that are switched off from the planner only, which may start later.
"""
_MOST: Final = 255
"""Characters of a state in Home Assistant."""


class HomeAssistant:
    """What Home Assistant is told of one floor, and what it may ask for."""

    def __init__(self, site: str) -> None:
        self._site = site
        self._robots: dict[str, dict[str, Any]] = {}
        self._places: list[str] = []
        self._is_complete = False
        """Whether what is not there is gone: between `hello` and `ready` it may only not have been told yet."""
        self._heard = Heard()
        self._known_since = math.inf
        """Since when the floor's state is known (s); infinite while it is not, and nobody is silent then."""
        self._silent: set[str] = set()
        """Robots that told nothing for too long, and have not been heard since."""
        self._told: dict[str, tuple[str, str]] = {}
        """The description and state of each robot that Home Assistant has."""
        self._gone: set[str] = set()
        """Robots whose devices are to be deleted."""

    def on_event(self, name: str, data: dict[str, Any], now: float) -> Sequence[Publication]:
        """Take in an event of the floor at `now` (s, monotonic); return what Home Assistant has to know."""
        if name == "hello":
            self._is_complete = False
            if data["fresh"]:
                self._robots, self._places = {}, []
        elif name == "ready":
            self._is_complete, self._known_since = True, now
        elif name == "robot":
            self._on_robot(data["id"], data["value"], now)
        elif name == "place":
            known = {*self._places, data["id"]} - ({data["id"]} if data["value"] is None else set())
            self._places = sorted(known)
        else:
            return ()
        return list(self._news())

    def _on_robot(self, robot: str, view: dict[str, Any] | None, now: float) -> None:
        """Take in what is told of a robot: what is told before all is known may be long ago, and is no sign of life."""
        if view is None:
            self._robots.pop(robot, None)
            self._gone.add(robot)
            self._heard.forget(robot)
            self._silent.discard(robot)
            return
        is_known, before = self._known_since < math.inf, self._robots.get(robot)
        if is_known and view["state"] and (before is None or _stamp(before) != _stamp(view)):
            self._heard.hear(robot, now)
            self._silent.discard(robot)
        self._robots[robot] = view
        self._gone.discard(robot)

    def on_kept(self, robot: str) -> None:
        """Take in that the broker keeps a robot's state, told now or by an earlier run."""
        self._told.setdefault(robot, ("", ""))

    def on_lost(self) -> None:
        """Take in that nobody knows the floor's state."""
        self._known_since = math.inf

    def tick(self, now: float) -> Sequence[Publication]:
        """Take in that time passes; return what Home Assistant has to know of robots that are silent or gone."""
        if now - self._known_since >= FORGET_S:
            self._gone |= self._told.keys() - self._robots.keys()
        silent = {
            robot
            for robot, view in self._robots.items()
            if view["state"] and min(self._heard.silent_s(robot, now), now - self._known_since) >= SILENT_S
        }
        if silent <= self._silent and not self._gone:
            return ()
        self._silent |= silent
        return list(self._news())

    def knows(self, robot: str) -> bool:
        """Whether the floor has told of a robot."""
        return robot in self._robots

    def on_command(self, robot: str, text: str, now: float) -> Request | str:
        """Return the request of a command to a robot at `now` (s, monotonic), or why there is none, in words."""
        path = f"/api/v1/robots/{robot}"
        if not self.knows(robot):
            return f"there is no robot {robot}; there are: {', '.join(sorted(self._robots)) or 'none'}"
        if text == STOP:
            return Request("POST", f"{path}/stop")
        if text == CANCEL or text == GOAL + _NO_GOAL:
            return Request("DELETE", f"{path}/goal")
        if text == DOCK:
            return Request("POST", f"{path}/commands", {"kind": "dock"})
        place = text.removeprefix(GOAL)
        if text.startswith(GOAL) and place in self._places:
            refusal = self._refusal(robot, now)
            return refusal or Request("PUT", f"{path}/goal", {"place": place})
        known = f"{STOP}, {CANCEL}, {DOCK}, or {GOAL}with one of {', '.join(self._places) or 'no place'}"
        return f"{text[:40]!r} is no command: send {known}"

    def _refusal(self, robot: str, now: float) -> str:
        """Return why a robot takes no goal; empty if it does."""
        if now < self._known_since:
            return _LOST
        return self._heard.refusal(robot, now, waits=_waits(self._robots[robot]["state"]))

    def everything(self) -> Sequence[Publication]:
        """Return all that Home Assistant has to know, again: the broker may have lost it."""
        self._told = dict.fromkeys(self._told, ("", ""))
        return list(self._news())

    def _news(self) -> Iterator[Publication]:
        if not self._is_complete:
            return
        gone, self._gone = self._told.keys() & self._gone, set()
        for robot in sorted(gone):
            del self._told[robot]
            yield Publication(ch.HOME_ASSISTANT_ROBOT, None, {"robot_device": f"robot_{robot}"})
            for channel in (ch.ROBOT_REPORT, ch.ROBOT_REFUSAL):
                yield Publication(channel, None, {"robot": robot})
        for robot, view in sorted(self._robots.items()):
            now = discovery(self._site, robot, self._places), self._report(robot, view)
            before = self._told.get(robot, ("", ""))
            self._told[robot] = now
            if before[0] != now[0]:
                yield Publication(ch.HOME_ASSISTANT_ROBOT, now[0], {"robot_device": f"robot_{robot}"})
            if before[1] != now[1]:
                yield Publication(ch.ROBOT_REPORT, now[1], {"robot": robot})

    def _report(self, robot: str, view: Mapping[str, Any]) -> str:
        return report(view, self._places, is_silent=robot in self._silent)


def _stamp(view: Mapping[str, Any]) -> float | None:
    return (view["state"] or {}).get("stamp")


def _waits(state: Mapping[str, Any] | None) -> bool:
    """Whether a robot drives only after an operator has enabled it."""
    return state is not None and (not state.get("enabled", True) or bool(state.get("awaits_operator")))


def report(view: Mapping[str, Any], places: Collection[str], *, is_silent: bool = False) -> str:
    """Return what is told of a robot (JSON), from what the console tells of it: fields of `discovery`'s templates.

    Of one that is silent the state is the last one that it told, but for what it does.
    """
    state, goal = view["state"] or {}, view["goal"] or {}
    mode, power = None if is_silent else state.get("mode"), state.get("power") or {}
    battery = state.get("battery")
    reasons = SILENT if is_silent else "; ".join(state.get("reasons", ()))
    found = {
        "state": "error" if is_silent else activity(state, under_way=bool(goal)),
        "mode": mode or "unknown",
        "why": (reasons or ("no state was received yet" if mode is None else "nothing keeps it"))[:_MOST],
        "battery": None if battery is None else round(100.0 * battery),
        "charging": "ON" if power.get("charging") in _CHARGING else "OFF",
        "problem": "ON" if is_silent or mode in _ERRORS else "OFF",
        # A choice that is not among the options is an error there: a point on the floor is none of them.
        "goal": _NO_GOAL if not goal else goal.get("place") if goal.get("place") in places else None,
        "waits_for_operator": "ON" if state.get("awaits_operator") else "OFF",
    }
    return msgspec.json.encode(found).decode()


def activity(state: Mapping[str, Any], *, under_way: bool) -> str:
    """Return a robot's state in the words that Home Assistant has for a vacuum."""
    if state.get("mode") in _ERRORS:
        return "error"
    if state.get("docked"):
        return "docked"
    if not state:
        return "idle"
    if state.get("wants_dock") or state.get("mode") == "DOCK":
        return "returning"
    if not under_way or state.get("goal_reached"):
        return "idle"
    return "cleaning" if state.get("mode") in ("NORMAL", "DEGRADED", "EGRESS") else "paused"


def discovery(site: str, robot: str, places: Sequence[str]) -> str:
    """Return the description (JSON) of a robot as a device."""
    device = f"fognav-{site}-robot-{robot}"
    command = ch.ROBOT_ORDER.key(site=site, robot=robot)
    components: dict[str, dict[str, Any]] = {
        "vacuum": {
            "p": "vacuum", "name": None, "supported_features": ["stop", "return_home"],
            "command_topic": command, "payload_stop": STOP, "payload_return_to_base": DOCK,
        },
        "battery": {
            "p": "sensor", "name": "battery", "device_class": "battery", "unit_of_measurement": "%",
            "value_template": "{{ value_json.battery }}",
        },
        "charging": {
            "p": "binary_sensor", "name": "charging", "device_class": "battery_charging",
            "value_template": "{{ value_json.charging }}",
        },
        "problem": {
            "p": "binary_sensor", "name": "problem", "device_class": "problem",
            "value_template": "{{ value_json.problem }}",
        },
        "waits": {
            "p": "binary_sensor", "name": "waits for an operator",
            "value_template": "{{ value_json.waits_for_operator }}",
        },
        "mode": {"p": "sensor", "name": "mode", "value_template": "{{ value_json.mode }}"},
        "why": {"p": "sensor", "name": "why it stands", "value_template": "{{ value_json.why }}"},
        "refusal": {"p": "sensor", "name": "refused order", "value_template": "{{ value[:255] }}"},
        "goal": {
            "p": "select", "name": "goal", "options": [_NO_GOAL, *places], "command_topic": command,
            "command_template": GOAL + "{{ value }}", "value_template": "{{ value_json.goal }}",
        },
        "stop": {"p": "button", "name": "stop", "command_topic": command, "payload_press": STOP},
        "cancel": {"p": "button", "name": "end the mission", "command_topic": command, "payload_press": CANCEL},
        "map": {
            "p": "image", "name": "map", "image_topic": ch.MAP_PICTURE.key(site=site), "image_encoding": "b64",
            "content_type": "image/png", "json_attributes_topic": ch.MAP_PICTURE_PLACE.key(site=site),
        },
    }  # fmt: skip
    for name, component in components.items():
        component["unique_id"] = f"{device}-{name}"
        if "value_template" in component or name == "vacuum":
            channel = ch.ROBOT_REFUSAL if name == "refusal" else ch.ROBOT_REPORT
            component["state_topic"] = channel.key(site=site, robot=robot)
    description = {
        "dev": {"ids": device, "name": robot, "mf": "Fognav", "mdl": "robot"},
        "o": {"name": "fognav"},
        "cmps": components,
        "availability_topic": ch.BRIDGE_AVAILABILITY.key(site=site),
    }
    return msgspec.json.encode(description).decode()
