"""The firmware's node measures, classifies and publishes as the contract says, and as the model in Python does."""

import itertools
from types import SimpleNamespace

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fog_contracts import channels as ch
from fog_contracts.channels import NODE_READING
from fog_contracts.codec import decode, encode
from fog_contracts.messages import NodeCalibration, NodeConfig, NodeReading
from fog_contracts.site import NodeSite, Sonar
from fog_kernels.sonar import classify, default_config
from fognav_sim.node import SonarNode
from fognav_sim.nodes import STEP_US, FirmwareNode

SITE = NodeSite(id="n1", area="z1", x=0.0, y=0.0, theta=0.0, sonars=[Sonar(range_limit=2.0), Sonar(range_limit=2.5)])
RANGE = st.none() | st.floats(0.05, 4.0)


@pytest.mark.parametrize("metres", [(2.0, 2.0), (3.0, 3.0), (2.2, None), (None, None)])
def test_node_measures_eight_to_ten_times_a_second_with_and_without_echoes(make_node, run, metres):
    assert 7.9 <= len(run(make_node(every_reading=True), metres, 20.0)) / 20.0 <= 10.0


def test_readings_have_consecutive_numbers_and_true_uptimes_and_fit_the_channel(make_node, run):
    published = run(make_node(every_reading=True), (2.2, 2.7), 5.0)
    assert [reading.seq for reading in published] == list(range(len(published)))
    uptimes = [reading.uptime_ms for reading in published]
    assert uptimes == sorted(uptimes)
    assert uptimes[-1] == pytest.approx(5000, abs=150)
    assert {reading.boot for reading in published} == {7}
    assert all(decode(NODE_READING, encode(NODE_READING, reading), NodeReading) == reading for reading in published)


def test_uptime_goes_on_when_the_clock_of_32_bits_wraps(make_node, run):
    node = make_node()
    run(node, (3.0, 3.0), 1.0)
    node._now.value += 2**32 - 3_000_000  # the board's clock is about to wrap, and nobody was asked until now
    node._start -= (2**32 - 3_000_000) / 1e6
    uptimes = [reading.uptime_ms for reading in run(node, (3.0, 3.0), 6.0)]
    assert uptimes[-1] - uptimes[0] == pytest.approx(6000, abs=1100)
    assert uptimes == sorted(uptimes)


@pytest.mark.parametrize("metres", [(0.03, 0.03), (0.4, 4.0), (3.9, 2.2), (None, 1.0), (None, None)])
def test_sonars_are_triggered_in_turn_and_only_when_the_echoes_of_the_other_have_died_away(core, metres):
    """Else one would hear the other's burst, and at times that vary: a ghost must not come twice at the same range."""
    node = FirmwareNode(core, msgspec.structs.replace(SITE, every_reading=True), 7, 0.0)
    triggered: list[tuple[int, int]] = []
    waiting: list[int] = []
    answer = node._trigger

    def trigger(world, at_us):
        waiting.append(len(node._edges))
        triggered.append((at_us, core.sonar(node._node)))
        answer(world, at_us)

    node._trigger = trigger
    world = type("World", (), {"sonar": lambda _self, _node, index: metres[index]})()
    for step in range(500):
        node.poll(world, step * 0.01)
    assert len(triggered) > 60
    assert set(waiting) == {0} or None in metres, "an echo of the other is on its way"
    assert [sonar for _, sonar in triggered] == [i % 2 for i in range(len(triggered))]
    moments = [at for at, _ in triggered]
    between = [after - before for before, after in itertools.pairwise(moments)]
    assert min(between) >= 50_000
    assert all(len(set(gaps)) >= 8 for gaps in (between[::2], between[1::2]))


def test_burst_that_walls_throw_to_and_fro_is_no_echo_of_the_next_sonar(core):
    """Walls 2.1 m apart: its third return, after 37 ms, was an echo from 1.66 m to a sonar that came after 27 ms."""
    sonars = [Sonar(range_limit=1.8, range_max=2.4)] * 2
    node = FirmwareNode(core, msgspec.structs.replace(SITE, sonars=sonars, every_reading=True), 7, 0.0)
    flight = round(2 * 2.1 / 343.42 * 1e6)
    bursts: list[int] = []

    def trigger(_world, at_us):
        rise = at_us + 450
        late = [burst + count * flight for burst in bursts[-1:] for count in (2, 3, 4)]
        sonar = core.sonar(node._node)
        node._edges = [(rise, sonar, 1), (min(at for at in (*late, rise + flight) if at > rise), sonar, 0)]
        bursts.append(rise)

    node._trigger = trigger
    published = [reading for step in range(1, 2000) for reading in node.poll(None, step * 0.01)]
    assert {reading.state for reading in published[1:]} == {"clear"}
    assert {tuple(reading.range_m) for reading in published[1:]} == {(2.1, 2.1)}


@settings(deadline=None, max_examples=60)
@given(metres=st.tuples(RANGE, RANGE), silent=st.tuples(st.booleans(), st.booleans()))
def test_steady_ranges_are_classified_as_by_the_model(core, metres, silent):
    sonars = [Sonar(range_limit=2.0, no_echo_is_clear=silent[0]), Sonar(range_limit=2.5, no_echo_is_clear=silent[1])]
    site = NodeSite(id="n1", area="z1", x=0.0, y=0.0, theta=0.0, sonars=sonars)
    world = type("World", (), {"sonar": lambda _self, _node, index: metres[index]})()
    node, model = FirmwareNode(core, site, 7, 0.0), SonarNode(site, 7, 0.0)
    last = [reading for step in range(150) for reading in node.poll(world, step * 0.01)][-1]
    expected = [reading for step in range(150) for reading in model.poll(world, step * 0.01)][-1]
    assert last.status == expected.status
    for ours, theirs in zip(last.range_m, expected.range_m, strict=True):
        assert (ours is None) == (theirs is None)
        # A clock of a microsecond and the speed of sound at 20 degrees, which the model rounds: 3 mm in 4 m.
        assert ours is None or ours == pytest.approx(theirs, abs=0.008)
    assert last.state == classify(last.range_m, default_config(site))


@pytest.mark.parametrize("spike", [0.4, None, 0.01])
def test_single_spike_never_changes_what_is_reported(make_node, run, spike):
    """Every fifth measurement of one sonar is a spike."""
    measured = itertools.count()

    class World:
        def sonar(self, _node, index):
            return spike if index == 0 and next(measured) % 5 == 4 else 3.0

    node = make_node(every_reading=True)
    published = [reading for step in range(1, 1000) for reading in node.poll(World(), 100.0 + step * 0.01)]
    assert len(published) > 60
    assert {(reading.state, *reading.range_m, *reading.status) for reading in published} == {
        ("clear", 3.004, 3.004, "ok", "ok")
    }


def test_real_change_is_reported_with_its_second_measurement(make_node, run):
    node = make_node(every_reading=True)
    run(node, (3.0, 3.0), 3.0)
    states = [reading.state for reading in run(node, (1.0, 3.0), 1.0)]
    assert states.index("blocked") == 1
    assert set(states[1:]) == {"blocked"}


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("pause_ms", [10, 1000])
def test_first_echo_of_an_obstacle_is_verified_at_once_by_the_same_sonar(core, run, count, pause_ms):
    """The aggregator takes readings that are less than 40 ms apart for one."""
    node = FirmwareNode(
        core, msgspec.structs.replace(SITE, sonars=[Sonar(range_limit=2.0)] * count, every_reading=True), 7, 100.0
    )
    config = NodeConfig(version=1, range_limit_m=[2.0] * count, no_echo_is_clear=[False] * count, pause_ms=pause_ms)
    assert node.configure(config)
    triggered: list[tuple[int, int]] = []
    answer = node._trigger

    def trigger(world, at_us):
        triggered.append((at_us, core.sonar(node._node)))
        answer(world, at_us)

    run(node, (3.0,) * count, 3.05)
    node._trigger = trigger
    published = run(node, (1.0,) * count, 2.0)
    (began, sonar), (again, same) = triggered[:2]
    assert sonar == same
    assert 50_000 <= again - began <= 61_000
    first = next(reading for reading in published if reading.state == "blocked")
    assert first.uptime_ms * 1000 - began <= count * 61_000 + 15_000
    between = [after.uptime_ms - before.uptime_ms for before, after in itertools.pairwise(published)]
    assert min(between) >= 50


def test_obstacle_at_the_limit_does_not_flap(make_node, run):
    node = make_node()
    run(node, (1.98, 3.0), 1.0)
    states = {reading.state for metres in (2.02, 1.99, 2.03, 2.0) * 5 for reading in run(node, (metres, 3.0), 0.3)}
    assert states == {"blocked"}
    assert run(node, (2.06, 3.0), 0.6)[-1].state == "clear"


def test_silence_is_clear_only_where_it_was_calibrated(make_node, run):
    assert run(make_node(), (None, 3.0), 2.0)[-1].state == "unknown"
    node = make_node()
    config = NodeConfig(version=1, range_limit_m=[2.0, 2.5], no_echo_is_clear=[True, True])
    assert node.configure(config)
    assert run(node, (None, 3.0), 2.0)[-1].state == "clear"
    # Both dead or covered would sound the same: silence alone never shows that nothing is there.
    assert run(node, (None, None), 2.0)[-1].state == "unknown"


def test_echo_from_behind_the_wall_is_unknown(make_node, run):
    """What stands flush to the wall, slants or is soft sends the sound on a detour: the wall's echo comes late."""
    node = make_node(sonars=[Sonar(range_limit=1.8, range_max=2.4), Sonar(range_limit=1.8, range_max=2.4)])
    assert run(node, (2.1, 2.1), 1.0)[-1].state == "clear"
    assert run(node, (3.3, 2.1), 1.0)[-1].state == "unknown"
    assert run(node, (2.1, 2.41), 1.0)[-1].state == "unknown"
    assert run(node, (2.1, 2.38), 1.0)[-1].state == "clear"
    assert run(node, (3.3, 1.2), 1.0)[-1].state == "blocked"


def test_sonar_without_an_answer_is_stuck_and_unknown(core):
    node = FirmwareNode(core, SITE, 7, 0.0)
    # Nothing moves the echo lines.
    node._trigger = lambda _world, _at_us: None
    published = [reading for step in range(300) for reading in node.poll(None, step * 0.01)]
    assert published[-1].status == ["stuck", "stuck"]
    assert {reading.state for reading in published} == {"unknown"}


def test_leak_of_the_trigger_and_bounces_are_no_echoes(core):
    node = FirmwareNode(core, SITE, 7, 0.0)

    def trigger(_world, now):
        sonar = core.sonar(node._node)
        flight = round(2 * 3.0 / 343.42 * 1e6)
        leak = [(now + 10, sonar, 1), (now + 60, sonar, 0)]
        bounce = [(now + 300, sonar, 1), (now + 320, sonar, 0)]
        node._edges = [*leak, *bounce, (now + 450, sonar, 1), (now + 450 + flight, sonar, 0)]

    node._trigger = trigger
    published = [reading for step in range(300) for reading in node.poll(None, step * 0.01)]
    assert {tuple(reading.range_m) for reading in published} == {(3.0, 3.0)}


def test_edge_that_comes_after_the_loop_read_its_clock_is_no_missing_echo(core):
    node = FirmwareNode(core, SITE, 7, 0.0)

    def trigger(_world, now):
        sonar = core.sonar(node._node)
        flight = round(2 * 3.0 / 343.42 * 1e6)
        # The interrupt's clock is ahead of the one that the loop passes to the next step.
        core.edge(node._node, sonar, 1, now + STEP_US + 3)
        node._edges = [(now + STEP_US + 3 + flight, sonar, 0)]

    node._trigger = trigger
    published = [reading for step in range(300) for reading in node.poll(None, step * 0.01)]
    assert {tuple(reading.status) for reading in published} == {("ok", "ok")}


def test_what_was_measured_before_a_long_wait_is_not_fresh_after_it(make_node, run):
    """A board waits for seconds while it connects; the echoes of before came from a corridor that was free."""
    nodes = [make_node() for _ in range(13)]
    for node, stopped in zip(nodes, range(0, 130, 10), strict=True):  # ms: anywhere in the cycle
        assert run(node, (3.0, 3.0), 2)[-1].state == "clear"
        waits = 102.0 + stopped / 1000
        node.poll(SimpleNamespace(sonar=lambda _node, _index: 3.0), waits)
        blocked = SimpleNamespace(sonar=lambda _node, _index: 1.0)
        after = [reading for step in range(100) for reading in node.poll(blocked, waits + 5.0 + step * 0.01)]
        assert after[0].state == "blocked", stopped
        assert after[0].range_m == [pytest.approx(1.0, abs=0.01)] * 2


@pytest.mark.parametrize(("tenths", "metres"), [(-200, 2.787), (0, 2.894), (200, 3.0), (400, 3.106)])
def test_range_follows_the_temperature(core, run, make_node, tenths, metres):
    node = make_node()
    core.temperature(node._node, tenths)
    measured = run(node, (3.0, 3.0), 2.0)[-1].range_m[0]
    assert measured == pytest.approx(metres, abs=0.006)


def test_measured_temperature_is_followed_in_small_steps_and_only_where_people_live(core, run, make_node):
    """A DS18B20 that was without power says 85 degrees: 1.70 m would be 1.91 m, beyond the limit."""
    node = make_node(sonars=[Sonar(range_limit=1.8)] * 2)
    for wrong in (850, -1270, 501, -201, 33_000):
        for _ in range(20):
            core.measure_temperature(node._node, wrong)
    measured = run(node, (1.7, 1.7), 2.0)[-1]
    assert (measured.state, measured.range_m[0]) == ("blocked", pytest.approx(1.7, abs=0.006))
    core.measure_temperature(node._node, 400)
    assert run(node, (1.7, 1.7), 2.0)[-1].range_m[0] == pytest.approx(1.7, abs=0.006)
    for _ in range(60):
        core.measure_temperature(node._node, 400)
    assert run(node, (1.7, 1.7), 2.0)[-1].range_m[0] == pytest.approx(1.76, abs=0.006)


def test_saving_air_publishes_ten_readings_after_a_change_and_then_one_a_second(make_node, run):
    node = make_node()
    run(node, (3.0, 3.0), 5.0)
    quiet = run(node, (3.0, 3.0), 20.0)
    assert 18 <= len(quiet) <= 21
    changed = run(node, (1.0, 3.0), 10.0)
    blocked = [reading.uptime_ms for reading in changed if reading.state == "blocked"]
    gaps = [later - earlier for earlier, later in itertools.pairwise(blocked)]
    assert all(gap < 150 for gap in gaps[:9])
    assert all(900 < gap < 1200 for gap in gaps[10:])


@pytest.mark.parametrize("again", ["connected", "configure"])
def test_readings_go_out_as_after_a_change_when_connection_or_configuration_is_new(core, make_node, run, again):
    node = make_node()
    run(node, (3.0, 3.0), 5.0)
    if again == "connected":
        core.connected(node._node)
    else:
        assert node.configure(NodeConfig(version=2, range_limit_m=[2.0, 2.5], no_echo_is_clear=[False, False]))
    assert len(run(node, (3.0, 3.0), 1.3)) >= 10


@pytest.mark.parametrize(
    ("free", "learned"),
    [
        ((3.0, 3.5), [("calibrated", 2.8, 3.3, 0), ("calibrated", 3.3, 3.8, 0)]),
        ((None, 3.5), [("calibrated", 4.0, 0.0, 1), ("calibrated", 3.3, 3.8, 0)]),
        ((0.45, 3.5), [("its free distance", 2.0, 0.0, 0), ("calibrated", 2.5, 0.0, 0)]),
    ],
)
def test_calibration_learns_the_free_distance(core, make_node, run, free, learned):
    node = make_node()
    run(node, (3.0, 3.0), 1.0)
    assert node.command(ch.CALIBRATE) is None
    assert {reading.state for reading in run(node, free, 2.0)} == {"unknown"}
    run(node, free, 40.0)
    assert not core.calibrating(node._node)
    assert core.limit_mm(node._node, 1) == 2500, "nobody has said yet that it counts"
    all_learned = all(words == "calibrated" for words, *_ in learned)
    assert (node.command(ch.KEEP) is None) == all_learned
    run(node, free, 1.0)
    for sonar, (words, limit, farthest, silent) in enumerate(learned):
        assert core.describe_calibration(core.calibration(node._node, sonar)).decode().startswith(words)
        assert core.limit_mm(node._node, sonar) / 1000 == pytest.approx(limit, abs=0.02)
        assert core.max_mm(node._node, sonar) / 1000 == pytest.approx(farthest, abs=0.02)
        assert core.no_echo_is_clear(node._node, sonar) == silent


def test_calibration_refuses_a_sonar_that_is_disturbed(core, make_node, run):
    node = make_node()
    assert node.command(ch.CALIBRATE) is None
    for step in range(400):
        run(node, (3.0 if step % 2 else 1.5, 3.0), 0.2)
    assert not core.calibrating(node._node)
    assert b"unsteady" in core.describe_calibration(core.calibration(node._node, 0))
    assert core.limit_mm(node._node, 0) == 2000


def calibrated(run, node, command, metres):
    """Return what the node reports after a command; it counts from then on, if all sonars have learned."""
    assert node.command(command) is None
    run(node, metres, 60.0)
    report = node.take_calibration()
    if set(report.result) == {"done"}:
        assert node.command(ch.KEEP) is None
        run(node, metres, 1.0)
        assert node.take_calibration() == report
    assert decode(ch.NODE_CALIBRATION, encode(ch.NODE_CALIBRATION, report), NodeCalibration) == report
    return report


def test_calibration_is_reported_with_the_version_that_it_replaces(make_node, run):
    node = make_node()
    config = NodeConfig(version=9, range_limit_m=[1.0, 1.0], no_echo_is_clear=[False, False])
    assert node.configure(config)
    report = calibrated(run, node, ch.CALIBRATE, (3.0, 0.4))
    assert (report.boot, report.config_version, report.result) == (7, 9, ["done", "too_near"])
    assert report.range_limit_m == [pytest.approx(2.8, abs=0.02), 1.0]
    assert report.no_echo_is_clear == [False, False]
    assert node.take_calibration() is None


def test_no_sonar_takes_its_limit_where_another_one_failed(core, make_node, run):
    node = make_node()
    assert calibrated(run, node, ch.CALIBRATE, (3.0, 0.4)).result == ["done", "too_near"]
    assert "every sonar has learned" in node.command(ch.KEEP)
    run(node, (3.0, 0.4), 1.0)
    assert [core.limit_mm(node._node, sonar) for sonar in (0, 1)] == [2000, 2500]


def test_calibration_of_before_another_configuration_can_not_be_kept(core, make_node, run):
    node = make_node()
    assert node.command(ch.CALIBRATE) is None
    run(node, (3.0, 3.0), 60.0)
    assert node.configure(NodeConfig(version=10, range_limit_m=[1.5, 1.5], no_echo_is_clear=[False, False]))
    assert node.command(ch.KEEP) is not None
    run(node, (3.0, 3.0), 1.0)
    assert core.limit_mm(node._node, 0) == 1500


def test_calibration_counts_echoes_from_nearer_than_the_limit_and_missing_ones(make_node, run):
    node = make_node()
    assert node.command(ch.CALIBRATE) is None
    for _ in range(18):
        run(node, (3.0, 3.0), 2.6)
        run(node, (0.8, None), 0.25)
    report = node.take_calibration()
    assert report.result == ["done", "done"]
    assert report.samples == [256, 256]
    assert 8 <= report.false_echoes[0] <= 40
    assert (report.false_echoes[1], report.no_echoes[0]) == (0, 0)
    assert 8 <= report.no_echoes[1] <= 40


def test_calibration_counts_no_spikes_that_the_filter_keeps_from_its_readings(make_node):
    measured = itertools.count()

    class World:
        def sonar(self, _node, index):
            return 0.8 if index == 0 and next(measured) % 5 == 4 else 3.0

    node = make_node()
    assert node.command(ch.CALIBRATE) is None
    for step in range(1, 4500):
        node.poll(World(), 100.0 + step * 0.01)
    report = node.take_calibration()
    assert report.samples == [256, 256]
    assert report.false_echoes == [0, 0]


def test_calibration_that_learned_no_limit_counts_nothing(make_node, run):
    report = calibrated(run, make_node(), ch.CALIBRATE, (3.0, 0.4))
    assert (report.result, report.samples) == (["done", "too_near"], [256, 0])
    report = calibrated(run, make_node(), ch.LEARN_NO_ECHO, (0.4, None))
    assert (report.samples, report.false_echoes, report.no_echoes) == ([0, 0], [0, 0], [0, 0])


def test_calibration_of_eight_sonars_fits_its_message(make_node, run):
    node = make_node(sonars=8 * [Sonar(range_limit=2.0)])
    assert node.command(ch.CALIBRATE) is None
    run(node, 8 * (3.0,), 150.0)
    report = node.take_calibration()
    assert report is not None, "it did not fit"
    assert report.samples == [256] * 8


def test_sonar_that_does_not_answer_is_reported_and_keeps_its_limit(core, make_node, run):
    node = make_node()
    trigger = node._trigger
    node._trigger = lambda world, at_us: trigger(world, at_us) if core.sonar(node._node) else None
    report = calibrated(run, node, ch.CALIBRATE, (3.0, 3.0))
    assert report.result == ["stuck", "done"]
    assert report.range_limit_m == [2.0, pytest.approx(2.8, abs=0.02)]
    assert b"check its supply" in core.describe_calibration(core.calibration(node._node, 0))


def test_unsteady_echoes_are_reported_with_the_remedy(core, make_node, run):
    node = make_node()
    assert node.command(ch.CALIBRATE) is None
    assert b"keep the way" in core.describe_calibration(core.calibration(node._node, 0))
    for step in range(400):
        run(node, (3.0 if step % 2 else 1.5, 3.0), 0.2)
    assert node.take_calibration().result == ["unsteady", "done"]


def test_pulses_of_different_width_are_no_sign_for_no_echo(make_node, run):
    node = make_node()
    assert node.command(ch.LEARN_NO_ECHO) is None
    for step in range(60):
        run(node, (0.4 if step % 2 else 0.5, 3.0), 0.2)
    report = node.take_calibration()
    assert (report.result[0], report.no_echo_us[0]) == ("unsteady", 0)


def test_calibration_holds_until_another_version_comes_and_over_a_restart(core, make_node, run):
    config = NodeConfig(version=9, range_limit_m=[1.0, 1.0], no_echo_is_clear=[False, False])
    node = make_node()
    assert node.configure(config)
    report = calibrated(run, node, ch.CALIBRATE, (3.0, 3.0))
    again = make_node()
    assert again.restore(report)
    for each in (node, again):
        assert each.configure(msgspec.structs.replace(config, pause_ms=60))  # delivered again with each connection
        assert core.limit_mm(each._node, 0) == pytest.approx(2800, abs=20)
        assert core.max_mm(each._node, 0) == pytest.approx(3300, abs=20)
        assert each.configure(msgspec.structs.replace(config, version=10, range_limit_m=[1.5, 1.5]))
        assert (core.limit_mm(each._node, 0), core.max_mm(each._node, 0)) == (1500, 0)


def test_stored_calibration_for_other_sonars_is_refused(make_node, run):
    report = calibrated(run, make_node(), ch.CALIBRATE, (3.0, 3.0))
    one = msgspec.structs.replace(
        report, result=["done"], range_limit_m=[1.0], no_echo_is_clear=[False], no_echo_us=[0]
    )
    assert not make_node().restore(one)


def test_clone_that_says_no_echo_by_a_short_pulse_is_learned(make_node, run):
    """Some clones answer as if something stood at 0.4 m, when nothing is in their range."""
    node = make_node()
    assert run(node, (0.4, 3.0), 2.0)[-1].state == "blocked"
    report = calibrated(run, node, ch.LEARN_NO_ECHO, (0.4, None))
    assert report.result == ["done", "done"]
    assert report.no_echo_us == [pytest.approx(2 * 0.4 / 343.42 * 1e6, abs=5), 0]
    learned = run(node, (0.4, 3.0), 2.0)[-1]
    assert (learned.status, learned.state) == (["no_echo", "ok"], "unknown")
    assert run(node, (0.5, 3.0), 2.0)[-1].state == "blocked"
    restarted = make_node()
    assert restarted.restore(report)
    assert run(restarted, (0.4, 3.0), 2.0)[-1].status == ["no_echo", "ok"]


@settings(deadline=None, max_examples=12)
@given(st.lists(st.tuples(*[st.sampled_from([0.8, 0.95, 1.1, 2.2, 3.0, None])] * 2), min_size=1, max_size=6))
def test_as_many_readings_are_published_as_by_the_model(core, segments):
    """In each 4 s of steady ranges: the firmware tells a change one reading later, and pauses by chance."""
    node, model, now = FirmwareNode(core, SITE, 7, 0.0), SonarNode(SITE, 7, 0.0), 0.0
    for metres in segments:
        world = type("World", (), {"sonar": lambda _self, _node, index, metres=metres: metres[index]})()
        counts = dict.fromkeys((node, model), 0)
        for step in range(400):
            for each in counts:
                counts[each] += len(each.poll(world, now + step * 0.01))
        now += 4.0
        assert counts[node] == pytest.approx(counts[model], abs=3)


def standing_blocked(make_node, run, metres):
    """Return a node that saves air and has been blocked for so long that it publishes once a second."""
    node = make_node()
    run(node, metres, 5.0)
    assert len(run(node, metres, 5.0)) <= 6
    return node


@pytest.mark.parametrize("after", [(1.0, 1.2), (0.8, 3.0), (1.2, 3.0)])
def test_another_obstacle_goes_out_at_once_while_the_node_is_blocked_already(make_node, run, after):
    """The first obstacle may be a robot, which is no hazard: the second must not wait for the next heartbeat."""
    published = run(standing_blocked(make_node, run, (1.0, 3.0)), after, 1.3)
    assert {reading.state for reading in published} == {"blocked"}
    measured = [reading.uptime_ms for reading in published if reading.range_m == pytest.approx(list(after), abs=0.01)]
    gaps = [later - earlier for earlier, later in itertools.pairwise(measured)]
    assert len(gaps) >= 8
    assert max(gaps[:8]) < 150


def test_obstacle_that_stands_still_goes_out_once_a_second_though_its_range_trembles(make_node, run):
    node = standing_blocked(make_node, run, (1.0, 3.0))
    published = [reading for step in range(40) for reading in run(node, (1.0 + 0.04 * (step % 3 - 1), 3.0), 0.25)]
    assert 9 <= len(published) <= 11
