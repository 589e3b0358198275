"""Areas whose messages would be too large are refused before they are stored, and left out if they are stored."""

import pytest

from fog_contracts import channels as ch
from fog_contracts.codec import encode
from fog_contracts.messages import AreaDefinition, AreaHazard
from fog_runtime.health import Health
from hazard_aggregator.area_size import AreaError, check_size
from hazard_aggregator.writers.unusable_areas import UnusableAreas

POLYGON = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)]


def area(nodes: int) -> AreaDefinition:
    names = [f"node-with-a-rather-long-name-{number:03}" for number in range(nodes)]
    return AreaDefinition(id="hall", polygon=POLYGON, nodes=names)


@pytest.mark.parametrize("count", [120, 9000])
def test_area_with_more_nodes_than_a_hazard_can_name_is_refused_with_the_remedy(count):
    with pytest.raises(AreaError, match=f"an area with {count} nodes is too large .*: split it") as caught:
        check_size(area(count))
    assert caught.value.field == "nodes"


def test_hazard_of_an_accepted_area_fits_whatever_its_cause_says():
    unusable = UnusableAreas(lambda _: None, Health())
    accepted = [d for d in map(area, range(150)) if unusable.made_usable([d], {}) == [d]]
    assert len(accepted) > 60
    states = dict.fromkeys(accepted[-1].nodes, "unknown")
    hazard = AreaHazard(
        area="hall", state="blocked", severity=3, penalty=254, since=1.0, seq=1, epoch=1, cause="ö" * 500, nodes=states
    )
    assert len(encode(ch.AREA_HAZARD, hazard)) <= ch.AREA_HAZARD.limit
