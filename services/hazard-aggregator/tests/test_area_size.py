"""Areas whose messages would be too large are refused before they are stored, and left out if they are stored."""

from typing import get_args

import pytest

from fog_contracts import channels as ch
from fog_contracts.codec import decode, encode
from fog_contracts.messages import AREAS_MAX, AggregatorHeartbeat, AreaDefinition, AreaHazard
from fog_contracts.messages.basics import Count, Hash, Stamp
from fog_runtime.health import Health
from hazard_aggregator.area_size import AreaError, check_size, excess
from hazard_aggregator.records import UnusableAreas

POLYGON = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)]


def area(nodes: int) -> AreaDefinition:
    names = [f"node-with-a-rather-long-name-{number:03}" for number in range(nodes)]
    return AreaDefinition(id="hall", polygon=POLYGON, nodes=names)


@pytest.mark.parametrize("count", [400, 9000])
def test_area_with_more_nodes_than_a_hazard_can_name_is_refused_with_the_remedy(count):
    with pytest.raises(AreaError, match=f"an area with {count} nodes is too large .*: split it") as caught:
        check_size(area(count))
    assert caught.value.field == "nodes"


def test_area_of_130_nodes_with_the_longest_names_is_accepted_and_its_hazard_fits():
    definition = AreaDefinition(id="hall", polygon=POLYGON, nodes=[f"{number:032}" for number in range(130)])
    check_size(definition)
    states = dict.fromkeys(definition.nodes, "blocked")
    longest = "\N{GRINNING FACE}" * 500
    hazard = AreaHazard(
        area="hall", state="blocked", severity=3, penalty=254, since=1.0, seq=1, epoch=1, cause=longest, nodes=states
    )
    assert len(encode(ch.AREA_HAZARD, hazard)) <= ch.AREA_HAZARD.limit


def test_hazard_of_an_accepted_area_fits_whatever_its_cause_says():
    unusable = UnusableAreas(lambda area: area, Health())
    accepted = [d for d in map(area, range(400)) if unusable.made_usable([d], {}) == [d]]
    assert len(accepted) > 60
    states = dict.fromkeys(accepted[-1].nodes, "unknown")
    hazard = AreaHazard(
        area="hall", state="blocked", severity=3, penalty=254, since=1.0, seq=1, epoch=1, cause="ö" * 500, nodes=states
    )
    assert len(encode(ch.AREA_HAZARD, hazard)) <= ch.AREA_HAZARD.limit


def named(*ids: str, **fields: object) -> list[AreaDefinition]:
    return [AreaDefinition(id=name, polygon=POLYGON, **fields) for name in ids]


def test_areas_that_no_heartbeat_can_list_are_counted_without_removed_ones():
    areas = [*named(*(f"a{number}" for number in range(AREAS_MAX))), *named("gone", version=3, removed=True)]
    assert excess(areas) == ""
    assert f"have {AREAS_MAX + 2} areas together" in excess(areas + named("more", "again"))
    assert "remove 2 (PUT them with `removed`)" in excess(areas + named("more", "again"))


def most(kind: object) -> int:
    """Return the largest value of a bounded type."""
    return int(get_args(kind)[1].le)


def test_heartbeat_of_the_most_areas_fits_with_the_longest_ids_and_the_largest_numbers():
    late = most(Stamp) - 2**-13  # written with all 17 digits
    heartbeat = AggregatorHeartbeat(
        epoch=most(Count), areas={f"{number:032}": most(Count) for number in range(AREAS_MAX)}, complete=False,
        digest=most(Hash), uptime=late, stamp=late,
    )  # fmt: skip
    data = encode(ch.AGGREGATOR_HEARTBEAT, heartbeat)
    assert decode(ch.AGGREGATOR_HEARTBEAT, data, AggregatorHeartbeat) == heartbeat
