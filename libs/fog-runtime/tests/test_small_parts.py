"""Slots, logs, settings, health, metrics and files."""

import asyncio
import json
import logging
import math
import stat
import urllib.error
import urllib.request
from pathlib import Path
from typing import Annotated

import msgspec
import pytest
from prometheus_client import REGISTRY

from fog_contracts.messages import Trace
from fog_contracts.stages import SPANS
from fog_runtime import logs, metrics
from fog_runtime.concurrency import Slot
from fog_runtime.configuration.settings import CommonSettings, InflationSettings, Secret, SettingsError, describe, load
from fog_runtime.files import SHARED, atomic_write
from fog_runtime.health import Health, serve_health


async def test_slot_holds_only_the_newest_value_with_its_age():
    slot: Slot[int] = Slot()
    assert slot.get() is None
    assert slot.age(100.0) == math.inf
    slot.put(1, 100.0)
    slot.put(2, 101.0)
    assert slot.get() == 2
    assert slot.age(103.5) == 2.5


async def test_slot_wait_returns_on_a_newer_value_only():
    slot: Slot[str] = Slot()
    slot.put("old", 0.0)
    waiting = asyncio.create_task(slot.wait())
    await asyncio.sleep(0)
    assert not waiting.done()
    slot.put("newer", 1.0)
    slot.put("newest", 1.0)
    assert await waiting == "newest"


class Example(CommonSettings, frozen=True, kw_only=True):
    rate: float = 1.0
    debug: bool = False
    password: Secret = Secret("initial")  # immutable
    mode: Annotated[str, msgspec.Meta(pattern="^[ab]$")] = "a"


REQUIRED = {"FOGNAV_SITE_DIR": "/s", "FOGNAV_DATA_DIR": "/d"}


def test_environment_overrides_file_overrides_default(tmp_path):
    file = tmp_path / "x.toml"
    file.write_text('rate = 2.5\nmode = "b"\nsite_dir = "/from-file"\n')
    settings = load(Example, file=file, environ={"FOGNAV_DATA_DIR": "/d", "FOGNAV_MODE": "a", "FOGNAV_DEBUG": "true"})
    assert (settings.rate, settings.mode, settings.debug, settings.http_port) == (2.5, "a", True, 0)
    assert settings.site_dir == Path("/from-file")


def test_empty_variable_counts_as_not_set():
    assert load(Example, environ={**REQUIRED, "FOGNAV_RATE": "", "FOGNAV_PORT_FILE": ""}).rate == 1.0


@pytest.mark.parametrize(
    ("environ", "texts"),
    [
        ({}, ["site_dir", "FOGNAV_SITE_DIR"]),
        ({**REQUIRED, "FOGNAV_RATE": "fast"}, ["FOGNAV_RATE", "float", "'fast'"]),
        ({**REQUIRED, "FOGNAV_MODE": "c"}, ["FOGNAV_MODE", "'c'"]),
        ({**REQUIRED, "FOGNAV_LOG_LEVEL": "loud"}, ["FOGNAV_LOG_LEVEL", "'loud'"]),
    ],
)
def test_invalid_environment_variable_is_refused_by_name(environ, texts):
    with pytest.raises(SettingsError) as refused:
        load(Example, environ=environ)
    assert all(text in str(refused.value) for text in texts), refused.value


@pytest.mark.parametrize(
    ("content", "word"), [("rate = 'x'", "rate"), ("ratte = 1", "'ratte'"), ("rate = ", "TOML"), (None, "read")]
)
def test_invalid_settings_file_is_refused_by_name(tmp_path, content, word):
    file = tmp_path / "x.toml"
    if content is not None:
        file.write_text(content)
    with pytest.raises(SettingsError, match=word) as refused:
        load(Example, file=file, environ=REQUIRED)
    assert str(file) in str(refused.value)


def test_secrets_do_not_appear_in_logs_or_errors():
    environ = {**REQUIRED, "FOGNAV_PASSWORD": "hush", "FOGNAV_MQTT_URL": "mqtt://user:hush@broker:1883"}
    settings = load(Example, environ=environ)
    assert settings.password.reveal() == "hush"
    shown = f"{describe(settings)} {settings.password} {settings.password!r} {settings!r}"
    assert "hush" not in shown.replace(settings.mqtt_url, "")
    assert describe(settings)["mqtt_url"] == "mqtt://user:***@broker:1883"
    with pytest.raises(SettingsError) as refused:
        load(Example, environ={**environ, "FOGNAV_REDIS_URL": "x", "FOGNAV_SPEED": "redis://u:hush@h"})
    assert "hush" not in str(refused.value)


@pytest.fixture
def lines(capsys):
    """Return a function that returns the lines logged so far; the root logger is restored at the end."""
    root = logging.getLogger()
    before, level = root.handlers[:], root.level
    seen: list[str] = []

    def read() -> list[str]:
        seen.extend(capsys.readouterr().err.splitlines())
        return seen

    yield read
    root.handlers[:] = before
    root.setLevel(level)


def test_log_line_is_json_with_fields_and_errors(lines):
    logs.configure("proc", "info", "json")
    log = logs.get("part")
    log.info("100%s", robot="r1", level="mine", path=Path("/x"))
    log.debug("unseen")
    log.error("failed", error=ValueError("why"))
    first, second = (json.loads(line) for line in lines())
    assert (first["event"], first["process"], first["logger"], first["level"]) == ("100%s", "proc", "part", "info")
    assert (first["robot"], first["level_"], first["path"]) == ("r1", "mine", "/x")
    assert second["error"] == "ValueError: why"


def test_text_log_names_event_and_fields(lines):
    logs.configure("proc", "debug", "text")
    logs.get("part").warning("odd", n=3)
    assert lines()[0].endswith("warning proc part: odd n=3")


def test_rate_limited_log_logs_the_first_and_counts_the_suppressed(lines):
    logs.configure("proc")
    limited = logs.RateLimited(logs.get("part"), period=10.0, max_keys=2)
    for now in (0.0, 1.0, 9.9, 10.5):
        limited.warning("refused", "a", now)
    assert [json.loads(line).get("suppressed") for line in lines()] == [None, 2]
    for key in "bcdef":
        limited.warning("refused", key, 11.0)
    assert len(lines()) == 4, "b, and the first of those beyond the bound"


def get(port, path):
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=5) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()


def test_readyz_names_unmet_conditions(tmp_path):
    health = Health("mqtt", "store")
    health.set("mqtt", ok=True)
    health.set("store", ok=False, detail="redis://x refuses")
    with serve_health(health, port_file=tmp_path / "run" / "port") as server:
        assert int((tmp_path / "run" / "port").read_text()) == server.port
        assert get(server.port, "/healthz")[0] == 200
        status, body = get(server.port, "/readyz")
        assert status == 503
        assert json.loads(body)["missing"] == ["store"]
        assert "redis://x refuses" in body
        health.set("store", ok=True)
        assert get(server.port, "/readyz?x=1")[0] == 200
        assert "process_cpu_seconds_total" in get(server.port, "/metrics")[1]
        assert get(server.port, "/nothing")[0] == 404


def stage_sum(stage):
    return REGISTRY.get_sample_value("fognav_stage_seconds_sum", {"stage": stage}) or 0.0


def test_observed_trace_counts_its_finished_stages_only():
    before = {stage: stage_sum(stage) for stage in SPANS}
    trace = Trace(area="a1", epoch=1, seq=1, first_reading=10.0, confirmed=10.5, costmap_published=10.75)
    metrics.observe_trace(trace)
    gained = {stage: stage_sum(stage) - before[stage] for stage in SPANS}
    assert gained == pytest.approx(
        {"debounce": 0.5, "costmap": 0.25, "plan": 0, "deliver": 0, "command": 0, "total": 0}
    )


def test_stage_that_ends_before_it_begins_is_counted_as_skew():
    def skew():
        return REGISTRY.get_sample_value("fognav_trace_skew_total", {"stage": "debounce"}) or 0.0

    before, seconds = skew(), stage_sum("debounce")
    metrics.observe_trace(Trace(area="a1", epoch=1, seq=1, first_reading=10.0, confirmed=9.0), ["debounce"])
    assert skew() == before + 1
    assert stage_sum("debounce") == seconds


def test_written_file_is_private_unless_it_is_for_programs_of_other_users(tmp_path):
    atomic_write(tmp_path / "token", b"secret")
    atomic_write(tmp_path / "site.toml", b"old")
    atomic_write(tmp_path / "site.toml", b"new", mode=SHARED)
    assert stat.S_IMODE((tmp_path / "token").stat().st_mode) == 0o600
    assert stat.S_IMODE((tmp_path / "site.toml").stat().st_mode) == 0o644


def test_failed_atomic_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "f"
    atomic_write(path, b"old")
    with pytest.raises(TypeError):
        atomic_write(path, "no bytes")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_invalid_inflation_is_refused_when_the_settings_are_read():
    environ = {"FOGNAV_SITE_DIR": "/s", "FOGNAV_DATA_DIR": "/d", "FOGNAV_COST_SCALING": "5"}
    assert load(InflationSettings, environ=environ).inflation.cost_scaling == 5.0
    with pytest.raises(SettingsError, match="inflation_radius"):
        load(InflationSettings, environ={**environ, "FOGNAV_INFLATION_RADIUS": "-1"})
