"""`fognav test`, `check` and `channels`: how pytest is called, and what is checked and generated."""

import asyncio
import importlib.util
import os
import pty
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
from typer.testing import CliRunner

from fog_contracts.generate.acl import mqtt_acl, zenoh_acl
from fog_contracts.generate.header import firmware_header
from fognav import checkout, documentation
from fognav.__main__ import app
from fognav.commands import develop
from fognav.commands.develop import CHECKS, Check, CheckResult, run_checks


def python(name: str, code: str) -> Check:
    return Check(name, (sys.executable, "-S", "-c", code), f"correct {name}")


def run(folder: Path, *checks: Check, cores: int = 2) -> tuple[list[CheckResult], list[str]]:
    ended: list[str] = []
    results = asyncio.run(run_checks(checks, folder, lambda result: ended.append(result.check.name), cores))
    return results, ended


def test_failed_check_does_not_stop_the_others(tmp_path: Path) -> None:
    bad = python("bad", "print('line 3 is wrong'); raise SystemExit(2)")
    results, ended = run(tmp_path, bad, Check("missing", ("/nowhere/tool",), ""), python("good", "print('fine')"))
    assert [(r.check.name, r.ok, r.output) for r in results] == [
        ("bad", False, "line 3 is wrong"),
        ("missing", False, "/nowhere/tool can't be started: No such file or directory"),
        ("good", True, "fine"),
    ]
    assert sorted(ended) == ["bad", "good", "missing"]


def test_checks_run_in_parallel_in_the_checkout(tmp_path: Path) -> None:
    wait = "import pathlib, time\npathlib.Path('{0}').touch()\nwhile not pathlib.Path('{1}').exists(): time.sleep(0.01)"
    results, _ = run(tmp_path, python("one", wait.format("a", "b")), python("two", wait.format("b", "a")))
    assert all(result.ok for result in results)


def test_checks_that_import_kernels_compile_none(tmp_path: Path) -> None:
    results, _ = run(tmp_path, python("imports", "import os; print(os.environ['NUMBA_DISABLE_JIT'])"))
    assert [result.output for result in results] == ["1"]


def test_at_most_one_check_per_core_runs_at_once(tmp_path: Path) -> None:
    exclusive = "import pathlib\np = pathlib.Path('busy')\np.touch(exist_ok=False)\np.unlink()"
    results, ended = run(tmp_path, *(python(name, exclusive) for name in "abc"), cores=1)
    assert all(result.ok for result in results)
    assert ended == ["a", "b", "c"]


def test_every_check_has_a_tool_and_a_remedy() -> None:
    for check in CHECKS:
        assert (checkout.root() / check.command[0]).exists(), check.name
        assert check.remedy
    assert len({check.name for check in CHECKS}) == len(CHECKS)


TESTS = """
import pytest

@pytest.mark.parametrize("n", range(3))
def test_without_a_sonar(n):
    pytest.skip("no sonar: plug one in")

def test_that_passes():
    pass

def test_that_fails():
    assert False
"""


ENVIRONMENT = {**os.environ, "PYTHONPATH": str(checkout.root())}
"""The progress is in the checkout's tests; pytest begins there, but in these tests."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "test_some.py").write_text(TESTS)
    (tmp_path / "pytest.ini").write_text("[pytest]\nasyncio_default_fixture_loop_scope = function\n")
    return tmp_path


def command(*, terminal: bool = False) -> list[str]:
    return develop.pytest_command(["-n", "0", "test_some.py"], terminal=terminal)


def test_skipped_tests_are_summarized_once_per_reason(folder: Path) -> None:
    done = subprocess.run(command(), cwd=folder, env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stdout.count("no sonar") == 1
    assert "3 skipped: no sonar: plug one in" in done.stdout
    assert "test_some.py sss.F" in done.stdout  # no terminal, no bar
    assert done.stderr == ""


def test_bar_on_a_terminal_shows_progress_and_failures_at_once(folder: Path) -> None:
    master, slave = pty.openpty()
    environment = {**ENVIRONMENT, "TERM": "xterm", "COLUMNS": "100"}
    process = subprocess.Popen(command(terminal=True), cwd=folder, stdout=slave, stderr=slave, env=environment)
    os.close(slave)
    output = b""
    try:
        while chunk := os.read(master, 4096):
            output += chunk
    except OSError:  # on Linux: the other end is closed
        pass
    assert process.wait() == 1
    text = output.decode()
    assert "5/5" in text
    assert text.index("test_some.py::test_that_fails") < text.index("FAILURES")
    assert "sss" not in text
    assert "3 skipped: no sonar: plug one in" in text


def test_tests_run_on_all_cores_unless_the_arguments_choose_otherwise() -> None:
    command = develop.pytest_command(["-k", "replica"], terminal=False)
    assert command[:3] == [sys.executable, "-m", "pytest"]
    assert command[command.index("-n") + 1] == str((os.cpu_count() or 1) + 2)
    quick = develop.pytest_command([], terminal=False)
    assert quick[quick.index("-n") + 1] == str(os.cpu_count() or 1), "they compute, and the real processes need time"
    assert command[-2:] == ["-k", "replica"]
    for arguments in (["-n", "0"], ["-n4"], ["--pdb"], ["-s"], ["--collect-only"]):
        assert "--dist" not in develop.pytest_command(arguments, terminal=False)


@pytest.mark.parametrize(
    ("arguments", "tier"),
    [
        ([], "quick"), (["-q", "-x"], "quick"), (["--all"], "all"), (["--rest", "-q"], "rest"), (["--long"], "long"),
        (["-k", "replica"], "all"), (["-m", "claim"], "all"), (["cli/tests/test_develop.py::test_x"], "all"),
    ],
)  # fmt: skip
def test_quick_tests_run_unless_all_are_asked_for_or_some_by_name(arguments: list[str], tier: str) -> None:
    command = develop.pytest_command(arguments, terminal=False)
    assert [argument for argument in command if "tier" in argument] == [f"--tier={tier}"]
    assert not {"--all", "--rest", "--long"} & set(command)


@pytest.fixture(scope="module")
def grouping() -> ModuleType:
    spec = importlib.util.spec_from_file_location("root_conftest", checkout.root() / "conftest.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_tests_of_reaction_times_share_one_worker(grouping: ModuleType) -> None:
    faults = grouping.group_of("tests/live/test_faults.py")
    assert faults == grouping.group_of("robot-agent/tests/guardian/test_processes.py")
    assert faults[0] == grouping.REACTION
    assert grouping.group_of("cli/tests/test_stack.py")[0] == grouping.LIVE
    assert grouping.group_of("tests/replay/test_replay.py")[0] == grouping.SYSTEM
    assert grouping.group_of("services/tests/test_rest.py")[0] == grouping.SYSTEM


runner = CliRunner()


@pytest.mark.parametrize("name", documentation.FILES)
def test_generated_file_is_up_to_date(name: str) -> None:
    committed = (checkout.root() / name).read_text("utf-8")
    assert committed == documentation.FILES[name](), f"{name} is out of date. Run: {documentation.WRITE}"


def test_routes_of_all_services_are_in_the_document() -> None:
    text = documentation.markdown()
    for route in ("PUT /api/v1/areas/{area_id}", "POST /api/v1/zones", "PUT /api/v1/robots/{robot}/goal"):
        assert text.count(f"| `{route}` |") == 1


def test_printed_formats_equal_the_generated_files() -> None:
    assert runner.invoke(app, ["channels", "--format", "header"]).stdout == firmware_header()
    assert runner.invoke(app, ["channels", "--format", "acl"]).stdout == mqtt_acl() + zenoh_acl()
    assert runner.invoke(app, ["channels", "--format", "acl", "--broker", "mqtt"]).stdout == mqtt_acl()
    assert runner.invoke(app, ["channels"]).stdout == documentation.markdown()


def test_lists_for_a_site_name_it_and_its_robots() -> None:
    done = runner.invoke(app, ["channels", "--format", "acl", "--broker", "zenoh", "--site", "estig"])
    assert done.exit_code == 0
    assert done.stdout == zenoh_acl("estig", ["r1"])


@pytest.mark.parametrize(
    "arguments", [["--broker", "mqtt"], ["--format", "header", "--site", "estig"], ["--format", "acl", "--site", "x/y"]]
)
def test_options_that_do_not_match_the_format_are_wrong_use(arguments: list[str]) -> None:
    assert runner.invoke(app, ["channels", *arguments]).exit_code == 2


def test_stale_file_is_listed_by_check_and_updated_by_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkout, "root", lambda: tmp_path)
    monkeypatch.setattr(documentation, "FILES", {"a/acl": mqtt_acl, "b/header.h": firmware_header})
    assert runner.invoke(app, ["channels", "--check"]).exit_code == 1
    assert "a/acl, b/header.h" in runner.invoke(app, ["channels", "--write"]).output
    assert runner.invoke(app, ["channels", "--check"]).exit_code == 0
    (tmp_path / "a" / "acl").write_text("# by hand\n")
    done = runner.invoke(app, ["channels", "--check"])
    assert done.exit_code == 1
    assert "a/acl: out of date. Run: ./fognav channels --write" in done.output
    assert "up to date" not in runner.invoke(app, ["channels", "--write"]).output
    assert (tmp_path / "a" / "acl").read_text() == mqtt_acl()
    assert "up to date" in runner.invoke(app, ["channels", "--write"]).output
