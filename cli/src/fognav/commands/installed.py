"""The list of commands, by who uses them: each is loaded when it is used, or listed; other packages add theirs.

Those that measure come with fognav-experiments, where it is installed.

    [project.entry-points."fognav.commands"]
    my-command = "my_package.commands:add_to"

An entry is a function that gets a `typer.Typer` and adds to it; the `rich_help_panel` of a command is its group.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from types import FunctionType
from typing import TYPE_CHECKING, Any, ClassVar, Final, NamedTuple

import typer
from typer.core import TyperGroup
from typer.main import get_group

from fog_runtime.configuration import parts
from fognav.output import fail

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

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


_NUMBERS: Final = {
    "float_parsing": "no number: write it with a point, such as 0.1",
    "int_parsing": "no whole number: write one, such as 10",
}
"""What is said of an option or argument that is no number, by the parser's name for that."""


class Row(NamedTuple):
    """A command of this package: its group ("": none), and its name ("up", or "zone import" for one of `zone`).

    `source`: module below `fognav`, and what of it: a function, or the `typer.Typer` of a command that has
    others. `also`: modules that add to the latter. `robot`: a robot's computer has it without its extra `fog`.
    """

    group: str
    name: str
    source: str
    example: str = ""
    settings: Mapping[str, Any] = {}
    also: tuple[str, ...] = ()
    robot: bool = False

    def load(self) -> Any:  # noqa: ANN401  # a function, or a Typer
        """Return what the row names."""
        module, _, attribute = self.source.partition(":")
        return getattr(import_module(f"fognav.{module}"), attribute)

    def add_to(self, app: typer.Typer) -> None:
        """Add it to the command that has it."""
        found, name = self.load(), self.name.split()[-1]
        if isinstance(found, typer.Typer):
            app.add_typer(found, name=name, rich_help_panel=self.group or None)
        else:
            example = f"Example: fognav {self.example}"
            app.command(name, context_settings=dict(self.settings), epilog=example, rich_help_panel=self.group or None)(
                found
            )


_complete: Final[set[str]] = set()


class Commands(TyperGroup):
    """The command line, or one of its commands that has others.

    A command of its `rows` is loaded when it is asked for. Those of packages are loaded only when it does not know a
    command itself. To list all, all are loaded.
    """

    rows: ClassVar[tuple[Row, ...]] = ()
    _loaded = False

    def invoke(self, ctx: Any) -> Any:  # noqa: ANN401  # typer's class is private
        """Run the command; what is no number is named as such, in other words than those of the parser."""
        try:
            return super().invoke(ctx)
        except typer.BadParameter as error:
            for found in getattr(error.__cause__, "errors", list)():
                if (wanted := _NUMBERS.get(found["type"])) is not None:
                    error.message = f"{found['input']!r} is {wanted}"
            raise

    def list_commands(self, ctx: Any) -> list[str]:  # noqa: ANN401  # typer's class is private
        """Return the names of all commands."""
        for row in self.rows:
            if " " not in row.name:
                self._own(row.name)
        self._load()
        return super().list_commands(ctx)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ANN401  # same
        """Return a command, or None if there is none of this name."""
        if cmd_name not in self.commands and not self._own(cmd_name):
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

    def _own(self, name: str) -> bool:
        """Load a command of the rows, with all that it has; return False if it is none of them."""
        fog = find_spec("map_service") is not None
        rows = [row for row in self.rows if row.name.split()[0] == name and (fog or row.robot)]
        if not rows or name in self.commands:
            return bool(rows)
        row, *others = rows
        if name not in _complete:  # which outlives this list: tests run many commands in one process
            _complete.add(name)
            for module in row.also if fog else ():
                import_module(f"fognav.{module}")
            for other in others:
                other.add_to(row.load())
        added = typer.Typer(rich_markup_mode=self.rich_markup_mode)
        row.add_to(added)
        self.commands.update(get_group(added).commands)
        return True

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
