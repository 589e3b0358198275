"""The page `docs/reaction-times.md`."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Final

from fognav import checkout

if TYPE_CHECKING:
    from collections.abc import Sequence

_PAGE: Final = """# Reaction times

How long the wheels of a robot that drives at 0.3 m/s turn on after a fault: the time until the emulated base was last
commanded to turn a wheel, or, where a fault only slows the robot, to exceed 0.15 m/s. Watchdog, guardian and agent are
the real processes, on ptys to a byte-exact emulated base and lidar in a simulated corridor; map, planner and operator
speak to them over a real zenoh router. Written by

```sh
{command}
```

which continues the trials in the log FILE, if there is one; without it the command starts anew.

{tables}

When guardian and watchdog die or hang in the same moment, nothing on the robot's computer stops the wheels until the
watchdog is started again or goes on: see the limits in the [README](../README.md). The same holds for the cable of the
base. A watchdog that hangs alone is no fault: the wheels keep obeying guardian and agent.

Measured at commit {commit} on: {machine}, {robots} robots at once, at a niceness of {niceness}.
Robots, emulated devices and whatever else ran shared its cores: a load above their
number means that all of them waited for a processor, and the times beyond a limit include that.

{mark}
"""
_MARK: Final = "<!-- Remarks: what stands below this line is kept when the command writes the page again. -->"
_HEAD: Final = """| fault | trials | stopped | median, s | p99, s | longest, s | limit, s | beyond | its parts, s |
|---|---|---|---|---|---|---|---|---|
"""
_TITLES: Final = {
    "process": "Processes killed (`SIGKILL`) or stopped (`SIGSTOP`)",
    "device": "Base and lidar",
    "fog": "Map, planner and network",
    "operator": "Operator",
}


def remarks(page: str) -> str:
    """Return what people wrote below the mark of a page, "" for one without."""
    return page.partition(_MARK)[2].strip()


def markdown(rows: Sequence[dict[str, object]], command: str, machine: str, robots: int, kept: str = "") -> str:
    """Return the page, of this process and the checkout that it runs from, with the remarks `kept` at its end."""
    tables = []
    for kind, title in _TITLES.items():
        lines = [_line(each) for each in rows if each["kind"] == kind]
        if lines:
            tables.append(f"## {title}\n\n{_HEAD}" + "\n".join(lines))
    page = _PAGE.format(
        mark=_MARK,
        tables="\n\n".join(tables),
        command=command,
        machine=machine,
        robots=robots,
        commit=checkout.revision() or "unknown",
        niceness=os.getpriority(os.PRIO_PROCESS, 0),
    )
    return f"{page}\n{kept}\n" if kept else page


def _line(each: dict[str, object]) -> str:
    limit = "none" if each["limit_s"] is None else each["limit_s"]
    figures = " | ".join(str(each[name]) for name in ("trials", "stopped", "median_s", "p99_s", "max_s"))
    return f"| {each['fault']} | {figures} | {limit} | {each['beyond_limit']} | {each['design']} |"
