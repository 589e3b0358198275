"""When zones are in force, whatever happens to the clock on the wall."""

from datetime import date, datetime
from zoneinfo import ZoneInfo

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fog_contracts import weekly as weekly_windows
from fog_contracts.handlers import Moment
from fog_contracts.messages import CircleShape, WeeklySchedule, WeeklyTime, Zone
from fog_contracts.weekly import window_of
from map_service.zone_times import ZoneTimes

T0 = datetime(2026, 11, 21, 12, 0, tzinfo=ZoneInfo("UTC")).timestamp()  # a Saturday
HOUR = 3600.0
LISBON = "Europe/Lisbon"


def zone(**fields) -> Zone:
    return Zone(id="z", kind="BLOCKED", shape=CircleShape(centre=(1.0, 1.0), radius=1.0), **fields)


def active(times: ZoneTimes, now: float, stamp: float, *, synchronized: bool = True) -> bool:
    return times.is_active(Moment(now, stamp, synchronized))


@pytest.mark.parametrize("step", [-HOUR, HOUR])
def test_started_zone_stays_started_and_ends_on_time_by_the_monotonic_clock_after_a_step_of_an_hour(step):
    times = ZoneTimes(zone(starts_at=T0 - 60.0, expires_at=T0 + 1800.0))
    assert active(times, 0.0, T0)
    assert active(times, 1.0, T0 + 1.0 + step), "a step neither ends it nor takes back its start"
    assert active(times, 1799.0, T0 + 1799.0 + step)
    # Ahead: it ends when its time has passed. Behind: it also waits for the moment that was named.
    assert active(times, 1801.0, T0 + 1801.0 + step) == (step < 0.0)
    assert not active(times, 1800.0 + HOUR, T0 + 1800.0 + HOUR + step)
    assert not active(times, 1801.0 + HOUR, T0), "what has ended does not come back"


@settings(max_examples=200)
@given(
    st.lists(st.tuples(st.floats(0.1, 600.0), st.floats(-5 * HOUR, 5 * HOUR), st.booleans()), min_size=1, max_size=30),
    st.floats(1.0, 5000.0),
)
def test_time_to_live_is_monotonic_time_whatever_the_wall_clock_says(steps, ttl):
    times = ZoneTimes(zone(ttl_s=ttl, expires_at=T0 + ttl))
    now = 0.0
    assert active(times, now, T0)
    for passed, error, synchronized in steps:
        now += passed
        assert active(times, now, T0 + now + error, synchronized=synchronized) == (now < ttl)


@settings(max_examples=200)
@given(
    st.lists(st.tuples(st.floats(0.1, 600.0), st.floats(-5 * HOUR, 5 * HOUR), st.booleans()), min_size=1, max_size=30),
    st.floats(1.0, 5000.0),
)
def test_nothing_ends_early_by_the_wall_clock_nor_while_it_is_not_synchronized(steps, life):
    times = ZoneTimes(zone(expires_at=T0 + life))
    now, was_active = 0.0, active(times, 0.0, T0)
    assert was_active
    for passed, error, synchronized in steps:
        now += passed
        is_active = active(times, now, T0 + now + error, synchronized=synchronized)
        if now < life:
            assert is_active
        if was_active and not is_active:
            assert synchronized
        was_active = is_active


def test_without_a_clock_at_boot_a_later_zone_is_in_force_until_the_time_is_known():
    later = zone(starts_at=T0 + HOUR)
    times = ZoneTimes(later)
    assert active(times, 0.0, 5.0, synchronized=False), "1970: nobody knows whether it has started"
    assert not active(times, 10.0, T0)
    assert active(times, 20.0, T0 + HOUR)
    assert active(times, 21.0, 30.0, synchronized=False)
    scheduled = ZoneTimes(zone(schedule=WeeklySchedule(time_zone="UTC", times=[weekly("mon", "08:00", "09:00")])))
    assert active(scheduled, 0.0, 5.0, synchronized=False)
    assert not active(scheduled, 10.0, T0)


def test_time_to_live_survives_restarts_and_boots():
    limited = zone(ttl_s=100.0)
    times = ZoneTimes(limited)
    assert active(times, 1000.0, T0)
    stored = times.progress("boot-1", 1040.0)
    same_boot = ZoneTimes(limited, stored, boot="boot-1", now=1090.0)
    assert active(same_boot, 1099.0, 5.0, synchronized=False)
    assert not active(same_boot, 1100.0, 5.0, synchronized=False)
    next_boot = ZoneTimes(limited, stored, boot="boot-2", now=7.0)
    assert active(next_boot, 66.0, 5.0, synchronized=False)
    assert not active(next_boot, 67.0, 5.0, synchronized=False)
    ended = ZoneTimes(limited, next_boot.progress("boot-2", 70.0), boot="boot-3", now=1.0)
    assert not active(ended, 2.0, T0)
    replaced = ZoneTimes(zone(ttl_s=100.0, version=2), stored, boot="boot-1", now=1090.0)
    assert active(replaced, 1189.0, T0), "another version has times of its own"


def test_started_zone_stays_started_after_a_boot_without_a_clock_and_an_end_waits_for_it():
    limited = zone(starts_at=T0, expires_at=T0 + 100.0)
    times = ZoneTimes(limited)
    assert active(times, 0.0, T0 + 1.0)
    booted = ZoneTimes(limited, times.progress("boot-1", 50.0), boot="boot-2", now=3.0)
    assert active(booted, 500.0, 400.0, synchronized=False)
    assert not active(booted, 501.0, T0 + 900.0)


def weekly(day: str, begin: str, end: str) -> WeeklyTime:
    return WeeklyTime(days=[day], begin=begin, end=end)


def at_local(text: str, name: str = LISBON, fold: int = 0) -> float:
    return datetime.fromisoformat(text).replace(tzinfo=ZoneInfo(name), fold=fold).timestamp()


def test_weekly_schedule_follows_local_time_over_midnight_and_the_week():
    schedule = WeeklySchedule(
        time_zone=LISBON, times=[weekly("sun", "22:00", "06:00"), weekly("wed", "09:00", "10:00")]
    )
    for text, expected in (
        ("2026-11-22T21:59", False), ("2026-11-22T22:00", True), ("2026-11-23T05:59", True),
        ("2026-11-23T06:00", False), ("2026-11-25T09:30", True), ("2026-11-25T10:00", False),
        ("2027-06-27T23:00", True),
    ):  # fmt: skip
        assert active(ZoneTimes(zone(schedule=schedule)), 0.0, at_local(text)) == expected, text


def test_windows_on_days_of_23_and_25_hours_are_rather_too_long_than_too_short():
    lisbon = ZoneInfo(LISBON)
    spring, autumn = date(2026, 3, 29), date(2026, 10, 25)
    begin, end = window_of(spring, "00:00", "00:00", lisbon)
    assert end - begin == 23 * HOUR
    begin, end = window_of(autumn, "00:00", "00:00", lisbon)
    assert end - begin == 25 * HOUR
    # 01:30 occurs twice in autumn and never in spring.
    assert window_of(autumn, "01:30", "03:00", lisbon) == (at_local("2026-10-25T01:30"), at_local("2026-10-25T03:00"))
    assert window_of(autumn, "00:30", "01:30", lisbon)[1] == at_local("2026-10-25T01:30", fold=1)
    begin, end = window_of(spring, "01:30", "01:45", lisbon)
    assert begin <= at_local("2026-03-29T00:59") + 31 * 60
    assert end >= at_local("2026-03-29T02:45")


@pytest.mark.parametrize("step", [-HOUR, HOUR])
def test_window_that_has_begun_ends_no_earlier_than_its_length_after_a_step(step):
    schedule = WeeklySchedule(time_zone="UTC", times=[weekly("sat", "11:00", "13:00")])
    times = ZoneTimes(zone(schedule=schedule))
    assert active(times, 0.0, T0)
    for now in range(60, 3600, 60):
        assert active(times, float(now), T0 + now + step)
    assert not active(times, 2 * HOUR + 60.0, T0 + 2 * HOUR + 60.0 + step)


ZONES = [LISBON, "UTC", "Pacific/Kiritimati", "America/St_Johns", "Asia/Tokyo", "Pacific/Pago_Pago"]


@settings(max_examples=100, deadline=None)
@given(st.floats(0.0, 2e9), st.sampled_from(ZONES), st.floats(0.0, 9.0))
# 03:15 on a Sunday whose 02:00 was 03:00: the window's end, 02:30, did not occur.
@example(datetime(1986, 4, 27, 1, 15, tzinfo=ZoneInfo("America/St_Johns")).timestamp(), "America/St_Johns", 3.0)
@example(datetime(1970, 4, 26, 3, 15, tzinfo=ZoneInfo("America/St_Johns")).timestamp(), "America/St_Johns", 3.0)
# A Friday before a Saturday that a change of the date line left out.
@example(datetime(1994, 12, 30, 23, 45, tzinfo=ZoneInfo("Pacific/Kiritimati")).timestamp(), "Pacific/Kiritimati", 3.0)
def test_schedule_computed_for_days_ahead_equals_the_definition(stamp, name, days):
    schedule = WeeklySchedule(time_zone=name, times=[weekly("sat", "23:30", "01:15"), weekly("sun", "01:00", "02:30")])
    local = datetime.fromtimestamp(stamp, tz=ZoneInfo(name))
    text, day = local.strftime("%H:%M"), local.weekday()
    expected = (day == 5 and text >= "23:30") or (day == 6 and (text < "01:15" or "01:00" <= text < "02:30"))
    times = ZoneTimes(zone(schedule=schedule))
    active(times, 0.0, stamp - days * 86_400.0)
    found = active(times, days * 86_400.0, stamp)
    # Where local times repeat or are missing within a day of it, windows may be longer.
    assert found >= expected
    nearby = (datetime.fromtimestamp(stamp + shift, tz=ZoneInfo(name)) for shift in (-86_400.0, 0.0, 86_400.0))
    if len({moment.utcoffset() for moment in nearby}) == 1:
        assert found == expected, local


@pytest.mark.parametrize("name", ZONES)
def test_windows_of_a_schedule_are_computed_once_in_days_at_any_time_of_the_day(name, monkeypatch):
    computed = []
    compute = weekly_windows.window_of
    monkeypatch.setattr(weekly_windows, "window_of", lambda *arguments: computed.append(1) or compute(*arguments))
    times = ZoneTimes(zone(schedule=WeeklySchedule(time_zone=name, times=[weekly("wed", "08:00", "09:00")])))
    for hour in range(48):
        active(times, hour * HOUR, T0 + hour * HOUR)
    assert len(computed) <= 4, "each computation has three or four Wednesdays"


@pytest.mark.parametrize(
    ("fields", "lasts"),
    [
        ({"expires_at": T0 + 5 * HOUR}, 0.1),
        ({"expires_at": T0 + 5 * HOUR}, 2 * HOUR),
        ({"ttl_s": HOUR}, 0.1),
        ({"ttl_s": HOUR}, 2 * HOUR),
    ],
    ids=["end, a moment", "end, two hours", "time to live, a moment", "time to live, two hours"],
)
@pytest.mark.parametrize("jump", [3.5 * HOUR, 24 * HOUR, 365 * 24 * HOUR])
def test_future_zone_is_in_force_in_its_time_although_the_clock_was_ahead_before(fields, lasts, jump):
    begin = T0 + 3 * HOUR
    future = zone(starts_at=begin, **fields)
    times = ZoneTimes(future)
    assert not active(times, 0.0, T0)
    for share in (0.0, 0.5, 1.0):
        active(times, 1.0 + share * lasts, T0 + 1.0 + share * lasts + jump)
    restarted = ZoneTimes(future, times.progress("boot", 2.0 + lasts), boot="boot", now=2.0 + lasts)
    for each in (times, restarted):
        for now in (2.0 + lasts, 2.5 * HOUR, 2.5 * HOUR + 0.1):
            active(each, now, T0 + now)
        assert active(each, 3 * HOUR + 1.0, begin + 1.0)
        assert each.over_for(3 * HOUR + 1.0) < 0.0
        active(each, 10 * HOUR, T0 + 10 * HOUR)
        assert not active(each, 10 * HOUR + 1.0, T0 + 10 * HOUR + 1.0)


def test_zone_is_over_since_its_end_also_after_a_restart_and_not_while_a_clock_is_ahead():
    coming = zone(starts_at=T0 + HOUR, expires_at=T0 + 2 * HOUR)
    times = ZoneTimes(coming)
    for now in (0.0, 0.5 * HOUR):
        active(times, now, T0 + 5 * HOUR + now)
        assert times.over_for(now) < 0.0, "it was never in force"
    assert active(times, 1.5 * HOUR, T0 + 1.5 * HOUR)
    assert times.over_for(1.5 * HOUR) < 0.0
    assert not active(times, 2 * HOUR, T0 + 2 * HOUR)
    assert times.over_for(2 * HOUR + 60.0) == 60.0
    restarted = ZoneTimes(coming, times.progress("boot", 2.2 * HOUR), boot="boot", now=2.5 * HOUR)
    assert not active(restarted, 2.5 * HOUR, T0 + 2.5 * HOUR)
    assert restarted.over_for(3 * HOUR) == pytest.approx(HOUR)
    disabled = ZoneTimes(zone(expires_at=T0 - 60.0, enabled=False))
    active(disabled, 0.0, T0)
    assert disabled.over_for(HOUR) < 0.0, "it may be enabled again"
