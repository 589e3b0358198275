"""When the aggregator publishes: dangers at once, reliefs once stored, everything again for a new broker."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs

from fog_contracts import channels as ch
from fog_contracts.handlers import Moment, Publication, RefusedMessageError
from fog_contracts.messages import (
    AggregatorHeartbeat,
    AreaDefinition,
    AreaHazard,
    NodeConfig,
    NodeReading,
    hazards_digest,
    is_relief,
)
from fog_contracts.site import NodeSite, Sonar
from hazard_aggregator.core import Aggregator, Outbox
from hazard_aggregator.fusion import AreaFusion
from hazard_aggregator.history import period_of
from hazard_aggregator.publications import wsn_line
from hazard_aggregator.registry import find_rule

SQUARE = [(0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (0.0, 1.0)]
AREA = AreaDefinition(id="hall", polygon=SQUARE, nodes=["n1"], number=7)
NODE = NodeSite(id="n1", area="hall", x=0.0, y=0.5, theta=0.0, sonars=[Sonar(range_limit=1.2, no_echo_is_clear=True)])


def stored(state: str, penalty: int, epoch: int = 0) -> AreaHazard:
    return AreaHazard(area="hall", state=state, severity=3, penalty=penalty, since=1.0, seq=9, epoch=epoch, cause="")


def heartbeat(epoch: int, uptime: float = 1.0) -> AggregatorHeartbeat:
    return AggregatorHeartbeat(epoch=epoch, areas={}, complete=True, digest=0, uptime=uptime, stamp=0.0)


class Rig:
    """A core that gets messages through its handlers, 0.1 s apart."""

    def __init__(self, *restored: AreaHazard, complete: bool = True) -> None:
        self.core = Aggregator(
            AreaFusion([AREA], [NODE], 5, restored, registry=find_rule, default_rule="consecutive"), complete=complete
        )
        self.now = 100.0
        self.seq = 0
        self.published: list[Publication] = []
        self.published += self.core.tick(self.at)

    @property
    def at(self) -> Moment:
        return Moment(self.now, self.now + 1e6)

    def deliver(self, channel: ch.Channel, message: object, **ids: str) -> list[Publication]:
        self.now += 0.1
        publications = list(self.core.handlers()[channel](ids, message, self.at))
        self.published += publications
        return publications

    def read(self, distance: float, times: int = 5) -> None:
        for _ in range(times):
            self.seq += 1
            state = "blocked" if distance < 1.2 else "clear"
            reading = NodeReading(
                seq=self.seq, boot=1, uptime_ms=round(1000 * self.now), range_m=[distance], status=["ok"], state=state
            )
            self.deliver(ch.NODE_READING, reading, node="n1")

    def states(self) -> list[str]:
        return [p.message.state for p in self.published if p.channel is ch.AREA_HAZARD]

    def lines(self) -> list[str]:
        return [p.message for p in self.published if p.channel is ch.THESIS_WSN]


def test_danger_is_published_at_once_with_its_thesis_line():
    rig = Rig()
    rig.published.clear()
    rig.read(0.8)
    assert [(p.channel.name, dict(p.ids)) for p in rig.published] == [
        ("area_hazard", {"area": "hall"}),
        ("thesis_wsn", {}),
    ]
    assert rig.states() == ["blocked"]
    assert rig.lines() == ["7,0.000,0.500"]
    assert [hazard.state for hazard in rig.core.to_store()] == ["blocked"]


def test_relief_is_published_once_it_is_stored():
    rig = Rig()
    rig.read(0.8)
    rig.published.clear()
    rig.read(3.0)
    assert rig.states() == []
    assert rig.core.withheld() == ["hall"]
    assert rig.core.announced()["hall"].state == "blocked"
    rig.published += rig.core.mark_stored(rig.core.to_store())
    assert (rig.states(), rig.lines()) == (["clear"], ["7,-999,-999"])
    assert (rig.core.to_store(), rig.core.withheld()) == ([], [])


def test_hazard_and_its_period_name_the_node_that_decided_and_identify_why():
    rig = Rig()
    rig.read(0.8)
    hazard = next(p.message for p in reversed(rig.published) if p.channel is ch.AREA_HAZARD)
    assert (hazard.state, hazard.code, hazard.decided_by) == ("blocked", "something_near", "n1")
    period = period_of(hazard, None)
    assert (period.code, period.decided_by) == ("something_near", "n1")


def test_availability_that_is_neither_online_nor_offline_is_refused():
    rig = Rig()
    with pytest.raises(RefusedMessageError, match="maybe"):
        rig.deliver(ch.NODE_AVAILABILITY, "maybe", node="n1")
    rig.read(3.0)
    rig.core.mark_stored(rig.core.to_store())
    rig.published.clear()
    rig.deliver(ch.NODE_AVAILABILITY, "offline", node="n1")
    assert rig.states() == ["unknown"]


def test_retained_hazard_of_an_earlier_run_is_restored():
    rig = Rig()
    rig.published.clear()
    rig.deliver(ch.AREA_HAZARD, stored("blocked", 254, epoch=4), area="hall")
    assert [p.message.penalty for p in rig.published if p.channel is ch.AREA_HAZARD] == [254]
    assert rig.core.outranked_by is None


def test_reconnected_broker_gets_definitions_announced_hazards_and_node_configs():
    rig = Rig()
    rig.read(0.8)
    rig.read(3.0)
    republished = rig.core.republish_all()
    assert [p.message for p in republished if p.channel is ch.AREA_DEFINITION] == [structs.replace(AREA, epoch=5)]
    assert [p.message.state for p in republished if p.channel is ch.AREA_HAZARD] == ["blocked"], "relief not stored"
    (config,) = [p.message for p in republished if p.channel is ch.NODE_CONFIG]
    assert isinstance(config, NodeConfig)
    assert (config.range_limit_m, config.no_echo_is_clear, config.version > 0) == ([1.2], [True], True)


def test_stored_areas_and_hazards_take_effect_when_they_are_loaded_late():
    rig = Rig()
    rig.published.clear()
    gate_area = AreaDefinition(id="gate", polygon=SQUARE, number=8)
    rig.published += rig.core.restore([gate_area], [stored("blocked", 254)], rig.at)
    hall, gate = (rig.core.announced()[name] for name in ("hall", "gate"))
    assert (hall.state, hall.penalty, gate.state) == ("unknown", 254, "unknown")
    assert rig.core.thesis_numbers() == [7, 8]
    assert {p.ids["area"] for p in rig.published if p.channel is ch.AREA_DEFINITION} == {"hall", "gate"}


def test_since_is_taken_over_from_hazards_that_are_loaded_late():
    rig = Rig(complete=False)
    rig.read(0.8)
    assert rig.core.announced()["hall"].since > 1e6
    rig.core.restore([], [stored("blocked", 254)], rig.at)
    assert (rig.core.announced()["hall"].state, rig.core.announced()["hall"].since) == ("blocked", 1.0)
    rig.read(3.0)
    rig.core.mark_stored(rig.core.to_store())
    rig.read(0.8)
    assert rig.core.announced()["hall"].since > 1e6, "blocked anew"
    silent = Rig(complete=False)
    silent.core.restore([], [stored("unknown", 200)], silent.at)
    assert silent.core.announced()["hall"].since == 1.0


def test_since_of_an_area_that_changed_meanwhile_is_kept_when_hazards_are_loaded_late():
    rig = Rig(complete=False)
    rig.read(3.0)
    rig.core.mark_stored(rig.core.to_store())
    rig.read(0.8)
    since = rig.core.announced()["hall"].since
    rig.core.restore([], [stored("blocked", 254)], rig.at)
    assert rig.core.announced()["hall"].since == since


def test_area_that_was_removed_while_another_aggregator_led_is_deleted_from_the_broker_for_good():
    rig = Rig()
    assert "hall" in rig.core.announced()
    removed = AreaDefinition(id="hall", polygon=SQUARE, removed=True, version=1)
    for published in (rig.core.restore([removed], [], rig.at), rig.core.set_epoch(6), rig.core.republish_all()):
        about = [(each.channel.name, each.message) for each in published if each.ids == {"area": "hall"}]
        assert about == [("area_hazard", None), ("area_definition", None)]
    assert rig.core.to_store() == []


def test_removed_area_is_published_as_removed_and_leaves_nothing_to_store():
    rig = Rig()
    removed = AreaDefinition(id="hall", polygon=SQUARE, removed=True, version=1)
    publications = rig.core.put_area(removed, rig.at)
    assert [(p.channel.name, p.message) for p in publications] == [
        ("area_definition", structs.replace(removed, epoch=5)),
        ("area_hazard", None),
        ("area_definition", None),
    ]
    assert (rig.core.to_store(), rig.core.announced(), rig.core.thesis_numbers()) == ([], {}, [])


# --- The aggregator's own messages on the broker ---------------------------------------------------------------------


def heartbeats(publications: list[Publication]) -> list[AggregatorHeartbeat]:
    return [p.message for p in publications if p.channel is ch.AGGREGATOR_HEARTBEAT]


def test_heartbeat_is_published_five_times_a_second_and_lists_every_announced_hazard():
    rig = Rig()
    rig.read(0.8)
    beats = []
    for _ in range(20):
        rig.now += 0.1
        beats += heartbeats(rig.core.tick(rig.at))
    assert len(beats) == 10
    announced = rig.core.announced()["hall"]
    assert (beats[-1].epoch, beats[-1].areas, beats[-1].complete) == (5, {"hall": announced.seq}, True)
    assert beats[-1].digest == hazards_digest([announced])
    assert beats[-1].uptime - beats[0].uptime == pytest.approx(1.8)
    rig.read(3.0)
    assert rig.core.withheld() == ["hall"]
    rig.now += 1.0
    assert heartbeats(rig.core.tick(rig.at))[0].areas == {"hall": announced.seq}, "what is withheld is not announced"


def test_late_tick_causes_no_burst_of_heartbeats():
    rig = Rig()
    rig.now += 10.0
    assert len(heartbeats([*rig.core.tick(rig.at), *rig.core.tick(rig.at)])) == 1


def test_own_messages_that_the_broker_returns_are_not_foreign():
    rig = Rig()
    rig.read(0.8)
    rig.now += 0.3
    own = [*rig.published, *rig.core.tick(rig.at)]
    own += rig.core.set_epoch(9)
    rig.now += 0.3
    own += rig.core.tick(rig.at)
    rig.published.clear()
    for publication in own:
        if publication.channel in {ch.AREA_HAZARD, ch.AGGREGATOR_HEARTBEAT}:
            rig.deliver(publication.channel, publication.message, **publication.ids)
    assert rig.published == []
    assert rig.core.pop_foreign() == []
    assert rig.core.outranked_by is None


@pytest.mark.parametrize("epoch", [5, 77])
@pytest.mark.parametrize("state", ["clear", "blocked"])
def test_aggregator_goes_above_a_foreign_hazard_and_publishes_its_own_message_again(epoch, state):
    rig = Rig()
    rig.read(0.8)
    own = rig.core.announced()["hall"]
    foreign = structs.replace(own, state=state, penalty=0 if state == "clear" else 254, seq=own.seq + 9, epoch=epoch)
    rig.deliver(ch.AREA_HAZARD, foreign, area="hall")
    assert rig.core.outranked_by == epoch
    assert [tuple(f) for f in rig.core.pop_foreign()] == [("hazard", epoch, "hall")]
    published = rig.core.set_epoch(epoch + 1)
    (again,) = [p.message for p in published if p.channel is ch.AREA_HAZARD]
    assert (again.state, again.penalty, again.epoch) == ("blocked", 254, epoch + 1)
    assert rig.core.outranked_by is None
    assert [h.epoch for h in rig.core.to_store()] == [epoch + 1]
    with pytest.raises(ValueError, match="only grows"):
        rig.core.set_epoch(epoch + 1)


def test_aggregator_gets_above_a_forged_epoch_as_far_as_receivers_follow_it():
    rig = Rig()
    rig.deliver(ch.AGGREGATOR_HEARTBEAT, heartbeat(epoch=2**53))
    assert rig.core.outranked_by is not None
    rig.core.set_epoch(rig.core.outranked_by + 1)
    assert rig.core.epoch < 2**53
    assert rig.core.outranked_by is None


def test_foreign_heartbeat_with_a_higher_epoch_outranks_and_a_lower_one_does_not():
    rig = Rig()
    rig.deliver(ch.AGGREGATOR_HEARTBEAT, heartbeat(epoch=4))
    assert rig.core.outranked_by is None
    rig.deliver(ch.AGGREGATOR_HEARTBEAT, heartbeat(epoch=5, uptime=3.0))
    assert rig.core.outranked_by == 5
    rig.deliver(ch.AGGREGATOR_HEARTBEAT, heartbeat(epoch=8))
    assert rig.core.outranked_by == 8


def test_own_message_is_published_again_over_a_foreign_one_with_a_lower_epoch():
    rig = Rig()
    rig.read(0.8)
    rig.published.clear()
    rig.deliver(ch.AREA_HAZARD, stored("clear", 0, epoch=3), area="hall")
    assert [(p.message.state, p.message.epoch) for p in rig.published if p.channel is ch.AREA_HAZARD] == [
        ("blocked", 5)
    ]


def test_hazard_on_the_topic_of_another_area_is_refused():
    rig = Rig()
    with pytest.raises(RefusedMessageError, match="another area"):
        rig.deliver(ch.AREA_HAZARD, stored("clear", 0), area="gate")


def test_retained_messages_of_an_area_that_nobody_lists_are_deleted_from_the_broker():
    rig = Rig()
    gone = structs.replace(stored("blocked", 254), area="gone")
    deleted = rig.deliver(ch.AREA_HAZARD, gone, area="gone")
    assert [(p.channel, p.message, p.ids["area"]) for p in deleted] == [
        (ch.AREA_HAZARD, None, "gone"),
        (ch.AREA_DEFINITION, None, "gone"),
    ]


def test_no_area_counts_as_gone_before_the_stored_areas_are_loaded():
    rig = Rig(complete=False)
    for name in ("gone", "gate"):
        rig.deliver(ch.AREA_HAZARD, structs.replace(stored("blocked", 254), area=name), area=name)
    rig.now += 1.0
    assert [beat.complete for beat in heartbeats(rig.core.tick(rig.at))] == [False]
    assert [p for p in rig.published if p.message is None] == []
    loaded = rig.core.restore([AreaDefinition(id="gate", polygon=SQUARE)], [], rig.at)
    assert {p.ids["area"] for p in loaded if p.message is None} == {"gone"}
    rig.now += 1.0
    (beat,) = heartbeats(rig.core.tick(rig.at))
    assert beat.complete
    assert set(beat.areas) == {"hall", "gate"}


def test_everything_is_published_again_on_request_and_another_request_is_refused():
    rig = Rig()
    assert rig.deliver(ch.AGGREGATOR_REQUEST, ch.REPUBLISH) == rig.core.republish_all()
    with pytest.raises(RefusedMessageError, match="restart"):
        rig.deliver(ch.AGGREGATOR_REQUEST, "restart")


def test_flood_of_requests_for_everything_is_answered_twice_a_second():
    rig = Rig()
    handle, everything = rig.core.handlers()[ch.AGGREGATOR_REQUEST], rig.core.republish_all()
    answers = [handle({}, ch.REPUBLISH, Moment(100.0 + 0.01 * step, 0.0)) for step in range(150)]
    assert [answer for answer in answers if answer] == [everything] * 3


def test_thesis_line_has_the_position_of_node_or_area_and_none_when_clear():
    assert wsn_line(AREA, stored("blocked", 254)) == "7,1.000,0.500"
    assert wsn_line(AREA, stored("blocked", 254), NODE) == "7,0.000,0.500"
    assert wsn_line(AREA, stored("clear", 0)) == "7,-999,-999"
    assert wsn_line(AREA, stored("unknown", 200)) == "7,1.000,0.500"


def hazard(state: str, seq: int, penalty: int | None = None, area: str = "hall") -> AreaHazard:
    cost = {"blocked": 254, "unknown": 200, "clear": 0}[state] if penalty is None else penalty
    return AreaHazard(area=area, state=state, severity=0, penalty=cost, since=0.0, seq=seq, epoch=1, cause="")


def test_stored_clear_is_not_announced_after_a_newer_danger():
    outbox = Outbox()
    outbox.offer([hazard("blocked", 1)])
    clear = hazard("clear", 2)
    outbox.offer([clear])
    newer = hazard("blocked", 3)
    assert outbox.offer([newer]) == [newer]
    assert outbox.mark_stored([clear]) == []
    assert outbox.announced() == [newer]
    assert outbox.unstored() == [newer]


states = st.sampled_from([("blocked", 254), ("unknown", 254), ("unknown", 200), ("clear", 0)])


@given(st.lists(st.one_of(states, st.just("store"), st.just("begin")), max_size=60))
def test_no_relief_is_announced_before_it_is_stored(steps):
    outbox = Outbox()
    on_disk: AreaHazard | None = None
    announced: AreaHazard | None = None
    in_flight: list[AreaHazard] = []
    for seq, step in enumerate(steps):
        if step == "begin":
            in_flight = outbox.unstored()
            continue
        if step == "store":
            on_disk = in_flight[0] if in_flight else on_disk
            released = outbox.mark_stored(in_flight)
            in_flight = []
        else:
            released = outbox.offer([hazard(step[0], seq, step[1])])
        for newest in released:
            if is_relief(newest, announced):
                assert on_disk is newest
            assert announced is None or newest.seq > announced.seq
            announced = newest
    assert outbox.announced() == ([announced] if announced else [])
