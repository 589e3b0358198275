"""The footprint: which polygons are refused and how, and its radii."""

from __future__ import annotations

import math

import msgspec
import pytest

from robot_agent.config import AgentConfig
from robot_agent.footprint import Footprint, FootprintError

BOX = ((0.2, 0.15), (-0.1, 0.15), (-0.1, -0.15), (0.2, -0.15))


def test_radii_of_a_box_around_an_axle_off_its_middle():
    box = Footprint(BOX)
    assert box.inscribed_radius == pytest.approx(0.1)
    assert box.circumscribed_radius == pytest.approx(0.25)
    assert box.polygon.shape == (4, 2)


@pytest.mark.parametrize("radius", [0.05, 0.17, 0.5])
def test_circle_lies_inside_its_polygon_which_exceeds_it_by_half_a_percent(radius):
    footprint = Footprint.circle(radius)
    assert footprint.inscribed_radius == pytest.approx(radius)
    assert radius < footprint.circumscribed_radius < 1.005 * radius


@pytest.mark.parametrize(
    ("vertices", "words"),
    [
        (BOX[:2], "3 to 64 vertices, not 2"),
        (BOX * 17, "3 to 64 vertices, not 68"),
        (((200.0, 150.0), *BOX[1:]), r"vertex 1 \(200.0, 150.0\) is more than 2 m"),
        ((*BOX[:2], (math.nan, 0.0), BOX[3]), "vertex 3"),
        (BOX[::-1], "counter-clockwise"),
        ((*BOX[:2], (-0.05, 0.0), *BOX[2:]), "turns right at vertex 3"),
        (((0.2, 0.15), (0.2, 0.15), *BOX[1:]), "vertices 1 and 2 are equal"),
        (((0.2, 0.15), *BOX[1:], (0.2, 0.15)), "vertices 5 and 1 are equal"),
        (
            tuple((0.2 * math.cos(4 * k * math.pi / 5), 0.2 * math.sin(4 * k * math.pi / 5)) for k in range(5)),
            "crosses",
        ),
        (tuple((x + 0.3, y) for x, y in BOX), r"the axle's centre \(0, 0\) is not"),
    ],
)
def test_a_wrong_polygon_is_refused_by_name_of_its_fault(vertices, words):
    with pytest.raises(FootprintError, match=words):
        Footprint(vertices)


def test_configuration_with_a_footprint_survives_json():
    config = AgentConfig(
        robot="r1", operator_key=b"", boot="b", drive_train=None, motion=None, footprint=Footprint(BOX)
    )
    encoded = msgspec.json.encode(config.footprint)
    assert msgspec.json.decode(encoded, type=Footprint) == config.footprint
    assert msgspec.json.decode(msgspec.json.encode(Footprint.circle(0.17)), type=Footprint) == Footprint.circle(0.17)
