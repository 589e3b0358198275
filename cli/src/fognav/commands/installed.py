"""The list of commands, by who uses them; and those of other packages, found by entry points.

Those that measure come with fognav-experiments, where it is installed.

    [project.entry-points."fognav.commands"]
    my-command = "my_package.commands:add_to"

An entry is a function that gets a `typer.Typer` and adds to it; the `rich_help_panel` of a command is its group.
"""

from __future__ import annotations

from types import FunctionType
from typing import TYPE_CHECKING, Any, Final

import typer
from typer.core import TyperGroup
from typer.main import get_group

from fog_runtime.configuration import parts
from fognav.output import fail

if TYPE_CHECKING:
    from collections.abc import Callable

PROGRAM: Final = "fognav"
ENTRY_POINTS: Final = "fognav.commands"
"""Of the command line; those of `fognav site` are in `fognav.commands.site`, and so on."""

TRY_IT: Final = "Try it"
OPERATE: Final = "Operate"
SET_UP: Final = "Set up a robot or node"
RUN: Final = "Run a fog node"
MEASURE: Final = "Measure"
DEVELOP: Final = "Change Fognav"
OTHERS: Final = "Commands"
GROUPS: Final = (TRY_IT, OPERATE, SET_UP, RUN, MEASURE, DEVELOP, OTHERS)
"""Groups of commands, in the order in which a newcomer needs them; the last has those that name none."""


class Commands(TyperGroup):
    """The command line, or one of its commands that has others.

    Those of packages are loaded only when it does not know a command itself, and to list all.
    """

    _loaded = False

    def list_commands(self, ctx: Any) -> list[str]:  # noqa: ANN401  # typer's class is private
        """Return the names of all commands."""
        self._load()
        return super().list_commands(ctx)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ANN401  # same
        """Return a command, or None if there is none of this name."""
        if cmd_name not in self.commands:
            self._load()
        return super().get_command(ctx, cmd_name)

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # noqa: ANN401  # same
        """Write the list of commands, by groups, with one column for all names."""
        names = self.list_commands(ctx)
        groups = {name: getattr(self.commands[name], "rich_help_panel", None) or OTHERS for name in names}
        width = max(map(len, names), default=0)
        for group in dict.fromkeys((*GROUPS, *groups.values())):
            rows = [
                (name.ljust(width), self.commands[name].get_short_help_str(formatter.width - 6 - width))
                for name in names
                if groups[name] == group
            ]
            if rows:
                with formatter.section(group):
                    formatter.write_dl(rows)

    def _load(self) -> None:
        if self._loaded:
            return
        self._loaded = True
        added = typer.Typer(rich_markup_mode=self.rich_markup_mode)
        group = ENTRY_POINTS if self.name == PROGRAM else f"{ENTRY_POINTS}.{self.name}"
        try:
            for name in parts.names(group):
                add_to: Callable[[typer.Typer], None] = parts.load(group, name, FunctionType)
                add_to(added)
        except parts.PartError as error:
            fail(str(error))
        self.commands.update(get_group(added).commands)
