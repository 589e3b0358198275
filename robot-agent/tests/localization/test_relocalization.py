"""Search of the whole map: the place is found, undecided searches say so, the work comes in shares."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from little_world import L_ROOMS, grid_of

from robot_agent.config import LocalizationConfig
from robot_agent.localization import relocalization
from robot_agent.localization.hypotheses import Near
from robot_agent.localization.map_fields import MapFields, map_fields
from robot_agent.localization.pose import Pose2, wrap
from robot_agent.localization.relocalization import GlobalSearch

if TYPE_CHECKING:
    from robot_agent.localization.hypotheses import Hypotheses

CONFIG = LocalizationConfig()
ORIGIN = Pose2(0.0, 0.0, 0.0)


def view(fields: MapFields, pose: Pose2):
    angles = np.linspace(-math.pi, math.pi, 60, endpoint=False)
    ranges = fields.ranges(pose.x, pose.y, angles + pose.theta, 12.0)
    hit = np.isfinite(ranges)
    return np.column_stack((ranges[hit] * np.cos(angles[hit]), ranges[hit] * np.sin(angles[hit])))


def search(fields: MapFields, points, near: Near | None = None) -> tuple[Hypotheses, int]:
    one = GlobalSearch(fields, points, ORIGIN, CONFIG.range_max, near)
    for shares in range(1, 1000):
        result = one.advance(fields)
        if result is not None:
            return result, shares
    raise AssertionError("the search does not end")


@pytest.mark.parametrize("place", [Pose2(5.0, 2.0, 1.0), Pose2(12.0, 8.0, -2.0)])
def test_robot_is_found_anywhere(place):
    fields = map_fields(*grid_of(L_ROOMS, 15.0, 12.0), CONFIG)
    result, _ = search(fields, view(fields, place))
    found = result.decided
    assert math.hypot(found.x - place.x, found.y - place.y) < 0.1
    assert abs(wrap(found.theta - place.theta)) < 0.05


def test_scan_decides_for_no_place_that_it_does_not_confirm():
    """Among the visitors of a museum, 3 of 60 robots at rest were at a wrong place by such a scan, up to 19 m off."""
    fields = map_fields(*grid_of(L_ROOMS, 15.0, 12.0), CONFIG)
    behind_a_door = (4.7, 3.0, 5.3, 5.5)
    seen = view(map_fields(*grid_of([*L_ROOMS, behind_a_door], 15.0, 12.0), CONFIG), place := Pose2(5.0, 2.0, 1.0))
    result, _ = search(fields, seen)
    assert math.dist(result.contenders[0].pose[:2], place[:2]) < 0.1
    assert len(result.contenders) == 1
    assert result.decided is None


def test_place_near_the_last_good_pose_is_among_those_found_though_more_others_look_like_it_than_are_kept():
    rooms = [(1 + 4 * (number % 6), 1 + 4 * (number // 6)) for number in range(36)]
    mapped = map_fields(*grid_of([(x, y, x + 3, y + 2.5) for x, y in rooms], 26, 26), CONFIG)
    # Furniture stands in the robot's room, and in none on the map.
    room = [(1, 1, 4, 3.5), (1, 21, 4, 23.2), (1, 21, 2.6, 23.5), (3.2, 21, 4, 23.5)]
    points = view(map_fields(*grid_of(room, 26, 26), CONFIG), Pose2(2.2, 22.1, 0.7))
    for near, found in ((None, False), (Near(2.0, 22.0, 1.5), True)):
        result, _ = search(mapped, points, near)
        assert any(math.dist(place.pose, (2.2, 22.1, 0.7)) < 0.15 for place in result.contenders) is found


def test_twin_rooms_leave_the_search_undecided():
    fields = map_fields(*grid_of([(1, 1, 4, 4), (6, 1, 9, 4)], 10, 5), CONFIG)
    result, _ = search(fields, view(fields, Pose2(2.0, 2.2, 0.0)))
    assert result.decided is None
    assert len(result.places) > 1


def test_view_of_another_building_fits_no_place():
    fields = map_fields(*grid_of([(1, 1, 4, 4)], 6, 6), CONFIG)
    elsewhere = map_fields(*grid_of([(1, 1, 11, 9)], 12, 10), CONFIG)
    result, _ = search(fields, view(elsewhere, Pose2(6.0, 5.0, 0.4)))
    assert result.decided is None
    assert result.places == []


def test_work_is_done_in_shares_and_their_size_does_not_matter(monkeypatch):
    fields = map_fields(*grid_of(L_ROOMS, 15.0, 12.0), CONFIG)
    points = view(fields, Pose2(5.0, 2.0, 1.0))
    whole, few = search(fields, points)
    monkeypatch.setattr(relocalization, "_CHUNK", 1000)
    parts, many = search(fields, points)
    assert parts.places == whole.places
    assert many > 5 * few
