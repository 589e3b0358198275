"""A robot's link in lockstep: nothing is lost or overtaken by a delay, and nothing passes a gap."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from fog_contracts import channels as ch
from fog_contracts.handlers import Publication
from fog_contracts.messages import MapSnapshot
from fognav_experiments.computers import Link
from fognav_experiments.processes import QUERY_TIMEOUT_S, AgentProcess
from fognav_experiments.rigs import moment


@given(st.lists(st.tuples(st.floats(0.0, 3.0), st.floats(0.0, 3.0)), max_size=40))
def test_a_slow_link_loses_nothing_and_keeps_the_order(messages):
    """Each message: the time since the one before, and the link's delay from then on."""
    link, arrived, now = Link(), [], 0.0
    for number, (pause, delay) in enumerate(messages):
        now += pause
        link.due(moment(now))
        link.delay_s = delay
        link.down(lambda at, number=number, sent=now, delay=delay: arrived.append((number, at.now - sent, delay)) or (),
                  moment(now))  # fmt: skip
    link.due(moment(now + 10.0))
    assert [number for number, _, _ in arrived] == list(range(len(messages)))
    assert all(took >= delay - 1e-9 for _, took, delay in arrived)


def test_what_is_under_way_when_the_link_is_cut_is_lost():
    link, heard = Link(), []
    link.delay_s = 1.0
    link.down(lambda at: heard.append(at.now) or (), moment(0.0))
    link.hears = False
    link.due(moment(2.0))
    link.hears = True
    link.down(lambda at: heard.append(at.now) or (), moment(3.0))
    link.due(moment(5.0))
    assert heard == [5.0]


def test_each_direction_can_be_cut_alone():
    link, heard = Link(), []
    said = [Publication(ch.ROBOT_STATE, None)]
    link.hears = False
    link.down(lambda at: heard.append(at) or (), moment(1.0))
    assert list(link.up(said, moment(1.0))) == said
    assert not link.whole
    link.hears, link.is_heard = True, False
    link.down(lambda at: heard.append(at) or (), moment(2.0))
    assert list(link.up(said, moment(2.0))) == []
    assert [at.now for at in heard] == [2.0]


def test_a_query_takes_the_delay_both_ways_and_is_lost_when_either_is_cut():
    link, replies = Link(), []
    link.ask(lambda at: at.now, lambda asked, at: replies.append((asked, at.now)), moment(0.0))
    assert replies == [(0.0, 0.0)]
    link.delay_s = 1.0
    link.ask(lambda at: at.now, lambda asked, at: replies.append((asked, at.now)), moment(10.0))
    for tenth in range(100, 130):
        link.due(moment(tenth / 10))
    assert replies[1:] == [(11.0, 12.0)]
    for cut in ("is_heard", "hears"):
        link = Link()
        setattr(link, cut, False)
        link.ask(lambda at: at.now, lambda asked, at: replies.append((asked, at.now)), moment(20.0))
    assert len(replies) == 2


class Asking:
    """A robot's core that always wants a map, and what it was given; beside it a bus that answers every query."""

    def __init__(self):
        self.loaded, self.asked = [], []

    def handlers(self):
        return {}

    query_handlers = handlers

    def wants_snapshot(self, _now):
        return True

    def load(self, _snapshot, now):
        self.loaded.append(now)

    def subscribe(self, *_, **__):
        pass

    serve = subscribe

    def query(self, _channel, _request, _reply, at):
        self.asked.append(at.now)
        return MapSnapshot(
            site="s", epoch=1, seq=1, hash="0" * 64, geometry=None, cost=b"", speed=b"", static=b"",
        )  # fmt: skip


def test_a_map_that_comes_after_its_query_has_timed_out_is_not_loaded():
    robot = Asking()
    process = AgentProcess(robot, "r1", robot)
    process.link.delay_s = 2.0
    for twentieth in range(200):
        process.link.due(moment(twentieth / 20))
        process.fetch_map(moment(twentieth / 20))
    assert robot.asked == [2.0, 5.0, 8.0]
    assert robot.loaded == []
    process.link.delay_s = 0.4
    for twentieth in range(200, 400):
        process.link.due(moment(twentieth / 20))
        process.fetch_map(moment(twentieth / 20))
    assert robot.loaded
    assert all(any(0.0 < now - asked <= QUERY_TIMEOUT_S for asked in robot.asked) for now in robot.loaded)
