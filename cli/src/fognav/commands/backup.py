"""`fognav backup` and `fognav restore`: what people decided, the site and the secrets, in one file."""

import asyncio
import time
from pathlib import Path
from typing import Annotated, Final

import typer

from fog_runtime import backup
from fog_runtime.access.credentials import CredentialsError
from fog_runtime.backup_archive import Backup, BackupError, read_archive
from fog_runtime.configuration.site import SiteError, load_site
from fognav.locking import locks_errors, own_credentials
from fognav.output import FailedError, WrongUseError, check_writable, exit_codes, print_line

FileArgument = Annotated[Path, typer.Argument(metavar="FILE", help="The backup, a tar.gz that only you can read.")]
RedisOption = Annotated[str, typer.Option("--redis", envvar="FOGNAV_REDIS_URL", help="Redis of the fog node.")]
SiteOption = Annotated[Path, typer.Option("--site", envvar="FOGNAV_SITE_DIR", help="The site's folder.")]
SecretsOption = Annotated[
    Path | None, typer.Option("--secrets", help="Folder of tokens, keys and certificates; default: no secrets.")
]
_DATA: Final = typer.Option(
    "--data", envvar="FOGNAV_DATA_DIR", help="The services' data folder: notes when the backup was."
)
DataOption = Annotated[Path, _DATA]
ReplaceOption = Annotated[bool, typer.Option("--replace", help="Replace what is there already.")]


def backup_command(
    file: FileArgument,
    *,
    site: SiteOption,
    data: DataOption,
    redis: RedisOption = "redis://127.0.0.1:6379/0",
    secrets: SecretsOption = None,
) -> None:
    """Back up a fog node into one file, while it runs."""
    with exit_codes():
        check_writable(file)
        try:
            place = _place(redis, load_site(site).site.id, site, secrets, data)
            _report("backed up", asyncio.run(backup.create(file, place, time.time())), file)
        except (BackupError, CredentialsError, SiteError, ValueError) as error:
            raise FailedError(str(error)) from error


def restore_command(  # noqa: PLR0913  # each option is an argument
    file: FileArgument,
    *,
    site: SiteOption,
    data: Annotated[Path | None, _DATA] = None,
    redis: RedisOption = "redis://127.0.0.1:6379/0",
    secrets: SecretsOption = None,
    up: Annotated[
        Path | None,
        typer.Option("--up", metavar="DIR", help="A node of `fognav up`; instead of --data, --redis, --secrets."),
    ] = None,
    replace: ReplaceOption = False,
) -> None:
    """Restore a backup; stop the services before. Everything is checked before anything is changed."""
    with exit_codes(), locks_errors():
        try:
            if up is not None:
                _report("restored", _restore_into_node(file, up, site, replace=replace), file)
                return
            if data is None:
                raise WrongUseError("name the services' data folder (--data), or that of `fognav up` (--up)")
            place = _place(redis, read_archive(file).site, site, secrets, data)
            _report("restored", asyncio.run(backup.restore(file, place, replace=replace)), file)
        except (BackupError, CredentialsError, ValueError) as error:
            raise FailedError(str(error)) from error


def _restore_into_node(file: Path, up: Path, site: Path, *, replace: bool) -> Backup:
    from fognav.hosting.folders import NodeFolder  # noqa: PLC0415  # keeps the other commands fast
    from fognav.hosting.restoring import restore  # noqa: PLC0415  # same

    return asyncio.run(restore(file, NodeFolder(up), site, replace=replace))


def _place(redis: str, name: str, site: Path, secrets: Path | None, data: Path) -> backup.Place:
    folders = {backup.SITE: site, **({backup.SECRETS: secrets} if secrets else {})}
    return backup.Place(redis, name, folders, data, own_credentials(None))


def _report(done: str, made: Backup, file: Path) -> None:
    files = ", ".join(f"{len(content)} files of the {name}" for name, content in made.folders.items())
    print_line(f"{done} site {made.site}: {len(made.keys)} keys of Redis, {files}: {file}")
