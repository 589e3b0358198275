"""A pytest plugin: a progress bar on a terminal instead of dots, and at the end what was skipped and how to get it.

`fognav test` loads it; with pytest-xdist it runs in the process that hands out the tests.
"""

from collections import Counter
from collections.abc import Generator
from typing import Final

import pytest
from _pytest.terminal import TerminalReporter  # pytest gives its reporter's type no public name
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

_NAME: Final = "fognav-progress-bar"
_SKIPPED: Final = "Skipped: "


class ProgressBar:
    """Counts the tests that have ended; failures are named when they happen."""

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
        """Count the tests, when one process runs them all."""
        # The process that hands tests out to others collects none itself.
        if session.items:
            self._progress.update(self._task, total=len(session.items))

    @pytest.hookimpl(optionalhook=True)
    def pytest_xdist_node_collection_finished(self, ids: list[str]) -> None:
        """Count the tests, when several processes run them; each has collected them all."""
        self._progress.update(self._task, total=len(ids))

    def pytest_runtest_logstart(self) -> None:
        """Show the bar when the first test begins: pytest writes its own lines until then."""
        if not self._running:
            self._running = True
            self._progress.start()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Count a test when all of it is over."""
        if report.failed:
            self._failed += 1
            self._progress.update(self._task, description=f"tests, [red]{self._failed} failed[/]")
            self._progress.console.print(f"[red]failed[/] {report.nodeid}", markup=True, highlight=False)
        if report.when == "teardown":
            self._progress.advance(self._task)

    @pytest.hookimpl(wrapper=True)
    def pytest_report_teststatus(self) -> Generator[None, tuple[str, object, object], tuple[str, str, str]]:
        """Keep the outcome's category, and let nothing be written for a single test."""
        category, _, _ = yield
        return category, "", ""

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self) -> None:
        """Remove the bar before pytest writes its summary."""
        self._progress.stop()


def pytest_configure(config: pytest.Config) -> None:
    """Show the bar where it can be seen: on a terminal, unless details are asked for."""
    console = Console(stderr=True)
    worker = hasattr(config, "workerinput")
    if console.is_terminal and not worker and config.get_verbosity() == 0 and config.getoption("capture") != "no":
        config.pluginmanager.register(ProgressBar(console), _NAME)


def pytest_terminal_summary(terminalreporter: TerminalReporter) -> None:
    """Tell once for each reason how many tests were skipped for it; reasons say how to get them."""
    reasons: Counter[str] = Counter()
    for report in terminalreporter.stats.get("skipped", []):
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
        reasons[reason.removeprefix(_SKIPPED)] += 1
    if reasons:
        terminalreporter.section("skipped")
        for reason, count in reasons.most_common():
            terminalreporter.line(f"{count} skipped: {reason}")
