"""The rules of Prometheus, checked by its own tool, and what operators are told about each alert."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

from fog_contracts.messages import ReasonCode

ROOT = Path(__file__).parents[2]
DEPLOYED = ROOT / "deploy" / "prometheus"
TESTS = sorted(Path(__file__).parent.glob("*.test.yml"))
ALERTS = [
    rule["alert"]
    for group in yaml.safe_load((DEPLOYED / "rules" / "alerts.yml").read_text("utf-8"))["groups"]
    for rule in group["rules"]
]
LIMIT_S = 900
"""Ten seconds of a processor, of which a busy machine has little to give."""

needs_promtool = pytest.mark.skipif(shutil.which("promtool") is None, reason="promtool is not installed")


def promtool(*arguments: str) -> str:
    done = subprocess.run(["promtool", *arguments], capture_output=True, text=True, timeout=LIMIT_S, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@needs_promtool
def test_configuration_is_valid_and_names_files_that_exist() -> None:
    assert "3 rule files found" in promtool("check", "config", str(DEPLOYED / "prometheus.yml"))


@pytest.mark.drive
@needs_promtool
@pytest.mark.timeout(LIMIT_S + 60)
def test_each_alert_fires_when_it_must_and_not_before() -> None:
    assert promtool("test", "rules", *map(str, TESTS)).count("SUCCESS") == len(TESTS) == 2


def test_alert_on_robots_that_hold_leaves_out_reasons_that_robots_give() -> None:
    rule = (DEPLOYED / "rules" / "alerts.yml").read_text("utf-8")
    (named,) = re.findall(r"reason=~\"([^\"]+)\"", rule)
    assert set(named.split("|")) == {ReasonCode.AT_REST, ReasonCode.ON_DOCK}


@pytest.mark.parametrize("alert", ALERTS)
def test_alert_has_a_test_and_tells_operators_what_to_do(alert: str) -> None:
    tests = [test for file in TESTS for test in yaml.safe_load(file.read_text("utf-8"))["tests"]]
    expected = [case for test in tests for case in test.get("alert_rule_test", []) if case["alertname"] == alert]
    assert any(case["exp_alerts"] for case in expected), "no test in which it fires"
    operations = (ROOT / "docs" / "operations.md").read_text("utf-8")
    assert re.search(rf"^\*\*{alert}\.\*\* \S", operations, re.MULTILINE), "say in docs/operations.md what to do"
