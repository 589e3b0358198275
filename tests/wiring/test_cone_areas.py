"""An area that is the cone of a node, from the site's file to the costmap: it follows the node that was moved."""

import msgspec
import pytest

from fog_contracts import channels as ch
from fog_contracts.bus import Bus
from fog_contracts.cones import node_cones
from fog_contracts.handlers import Moment, Publication
from fog_contracts.messages import AreaDefinition, NodeReading
from fog_contracts.site import NodeSite
from fog_runtime.configuration.site import LoadedSite, load_site
from fognav import checkout
from hazard_aggregator.core import Aggregator
from hazard_aggregator.fusion import AreaFusion
from hazard_aggregator.registry import find_rule
from map_service.core import MapCore
from map_service.registry import make_layers

SOMEWHERE = [(1.0, 1.0), (2.0, 1.0), (2.0, 2.0)]
STORED = AreaDefinition(
    id="z1", polygon=SOMEWHERE, cone_of="n1", nodes=["n1"], version=3, debounce={"rule": "consecutive"}
)


@pytest.fixture(scope="module")
def estig() -> LoadedSite:
    return load_site(checkout.root() / "sites" / "estig")


class Fog:
    """Map and aggregator of a site whose only area is the cone of its first node, as Redis has it."""

    def __init__(self, loaded: LoadedSite) -> None:
        self.loaded = loaded
        self.now = 0.0
        self.bus = Bus(loaded.site.id)
        self.map = MapCore(
            loaded.site.id, loaded.map, 1, layers=make_layers(loaded.map, loaded.site.layers), definitions=[]
        )
        self.map.load_zones([], Moment(0.0, 0.0))
        self.bus.connect(self.map)

    def start_aggregator(self, node: NodeSite, epoch: int) -> None:
        cones = node_cones([node], self.loaded.map)
        core = Aggregator(AreaFusion([STORED], [node], epoch, registry=find_rule, cones=cones))
        self.bus.connect(core)
        self.bus.publish(core.republish_all())
        for seq in range(30):
            self.now += 0.1
            reading = NodeReading(
                seq=seq, boot=epoch, uptime_ms=100 * seq, range_m=[0.8, 0.8], status=["ok", "ok"], state="blocked"
            )
            self.bus.publish([Publication(ch.NODE_READING, reading, {"node": node.id})])
            at = Moment(self.now, self.now)
            for one in (core, self.map):
                self.bus.publish(one.tick(at))
            self.bus.publish(core.mark_stored(core.to_store()))
            self.bus.deliver(at)

    def cost(self, x: float, y: float) -> int:
        column, row = self.loaded.map.geometry.cell(x, y)
        return int(self.map.costmap.cost[row, column])


def test_area_follows_its_node_that_was_moved_on_the_map(estig):
    node = estig.site.nodes[0]
    moved = msgspec.structs.replace(node, x=node.x - 3.0)
    fog = Fog(estig)
    fog.start_aggregator(node, epoch=2)
    before, after = (node.x, node.y - 1.2), (moved.x, moved.y - 1.2)
    assert (fog.cost(*before), fog.cost(*after)) == (254, 0)
    fog.start_aggregator(moved, epoch=3)
    assert (fog.cost(*before), fog.cost(*after)) == (0, 254)


def test_area_shrinks_with_the_limit_that_its_node_has_learned(estig):
    node = estig.site.nodes[0]
    far = (node.x + 0.3, node.y - 2.0)
    fog = Fog(estig)
    fog.start_aggregator(node, epoch=2)
    assert fog.cost(*far) == 254
    nearer = [msgspec.structs.replace(sonar, range_limit=1.0) for sonar in node.sonars]
    fog.start_aggregator(msgspec.structs.replace(node, sonars=nearer), epoch=3)
    assert fog.cost(*far) == 0
