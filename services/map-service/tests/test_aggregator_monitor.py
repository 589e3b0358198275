"""When an area counts as clear: only while the living aggregator confirms the very hazard that says so."""

import contextlib
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from msgspec import structs

from fog_contracts import channels as ch
from fog_contracts.grid import GridGeometry, StaticMap
from fog_contracts.handlers import Moment, Publication, RefusedMessageError
from fog_contracts.messages import AggregatorHeartbeat, AreaDefinition, AreaHazard, HazardOverride, hazards_digest
from map_service.aggregator_monitor import IN_FLIGHT_S, TRUSTED_AFTER_S
from map_service.core import MapCore
from map_service.layers.hazards import HazardsLayer
from map_service.registry import make_layers

MAX_AGE_S = 1.3
PERIOD_S = 0.2
GEOMETRY = GridGeometry(80, 60, 0.05, 0.0, 0.0)


def definition(area: str, version: int = 0) -> AreaDefinition:
    return AreaDefinition(id=area, polygon=[(0.5, 0.5), (1.5, 0.5), (1.5, 1.5)], version=version)


def hazard(state: str, seq: int, *, area: str = "hall", epoch: int = 5) -> AreaHazard:
    penalty = {"blocked": 254, "unknown": 200, "clear": 0}[state]
    return AreaHazard(area=area, state=state, severity=0, penalty=penalty, since=0, seq=seq, epoch=epoch, cause="test")


class Fog:
    """A layer, and what aggregators send to it: one heartbeat per step of 0.2 s."""

    def __init__(self, *areas: str) -> None:
        self.layer = HazardsLayer(StaticMap(GEOMETRY, np.zeros(GEOMETRY.shape, np.uint8)))
        self.now = 100.0
        for area in areas or ("hall", "gate"):
            self.layer.define(definition(area), self.at)

    @property
    def at(self) -> Moment:
        return Moment(self.now, self.now + 1e6)

    def deliver(self, channel: ch.Channel, message, **ids: str) -> Sequence[Publication]:
        return self.layer.handlers()[channel](ids, message, self.at)

    def hear(self, *hazards: AreaHazard) -> None:
        for each in hazards:
            self.deliver(ch.AREA_HAZARD, each, area=each.area)

    def beat(
        self, *announced: AreaHazard, epoch: int = 5, delay: float = 0.0, complete: bool = True, **changes
    ) -> None:
        message = AggregatorHeartbeat(
            epoch=epoch, areas={h.area: h.seq for h in announced}, complete=complete, digest=hazards_digest(announced),
            uptime=self.now - delay + 5000.0, stamp=0.0,
        )  # fmt: skip
        self.deliver(ch.AGGREGATOR_HEARTBEAT, structs.replace(message, **changes))

    def run(self, seconds: float, *announced: AreaHazard, epoch: int = 5) -> None:
        """Let heartbeats arrive, if anything is announced, and the layer tick."""
        for _ in range(round(seconds / PERIOD_S)):
            self.now += PERIOD_S
            if announced:
                self.beat(*announced, epoch=epoch)
            self.layer.tick(self.at)

    def state(self, area: str = "hall") -> tuple[str, int]:
        shown = self.layer.hazard(area).hazard
        return shown.state, shown.penalty

    def requested(self) -> bool:
        return bool(self.layer.requests(self.at))


CLEAR, GATE = hazard("clear", 3), hazard("blocked", 4, area="gate")


def running() -> Fog:
    """Return a fog whose aggregator has been living for a second."""
    fog = Fog()
    fog.hear(CLEAR, GATE)
    fog.run(1.0, CLEAR, GATE)
    assert (fog.state(), fog.state("gate")) == (("clear", 0), ("blocked", 254))
    return fog


def test_retained_clear_of_a_dead_aggregator_does_not_count():
    fog = Fog()
    fog.hear(CLEAR, GATE)
    assert (fog.state(), fog.state("gate")) == (("unknown", 200), ("blocked", 254))
    shown = fog.layer.hazard("hall").hazard
    assert "does not confirm" in shown.cause
    fog.run(5.0)
    assert fog.layer.hazard("hall").hazard == shown, "published once"


def test_clear_area_is_unknown_1500_ms_after_the_last_heartbeat_and_a_blocked_one_stays_blocked():
    fog = running()
    last = fog.now
    while fog.now < last + MAX_AGE_S - 0.05:
        fog.now += 0.1
        fog.layer.tick(fog.at)
        assert fog.state() == ("clear", 0)
    fog.now = last + MAX_AGE_S + 0.1
    (changed, gate) = fog.layer.tick(fog.at)
    assert (changed.message.hazard.state, changed.message.confirmed) == ("unknown", False)
    assert changed.message.hazard.since == fog.at.stamp
    assert (gate.message.hazard.state, gate.message.confirmed) == ("blocked", False)
    assert fog.layer.tick(fog.at) == []
    fog.run(TRUSTED_AFTER_S + 2 * PERIOD_S, CLEAR, GATE)
    assert fog.state() == ("clear", 0)


@pytest.mark.parametrize("phase", [0.0, 0.001, 0.05, 0.099])
def test_area_costs_something_on_the_map_1500_ms_after_the_last_heartbeat_whatever_the_tick_s_phase(phase):
    plan = StaticMap(GEOMETRY, np.zeros(GEOMETRY.shape, dtype=np.uint8))
    core = MapCore("test", plan, layers=make_layers(plan), definitions=[definition("hall")])
    column, row = GEOMETRY.cell(1.2, 0.8)
    core.load_zones([], Moment(0.0, 0.0))

    def tick(number: int) -> None:
        at = number * ch.MAP_HEARTBEAT.period_s + phase
        core.tick(Moment(at, at))

    def beat(now: float) -> None:
        message = AggregatorHeartbeat(
            epoch=5, areas={"hall": 3}, complete=True, digest=hazards_digest([CLEAR]), uptime=now + 5000.0, stamp=0.0
        )
        core.handlers()[ch.AGGREGATOR_HEARTBEAT]({}, message, Moment(now, now))

    core.handlers()[ch.AREA_HAZARD]({"area": "hall"}, CLEAR, Moment(0.0, 0.0))
    for number in range(11):  # the last heartbeat comes after 1 s
        if number % 2 == 0:
            beat(number * ch.MAP_HEARTBEAT.period_s)
        tick(number)
    assert core.costmap.cost[row, column] == 0
    for number in range(11, 25):  # the last tick comes less than 2.5 s after the start
        tick(number)
    assert core.costmap.cost[row, column] != 0


def test_released_queue_of_heartbeats_makes_no_area_clear():
    fog = running()
    fog.now += 20.0
    fog.layer.tick(fog.at)
    for i in range(60):
        fog.beat(CLEAR, GATE, delay=20.0 - i * PERIOD_S)
        assert fog.state() == ("unknown", 200)


def test_relief_counts_once_a_heartbeat_confirms_it_and_danger_at_once():
    fog = running()
    blocked = hazard("blocked", 4)
    fog.hear(blocked)
    assert fog.state() == ("blocked", 254)
    fog.run(0.4, blocked, GATE)
    relief = hazard("clear", 5)
    fog.hear(relief)
    assert fog.state() == ("blocked", 254)
    fog.run(0.2, relief, GATE)
    assert fog.state() == ("clear", 0)


@pytest.mark.parametrize("epoch", [4, 5, 6])
def test_foreign_clear_never_clears_a_blocked_area(epoch):
    fog = running()
    with pytest.raises(RefusedMessageError) if epoch < 5 else contextlib.nullcontext():
        fog.hear(hazard("clear", 99, area="gate", epoch=epoch))
    for _ in range(20):
        fog.run(0.2, CLEAR, GATE)
        assert fog.state("gate") == ("blocked", 254)
    above = [structs.replace(h, epoch=7) for h in (CLEAR, GATE)]
    fog.hear(*above)
    for _ in range(10):
        fog.run(0.2, *above, epoch=7)
        assert (fog.state(), fog.state("gate")) == (("clear", 0), ("blocked", 254))


def declared_clear(seq: int, measured_penalty: int = 254) -> AreaHazard:
    override = HazardOverride(
        state="clear", author="ada", reason="the node is stuck", set_at=7.0, ttl_s=10.0,
        measured="blocked", measured_penalty=measured_penalty,
    )  # fmt: skip
    return structs.replace(hazard("unknown", seq), override=override)


def test_area_that_an_admin_declared_clear_is_passable_once_confirmed_and_measured_again_when_its_time_is_over():
    fog = running()
    blocked, relief = hazard("blocked", 4), declared_clear(5)
    fog.hear(blocked, relief)
    assert fog.state() == ("blocked", 254), "not confirmed yet"
    fog.run(0.4, relief, GATE)
    assert fog.state() == ("unknown", 200)
    fog.run(9.0)
    assert fog.state() == ("unknown", 200), "a restart of the aggregator strands no robot in the area"
    fog.run(1.4)
    assert fog.state() == ("unknown", 254), "nobody lives that would end it"
    fog.run(2.0, relief, GATE)
    assert fog.state() == ("unknown", 200), "its aggregator lives, and says that it still holds"


def test_changed_definition_does_not_prolong_an_admins_clearance():
    fog = running()
    blocked, relief = hazard("blocked", 4), declared_clear(5)
    fog.hear(blocked, relief)
    fog.run(8.0, relief, GATE)
    assert fog.state() == ("unknown", 200)
    fog.layer.define(definition("hall", version=1), fog.at)
    assert fog.state() == ("unknown", 200), "it holds for the changed area as well"
    fog.run(1.6)
    assert fog.state() == ("unknown", 200)
    fog.run(1.4)
    assert fog.state() == ("unknown", 254), "10 s are over, and nobody lives that would end it"


def test_retained_override_of_an_operator_that_an_area_is_clear_does_not_count():
    fog = Fog()
    fog.hear(declared_clear(3))
    assert fog.state() == ("unknown", 254)
    fog = Fog()
    fog.hear(declared_clear(3, measured_penalty=0))
    assert fog.state() == ("unknown", 200)


def test_foreign_blocked_counts_until_the_aggregator_has_gone_above_it():
    fog = running()
    fog.hear(hazard("blocked", 99, epoch=6))
    fog.run(0.4, CLEAR, GATE)
    assert fog.state() == ("blocked", 254)
    above = [structs.replace(h, epoch=7) for h in (CLEAR, GATE)]
    fog.hear(*above)
    fog.run(1.0, *above, epoch=7)
    assert fog.state() == ("clear", 0)


def test_hazards_of_a_replaced_aggregator_are_refused_but_for_dangers():
    fog = running()
    late = hazard("clear", 99, area="gate", epoch=4)
    with pytest.raises(RefusedMessageError, match="epoch 4 is below 5: another hazard-aggregator has taken over"):
        fog.hear(late)
    fog.hear(hazard("blocked", 99, epoch=4))
    assert fog.state() == ("blocked", 254)
    fog.run(1.0, CLEAR, GATE)
    assert fog.requested(), "so the one that leads says what is so"


def test_heartbeats_of_a_replaced_aggregator_are_refused():
    fog = running()
    fog.beat(CLEAR, GATE, epoch=6)
    with pytest.raises(RefusedMessageError, match="epoch 5 was replaced by the one with 6"):
        fog.beat(CLEAR, GATE, epoch=5)


def test_heartbeat_with_an_epoch_that_no_aggregator_can_have_is_refused_and_the_living_one_is_believed_still():
    fog = running()
    with pytest.raises(RefusedMessageError, match="no aggregator can have it"):
        fog.beat(CLEAR, GATE, epoch=2**53)
    fog.run(1.0, CLEAR, GATE)
    assert fog.layer.aggregator.epoch == 5
    assert fog.state() == ("clear", 0)


def test_new_aggregator_is_believed_once_its_heartbeats_kept_arriving():
    fog = running()
    own = [structs.replace(h, epoch=6) for h in (CLEAR, GATE)]
    fog.hear(*own)
    fog.beat(*own, epoch=6)
    assert fog.layer.aggregator.epoch == 5
    fog.run(0.6, *own, epoch=6)
    assert fog.layer.aggregator.epoch == 6
    assert fog.state() == ("clear", 0)


def test_area_whose_hazard_was_lost_is_unknown_until_it_is_sent_again():
    fog = running()
    lost = hazard("blocked", 4)
    fog.run(IN_FLIGHT_S, lost, GATE)
    assert fog.state() == ("clear", 0), "it may be under way still"
    assert not fog.requested()
    fog.run(0.4, lost, GATE)
    assert fog.state() == ("unknown", 200)
    assert fog.requested()
    assert not fog.requested(), "once a second"
    fog.run(1.2, lost, GATE)
    assert fog.requested()
    fog.hear(lost)
    assert fog.state() == ("blocked", 254)
    assert not fog.requested()


def test_hazard_with_altered_content_makes_all_clear_areas_unknown():
    fog = running()
    fog.run(1.0, CLEAR, structs.replace(GATE, state="unknown"))
    assert (fog.state(), fog.state("gate")) == (("unknown", 200), ("blocked", 254))
    assert fog.requested()
    fog.run(0.4, CLEAR, GATE)
    assert fog.state() == ("clear", 0)


def test_area_that_the_aggregator_does_not_list_vanishes_from_the_map():
    fog = running()
    fog.now += PERIOD_S
    fog.beat(CLEAR)
    assert [described.hazard.area for described in fog.layer.hazards()] == ["hall"]
    assert fog.state("gate") == ("clear", 0), "a late subscriber learns that it was removed"
    with pytest.raises(RefusedMessageError, match="no area nowhere"):
        fog.layer.hazard("nowhere")
    fog.deliver(ch.AREA_DEFINITION, definition("gate"), area="gate")
    fog.hear(GATE)  # late, of the removed area
    fog.run(0.4, CLEAR, GATE)
    assert fog.state("gate") == ("unknown", 200)
    again = structs.replace(GATE, seq=GATE.seq + 1)
    fog.hear(again)
    fog.run(0.4, CLEAR, again)
    assert fog.state("gate") == ("blocked", 254)


def test_danger_of_a_newer_aggregator_stays_while_the_one_before_it_is_believed_and_does_not_list_its_area():
    fog = running()
    fog.deliver(ch.AREA_DEFINITION, structs.replace(definition("new", 1), epoch=6), area="new")
    fog.hear(hazard("blocked", 1, area="new", epoch=6))
    fog.beat(CLEAR, GATE)
    assert fog.state("new") == ("blocked", 254)


def test_danger_is_shown_again_after_a_heartbeat_from_before_its_area_came_late():
    fog, new = running(), hazard("blocked", 1, area="new")
    for heartbeat in ((CLEAR, GATE), (CLEAR, GATE, new)):
        fog.deliver(ch.AREA_DEFINITION, structs.replace(definition("new", 1), epoch=5), area="new")
        fog.hear(new)
        fog.beat(*heartbeat)
    fog.hear(new)  # as requested
    assert fog.state("new") == ("blocked", 254)


def test_area_stays_while_the_aggregator_does_not_know_all_areas_and_is_not_clear():
    fog = running()
    gate = hazard("clear", 5, area="gate")
    fog.hear(gate)
    fog.run(0.4, CLEAR, gate)
    assert fog.state("gate") == ("clear", 0)
    for _ in range(6):
        fog.now += PERIOD_S
        fog.beat(CLEAR, complete=False)
    assert (fog.state(), fog.state("gate")) == (("clear", 0), ("unknown", 200))


def test_missing_definition_is_requested():
    fog = Fog("hall")
    fog.hear(CLEAR, GATE)
    fog.run(1.4, CLEAR, GATE)
    assert fog.layer.aggregator.overdue(fog.now) == ["gate"]
    assert fog.requested()


def test_hazard_on_the_topic_of_another_area_is_refused():
    with pytest.raises(RefusedMessageError, match="another area, hall"):
        Fog().deliver(ch.AREA_HAZARD, CLEAR, area="gate")


# --- Invariant ------------------------------------------------------------------------------------------------------

STATES = st.sampled_from(["blocked", "unknown", "clear"])
STEPS = st.one_of(
    st.tuples(st.just("change"), STATES),
    st.tuples(st.just("lose"), STATES),
    st.tuples(st.just("foreign"), STATES, st.integers(-1, 3), st.integers(0, 40)),
    st.tuples(st.just("silence"), st.floats(0.1, 4.0)),
    st.tuples(st.just("beats"), st.integers(1, 8)),
    st.tuples(st.just("restart"), STATES),
    st.tuples(st.just("republish"), st.just("")),
)


@given(st.lists(STEPS, max_size=40))
@example([("change", "blocked"), ("beats", 4), ("foreign", "blocked", -1, 0)])
@example([("change", "clear"), ("beats", 4), ("lose", "blocked"), ("silence", 1.0), ("beats", 2)])
@settings(max_examples=200, deadline=None)
def test_clear_area_is_one_that_the_aggregator_announced_as_clear_within_the_limit(steps):
    fog = Fog("hall")
    epoch, seq, state = 10, 1, "unknown"
    clear_until = -1.0
    fog.hear(hazard(state, seq, epoch=epoch))
    for kind, value, *rest in steps:
        if kind in {"change", "lose"}:
            state, seq = value, seq + 1
            if kind == "change":
                fog.hear(hazard(state, seq, epoch=epoch))
        elif kind == "foreign":
            # Nobody is refused but a replaced aggregator, unless it speaks of a danger that is not known yet.
            with contextlib.suppress(RefusedMessageError) if rest[0] < 0 else contextlib.nullcontext():
                fog.hear(hazard(value, rest[1], epoch=epoch + rest[0]))
        elif kind == "restart":
            epoch, seq, state = epoch + 5, 1, value
            fog.hear(hazard(state, seq, epoch=epoch))
        elif kind == "republish":
            fog.hear(hazard(state, seq, epoch=epoch))
        elif kind == "silence":
            fog.now += value
            fog.layer.tick(fog.at)
        for _ in range(value if kind == "beats" else 0):
            fog.run(PERIOD_S, hazard(state, seq, epoch=epoch), epoch=epoch)
            # What the heartbeat does not confirm any more may hold for as long as its message may be under way.
            if state == "clear":
                clear_until = fog.now + MAX_AGE_S
            assert fog.state()[0] != "clear" or fog.now <= clear_until
        assert fog.state()[0] != "clear" or fog.now <= clear_until
