"""`fognav bench warning`: an obstacle's way from a node's echo to a robot's path, through the whole fog."""

import asyncio
import dataclasses
import random
import shutil
import time
from pathlib import Path
from typing import Any, cast

import pytest
from msgspec import structs

from fog_contracts.messages import RobotPath, Trace
from fog_contracts.site import NodeSite, Sonar
from fog_runtime.clock import SystemClock
from fog_runtime.configuration.site import load_site
from fognav import checkout
from fognav.output import FailedError, WrongUseError
from fognav_experiments.bench import false_echoes, second_planner, warning
from fognav_experiments.bench.false_echoes import Asked, FalseEchoes, calibrated
from fognav_experiments.bench.warning import Arrived
from fognav_sim.live import StillFloor

needs_compiler = pytest.mark.skipif(
    shutil.which("g++") is None, reason="the firmware's code needs a C++ compiler (g++)"
)


def test_figures_name_each_stretch_and_count_what_never_arrived():
    quick, slow = warning.Warned(1.0, 1.1, 1.2, 1.205, 1.21), warning.Warned(2.0, 2.2, 2.4, 2.405, 2.41)
    row = warning.figures("evidence", [quick, None, slow])
    assert (row["warnings"], row["missed"]) == (3, 1)
    assert row["reading_to_confirmed_p50_ms"] == 150.0
    assert (row["echo_to_path_p50_ms"], row["echo_to_path_max_ms"]) == (310.0, 410.0)
    assert warning.figures("evidence", [None])["echo_to_path_max_ms"] is None


def path(at: float, *traces: Trace) -> Arrived:
    points = [(0.0, 0.0), (1.0, 0.0)]
    return Arrived(
        at,
        RobotPath(
            plan_id=1, planner_epoch=1, goal_id="g", points=points, map_epoch=1, map_seq=1, released_length=1.0,
            traces=list(traces),
        ),
    )  # fmt: skip


def test_path_that_arrives_before_the_delta_that_it_answers_waits_for_it():
    trace = Trace(area="a1", epoch=1, seq=7, first_reading=10.1, confirmed=10.2)
    paths, deltas = [path(10.31, trace)], {("a1", 1, 6): 9.0}
    assert warning.first_warning(paths, "a1", 10.0, 10.05, deltas) is None
    deltas["a1", 1, 7] = 10.32
    assert warning.first_warning(paths, "a1", 10.0, 10.05, deltas) == (10.05, 10.1, 10.2, 10.32, 10.31)


def test_path_without_a_trace_of_this_obstacle_is_no_warning():
    earlier, elsewhere = (Trace(area=a, epoch=1, seq=7, first_reading=t) for a, t in (("a1", 9.9), ("a2", 10.1)))
    deltas = {("a1", 1, 7): 10.3, ("a2", 1, 7): 10.3}
    assert warning.first_warning([path(10.4), path(10.5, earlier, elsewhere)], "a1", 10.0, 10.05, deltas) is None


def test_unknown_rule_and_a_site_without_nodes_are_told_before_anything_is_simulated():
    loaded = load_site(checkout.site_folder(Path("estig")))
    asked = Asked(0.01, 100_000.0, 1, 1)
    with pytest.raises(WrongUseError, match=r"--rule nonsense: .*evidence"):
        false_echoes.measure(loaded, "nonsense", asked)
    empty = dataclasses.replace(loaded, site=structs.replace(loaded.site, nodes=[]))
    with pytest.raises(FailedError, match="site estig has no nodes: add one"):
        false_echoes.measure(empty, "evidence", asked)


NODE = NodeSite(
    id="n1", area="a1", x=0.0, y=0.0, theta=0.0, sonars=[Sonar(range_limit=2.0), Sonar(angle=0.2, range_limit=1.5)]
)


class Corridor:
    """Whose other wall is 3 m away, for sonars with false echoes."""

    def __init__(self, share: float) -> None:
        self.false_echoes = FalseEchoes(share, 1)

    def sonar(self, node: NodeSite, index: int) -> float | None:
        return self.false_echoes.heard(3.0, node.sonars[index])


def test_false_echoes_are_nearer_than_the_limit_and_as_many_as_wanted():
    corridor = Corridor(0.05)
    measured = [corridor.sonar(NODE, 1) for _ in range(20_000)]
    false = [each for each in measured if each != 3.0]
    assert 0.04 < len(false) / len(measured) < 0.06
    assert all(0.02 <= each <= 1.5 for each in false)
    assert {Corridor(0.0).sonar(NODE, 0) for _ in range(100)} == {3.0}


@needs_compiler
def test_nodes_learn_by_their_own_calibration_how_many_false_echoes_pass_their_filter():
    quiet, noisy = (calibrated(NODE, cast("Any", Corridor(share))) for share in (0.0, 0.08))
    few, many = ([sonar.false_echo_rate for sonar in node.sonars] for node in (quiet, noisy))
    assert few == [pytest.approx(2 / 260, abs=1e-4)] * 2
    assert all(a is not None and b is not None and a <= b < 0.08 for a, b in zip(few, many, strict=True))
    assert [sonar.range_limit for sonar in noisy.sonars] == [2.0, 1.5]
    with pytest.raises(FailedError, match=r"sonar 1 of node n1 can't be calibrated .*choose fewer --false-echoes"):
        calibrated(NODE, cast("Any", Corridor(0.6)))


@needs_compiler
def test_warnings_and_false_alarms_are_measured_in_simulated_time_and_repeatable():
    loaded = load_site(checkout.site_folder(Path("estig")))
    few, many = (false_echoes.measure(loaded, "consecutive", Asked(share, 0.05, 3, 1)) for share in (0.0, 0.15))
    assert (few["false_alarms"], few["missed"], few["learned_percent_max"]) == (0, 0, 0.77)
    assert 300 < few["echo_to_confirmed_p50_ms"] < 1000, "five readings in a row"
    assert many["false_alarms"] > few["false_alarms"]
    assert many["false_alarms_per_h"] == pytest.approx(many["false_alarms"] / 0.05)
    assert few == false_echoes.measure(loaded, "consecutive", Asked(0.0, 0.05, 3, 1))


class Alarmed(false_echoes._Fog):
    """A fog in which false echoes block an area just before the first two obstacles come."""

    alarms_left = 2

    def run(self, seconds: float) -> None:
        if self.alarms_left:
            self.alarms_left -= 1
            self.world.false_echoes = FalseEchoes(1.0, 1)
            assert self.run_until(lambda: self.states["z1"] == "blocked", 60.0)
            self.world.false_echoes = FalseEchoes(0.0, 1)
        super().run(seconds)


@needs_compiler
def test_obstacle_comes_again_where_a_false_alarm_had_blocked_its_area_before() -> None:
    loaded = load_site(checkout.site_folder(Path("estig")))
    world = StillFloor(loaded, (), SystemClock(), world=false_echoes._NoisyWorld).world
    assert isinstance(world, false_echoes._NoisyWorld)
    fog = Alarmed(loaded, world, loaded.site.nodes, "consecutive")
    placed = false_echoes._barrier(loaded, ["z1"], 0, 1)
    warned = false_echoes._warning(fog, ["z1"], placed, random.Random(1))
    assert fog.alarms_left == 0
    assert warned is not None
    assert 0.3 < warned < 1.0, "five readings in a row"
    assert world.obstacles == []


def test_figures_of_a_planners_change_are_those_of_each_phase_and_name_the_takeover_once():
    before, during = (second_planner.row("slow", phase, [0.25, None], [1.2, 1.6]) for phase in ("before", "during"))
    assert (before["warnings"], before["missed"], before["echo_to_path_max_ms"]) == (2, 1, 250.0)
    assert (during["takeover_p50_ms"], during["takeover_max_ms"]) == (1400, 1600)
    assert "takeover_max_ms" not in before
    with pytest.raises(WrongUseError, match="--leader late: choose one of slow, lossy, dead"):
        second_planner.fault("late")


async def test_relay_passes_everything_on_in_its_order_later_by_its_delay():
    relay, received = second_planner.Relay(), bytearray()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while data := await reader.read(1000):
            received.extend(data)
            writer.write(data)
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    relay.target = server.sockets[0].getsockname()[1]
    async with server, relay.running():
        reader, writer = await asyncio.open_connection("127.0.0.1", relay.port)
        sent = b""
        for delay_s, loss in ((0.0, 0.0), (0.1, 0.0), (0.0, 0.4), (0.0, 0.0)):
            relay.delay_s, relay.loss = delay_s, loss
            piece, began = bytes([len(sent) % 256]) * 100, time.monotonic()
            writer.write(piece)
            assert await reader.readexactly(len(piece)) == piece
            assert time.monotonic() - began >= 2 * delay_s
            sent += piece
        writer.close()
        await writer.wait_closed()
    assert bytes(received) == sent


@pytest.mark.live
@pytest.mark.usefixtures("forked_programs")
async def test_robot_is_warned_while_the_leading_planner_becomes_slow_and_another_takes_over():
    loaded = load_site(checkout.site_folder(Path("estig")))
    rows = await second_planner.measure(loaded, "slow", 1, 1, lambda: None)
    assert [row["phase"] for row in rows] == ["before", "during", "after"]
    assert rows[0]["warnings"] == rows[2]["warnings"] == 1
    assert rows[1]["takeover_max_ms"] is not None


@pytest.mark.live
@pytest.mark.long
async def test_robot_gets_a_way_around_an_obstacle_that_a_node_has_seen():
    loaded = load_site(checkout.site_folder(Path("estig")))
    row = await warning.measure(loaded, "evidence", 3, 1, lambda: None)
    # Beside other tests one may take longer than the benchmark waits, as the whole fog runs on the same cores.
    assert row["missed"] <= 1
    stretches = ("echo_to_reading", "reading_to_confirmed", "confirmed_to_delta", "delta_to_path")
    assert all(0 < row[f"{stretch}_p50_ms"] <= row["echo_to_path_p50_ms"] for stretch in stretches)
