"""For who changes Fognav: `fognav test`, `check`, `docs` and `channels`.

`test` runs pytest: which tests, on all cores, with progress, and with programs that can be installed. Each of the
static checks is a program whose exit code is 0 if it passes; all of them run, as many at once as there are cores.
"""

import asyncio
import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final, Literal

import typer

from fog_contracts.generate.header import firmware_header
from fognav import checkout, kernels, system
from fognav.operate.options import JsonOption, YesOption
from fognav.output import NOT_TRUE, FailedError, WrongUseError, console, exit_codes, fail, print_json, print_line

_OVERRIDES: Final = (
    "-n",
    "--numprocesses",
    "--dist",
    "--pdb",
    "--trace",
    "--collect-only",
    "--co",
    "-s",
    "--capture=no",
)
"""Arguments that choose another distribution of the tests, or need a single process."""

_TIERS: Final = {"--all": "all", "--rest": "rest", "--long": "long"}
"""Arguments that ask for every test, those that are left out without one, or those that all tests leave out."""


def run_tests(context: typer.Context, *, yes: YesOption = False) -> None:
    """Set up what is missing, then run the tests on all cores.

    These are some minutes of them, or those that you name. With --all every test runs, with --rest those that are
    left out without it, with --long new random worlds and containers, which keeps its result in
    tests/last-long-run.txt. Further arguments go to pytest (`-n 0` runs one at a time).
    """
    with exit_codes():
        system.ensure([system.MOSQUITTO, system.REDIS], yes=yes, print_line=print_line)
        kernels.warm_cache(print_line)
    get_optional_tools(yes=yes, print_line=print_line)
    done = subprocess.run(pytest_command(context.args), check=False, cwd=checkout.root())
    raise typer.Exit(done.returncode)


def workers(tier: str) -> int:
    """Return how many tests run at once: two more than there are cores, because most tests of processes wait.

    The root's conftest.py lets no more of them compute than there are cores to spare. Nearly all quick ones do: more at
    once would leave no time to the real processes of the others.
    """
    return (os.cpu_count() or 1) + (0 if tier == "quick" else 2)


def pytest_command(arguments: Sequence[str], *, terminal: bool | None = None) -> list[str]:
    """Return the command line of pytest, with the user's arguments last."""
    tier = next((_TIERS[argument] for argument in arguments if argument in _TIERS), None)
    if tier is None:
        tier = "all" if _selects(arguments) else "quick"
    arguments = [argument for argument in arguments if argument not in _TIERS]
    command = [sys.executable, "-m", "pytest", "-p", "tests.support.progress", "-r", "fE", f"--tier={tier}"]
    if sys.stderr.isatty() if terminal is None else terminal:
        command += ["-o", "console_output_style=classic"]  # the bar shows the progress
    if not any(argument.startswith(_OVERRIDES) for argument in arguments):
        command += ["-n", str(workers(tier)), "--dist", "loadgroup", "--no-loadscope-reorder"]
    return [*command, *arguments]


def _selects(arguments: Sequence[str]) -> bool:
    """Whether the user says which tests to run, by their path, a name or a marker: then no tier leaves one out."""
    paths = (argument.partition("::")[0] for argument in arguments if not argument.startswith("-"))
    by_name = any(argument.startswith(("-k", "-m")) for argument in arguments)
    return by_name or any((checkout.root() / path).exists() for path in paths)


def get_optional_tools(*, yes: bool, print_line: Callable[[str], None]) -> None:
    """Install, given consent, missing programs that some tests need; without them those tests are skipped."""
    if not system.has_consent(yes):
        return
    for tool in system.TOOLS:
        if tool.required or system.find(tool) is not None:
            continue
        try:
            system.ensure([tool], yes=yes, print_line=print_line)
        except system.MissingToolsError as error:
            print_line(f"skipping tests that need {tool.name} ({tool.purpose}): {error}")


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
    Check(
        "console", (sys.executable, "-m", "fognav.console_page", "--check"), "correct what is listed above in console/"
    ),
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


def check_command(*, json: JsonOption = False) -> None:
    """Run all static checks.

    These are format, lint, types, import contracts, declared imports, dead code and generated files. All of them
    run; the exit code is 1 if one fails.
    """

    def show(result: CheckResult) -> None:
        mark = "[green]ok[/]    " if result.ok else "[red]failed[/]"
        console.print(f"{mark} {result.seconds:5.1f} s  {result.check.name}")
        if not result.ok:
            print_line(result.output)

    started = time.monotonic()
    with exit_codes():
        results = asyncio.run(run_checks(CHECKS, checkout.root(), show))
    seconds, failed = time.monotonic() - started, [result for result in results if not result.ok]
    if json:
        shown = [{"check": r.check.name, "ok": r.ok, "seconds": round(r.seconds, 1)} for r in results]
        print_json({"ok": not failed, "seconds": round(seconds, 1), "checks": shown})
    if failed:
        remedies = "\n".join(f"  {result.check.name}: {result.check.remedy}" for result in failed)
        fail(f"{len(failed)} of {len(results)} checks failed in {seconds:.0f} s:\n{remedies}")
    print_line(f"all {len(results)} checks passed ({seconds:.0f} s)")


async def _run_check(check: Check, folder: Path, environment: Mapping[str, str]) -> CheckResult:
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
    # None computes: those that import the services, to describe their routes, would compile kernels for half a minute.
    environment = {**os.environ, "NO_COLOR": "1", "NUMBA_DISABLE_JIT": "1"}

    async def run_one(check: Check) -> CheckResult:
        async with slots:
            result = await _run_check(check, folder, environment)
        on_result(result)
        return result

    return list(await asyncio.gather(*(run_one(check) for check in checks)))


@exit_codes()
def docs_command(
    *,
    serve: Annotated[
        bool, typer.Option("--serve", help="Show it on this machine until Ctrl-C, and documents as they change.")
    ] = False,
    port: Annotated[int, typer.Option("--port", min=1, max=65535, help="Port of --serve.")] = 8000,
) -> None:
    """Build the documentation as a site, and check its links.

    The first time this installs what builds it. The site is in .fognav/docs/site, and loads nothing from elsewhere.
    """
    from fognav import documentation  # noqa: PLC0415  # keeps the other commands fast

    root = checkout.root()
    folder = root / ".fognav" / "docs"
    if (builder := system.find_tool(root, "docs", "zensical")) is None:
        print_line("installing what builds the documentation (once)")
        builder = system.install_tool(root, "docs", "zensical")
    started = time.monotonic()
    routes = documentation.rest_routes()
    documentation.write(root, folder, routes)
    if wrong := documentation.build(builder, folder):
        raise FailedError(f"{wrong}\ncorrect the documents named above")
    pages = sum(1 for _ in (folder / "site").rglob("*.html"))
    print_line(f"built {pages} pages in {time.monotonic() - started:.0f} s: {folder / 'site' / 'index.html'}")
    if serve:
        _serve(builder, folder, port, lambda: documentation.write(root, folder, routes))


def _serve(builder: Path, folder: Path, port: int, update: Callable[[], None]) -> None:
    """Show the site; the program builds anew what changes in its folder."""
    with subprocess.Popen([builder, "serve", "--dev-addr", f"127.0.0.1:{port}"], cwd=folder) as server:
        try:
            while server.poll() is None:
                update()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    server.wait(1.0)
        except KeyboardInterrupt:
            server.terminate()


def channels_command(
    *,
    format: Annotated[  # noqa: A002  # the name of the option
        Literal["markdown", "acl", "header", "openapi"], typer.Option("--format", help="What to print.")
    ] = "markdown",
    broker: Annotated[
        Literal["mqtt", "zenoh"] | None, typer.Option("--broker", help="For acl: only this broker's list.")
    ] = None,
    site: Annotated[
        Path | None,
        typer.Option("--site", metavar="D", help="For acl: only this site, its robots listed by id."),
    ] = None,
    write: Annotated[bool, typer.Option("--write", help="Write all generated files of the checkout.")] = False,
    check: Annotated[bool, typer.Option("--check", help="List the generated files that are out of date.")] = False,
) -> None:
    """Print what the channel table generates.

    This is the document of all messages and routes, the brokers' access control lists, the firmware's header, or the
    OpenAPI document of all services, from which a client's types can be made.
    """
    with exit_codes():
        _print_or_write(format, broker, site, write=write, check=check)


def _print_or_write(format: str, broker: str | None, site: Path | None, *, write: bool, check: bool) -> None:  # noqa: A002  # same
    from fognav import documentation  # noqa: PLC0415  # same

    if format != "acl" and (broker or site):
        raise WrongUseError(f"--broker and --site apply only to --format acl, not to {format}")
    if write:
        names = documentation.write_generated(checkout.root())
        console.print(f"wrote {', '.join(names)}" if names else "all generated files are up to date", markup=False)
    elif check:
        if names := documentation.stale_generated(checkout.root()):
            console.print(f"{', '.join(names)}: out of date. Run: {documentation.WRITE}", markup=False, style="red")
            raise typer.Exit(NOT_TRUE)
    elif format == "markdown":
        _print(documentation.markdown())
    elif format == "header":
        _print(firmware_header())
    elif format == "openapi":
        _print(documentation.openapi())
    else:
        mqtt, zenoh = documentation.acls(checkout.site_folder(site) if site else None)
        for name, text in (("mqtt", mqtt), ("zenoh", zenoh)):
            if broker in (None, name):
                _print(text)


def _print(text: str) -> None:
    typer.echo(text, nl=False)
