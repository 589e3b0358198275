"""What the console tells of areas and nodes: what is measured, and what of that the map shows."""

from __future__ import annotations

import json
from typing import Any

import pytest
from msgspec import structs, to_builtins

from console_service.areas import MAP_SILENT_S
from console_service.core import ConsoleCore
from console_service.sources import by_id
from fog_contracts import channels as ch
from fog_contracts.handlers import Moment
from fog_contracts.messages import AreaHazard, HazardArea, MapHeartbeat

CLEAR = AreaHazard(area="hall", state="clear", severity=0, penalty=0, since=1.0, seq=5, epoch=3, cause="all nodes")
BLOCKED = structs.replace(CLEAR, state="blocked", severity=3, penalty=254, seq=4)
RING = [(1.0, 1.0), (2.0, 1.0), (2.0, 2.0)]


class Hall:
    """A console-service that knows one area."""

    def __init__(self) -> None:
        self.core = ConsoleCore("lab", "r")
        self.now = 10.0
        value = {"definition": {"id": "hall"}, "hazard": to_builtins(CLEAR), "override": None}
        self.core.on_fetched("area", {"hall": value}, self.now)

    def hear(self, channel: ch.Channel, message: object) -> None:
        self.core.handlers()[channel]({"area": "hall"}, message, Moment(self.now, 1e9 + self.now))

    def map_shows(self, hazard: AreaHazard, *, confirmed: bool = True) -> None:
        self.hear(ch.HAZARD, HazardArea(hazard=hazard, polygon=RING, confirmed=confirmed, epoch=1))

    def beat(self, seconds: float = 0.0) -> None:
        self.wait(seconds)
        self.hear(ch.MAP_HEARTBEAT, MapHeartbeat(epoch=1, seq=1, hash=0, sent=None))

    def wait(self, seconds: float) -> None:
        self.now += seconds
        self.core.tick(Moment(self.now, 1e9 + self.now))

    @property
    def floor(self) -> dict[str, list[str]]:
        return self.core.floor(self.now)[1]

    @property
    def on_map(self) -> dict[str, Any] | None:
        return json.loads(self.core.log.data("area", "hall"))["value"]["on_map"]


def test_area_is_told_with_what_the_map_shows_and_with_nothing_while_the_map_service_is_silent():
    hall = Hall()
    assert hall.on_map is None
    hall.map_shows(CLEAR)
    assert hall.on_map is None, "it may be long ago"
    hall.beat()
    assert hall.on_map == {"state": "clear", "penalty": 0, "confirmed": True}
    hall.map_shows(structs.replace(CLEAR, state="unknown"), confirmed=False)
    assert hall.on_map == {"state": "unknown", "penalty": 0, "confirmed": False}
    hall.map_shows(CLEAR)
    hall.wait(MAP_SILENT_S - 0.1)
    assert hall.on_map is not None
    hall.wait(0.2)
    assert hall.on_map is None
    hall.beat()
    assert hall.on_map == {"state": "clear", "penalty": 0, "confirmed": True}


def test_floor_lists_an_area_as_clear_only_while_the_map_confirms_it():
    hall = Hall()
    assert hall.floor == {"unknown": ["hall"]}
    hall.map_shows(CLEAR)
    hall.beat()
    assert hall.floor == {"clear": ["hall"]}
    hall.map_shows(CLEAR, confirmed=False)
    assert hall.floor == {"unknown": ["hall"]}
    hall.map_shows(CLEAR)
    hall.wait(MAP_SILENT_S + 0.1)
    assert hall.floor == {"unknown": ["hall"]}
    hall.hear(ch.AREA_HAZARD, structs.replace(BLOCKED, seq=6))
    assert hall.floor == {"blocked": ["hall"]}, "whether the map has it or not"


def test_node_is_told_with_the_moment_at_which_it_was_heard():
    node = {"id": "n1", "area": "hall", "age_s": 2.5}
    assert by_id("node", [node, {**node, "id": "n2", "age_s": None}], 1000.0) == {
        "n1": {**node, "heard": 997.5},
        "n2": {**node, "id": "n2", "age_s": None, "heard": None},
    }


@pytest.mark.parametrize("shown", [BLOCKED, structs.replace(CLEAR, seq=4), structs.replace(CLEAR, epoch=2, seq=9)])
def test_area_is_not_confirmed_by_what_the_map_shows_of_an_earlier_hazard(shown):
    hall = Hall()
    hall.beat()
    hall.map_shows(shown)
    assert hall.on_map == {"state": shown.state, "penalty": shown.penalty, "confirmed": False}
    hall.map_shows(CLEAR)
    assert hall.on_map == {"state": "clear", "penalty": 0, "confirmed": True}
    hall.hear(ch.AREA_HAZARD, structs.replace(CLEAR, seq=6))
    assert hall.on_map["confirmed"] is False
