"""Commands of other packages, found by entry points: those that measure are the laboratory's, where it is installed.

    [project.entry-points."fognav.commands"]
    my-command = "my_package.commands:add_to"

An entry is a function that gets a `typer.Typer` and adds to it.
"""

from __future__ import annotations

from types import FunctionType
from typing import TYPE_CHECKING, Any, ClassVar

import typer
from typer.core import TyperGroup
from typer.main import get_group

from fog_runtime.configuration import parts
from fognav.output import fail

if TYPE_CHECKING:
    from collections.abc import Callable


class Commands(TyperGroup):
    """The command line; others are loaded only when it does not know a command itself, and to list all."""

    entry_points: ClassVar = "fognav.commands"
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

    def _load(self) -> None:
        if self._loaded:
            return
        self._loaded = True
        added = typer.Typer(rich_markup_mode=self.rich_markup_mode)
        try:
            for name in parts.names(self.entry_points):
                add_to: Callable[[typer.Typer], None] = parts.load(self.entry_points, name, FunctionType)
                add_to(added)
        except parts.PartError as error:
            fail(str(error))
        self.commands.update(get_group(added).commands)


class SiteCommands(Commands):
    """The same for `fognav site`."""

    entry_points: ClassVar = "fognav.commands.site"
