"""Which parts of a blocked area sonars show free: by fresh echoes of the far wall only, and none in any doubt."""

import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import structs

from fog_contracts.messages import AreaDefinition, NodeReading, RobotPose, Source, is_relief
from fog_contracts.site import NodeSite, Sonar
from hazard_aggregator.areas import AreaOverride
from hazard_aggregator.free_parts import FREE_AFTER_S, FRESH_S, HELD_S
from hazard_aggregator.fusion import AreaFusion
from hazard_aggregator.registry import find_rule

SQUARE = [(1.0, 0.0), (3.0, 0.0), (3.0, 3.0), (1.0, 3.0)]
SONARS = [Sonar(angle=angle, range_limit=3.0, range_max=3.6) for angle in (-0.12, 0.12)]
NODES = [NodeSite(id=f"n{number}", area="hall", x=0.0, y=0.7 * number, theta=0.0, sonars=SONARS) for number in (1, 2)]
CONES = {
    node.id: [[(node.x, node.y), (3.0, node.y + 0.3 * index), (3.0, node.y + 0.3 * index + 0.3)] for index in range(2)]
    for node in NODES
}
WALL, BOX, BEHIND, NOTHING = 3.3, 1.5, 3.9, None
FREE, BLOCKED = (WALL, WALL), (BOX, WALL)


class Hall:
    """An area that two nodes with two sonars each watch; readings come ten times a second."""

    def __init__(self, nodes=NODES, **fields) -> None:
        fields = {"polygon": SQUARE, "free_width": 0.5, "nodes": ["n1", "n2"], **fields}
        definition = AreaDefinition(id="hall", **fields)
        self.fusion = AreaFusion([definition], nodes, 5, registry=find_rule, sonar_cones=CONES)
        self.now, self.seq = 100.0, itertools.count(1)
        self.changes = []
        self.shown = {}

    def read(self, node: str, ranges) -> None:
        status = ["no_echo" if measured is None else "ok" for measured in ranges]
        states = [
            "unknown" if measured is None or measured > 3.6 else "blocked" if measured < 3.0 else "clear"
            for measured in ranges
        ]
        state = next((each for each in ("blocked", "unknown") if each in states), "clear")
        reading = NodeReading(
            seq=next(self.seq), boot=1, uptime_ms=round(1000 * self.now), range_m=list(ranges), status=status,
            state=state,
        )  # fmt: skip
        self.note(self.fusion.on_reading(node, reading, self.now, self.now))

    def note(self, changed) -> None:
        self.changes += changed

    def run(self, seconds: float, n1=FREE, n2=BLOCKED) -> None:
        for _ in range(round(seconds / 0.1)):
            self.now += 0.1
            for node, ranges in (("n1", n1), ("n2", n2)):
                if ranges is not None:
                    self.read(node, ranges)
            self.note(self.fusion.tick(self.now, self.now))

    @property
    def hazard(self):
        return self.fusion.hazards()[0]

    @property
    def free(self):
        names = [(node, index) for node, cones in CONES.items() for index in range(len(cones))]
        return {name for name in names if CONES[name[0]][name[1]] in self.hazard.free}


LOWER = {("n1", 0), ("n1", 1), ("n2", 1)}


def halved() -> Hall:
    hall = Hall()
    hall.run(FREE_AFTER_S + 2.0)
    assert hall.free == LOWER
    return hall


def test_sonars_that_hear_the_far_wall_show_their_parts_free_after_a_time_and_all_others_none():
    hall = Hall()
    hall.run(FREE_AFTER_S - 0.5)
    assert hall.hazard.state == "blocked"
    assert hall.free == set()
    hall.run(1.0)
    assert hall.free == LOWER
    assert all(is_relief(after, before) == bool(after.free) for before, after in itertools.pairwise(hall.changes[-2:]))


def test_sonars_that_look_through_what_another_one_hears_near_or_past_the_area_show_nothing(monkeypatch):
    monkeypatch.setitem(CONES, "n2", [[(0.0, 0.0), (3.0, 0.0), (3.0, 1.0), (0.0, 1.0)], CONES["n2"][1]])
    hall = Hall()
    hall.run(FREE_AFTER_S + 2.0)
    assert hall.hazard.state == "blocked"
    assert hall.free == set(), "one is left, which is not enough"
    hall = Hall(polygon=[(1.0, 2.0), (3.0, 2.0), (3.0, 3.0), (1.0, 3.0)])
    hall.run(FREE_AFTER_S + 2.0)
    assert hall.free == set()


def test_it_is_off_by_default():
    hall = Hall(free_width=None)
    hall.run(FREE_AFTER_S + 2.0)
    assert hall.hazard.state == "blocked"
    assert hall.hazard.free == []


@pytest.mark.parametrize("heard", [(NOTHING, NOTHING), (BEHIND, WALL), (BOX, WALL), (NOTHING, WALL)])
def test_first_reading_that_hears_anything_else_ends_what_it_showed(heard):
    hall = halved()
    hall.now += 0.1
    hall.read("n1", heard)
    assert not ({("n1", index) for index, measured in enumerate(heard) if measured != WALL} & hall.free)
    hall.run(FREE_AFTER_S - 0.5)
    assert ("n1", 0) not in hall.free, "the time begins anew"
    hall.run(1.0)
    assert hall.free == LOWER


def test_node_that_is_silent_shows_nothing_and_once_it_is_unknown_nobody_does():
    hall = halved()
    hall.run(FRESH_S + 0.2, n1=None)
    assert hall.free == set(), "one sonar is not enough"
    hall.run(2.0, n1=None)
    assert {report.id: report.state for report in hall.fusion.node_reports(hall.now)}["n1"] == "unknown"
    assert hall.free == set()


def test_echoes_of_the_wall_by_all_sonars_of_the_blocked_node_free_nothing_before_it_is_clear():
    hall = halved()
    hall.now += 0.1
    hall.read("n2", FREE)
    assert hall.hazard.state == "blocked"
    assert hall.free == set(), "nobody knows where the box is"


@pytest.mark.parametrize("sonar", [Sonar(range_limit=3.0), Sonar(range_limit=3.0, no_echo_is_clear=True)])
def test_sonar_whose_wall_is_not_calibrated_shows_nothing(sonar):
    plain = [structs.replace(sonar, angle=each.angle) for each in SONARS]
    hall = Hall([structs.replace(NODES[0], sonars=plain), NODES[1]])
    hall.run(FREE_AFTER_S + 2.0)
    assert hall.hazard.state == "blocked"
    assert hall.free == set()


@pytest.mark.parametrize("by_light", [False, True])
def test_one_sonar_is_too_few_and_one_time_of_flight_sensor_enough(by_light):
    single = [structs.replace(SONARS[0], time_of_flight=by_light)]
    nodes = [structs.replace(node, sonars=single) for node in NODES]
    hall = Hall(nodes)
    hall.run(FREE_AFTER_S + 2.0, n1=(WALL,), n2=(BOX,))
    assert hall.hazard.state == "blocked"
    assert hall.free == ({("n1", 0)} if by_light else set())


def test_operators_override_and_sources_that_see_no_place_close_the_whole_area():
    hall = halved()
    override = AreaOverride(
        area="hall", state="blocked", author="anna", reason="wet", ttl_s=60.0, set_at=1.0, boot="b", deadline=1e6,
        version=1,
    )  # fmt: skip
    hall.note(hall.fusion.set_override("hall", override, hall.now))
    assert hall.hazard.free == []
    source = Source(id="door", topic="door", blocked=["open"], clear=["shut"], period_s=10.0)
    hall = Hall(sources=[source])
    hall.fusion.on_source("door", b"open", hall.now, hall.now, retained=False)
    hall.run(FREE_AFTER_S + 2.0)
    assert hall.hazard.state == "blocked"
    assert hall.free == set()


def robot_at(x: float) -> RobotPose:
    return RobotPose(x=x, y=0.7, theta=0.0, covariance=[0.0] * 9, v=0.15, w=0.0, radius=0.17, height=0.35, stamp=0.0)


def test_robot_that_drives_along_the_free_part_leaves_it_free_for_as_long_as_that_takes_and_no_longer():
    hall = halved()
    for step in range(round((HELD_S - 1.0) / 0.1)):
        hall.fusion.on_pose("r1", robot_at(0.4 + 0.012 * step), hall.now)
        seen = 0.4 + 0.012 * step - 0.17
        hall.run(0.1, n1=(seen, seen))
        assert hall.free == LOWER, step
    for _ in range(round((FRESH_S + 2.0) / 0.1)):
        hall.fusion.on_pose("r1", robot_at(2.6), hall.now)
        hall.run(0.1, n1=(2.43, 2.43))
    assert hall.free == set()


steps = st.lists(
    st.tuples(
        st.sampled_from([FREE, BLOCKED, (NOTHING, WALL), (WALL, BEHIND), (BOX, BOX), None]),
        st.sampled_from([FREE, BLOCKED, (BOX, BOX), None]),
        st.sampled_from([0.1, 0.5, 3.0, 6.0]),
    ),
    min_size=1,
    max_size=8,
)


@settings(deadline=None, max_examples=40)
@given(steps=steps)
def test_no_part_is_free_whose_sonar_heard_anything_but_the_wall_in_the_last_seconds(steps):
    hall = Hall()
    heard: dict[tuple[str, int], list[tuple[float, float | None]]] = {}
    for n1, n2, seconds in [(FREE, BLOCKED, 6.0), *steps]:
        for _ in range(round(seconds / 0.1)):
            began = len(hall.changes)
            hall.run(0.1, n1, n2)
            for node, ranges in (("n1", n1), ("n2", n2)):
                for index, measured in enumerate(ranges or ()):
                    heard.setdefault((node, index), []).append((hall.now, measured))
            for sonar in hall.free:
                recent = [measured for at, measured in heard[sonar] if hall.now - at < FREE_AFTER_S - 0.05]
                assert set(recent) == {WALL}
                assert hall.now - heard[sonar][-1][0] <= FRESH_S + 0.05
                assert hall.hazard.state == "blocked"
                assert any(measured == BOX for _, measured in (heard[each][-1] for each in heard))
            for before, after in itertools.pairwise(hall.changes[max(0, began - 1) :]):
                gained = [part for part in after.free if part not in before.free]
                lost = [part for part in before.free if part not in after.free]
                assert not (gained and lost), "a danger never waits with a relief"
                assert not gained or before.state == after.state == "blocked"
