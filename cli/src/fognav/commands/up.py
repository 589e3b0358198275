"""`fognav up`, `down`, `logs` and `upgrade`: a fog node on this machine without containers, and its newer versions."""

import asyncio
import os
from pathlib import Path
from typing import Annotated, Final

import typer

from fognav import checkout, console_page, kernels, system
from fognav.aside import TRIAL
from fognav.commands.bridge import require_bridge
from fognav.commands.floor import require_floors
from fognav.credentials import own_hosts, security_errors
from fognav.hosting import local_nodes
from fognav.hosting.fog_node import NodeConfig, run_node
from fognav.hosting.folders import NodeFolder, default_data, hosted_sites, remember, settings_of
from fognav.hosting.local_nodes import UNIT, end_node, named_node, write_unit
from fognav.operate.options import JsonOption
from fognav.output import FailedError, WrongUseError, exit_codes, print_line, print_result

SitesOption = Annotated[
    list[Path] | None,
    typer.Option("--site", metavar="D", help="Folder of a site, or a name in sites/; once for each floor."),
]
DataOption = Annotated[
    Path | None,
    typer.Option("--data", metavar="DIR", help="Folder of all data; default: fognav in XDG_DATA_HOME."),
]


def up_command(  # noqa: PLR0913  # each option is an argument
    *,
    site: SitesOption = None,
    data: DataOption = None,
    bind: Annotated[
        str,
        typer.Option("--bind", envvar="FOGNAV_BIND", metavar="ADDRESS", help="On which address to listen."),
    ] = "0.0.0.0",  # noqa: S104  # with TLS and passwords
    host: Annotated[
        list[str] | None,
        typer.Option("--host", metavar="NAME", help="Another name of this computer, for its certificates."),
    ] = None,
    bridge: Annotated[
        Path | None,
        typer.Option("--bridge", metavar="FILE", help="Tell other systems of robots: settings (docs/interop.md)."),
    ] = None,
    floors: Annotated[
        Path | None,
        typer.Option("--floors", metavar="FILE", help="Floors on other machines, to be shown and stopped (campus.md)."),
    ] = None,
    sim: Annotated[bool, typer.Option("--sim", help="Simulate each site's first robot and its sensor nodes.")] = False,
    check: Annotated[bool, typer.Option("--check", help="End it as soon as everything is ready.")] = False,
    systemd: Annotated[bool, typer.Option("--systemd", help="Write a unit for systemd instead of running.")] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Install missing system packages without asking.")] = False,
) -> None:
    """Run a fog node on this machine until Ctrl-C.

    It has broker, Redis, router, and the services of each site. Everything uses TLS and passwords. Data stays in one
    folder, and is used again by the next start.
    """
    with exit_codes(), security_errors():
        if ":" in bind:
            raise WrongUseError(
                f"--bind {bind}: a fog node listens on IPv4. Name an IPv4 address of this computer, or 0.0.0.0 for all"
            )
        folders = [checkout.site_folder(each) for each in site] if site else [checkout.site_folder(None)]
        path = (data or default_data()).absolute()
        if bridge is not None:
            bridge = bridge.absolute()
            require_bridge(bridge)
        if floors is not None:
            floors = floors.absolute()
            require_floors(floors)
        if systemd:
            options = [word for each in folders for word in ("--site", str(each))]
            options += ["--data", str(path), "--bind", bind, *(["--sim"] if sim else [])]
            options += [word for each in host or [] for word in ("--host", each)]
            options += ["--bridge", str(bridge)] if bridge else []
            options += ["--floors", str(floors)] if floors else []
            print_line(f"wrote {write_unit(['up', *options])}. Start it now and at each boot:")
            print_line(f"  systemctl --user daemon-reload && systemctl --user enable --now {UNIT}")
            print_line(f"  loginctl enable-linger {os.environ.get('USER', '$USER')}")
            return
        system.ensure([system.MOSQUITTO, system.REDIS], yes=yes, print_line=print_line)
        kernels.warm_cache(print_line)
        console_page.build_in_background(checkout.root(), print_line)
        folder = NodeFolder(path)
        with folder.in_use():
            sites, security = hosted_sites(folders, folder.security, [*own_hosts(), *(host or [])])
            config = NodeConfig(
                folder=folder, sites=sites, security=security, address=bind, simulate=sim, bridge=bridge,
                floors=floors,
            )  # fmt: skip
            directories = {each.id: each.directory for each in sites}
            made = settings_of(directories, bind, host or [], simulate=sim, bridge=bridge, floors=floors)
            if TRIAL not in os.environ:  # it listens elsewhere than the node does
                remember(folder.path, made)
            asyncio.run(run_node(config, print_line, check=check))


def stack_command(
    floors: Annotated[
        list[str],
        typer.Argument(metavar="SITE@HOST[,HOST,HOST]...", help="Each floor's site, and its machine, or its three."),
    ],
    *,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder of stacks and credentials: keep it private.")
    ],
    images: Annotated[
        str, typer.Option("--images", metavar="PREFIX", help="What the names of Fognav's images begin with.")
    ] = "fognav/",
    json: JsonOption = False,
) -> None:
    """Write stack files for Docker Swarm.

    There is one for each floor, with its secrets and configuration. Each floor's console lists the others.
    With three machines a floor has two copies of each service, and three Redis servers.
    """
    from fognav.hosting.swarm_stacks import named_floors, write_stacks  # noqa: PLC0415  # pictures are slow to import

    with exit_codes(), security_errors():
        named = [(checkout.site_folder(folder), hosts) for folder, hosts in named_floors(floors)]
        made = write_stacks(named, checkout.root(), out.absolute(), images)
    stacks = [f"docker stack deploy -c {Path(file).name} {Path(file).stem}" for file in made["files"]]
    print_result(made, f"wrote {out}. On a manager, in this folder, for each floor:", *stacks, json=json)


def down_command(
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", help="As in fognav status, where several nodes run.")
    ] = None,
    *,
    data: DataOption = None,
) -> None:
    """End the fog node of `fognav up`; its data stays.

    It ends with all its sites; other nodes of yours go on.
    """
    with exit_codes():
        node = named_node(name, data)
        if node is None:
            print_line("no fog node of yours runs on this machine without containers")
        else:
            end_node(node.pid)
            print_line(f"the fog node (process {node.pid}) has ended")


def logs_command(
    name: Annotated[list[str] | None, typer.Argument(metavar="NAME", help="Programs; default: all.")] = None,
    *,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Show what is added, until Ctrl-C.")] = False,
    lines: Annotated[int, typer.Option("--lines", "-n", min=0, help="How many lines of each at first.")] = 20,
    data: DataOption = None,
) -> None:
    """Show the logs of the fog node of `fognav up`."""
    with exit_codes():
        running = None if data else named_node(None, None)
        folder = (data or (running.data if running else default_data())) / "logs"
        files = {file.stem: file for file in sorted(folder.glob("*.log"))}
        if unknown := [each for each in name or [] if each not in files]:
            raise FailedError(
                f"{folder} has no log of {unknown[0]}, only of: {', '.join(files) or 'nothing'}. "
                "Name one of these, or the data folder (--data)"
            )
        shown = {each: files[each] for each in name or files}
        if not shown:
            raise FailedError(f"{folder} has no logs: start a fog node (fognav up), or name its folder with --data")
        try:
            local_nodes.show_logs(shown, lines, follow=follow)
        except KeyboardInterrupt:
            return


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
    from fognav.hosting.backups import backup_errors  # noqa: PLC0415  # the client of Redis is slow
    from fognav.hosting.upgrading import Upgrade, Versions  # noqa: PLC0415  # same

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
