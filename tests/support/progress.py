"""A pytest plugin of `fognav test`: which tests are left out, a progress bar instead of dots, a summary of the skipped.

With pytest-xdist the bar and the summary are those of the process that distributes the tests.
"""

from collections import Counter
from collections.abc import Generator
from typing import Any, Final

import pytest
from _pytest.terminal import TerminalReporter  # pytest has no public name for it
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

_NAME: Final = "fognav-progress-bar"
_SKIPPED: Final = "Skipped: "
_LEFT_OUT: Final = "fognav_left_out"


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the choice of tests; the root's conftest.py knows which belong where."""
    tiers = ("quick", "rest", "all", "long")
    parser.addoption("--tier", choices=tiers, default="all", help="quick: some minutes; rest: others; all: both; long")


def pytest_deselected(items: list[pytest.Item]) -> None:
    """Count what is left out, for the process that distributes the tests as well."""
    if items:
        output = getattr(items[0].config, "workeroutput", vars(items[0].config))
        output[_LEFT_OUT] = output.get(_LEFT_OUT, 0) + len(items)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:  # a worker of pytest-xdist, which has no types
    """Take over a worker's count; each has left out the same tests."""
    vars(node.config)[_LEFT_OUT] = node.workeroutput.get(_LEFT_OUT, 0)


class ProgressBar:
    """Counts the tests that have ended, and prints failures at once."""

    def __init__(self, console: Console) -> None:
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            console=console,
            transient=True,
        )
        self._task = self._progress.add_task("tests", total=None)
        self._running = False
        self._failed = 0

    def pytest_collection_finish(self, session: pytest.Session) -> None:
        """Set the number of tests if one process runs them all."""
        # The process that distributes tests to others collects none itself.
        if session.items:
            self._progress.update(self._task, total=len(session.items))

    @pytest.hookimpl(optionalhook=True)
    def pytest_xdist_node_collection_finished(self, ids: list[str]) -> None:
        """Set the number of tests if several processes run them; each has collected all of them."""
        self._progress.update(self._task, total=len(ids))

    def pytest_runtest_logstart(self) -> None:
        """Show the bar at the first test: before that pytest prints its own lines."""
        if not self._running:
            self._running = True
            self._progress.start()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Count a test after its teardown."""
        if report.failed:
            self._failed += 1
            self._progress.update(self._task, description=f"tests, [red]{self._failed} failed[/]")
            self._progress.console.print(f"[red]failed[/] {report.nodeid}", markup=True, highlight=False)
        if report.when == "teardown":
            self._progress.advance(self._task)

    @pytest.hookimpl(wrapper=True)
    def pytest_report_teststatus(self) -> Generator[None, tuple[str, object, object], tuple[str, str, str]]:
        """Keep the outcome's category, but print nothing for a single test."""
        category, _, _ = yield
        return category, "", ""

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self) -> None:
        """Remove the bar before pytest prints its summary."""
        self._progress.stop()


def pytest_configure(config: pytest.Config) -> None:
    """Use the bar on a terminal, unless verbose or uncaptured output is requested."""
    console = Console(stderr=True)
    worker = hasattr(config, "workerinput")
    if console.is_terminal and not worker and config.get_verbosity() == 0 and config.getoption("capture") != "no":
        config.pluginmanager.register(ProgressBar(console), _NAME)


def pytest_terminal_summary(terminalreporter: TerminalReporter) -> None:
    """Print for each reason how many tests were skipped; reasons include the remedy."""
    reasons: Counter[str] = Counter()
    for report in terminalreporter.stats.get("skipped", []):
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
        reasons[reason.removeprefix(_SKIPPED)] += 1
    if reasons:
        terminalreporter.section("skipped")
        for reason, count in reasons.most_common():
            terminalreporter.line(f"{count} skipped: {reason}")
    config = terminalreporter.config
    if config.getoption("tier") == "quick":
        count = vars(config).get(_LEFT_OUT, 0)
        terminalreporter.line(
            f"{count} tests of whole drives, real processes and containers were left out: `fognav test --all` runs them"
        )
