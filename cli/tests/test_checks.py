import asyncio
import sys
from pathlib import Path

from fognav import checkout
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
