"""Operators' overrides of areas: what counts while they hold, when they end, and what a restart leaves of them."""

import itertools

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
from msgspec import structs

from fog_contracts import channels as ch
from fog_contracts.handlers import Moment
from fog_contracts.messages import AreaDefinition, AreaHazard, NodeReading, UnknownPolicy
from fog_contracts.site import NodeSite, Sonar
from hazard_aggregator.areas import AreaOverride, Rest
from hazard_aggregator.core import Aggregator
from hazard_aggregator.fusion import AreaFusion
from hazard_aggregator.overrides import StoredOverrides
from hazard_aggregator.registry import find_rule

AREA = AreaDefinition(id="hall", polygon=[(0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (0.0, 1.0)], nodes=["n1"], number=7)
NODE = NodeSite(id="n1", area="hall", x=0.0, y=0.5, theta=0.0, sonars=[Sonar(range_limit=1.2, no_echo_is_clear=True)])
BOOT = "this-boot"
DISTANCES = {"blocked": 0.8, "clear": 3.0}


class Rig:
    """A core whose store answers at once, and the records that it would find after a restart."""

    def __init__(self, area: AreaDefinition = AREA) -> None:
        self.area = area
        self.now = 100.0
        self.boot = BOOT
        self.boots = itertools.count()
        self.seq = itertools.count()
        self.versions = itertools.count(1)
        self.stored_hazards: dict[str, AreaHazard] = {}
        self.stored: dict[str, AreaOverride] = {}
        self.rests: dict[str, Rest] = {}
        self.start()

    @property
    def at(self) -> Moment:
        return Moment(self.now, self.now + 1e6)

    @property
    def hazard(self) -> AreaHazard:
        return self.core.announced()["hall"]

    def start(self, *, with_store: bool = True) -> None:
        restored = self.stored_hazards.values() if with_store else ()
        fusion = AreaFusion([self.area], [NODE], 0, restored, registry=find_rule, default_rule="consecutive")
        self.core = Aggregator(fusion, complete=with_store)
        if with_store:
            self.load()
        self.tick(0.0)

    def load(self) -> None:
        self.core.load_overrides(StoredOverrides(self.stored.values(), self.rests, self.boot), self.at)

    def settle(self) -> None:
        """Store what is to be stored, and delete what has ended."""
        for hazard in self.core.to_store():
            self.stored_hazards[hazard.area] = hazard
        self.core.mark_stored(self.core.to_store())
        for override in self.core.overrides.ended():
            self.stored.pop(override.area, None)
            self.core.remove_override(override.area, self.at)

    def tick(self, seconds: float) -> None:
        self.now += seconds
        self.core.tick(self.at)
        self.settle()

    def read(self, state: str, times: int = 5) -> None:
        for _ in range(times):
            reading = NodeReading(
                seq=next(self.seq), boot=1, uptime_ms=round(1000 * self.now), range_m=[DISTANCES[state]],
                status=["ok"], state=state,
            )  # fmt: skip
            self.core.handlers()[ch.NODE_READING]({"node": "n1"}, reading, self.at)
            self.tick(0.1)

    def put(self, state: str, ttl_s: float = 60.0) -> AreaOverride:
        override = AreaOverride(
            area="hall", state=state, author="ann", reason="wet floor", ttl_s=ttl_s, set_at=self.at.stamp,
            boot=self.boot, deadline=self.now + ttl_s, version=next(self.versions),
        )  # fmt: skip
        self.stored["hall"] = override
        self.core.put_override(override, self.at)
        self.settle()
        return override

    def remove(self) -> None:
        self.stored.pop("hall", None)
        self.core.remove_override("hall", self.at)
        self.settle()


def test_blocked_area_stays_blocked_whatever_its_nodes_measure_until_its_time_is_over():
    rig = Rig()
    rig.read("clear")
    assert rig.hazard.state == "clear"
    rig.put("blocked", 2.0)
    assert (rig.hazard.state, rig.hazard.penalty, rig.hazard.cause) == (
        "blocked",
        254,
        "ann blocked the area: wet floor",
    )
    assert (rig.hazard.override.measured, rig.hazard.override.state) == ("clear", "blocked")
    rig.read("clear", 15)
    assert rig.hazard.state == "blocked"
    rig.read("clear", 10)
    assert (rig.hazard.state, rig.hazard.override) == ("clear", None)
    assert rig.stored == {}, "what has ended is deleted"


def test_area_that_an_admin_declared_clear_is_passable_and_slow_but_never_clear():
    rig = Rig()
    rig.read("blocked")
    rig.put("clear")
    assert (rig.hazard.state, rig.hazard.penalty, rig.hazard.severity) == ("unknown", 200, 1)
    assert (rig.hazard.override.measured, rig.hazard.override.measured_penalty) == ("blocked", 254)
    assert rig.hazard.cause == "ann declared the area clear, which its nodes do not: wet floor"
    rig.read("clear")
    assert (rig.hazard.state, rig.hazard.penalty) == ("unknown", 200), "constant while it holds"
    assert rig.hazard.cause == "ann declared the area clear: wet floor", "its nodes agree by now"
    rig.read("blocked")
    rig.remove()
    assert (rig.hazard.state, rig.hazard.penalty) == ("blocked", 254)


@pytest.mark.parametrize("restarts", [False, True])
@pytest.mark.parametrize("state", ["blocked", "clear"])
def test_area_that_is_defined_again_does_not_meet_the_override_of_the_removed_one(state, restarts):
    rig = Rig()
    rig.read("blocked")
    rig.put(state)
    removed = structs.replace(AREA, version=1, removed=True)
    if restarts:
        # It ended after the removal was stored, and before the override was deleted.
        rig.area = removed
        rig.start()
    else:
        rig.core.put_area(removed, rig.at)
    assert [override.area for override in rig.core.overrides.ended()] == ([] if restarts else ["hall"])
    rig.core.put_area(structs.replace(AREA, version=2), rig.at)
    rig.settle()
    assert (rig.hazard.state, rig.hazard.penalty, rig.hazard.override) == ("unknown", 200, None)
    assert rig.stored == {}, "it is deleted"


def test_area_declared_clear_costs_no_more_than_its_policy_for_unknown():
    rig = Rig(structs.replace(AREA, unknown=UnknownPolicy(penalty=90)))
    rig.put("clear")
    assert rig.hazard.penalty == 90


def test_relief_of_an_override_is_withheld_until_it_is_stored_and_a_danger_is_not():
    rig = Rig()
    rig.read("blocked")
    override = structs.replace(rig.put("blocked"), state="clear", version=99)
    assert rig.core.put_override(override, rig.at) == []
    assert rig.core.withheld() == ["hall"]
    assert [p.message.state for p in rig.core.mark_stored(rig.core.to_store())[:1]] == ["unknown"]
    published = rig.core.put_override(structs.replace(override, state="blocked", version=100), rig.at)
    assert [p.message.state for p in published if p.channel is ch.AREA_HAZARD] == ["blocked"]


def test_blockage_that_nodes_measured_under_an_override_is_known_after_a_restart():
    rig = Rig()
    rig.read("blocked")
    rig.put("clear", 1.0)
    rig.now += 5.0
    rig.start()
    assert (rig.hazard.state, rig.hazard.penalty, rig.hazard.override) == ("blocked", 254, None)


def test_area_that_only_an_operator_blocked_is_not_taken_for_measured_after_a_restart():
    rig = Rig()
    rig.put("blocked", 1.0)
    rig.now += 5.0
    rig.start()
    rig.tick(5.0)
    assert (rig.hazard.state, rig.hazard.penalty) == ("unknown", 200)


@pytest.mark.parametrize(("state", "after_reboot"), [("blocked", "blocked"), ("clear", None)])
def test_override_survives_a_restart_and_after_a_reboot_only_a_blockage_for_the_stored_rest(state, after_reboot):
    rig = Rig()
    rig.read("blocked")
    rig.put(state, 60.0)
    rig.tick(20.0)
    rig.rests = rig.core.overrides.rests(rig.boot, rig.now)
    rig.tick(5.0)
    rig.start()
    assert rig.hazard.override.state == state
    assert rig.core.overrides.rest_s("hall", rig.now) == pytest.approx(35.0)
    rig.now, rig.boot = 3.0, "another-boot"
    rig.start()
    assert (rig.hazard.override.state if rig.hazard.override else None) == after_reboot
    assert rig.core.overrides.rest_s("hall", rig.now) == (pytest.approx(40.0) if after_reboot else 0.0)
    rig.rests = rig.core.overrides.rests(rig.boot, rig.now)
    rig.tick(9.0)
    rig.load()
    rig.start()
    rig.tick(30.0)
    assert (rig.hazard.override is not None) == (after_reboot is not None), "starting again prolongs nothing"
    rig.tick(1.1)
    assert rig.hazard.override is None


def test_aggregator_without_its_store_follows_the_blockages_of_the_one_before_and_no_declared_clearance():
    old, new = Rig(), Rig()
    new.start(with_store=False)
    follow = new.core.handlers()[ch.AREA_HAZARD]
    for state, known in (("blocked", True), ("clear", False), ("blocked", True)):
        old.put(state, 600.0)
        follow({"area": "hall"}, structs.replace(old.hazard, epoch=9), new.at)
        assert (new.core.overrides.get("hall") is not None) == known
    assert new.core.announced()["hall"].state == "blocked"
    old.remove()
    follow({"area": "hall"}, structs.replace(old.hazard, epoch=9), new.at)
    assert new.core.overrides.get("hall") is None
    new.load()
    old.put("blocked")
    follow({"area": "hall"}, structs.replace(old.hazard, epoch=9), new.at)
    assert new.core.overrides.get("hall") is None, "its own store says that there is none"


class OverriddenArea(RuleBasedStateMachine):
    """An area with overrides beside one without: the nodes of both measure the same."""

    def __init__(self) -> None:
        super().__init__()
        self.rig, self.plain = Rig(), Rig()
        self.until: tuple[str, float] | None = None

    def expire(self) -> None:
        if self.until is not None and self.rig.now >= self.until[1]:
            self.until = None

    @rule(state=st.sampled_from(["blocked", "clear"]), times=st.integers(1, 8))
    def measure(self, state, times):
        for each in (self.rig, self.plain):
            each.read(state, times)
        self.expire()

    @rule(seconds=st.sampled_from([0.1, 0.4, 2.0, 4.0]))
    def wait(self, seconds):
        for each in (self.rig, self.plain):
            # A gap between two ticks would only delay what they find.
            for _ in range(round(seconds * 10)):
                each.tick(0.1)
        self.expire()

    @rule(state=st.sampled_from(["blocked", "clear"]), ttl_s=st.sampled_from([0.3, 1.0, 5.0, 20.0]))
    def put(self, state, ttl_s):
        self.rig.put(state, ttl_s)
        self.until = state, self.rig.now + ttl_s

    @precondition(lambda self: self.until)
    @rule()
    def remove(self):
        self.rig.remove()
        self.until = None

    @rule()
    def store_rests(self):
        self.rig.rests = self.rig.core.overrides.rests(self.rig.boot, self.rig.now)

    @rule()
    def load_again(self):
        self.rig.load()
        self.rig.settle()

    @rule()
    def restart(self):
        rest = self.rig.rests.get("hall")
        of_this_boot = self.until is not None and self.rig.boot in {
            self.rig.stored["hall"].boot,
            rest.boot if rest and rest.version == self.rig.stored["hall"].version else "",
        }
        if not of_this_boot:
            self.expect_the_stored_rest()  # its deadline is still that of an earlier boot
        for each in (self.rig, self.plain):
            each.start()

    @rule()
    def reboot(self):
        self.expect_the_stored_rest()
        for each in (self.rig, self.plain):
            each.boot = f"boot {next(each.boots)}"
            each.start()

    def expect_the_stored_rest(self):
        if self.until is not None:
            state, deadline = self.until
            rest, version = self.rig.rests.get("hall"), self.rig.stored["hall"].version
            left = rest.rest_s if rest and rest.version == version else self.rig.stored["hall"].ttl_s
            assert left >= deadline - self.rig.now - 1e-6, "a blockage is never cut short"
            self.until = None if state == "clear" or left == 0.0 else (state, self.rig.now + left)

    @invariant()
    def operators_override_counts_and_the_nodes_go_on_underneath(self):
        hazard, plain = self.rig.hazard, self.plain.hazard
        if self.until is None:
            assert hazard.override is None
            assert (hazard.state, hazard.penalty, hazard.severity) == (plain.state, plain.penalty, plain.severity)
            assert self.rig.stored == {}
            return
        expected = {"blocked": ("blocked", 254), "clear": ("unknown", 200)}[self.until[0]]
        assert (hazard.state, hazard.penalty) == expected
        assert (hazard.override.measured, hazard.override.measured_penalty) == (plain.state, plain.penalty)
        assert self.rig.core.overrides.rest_s("hall", self.rig.now) == pytest.approx(self.until[1] - self.rig.now)


OverriddenArea.TestCase.settings = settings(max_examples=60, stateful_step_count=30, deadline=None)
test_overridden_area_is_what_operators_say_and_afterwards_what_its_nodes_measure = OverriddenArea.TestCase
