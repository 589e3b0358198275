"""Numbers that nodes measure (temperature, gas) as evidence for an area, and areas that are costly, not impassable."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fog_contracts.costs import LETHAL
from fog_contracts.messages import (
    AreaDefinition,
    AreaHazard,
    FusionPolicy,
    Limits,
    NodeReading,
    NodeValue,
    Quantity,
    Source,
)
from fog_contracts.site import NodeSite, Sonar
from hazard_aggregator.area_size import AreaError
from hazard_aggregator.fusion import AreaFusion
from hazard_aggregator.registry import find_rule

SQUARE = [(0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (0.0, 1.0)]
HOT = Limits(above=40.0, hysteresis=2.0, minimum=-40.0, maximum=120.0)
HEAT = Source(id="heat", quantity=Quantity(node="n1", kind="temperature"), number=HOT)


class Rig:
    """An area with a node that publishes ranges and values, at a clock that the test moves."""

    def __init__(self, *sources: Source, node_penalty=None, **fields) -> None:
        node = NodeSite(
            id="n1", area="hall", x=0.0, y=0.0, theta=0.0, sonars=[Sonar(range_limit=1.0)], penalty=node_penalty
        )
        definition = AreaDefinition(id="hall", polygon=SQUARE, sources=list(sources), **fields)
        self.fusion = AreaFusion([definition], [node], 1, registry=find_rule)
        self.now, self.seq = 100.0, 0
        self.fusion.tick(self.now, self.now)

    def value(self, value: float, kind: str = "temperature", boot: int = 1, seq: int | None = None) -> AreaHazard:
        self.seq += 1
        self.now += 1.0
        message = NodeValue(seq=self.seq if seq is None else seq, boot=boot, kind=kind, value=value, unit="C")
        self.fusion.on_value("n1", message, self.now, self.now)
        return self.hazard

    def read(self, state: str, times: int = 8) -> AreaHazard:
        for _ in range(times):
            self.seq += 1
            self.now += 0.1
            distance = 0.5 + 0.01 * (self.seq % 2) if state == "blocked" else 2.0
            reading = NodeReading(
                seq=self.seq, boot=1, uptime_ms=round(1000 * self.now), range_m=[distance], status=["ok"], state=state
            )
            self.fusion.on_reading("n1", reading, self.now, self.now)
        return self.hazard

    @property
    def hazard(self) -> AreaHazard:
        return self.fusion.hazards()[0]


def test_temperature_of_a_node_blocks_above_its_limit_and_clears_below_the_hysteresis():
    rig = Rig(HEAT)
    assert rig.value(20.0).state == "clear"
    assert rig.value(40.5).state == "blocked"
    assert rig.hazard.cause == "source heat: 40.5 is above 40"
    assert rig.value(38.5).state == "blocked"
    assert rig.value(90.0, kind="gas").state == "blocked", "another quantity of the same node"
    assert rig.value(37.0).state == "clear"
    assert rig.value(400.0).state == "unknown"


def test_value_of_a_node_that_is_silent_or_offline_is_unknown():
    rig = Rig(HEAT)
    rig.value(20.0)
    for _ in range(28):
        rig.now += 0.25
        rig.fusion.tick(rig.now, rig.now)
    assert (rig.hazard.state, "silent for more than 6 s" in rig.hazard.cause) == ("unknown", True)
    assert rig.value(20.0).state == "clear"
    rig.fusion.on_availability("n1", False, rig.now, rig.now)  # noqa: FBT003  # the topic's payload
    assert (rig.hazard.state, rig.hazard.cause) == ("unknown", "source heat: it went offline")
    assert rig.value(20.0).state == "clear"


def test_repeated_and_older_values_do_not_count_and_the_count_wraps():
    rig = Rig(HEAT)
    assert rig.value(50.0, seq=2**32 - 1).state == "blocked"
    assert rig.value(20.0, seq=2**32 - 1).state == "blocked"
    assert rig.value(20.0, seq=2**32 - 7).state == "blocked"
    assert rig.value(20.0, seq=0).state == "clear"
    assert rig.value(50.0, boot=2, seq=0).state == "blocked", "the node has started anew"


@given(st.permutations(list(range(1, 9))), st.integers(0, 2**32 - 1))
def test_last_of_permuted_and_repeated_values_decides(order, start):
    rig = Rig(HEAT)
    for step in [*order, *order]:
        rig.value(50.0 if step == 8 else 20.0, seq=(start + step) % 2**32)
    assert rig.hazard.state == "blocked"


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (Source(id="heat", quantity=Quantity(node="n9", kind="gas"), number=HOT), "the site has no node n9"),
        (Source(id="heat", quantity=Quantity(node="n1", kind="gas")), "it needs `above` or `below`"),
        (Source(id="heat", quantity=Quantity(node="n1", kind="gas"), number=HOT, topic="t"), "nothing else"),
    ],
)
def test_invalid_quantity_is_refused(source, message):
    with pytest.raises(AreaError, match=message):
        Rig(source)


def test_node_with_a_penalty_makes_its_area_costly_and_never_impassable():
    rig = Rig(nodes=["n1"], node_penalty=90)
    assert (rig.read("clear").state, rig.hazard.penalty) == ("clear", 0)
    assert (rig.read("blocked").state, rig.hazard.penalty) == ("unknown", 90)
    assert "nearer than 1.00 m" in rig.hazard.cause
    assert (rig.read("clear").state, rig.hazard.penalty) == ("clear", 0)


def test_area_with_a_penalty_is_costly_by_all_of_its_nodes_and_sources_unless_they_have_their_own():
    rig = Rig(HEAT, nodes=["n1"], penalty=60)
    rig.value(20.0)
    assert (rig.read("blocked").penalty, rig.read("clear").penalty) == (60, 0)
    assert (rig.value(50.0).state, rig.hazard.penalty) == ("unknown", 60)
    area = AreaDefinition(id="hall", polygon=SQUARE, nodes=["n1"], sources=[HEAT])
    rig.fusion.put_area(area, rig.now)
    assert (rig.hazard.state, rig.hazard.penalty) == ("blocked", LETHAL), "without its penalty it is impassable at once"
    with pytest.raises(AreaError, match=r"fusion\.rule.*use `any`"):
        Rig(nodes=["n1"], penalty=60, fusion=FusionPolicy(rule="all"))
