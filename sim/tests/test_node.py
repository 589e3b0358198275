"""A simulated node measures and classifies like the firmware."""

import pytest

from fog_contracts.messages import NodeConfig
from fog_contracts.site import NodeSite, Sonar
from fog_kernels.sonar import classify, default_config
from fognav_sim.node import SonarNode

SONARS = [Sonar(range_limit=2.0), Sonar(range_limit=2.5)]
SITE = NodeSite(id="n1", area="z1", x=0.0, y=0.0, theta=0.0, sonars=SONARS, every_reading=True)


class Ranges:
    """A stand-in for the world: the sonars measure the given ranges."""

    def __init__(self, *metres):
        self.metres = metres

    def sonar(self, _node, index):
        return self.metres[index]


def readings(world, seconds, node=None):
    node = node or SonarNode(SITE, boot=7, start=100.0)
    return [reading for step in range(round(seconds * 100)) for reading in node.poll(world, 100.0 + step * 0.01)]


@pytest.mark.parametrize("metres", [(2.0, 2.0), (3.0, 3.0), (2.2, None), (None, None)])
def test_node_publishes_eight_to_ten_readings_a_second_with_and_without_echoes(metres):
    assert 8.0 <= len(readings(Ranges(*metres), 20.0)) / 20.0 <= 10.0


def test_new_pause_is_applied_and_configuration_for_another_number_of_sonars_is_ignored():
    node = SonarNode(SITE, boot=7, start=100.0)
    assert not node.configure(NodeConfig(version=1, range_limit_m=[1.0], no_echo_is_clear=[True]))
    assert node.config == default_config(SITE)
    assert node.configure(NodeConfig(version=2, range_limit_m=[3.0, 3.0], no_echo_is_clear=[True, True], pause_ms=950))
    published = readings(Ranges(2.5, 2.8), 10.0, node)
    assert 9 <= len(published) <= 10
    assert {reading.state for reading in published} == {"blocked"}


@pytest.mark.parametrize(
    ("ranges", "no_echo_is_clear", "state"),
    [
        ([2.2, 2.7], (False, False), "clear"),
        ([1.9, 2.7], (False, False), "blocked"),
        ([None, 2.4], (False, False), "blocked"),
        ([None, 2.7], (False, False), "unknown"),
        ([None, 2.7], (True, False), "clear"),
        ([None, None], (True, True), "unknown"),
        ([2.2, 3.01], (False, False), "clear"),
        ([2.61, 2.7], (False, False), "unknown"),
        ([2.61, 2.4], (False, False), "blocked"),
        ([None, None], (True, False), "unknown"),
    ],
)
def test_no_echo_means_clear_only_if_calibrated_so(ranges, no_echo_is_clear, state):
    limits = {"range_limit_m": [2.0, 2.5], "range_max_m": [2.6, 0.0]}
    config = NodeConfig(version=0, **limits, no_echo_is_clear=list(no_echo_is_clear))
    assert classify(ranges, config) == state


def test_no_burst_of_readings_follows_a_pause_of_the_simulation():
    node = SonarNode(SITE, boot=7, start=100.0)
    readings(Ranges(2.2, 2.7), 1.0, node)
    assert len(node.poll(Ranges(2.2, 2.7), 200.0)) <= 1
