"""Many readings that are delayed, repeated, reordered and lost, against a model that looks at all of them each time.

FOGNAV_PERMUTED_READINGS scales it, for each debounce rule: 1,000,000 before a release.
"""

import os
import random
from dataclasses import dataclass, field

import pytest

from fog_contracts.messages import AreaDefinition, NodeReading
from fog_contracts.site import NodeSite, Sonar
from hazard_aggregator.debounce import DEFAULT_RULE
from hazard_aggregator.fusion import AreaFusion
from hazard_aggregator.readings import FORGOTTEN_S, MIN_PERIOD_S, SILENT_S
from hazard_aggregator.registry import find_rule

READINGS = int(os.environ.get("FOGNAV_PERMUTED_READINGS", "12000"))
SEQS = 2**32
SQUARE = [(0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (0.0, 1.0)]
NODE = NodeSite(id="n1", area="hall", x=0.0, y=0.5, theta=0.0, sonars=[Sonar(range_limit=1.2, no_echo_is_clear=True)])


@dataclass
class SimulatedNode:
    """Measures ten times a second; its counter wraps, and each boot begins another one."""

    random: random.Random
    boot: int = 1
    booted_at: float = 0.0
    seq: int = SEQS - 40
    blocked: bool = False

    def measure(self, now: float) -> NodeReading:
        if self.random.random() < 0.02:
            self.blocked = not self.blocked
        if self.random.random() < 0.002:
            self.boot, self.booted_at = self.random.getrandbits(32), now
            self.seq = self.random.choice((0, SEQS - 5))
        reading = NodeReading(
            seq=self.seq,
            boot=self.boot,
            uptime_ms=round(1000 * (now - self.booted_at)),
            range_m=[round((0.8 if self.blocked else 3.0) + self.random.uniform(-0.01, 0.01), 3)],
            status=["ok"],
            state="blocked" if self.blocked else "clear",
        )
        self.seq = (self.seq + 1) % SEQS
        return reading


@dataclass
class Network:
    """Delays, repeats, reorders and loses readings; now and then it holds all back, and then delivers a burst."""

    random: random.Random
    waiting: list[tuple[float, int, NodeReading]] = field(default_factory=list)
    held_until: float = 0.0
    sent: int = 0

    def send(self, reading: NodeReading, now: float) -> None:
        if now >= self.held_until and self.random.random() < 0.003:
            self.held_until = now + self.random.uniform(0.5, 6.0)
        if self.random.random() < 0.05:
            return
        for _ in range(2 if self.random.random() < 0.1 else 1):
            delay = self.random.choice((0.0, 0.0, 0.0, 0.05, 0.3, 1.0, 4.0))
            self.sent += 1
            self.waiting.append((max(now, self.held_until) + delay, self.sent, reading))

    def arrived(self, now: float) -> list[NodeReading]:
        due = sorted(entry for entry in self.waiting if entry[0] <= now)
        self.waiting = [entry for entry in self.waiting if entry[0] > now]
        return [reading for _, _, reading in due]


@dataclass
class Model:
    """What counts, by the contract alone: per boot the newest seq, never an earlier boot, nothing older than 3 s."""

    accepted: list[tuple[float, NodeReading]] = field(default_factory=list)
    boots: list[int] = field(default_factory=list)
    counted: list[tuple[float, NodeReading]] = field(default_factory=list)

    def is_news(self, reading: NodeReading, now: float) -> bool:
        if not self.accepted:
            return True
        at, last = self.accepted[-1]
        if now - at > FORGOTTEN_S:
            return True
        if reading.boot != last.boot:
            return reading.boot not in self.boots[-8:]
        return 0 < (reading.seq - last.seq) % SEQS < SEQS // 2

    def accept(self, reading: NodeReading, now: float) -> None:
        if not self.boots or self.boots[-1] != reading.boot:
            self.boots.append(reading.boot)
        last = next((one for _, one in reversed(self.counted)), None)
        begun_anew = last is None or last.boot != reading.boot or reading.uptime_ms < self.accepted[-1][1].uptime_ms
        if begun_anew or reading.uptime_ms - last.uptime_ms >= 1000 * MIN_PERIOD_S:
            self.counted.append((now, reading))
        self.accepted.append((now, reading))


def five_in_a_row(state: str, counted: list[str]) -> bool:
    return counted[-5:] == [state] * 5


def evidence(state: str, counted: list[str]) -> bool:
    """Whether as many readings show the state as the likelihoods of the rule's defaults ask for at the least.

    Eight without an echo clear. Two echoes block; no more than four readings without one lie between them.
    """
    if state == "clear":
        return counted[-8:] == ["clear"] * 8
    return counted[-1] == "blocked" and counted[-6:].count("blocked") >= 2


RULES = {"consecutive": five_in_a_row, DEFAULT_RULE: evidence}


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("seed", range(4))
def test_readings_count_once_in_order_and_while_fresh_however_they_arrive(seed, rule):
    chance = random.Random(seed)
    node, network, model = SimulatedNode(chance), Network(chance), Model()
    definition = AreaDefinition(id="hall", polygon=SQUARE, nodes=["n1"], debounce={"rule": rule})
    fusion = AreaFusion([definition], [NODE], 1, registry=find_rule)
    now, received, state, seqs = 0.0, 0, "unknown", [0]
    confirmed: set[str] = set()
    taken: dict[tuple[int, int], float] = {}
    fastest: dict[int, float] = {}
    while received < READINGS // 4:
        now += 0.1
        measured = node.measure(now)
        taken[measured.boot, measured.seq] = now
        network.send(measured, now)
        for reading in network.arrived(now):
            received += 1
            news = model.is_news(reading, now)
            changed = fusion.on_reading("n1", reading, now, now)
            rejections = [reason for _, reason in fusion.pop_rejections()]
            accepted = not {"duplicate", "outdated", "earlier_boot", "late"} & set(rejections)
            assert accepted or not news or rejections == ["late"]
            assert not accepted or news
            if accepted:
                # The age is measured against the fastest reading since the node's clock began.
                age = now - taken[reading.boot, reading.seq]
                fastest[reading.boot] = min(age, fastest.get(reading.boot, age))
                assert age - fastest[reading.boot] <= SILENT_S + 0.1
                model.accept(reading, now)
                assert (len(model.counted) and model.counted[-1][1] is reading) == ("too_soon" not in rejections)
            for hazard in changed:
                seqs.append(hazard.seq)
                if hazard.state in ("blocked", "clear") and hazard.state != state:
                    assert accepted, "only a reading that counts confirms a state"
                    assert RULES[rule](hazard.state, [one.state for _, one in model.counted[-8:]])
                    confirmed.add(hazard.state)
                state = hazard.state
        for hazard in fusion.tick(now, now):
            seqs.append(hazard.seq)
            state = hazard.state
            assert state == "unknown", "only readings confirm a state"
        if state == "clear":
            at, _ = model.accepted[-1]
            assert now - at <= SILENT_S + 0.2
    assert seqs == sorted(set(seqs))
    assert confirmed == {"blocked", "clear"}
    assert len(model.boots) > 1
    assert 0.2 * received < len(model.accepted) < received
