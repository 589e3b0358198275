"""`fognav backup`, `restore` and `store`: what people decided in a file, and what Redis lost.

A backup has what people decided, the site and the secrets. When Redis has lost records, an administrator decides.
"""

import asyncio
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import typer

from fog_runtime.configuration.site import load_site
from fognav.operate.fog import Fog, find_fog
from fognav.operate.options import FogOption, JsonOption
from fognav.output import (
    NOT_TRUE,
    FailedError,
    WrongUseError,
    check_writable,
    exit_codes,
    print_answer,
    print_result,
)
from fognav.programs import AGGREGATOR, MAP_SERVICE, PLANNER

FileArgument = Annotated[Path, typer.Argument(metavar="FILE", help="The backup, a tar.gz that only you can read.")]
RedisOption = Annotated[str, typer.Option("--redis", envvar="FOGNAV_REDIS_URL", help="Redis of the fog node.")]
SiteOption = Annotated[Path | None, typer.Option("--site", envvar="FOGNAV_SITE_DIR", help="The site's folder.")]
SecretsOption = Annotated[
    Path | None, typer.Option("--secrets", help="Folder of tokens, keys and certificates; default: no secrets.")
]
DataOption = Annotated[
    Path | None,
    typer.Option("--data", envvar="FOGNAV_DATA_DIR", help="The services' data folder: notes when the backup was."),
]
UpOption = Annotated[
    Path | None,
    typer.Option("--up", metavar="DIR", help="Data of a node of `fognav up`; instead of --data, --redis, --secrets."),
]
ReplaceOption = Annotated[bool, typer.Option("--replace", help="Replace what is there already.")]


def backup_command(
    file: FileArgument,
    *,
    site: SiteOption = None,
    data: DataOption = None,
    redis: RedisOption = "redis://127.0.0.1:6379/0",
    secrets: SecretsOption = None,
    up: UpOption = None,
) -> None:
    """Back up a fog node into one file, while it runs."""
    from fog_runtime import backup  # noqa: PLC0415  # the client of Redis is slow
    from fognav.hosting import backups  # noqa: PLC0415  # same

    with exit_codes(), backups.backup_errors():
        check_writable(file)
        no_index = None
        if up is not None:
            made, no_index = backups.create_of_node(file, up, site)
        else:
            folder = _required(site, "--site")
            place = backups.place_of(redis, load_site(folder).site.id, folder, secrets, _required(data, "--data"))
            made = asyncio.run(backup.create(file, place, time.time()))
        backups.report("backed up", made, file)
        if no_index is not None:
            raise FailedError(f"{file} is complete but for the index of the recordings: {no_index}. Then repeat it")


def restore_command(  # noqa: PLR0913  # each option is an argument
    file: FileArgument,
    *,
    site: SiteOption = None,
    data: DataOption = None,
    redis: RedisOption = "redis://127.0.0.1:6379/0",
    secrets: SecretsOption = None,
    up: UpOption = None,
    replace: ReplaceOption = False,
) -> None:
    """Restore a backup; stop the services before. Everything is checked before anything is changed."""
    from fog_runtime import backup  # noqa: PLC0415  # the client of Redis is slow
    from fognav.hosting import backups  # noqa: PLC0415  # same

    with exit_codes(), backups.backup_errors():
        folder = _required(site, "--site")
        if up is not None:
            made = backups.restore_into_node(file, up, folder, replace=replace)
        else:
            place = backups.place_of(redis, backup.read_archive(file).site, folder, secrets, _required(data, "--data"))
            made = asyncio.run(backup.restore(file, place, replace=replace))
        backups.report("restored", made, file)


def _required(folder: Path | None, option: str) -> Path:
    if folder is None:
        raise WrongUseError(f"name a folder with {option}; or the data folder of `fognav up` with --up")
    return folder


store_app = typer.Typer(help="Show what Redis lost, and recover from it.", no_args_is_help=True)

_SERVICES: Final = (AGGREGATOR, MAP_SERVICE, PLANNER)
ServiceOption = Annotated[
    str | None, typer.Option("--service", metavar="NAME", help="Only this service; default: all that report a loss.")
]
YesOption = Annotated[bool, typer.Option("--yes", help="Do it; without this, only say what would be done.")]


@store_app.command("status", epilog="Example: fognav store status")
def store_status(*, fog: FogOption = None, json: JsonOption = False) -> None:
    """Show what each service has in memory and in Redis, and whether Redis lost records.

    The exit code is 1 if it did, or if a service could not be asked.
    """
    with exit_codes():
        found = _statuses(find_fog(fog), None)
        print_result({"services": found}, *(_line(*each) for each in found.items()), json=json)
    if any(status["lost"] is not False for status in found.values()):
        raise typer.Exit(NOT_TRUE)


@store_app.command("restore", epilog="Example: fognav store restore --yes")
def store_restore(*, service: ServiceOption = None, yes: YesOption = False, fog: FogOption = None) -> None:
    """Write back to Redis what the running services have in memory, where Redis lost records.

    A service that was started after the loss has nothing in memory: restore a backup of Redis, or accept.
    """
    with exit_codes():
        _recover(find_fog(fog), "restore", service, yes=yes)


@store_app.command("accept", epilog="Example: fognav store accept --service planner --yes")
def store_accept(*, service: ServiceOption = None, yes: YesOption = False, fog: FogOption = None) -> None:
    """Go on with what Redis has now, where it lost records: what it lacks is lost for good."""
    with exit_codes():
        _recover(find_fog(fog), "accept", service, yes=yes)


def _recover(fog: Fog, action: Literal["restore", "accept"], service: str | None, *, yes: bool) -> None:
    """Send the decision to each service that reports a loss; raises `FailedError` if one could not carry it out."""
    found = _statuses(fog, service)
    failures = [f"{name}: {status['detail']}" for name, status in found.items() if status["lost"] is None]
    lost = {name: status for name, status in found.items() if status["lost"]}
    if not lost and not failures:
        raise FailedError("Redis has lost nothing: there is nothing to recover")
    for name, status in lost.items():
        print_answer(_line(name, status))
    if not yes:
        effect = "writes what is in memory to Redis" if action == "restore" else "gives up what Redis lacks"
        raise WrongUseError(f"nothing was changed. `fognav store {action} --yes` {effect}, for the services above")
    for name in lost:
        try:
            fog.send("POST", name, "/api/v1/store/recovery", {"action": action})
        except FailedError as error:
            failures.append(str(error))
        else:
            print_answer(f"{name}: {'restored' if action == 'restore' else 'accepted'}")
    if failures:
        raise FailedError("; ".join(failures))


def _statuses(fog: Fog, service: str | None) -> dict[str, dict[str, Any]]:
    """Return the status of each service's store; of one that can't be asked, `lost` is None and `detail` says why."""
    if service not in (None, *_SERVICES):
        raise WrongUseError(f"--service {service}: name {', '.join(_SERVICES)}")
    found: dict[str, dict[str, Any]] = {}
    for name in _SERVICES if service is None else (service,):
        try:
            found[name] = fog.get(name, "/api/v1/store")
        except FailedError as error:
            found[name] = {"lost": None, "detail": str(error), "in_memory": {}, "in_redis": {}}
    return found


def _line(service: str, status: Mapping[str, Any]) -> str:
    if status["lost"] is None:
        return f"{service}: not known: {status['detail']}"
    if not status["lost"]:
        return f"{service}: complete: {_counts(status['in_redis'])}"
    memory = _counts(status["in_memory"]) if status["in_memory"] else "nothing, since it was started after the loss"
    return f"{service}: LOST: {status['detail']}. In Redis: {_counts(status['in_redis'])}; in memory: {memory}"


def _counts(tables: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in tables.items())
