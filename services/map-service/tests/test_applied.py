"""Which robots use a map that contains a change, by the versions that they report."""

from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs
from sample_messages import sample

from fog_contracts.handlers import Moment
from fog_contracts.messages import RobotState
from fog_contracts.replica import Version
from map_service.applied import MAX_CHANGES, Applied

STATE = sample(RobotState)


def report(applied, robot, epoch, seq, now):
    applied.heard(robot, structs.replace(STATE, map_epoch=epoch, map_seq=seq), Moment(now, 1_000.0 + now))


@given(st.lists(st.tuples(st.integers(1, 2), st.integers(0, 9)), min_size=1, max_size=30), st.integers(0, 9))
def test_robot_has_a_change_from_the_first_of_its_versions_that_is_not_older(reported, seq):
    applied = Applied()
    applied.changed("zone", "wet", "active", Version(1, seq, 0), 1_000.0)
    history = sorted(reported)
    for number, (epoch, number_seq) in enumerate(history):
        report(applied, "r1", epoch, number_seq, float(number))
    (change,) = applied.changes(now=len(history) - 1.0)
    first = next((number for number, version in enumerate(history) if version >= (1, seq)), None)
    assert change.robots[0].applied == (first is not None)
    assert change.robots[0].since == 1_000.0 + (first or 0)


def test_robot_that_starts_again_with_an_older_map_has_no_newer_change():
    applied = Applied()
    applied.changed("zone", "wet", "active", Version(5, 3, 0), 1_000.0)
    report(applied, "r1", 5, 3, 1.0)
    assert next(applied.changes(now=1.0)).robots[0].applied
    report(applied, "r1", 0, 0, 2.0)
    assert not next(applied.changes(now=2.0)).robots[0].applied


def test_after_a_change_of_the_leading_map_service_robots_have_a_change_once_they_have_its_map():
    applied = Applied()
    applied.changed("zone", "wet", "active", Version(0, 7, 0), 1_000.0)
    report(applied, "r1", 4, 90, 1.0)
    applied.restart(Version(5, 7, 0))
    assert not next(applied.changes(now=1.0)).robots[0].applied
    report(applied, "r1", 5, 7, 2.0)
    assert next(applied.changes(now=2.0)).robots[0].applied


def test_latest_changes_come_first_and_the_oldest_are_forgotten():
    applied = Applied()
    for number in range(MAX_CHANGES + 1):
        applied.changed("zone", f"z{number}", "active", Version(1, number, 0), 1_000.0)
    applied.changed("hazard", "hall", "blocked", Version(1, MAX_CHANGES + 1, 0), 1_000.0)
    applied.changed("zone", "z5", "removed", Version(1, MAX_CHANGES + 2, 0), 1_000.0)
    changes = list(applied.changes(now=0.0))
    assert len(changes) == MAX_CHANGES
    assert [change.id for change in changes[:3]] == ["z5", "hall", f"z{MAX_CHANGES}"]
    assert [change.state for change in applied.changes(0.0, "zone", "z5")] == ["removed"]
    assert not list(applied.changes(0.0, "zone", "z0"))
