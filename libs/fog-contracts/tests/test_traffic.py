"""How large the messages are that robots get while they drive and when a hazard changes."""

from __future__ import annotations

import msgspec
import pytest

from fog_contracts import channels as ch
from fog_contracts.codec import encode
from fog_contracts.messages import VIEW_SECTORS, RobotObstacles, RobotPath, RobotRelease, View

LARGEST = 2**53


def test_a_report_of_obstacles_is_a_quarter_of_a_kilobyte_with_a_whole_view_and_20_bytes_more_per_point() -> None:
    view = View(x=12.34, y=56.78, reach=bytes(range(VIEW_SECTORS)))
    without = RobotObstacles(points=[], stamp=1.8e9, ttl=10.0, view=view)
    points = msgspec.structs.replace(without, points=[(0.05 + i / 10, 3.05) for i in range(10)])
    assert len(encode(ch.ROBOT_OBSTACLES, without)) <= 256
    assert len(encode(ch.ROBOT_OBSTACLES, points)) <= 256 + 10 * 20


def test_a_release_is_below_120_bytes_with_the_largest_numbers() -> None:
    release = RobotRelease(
        plan_id=2**32 - 1, planner_epoch=LARGEST, released_length=1234.5678, map_epoch=LARGEST, map_seq=LARGEST,
        sent=(2**32 - 1, 1e6 / 3),
    )  # fmt: skip
    assert len(encode(ch.ROBOT_RELEASE, release)) < 120
    assert len(encode(ch.ROBOT_RELEASE, msgspec.structs.replace(release, plan_id=LARGEST))) <= ch.ROBOT_RELEASE.limit


PATH = RobotPath(
    plan_id=5, planner_epoch=3, goal_id="g", points=[(0.0, 0.0), (9.0, 0.0)], map_epoch=7, map_seq=1,
    released_length=2.0,
)  # fmt: skip
RELEASE = RobotRelease(plan_id=5, planner_epoch=3, released_length=4.0, map_epoch=8, map_seq=2)


def test_a_release_of_a_path_changes_its_released_length_and_map_version_only() -> None:
    after = PATH.after(RELEASE)
    assert (after.released_length, after.map_epoch, after.map_seq) == (4.0, 8, 2)
    assert msgspec.structs.replace(after, released_length=2.0, map_epoch=7, map_seq=1) == PATH


@pytest.mark.parametrize("other", [{"plan_id": 6}, {"plan_id": 4}, {"planner_epoch": 4}])
def test_a_release_of_another_path_changes_nothing(other: dict[str, int]) -> None:
    assert PATH.after(msgspec.structs.replace(RELEASE, **other)) is PATH
