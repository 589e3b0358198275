"""From what a node measures to the costmap: a temperature makes an area costly, by way of both services' cores."""

import msgspec
import numpy as np

from fog_contracts import channels as ch
from fog_contracts.bus import Bus
from fog_contracts.handlers import Moment, Publication
from fog_contracts.messages import Limits, NodeValue, Quantity, Source
from fog_runtime.configuration.site import load_site
from fognav import checkout
from hazard_aggregator.core import Aggregator
from hazard_aggregator.fusion import AreaFusion
from hazard_aggregator.registry import find_rule
from map_service.core import MapCore
from map_service.registry import make_layers

HEAT = Source(
    id="heat", quantity=Quantity(node="n1", kind="temperature"), number=Limits(above=40.0, hysteresis=2.0), penalty=120
)


def test_hot_area_costs_its_penalty_in_the_map_until_it_is_cool():
    loaded = load_site(checkout.root() / "sites" / "estig")
    area = msgspec.structs.replace(loaded.site.definitions()[0], nodes=[], sources=[HEAT])
    bus = Bus(loaded.site.id)
    core = Aggregator(AreaFusion([area], loaded.site.nodes, 1, registry=find_rule))
    layers = make_layers(loaded.map, loaded.site.layers)
    fog_map = MapCore(loaded.site.id, loaded.map, 1, layers=layers, definitions=[area])
    fog_map.load_zones([], Moment(0.0, 0.0))
    bus.connect(core)
    bus.connect(fog_map)
    column, row = loaded.map.geometry.cell(*np.mean(area.polygon, axis=0))
    costs: list[int] = []
    for step in range(120):
        at = Moment(0.1 * step, 0.1 * step)
        temperature = 60.0 if 40 <= step < 80 else 20.0
        value = NodeValue(seq=step, boot=1, kind="temperature", value=temperature, unit="C")
        bus.publish([Publication(ch.NODE_VALUE, value, {"node": "n1"})])
        for one in (core, fog_map):
            bus.publish(one.tick(at))
        bus.publish(core.mark_stored(core.to_store()))
        bus.deliver(at)
        costs.append(int(fog_map.costmap.cost[row, column]))
    assert (costs[39], costs[79], costs[119]) == (0, 120, 0)
