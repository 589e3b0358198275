from __future__ import annotations

import math

import msgspec
import pytest
from little_world import AXLE, DRIVE_TRAIN

from robot_agent.agent.pose_persistence import SEARCH_AGAIN_S, PosePersistence
from robot_agent.guardian.link import BaseFeedback
from robot_agent.hardware import BaseStatus, WheelOdometry
from robot_agent.localization.pose import SavedPose

POSE = SavedPose(site="lab", x=1.0, y=2.0, theta=3.1, sigma_xy=0.1, sigma_theta=0.1)


FIELDS = object()


def feedback(seq, left, fault=None, guardian="one", right=2.0):
    wheels = WheelOdometry(left_m=left, right_m=right)
    return BaseFeedback(seq=seq, status=BaseStatus(), odometry=wheels, fault=fault, stopped=None, guardian=guardian)


class FakeLocalizer:
    def __init__(self):
        self.status = "none"
        self.searching = False
        self.known = None
        self.can_search = True
        self.searches = 0
        self.restored = []
        self.followed = []
        self.trusted = POSE
        self.moving = (0.0, 0.0)

    def twist(self):
        return self.moving

    def pose(self, _now):
        return self.known

    def global_localization(self):
        self.searches += self.can_search
        return self.can_search

    def restore(self, saved):
        self.restored.append(saved)

    def follow_saved(self, saved):
        self.followed.append(saved)

    def load_map(self, fields):
        self.fields = fields

    def save(self, site, _now):
        return self.trusted and msgspec.structs.replace(self.trusted, site=site)


@pytest.fixture
def localizer():
    return FakeLocalizer()


@pytest.fixture
def persistence(localizer):
    return PosePersistence(localizer, DRIVE_TRAIN)


def test_search_begins_without_a_pose_and_not_again_before_the_interval(persistence, localizer):
    assert persistence.search("INIT", 0.0, at_rest=True)
    assert not persistence.search("INIT", SEARCH_AGAIN_S, at_rest=True)
    assert persistence.search("INIT", SEARCH_AGAIN_S + 0.1, at_rest=True)
    assert localizer.searches == 2


def test_search_that_could_not_begin_is_retried_immediately(persistence, localizer):
    localizer.can_search = False
    assert not persistence.search("INIT", 0.0, at_rest=True)
    localizer.can_search = True
    assert persistence.search("INIT", 0.1, at_rest=True)


@pytest.mark.parametrize("change", [{"status": "lost"}, {"searching": True}, {"known": (1.0, 2.0, 0.0)}])
def test_no_search_begins_while_there_is_a_pose_or_a_search(persistence, localizer, change):
    for name, value in change.items():
        setattr(localizer, name, value)
    assert not persistence.search("INIT", 0.0, at_rest=True)


def test_search_begins_while_the_robot_has_a_fault(persistence):
    assert persistence.search("FAULT", 0.0, at_rest=True)


@pytest.mark.parametrize(("mode", "at_rest"), [("NORMAL", True), ("HOLD", True), ("INIT", False), ("FAULT", False)])
def test_no_search_begins_while_the_robot_is_enabled_or_moves(persistence, mode, at_rest):
    assert not persistence.search(mode, 0.0, at_rest=at_rest)


@pytest.mark.parametrize(("site", "restored"), [("lab", [POSE]), ("office", [])])
def test_a_stored_pose_waits_for_the_map_of_its_site(persistence, localizer, site, restored):
    persistence.restore(POSE, "")
    assert localizer.restored == []
    persistence.load_map(site, FIELDS)
    persistence.load_map("lab", FIELDS)
    assert localizer.restored == restored


def test_stored_pose_is_restored_immediately_on_the_map_of_its_site(persistence, localizer):
    persistence.restore(POSE, "lab")
    assert localizer.restored == [POSE]


@pytest.mark.parametrize("base_first", [True, False])
@pytest.mark.parametrize(
    ("first", "followed"),
    [((7, 2.5), 1), ((900, 2.0, None, "two"), 0), ((6, 2.0), 0), ((7, 3.6), 0), ((7, 2.0, "wheel drop"), 0)],
    ids=["same guardian", "another guardian, for long", "nothing since", "the wheels have turned", "it was lifted"],
)
def test_stored_pose_is_followed_if_one_guardian_has_watched_the_robot_since(
    persistence, localizer, first, followed, base_first
):
    persistence.on_base(feedback(6, 2.0))
    stored = persistence.to_store("lab", 0.0)
    successor = PosePersistence(localizer, DRIVE_TRAIN)
    if base_first:
        successor.on_base(feedback(*first))
    successor.restore(stored, "lab")
    successor.on_base(feedback(*first))
    assert localizer.restored == [stored]
    assert len(localizer.followed) == followed


@pytest.mark.parametrize("begin", [0.0, 0.98 * DRIVE_TRAIN.travel_wrap_m], ids=["", "the counters begin again"])
def test_followed_pose_is_where_the_wheels_have_taken_the_robot_since(persistence, localizer, begin):
    persistence.on_base(feedback(6, begin, right=begin))
    successor = PosePersistence(localizer, DRIVE_TRAIN)
    successor.restore(persistence.to_store("lab", 0.0), "lab")
    left, right = (math.remainder(begin + way, DRIVE_TRAIN.travel_wrap_m) for way in (0.4 + AXLE, 0.4 - AXLE))
    successor.on_base(feedback(900, left, right=right))
    (followed,) = localizer.followed
    chord = 0.4 * math.sin(1.0)
    at = (1.0 + chord * math.cos(2.1), 2.0 + chord * math.sin(2.1), 1.1)
    assert (followed.x, followed.y, followed.theta) == pytest.approx(at)


@pytest.mark.parametrize(
    ("change", "stored"),
    [
        ({"x": 1.01}, False),
        ({"x": 1.02, "y": 2.01}, True),
        ({"theta": 3.12}, False),
        ({"theta": 3.15}, True),
        ({"theta": 3.1 - 2 * math.pi}, False),
        ({"sigma_xy": 0.2}, True),
        ({"sigma_theta": 0.04}, True),
    ],
)
def test_only_a_pose_that_differs_is_stored(persistence, localizer, change, stored):
    assert persistence.to_store("lab", 0.0) == POSE
    assert persistence.to_store("lab", 1.0) is None
    localizer.trusted = msgspec.structs.replace(POSE, **change)
    assert (persistence.to_store("lab", 2.0) is not None) == stored


def test_pose_is_stored_again_when_another_guardian_watches_the_robot(persistence):
    for guardian, stored in (("one", True), ("one", False), ("two", True)):
        persistence.on_base(feedback(6, 2.0, guardian=guardian))
        assert (persistence.to_store("lab", 0.0) is not None) == stored


@pytest.mark.parametrize("moving", [(0.3, 0.0), (0.0, 0.5)])
@pytest.mark.parametrize(
    ("change", "stored"),
    [({"x": 1.4}, False), ({"x": 1.51}, True), ({"theta": 3.45}, False), ({"theta": 3.52}, True)],
)
def test_while_it_moves_a_pose_is_stored_less_often_and_again_at_rest(persistence, localizer, moving, change, stored):
    assert persistence.to_store("lab", 0.0) == POSE
    localizer.moving = moving
    localizer.trusted = msgspec.structs.replace(POSE, **change)
    assert (persistence.to_store("lab", 1.0) is not None) == stored
    localizer.moving = (0.0, 0.0)
    assert (persistence.to_store("lab", 2.0) is None) == stored


def test_a_pose_that_is_not_trusted_or_of_no_site_is_not_stored(persistence, localizer):
    assert persistence.to_store("", 0.0) is None
    localizer.trusted = None
    assert persistence.to_store("lab", 0.0) is None
