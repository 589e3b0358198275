"""`fognav upgrade`: a newer version of Fognav, with the data of the fog node of `fognav up`."""

from typing import Annotated, Final

import typer

from fognav import checkout
from fognav.commands.backup import backup_errors
from fognav.commands.up import DataOption
from fognav.output import exit_codes, print_line

_SHOWN: Final = 30


def upgrade_command(
    revision: Annotated[
        str | None, typer.Argument(metavar="VERSION", help="Tag, branch or commit; default: the newest release.")
    ] = None,
    *,
    data: DataOption = None,
    check: Annotated[bool, typer.Option("--check", help="Tell what would change, and change nothing.")] = False,
) -> None:
    """Upgrade this checkout and its fog node, with all data.

    It makes a backup of each site, ends the node, and starts the new version once. If that fails, version and data are
    those of before.
    """
    from fognav.hosting.folders import NodeFolder, default_data  # noqa: PLC0415  # keeps the other commands fast
    from fognav.hosting.upgrading import Upgrade  # noqa: PLC0415  # same
    from fognav.hosting.versions import Versions  # noqa: PLC0415  # same

    with exit_codes(), backup_errors():
        versions = Versions(checkout.root())
        current = versions.current()
        to = versions.newest() if revision is None else versions.named(revision)
        if to == current:
            print_line(f"this is {current[:12]} already: nothing to upgrade")
            return
        if revision is None and versions.contains(to):
            print_line(
                f"{current[:12]} has the newest release, {to[:12]}, and more: nothing to upgrade. Name a branch to "
                "follow what is not released yet (fognav upgrade main)"
            )
            return
        changes = versions.changes(to)
        print_line(f"from {current[:12]} to {to[:12]}: {len(changes)} changes (CHANGELOG.md tells what they mean)")
        for subject in changes[:_SHOWN]:
            print_line(f"  {subject}")
        if len(changes) > _SHOWN:
            print_line(f"  and {len(changes) - _SHOWN} more")
        if not check:
            Upgrade(NodeFolder((data or default_data()).absolute()), versions, print_line).run(to)
