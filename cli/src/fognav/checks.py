"""The static checks: format, lint, types, import contracts, declared imports, dead code, generated files.

Each check is a program whose exit code is 0 if it passes. All of them run, as many at once as there are cores.
"""

import asyncio
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final


@dataclass(frozen=True)
class Check:
    """A check: its name, the program and its arguments, and the remedy for a failure."""

    name: str
    command: tuple[str, ...]
    remedy: str


@dataclass(frozen=True)
class CheckResult:
    """The result of a check, its duration and its output."""

    check: Check
    ok: bool
    seconds: float
    output: str


_TOOLS: Final = Path(sys.executable).parent
CHECKS: Final = (
    # The longest first: the others run beside it.
    Check("types", (str(_TOOLS / "mypy"),), "correct the types listed above"),
    Check("import contracts", (str(_TOOLS / "lint-imports"),), "import inwards only: [tool.importlinter]"),
    Check(
        "declared imports",
        (".ci/declared-imports", str(_TOOLS / "deptry")),
        "declare in a member's pyproject.toml what it imports, and run requirements/compile",
    ),
    Check("lint", (str(_TOOLS / "ruff"), "check", "."), "ruff check --fix . applies the automatic corrections"),
    Check("format", (str(_TOOLS / "ruff"), "format", "--check", "."), "ruff format ."),
    Check(
        "dead code", (str(_TOOLS / "vulture"),), "remove it, or list it with its reason in .ci/dead-code-allowlist.py"
    ),
    Check(
        "generated files: servers",
        (sys.executable, "-m", "fog_supervisor.configurations", "--check", "deploy"),
        "python -m fog_supervisor.configurations --write deploy",
    ),
    Check(
        "generated files: channels",
        (sys.executable, "-m", "fognav", "channels", "--check"),
        "./fognav channels --write",
    ),
    Check(
        "generated files: dashboards",
        (sys.executable, "deploy/grafana/make_dashboards.py", "--check"),
        "python deploy/grafana/make_dashboards.py",
    ),
    Check(
        "generated files: baselines",
        (sys.executable, "deploy/prometheus/make_baselines.py", "--check"),
        "python deploy/prometheus/make_baselines.py",
    ),
)


async def _run(check: Check, folder: Path, environment: Mapping[str, str]) -> CheckResult:
    started = time.monotonic()
    try:
        process = await asyncio.create_subprocess_exec(
            *check.command,
            cwd=folder,
            env=dict(environment),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
        )
    except OSError as error:
        message = f"{check.command[0]} can't be started: {error.strerror}"
        return CheckResult(check, ok=False, seconds=time.monotonic() - started, output=message)
    output, _ = await process.communicate()
    ok = process.returncode == 0
    return CheckResult(check, ok, time.monotonic() - started, output.decode("utf-8", "replace").strip())


async def run_checks(
    checks: Sequence[Check], folder: Path, on_result: Callable[[CheckResult], None], cores: int | None = None
) -> list[CheckResult]:
    """Run all checks in `folder`, as many at once as there are `cores`; return them in their order.

    `on_result` is called when each ends. A failure does not stop the others.
    """
    slots = asyncio.Semaphore(cores or os.cpu_count() or 1)
    environment = {**os.environ, "NO_COLOR": "1"}

    async def run_one(check: Check) -> CheckResult:
        async with slots:
            result = await _run(check, folder, environment)
        on_result(result)
        return result

    return list(await asyncio.gather(*(run_one(check) for check in checks)))
