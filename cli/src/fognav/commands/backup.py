"""`fognav backup` and `fognav restore`: what people decided, the site and the secrets, in one file."""

import asyncio
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fog_runtime import backup
from fog_runtime.backup import Backup, BackupError, read_archive
from fog_runtime.configuration.site import SiteError, load_site
from fog_runtime.credentials import CredentialsError
from fognav import checkout
from fognav.locking import locks_errors, own_credentials
from fognav.output import FailedError, WrongUseError, check_writable, exit_codes, print_line

if TYPE_CHECKING:
    from fognav.hosting.backups import Created

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
    with exit_codes(), backup_errors():
        check_writable(file)
        no_index = None
        if up is not None:
            made, no_index = _create_of_node(file, up, site)
        else:
            folder = _required(site, "--site")
            place = _place(redis, load_site(folder).site.id, folder, secrets, _required(data, "--data"))
            made = asyncio.run(backup.create(file, place, time.time()))
        _report("backed up", made, file)
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
    with exit_codes(), backup_errors():
        folder = _required(site, "--site")
        if up is not None:
            made = _restore_into_node(file, up, folder, replace=replace)
        else:
            place = _place(redis, read_archive(file).site, folder, secrets, _required(data, "--data"))
            made = asyncio.run(backup.restore(file, place, replace=replace))
        _report("restored", made, file)


@contextmanager
def backup_errors() -> Iterator[None]:
    """Turn errors of backups into those of commands."""
    with locks_errors():
        try:
            yield
        except WrongUseError:
            raise
        except (BackupError, CredentialsError, SiteError, ValueError) as error:
            raise FailedError(str(error)) from error


def _required(folder: Path | None, option: str) -> Path:
    if folder is None:
        raise WrongUseError(f"name a folder with {option}; or the data folder of `fognav up` with --up")
    return folder


def _named(site: Path | None) -> Path | None:
    """Return a site's folder, also by its name in `sites/`; a folder without a site, to restore one, as it is."""
    try:
        return site and checkout.site_folder(site)
    except WrongUseError:
        return site


def _create_of_node(file: Path, up: Path, site: Path | None) -> "Created":
    from fognav.hosting.backups import create  # noqa: PLC0415  # keeps the other commands fast
    from fognav.hosting.folders import NodeFolder, require_node  # noqa: PLC0415  # same

    require_node(up)
    return asyncio.run(create(file, NodeFolder(up), _named(site)))


def _restore_into_node(file: Path, up: Path, site: Path, *, replace: bool) -> Backup:
    from fognav.hosting.backups import LOCKS, restore  # noqa: PLC0415  # same
    from fognav.hosting.folders import NodeFolder  # noqa: PLC0415  # same

    directory = _named(site) or site
    backup.require_same_site(read_archive(file), directory)  # before the node's folder is made
    made, refused, gone = asyncio.run(restore(file, NodeFolder(up), directory, replace=replace))
    if LOCKS not in made.folders:
        print_line(f"the credentials in {up} stay: they have the same authority, and what was added since")
    if refused:
        print_line(f"they do not admit {', '.join(refused)}, whom the backup has: add them again, if they shall be")
    if gone:
        print_line(f"recordings that are not in {up / 'recordings'}: {', '.join(gone)}")
    return made


def _place(redis: str, name: str, site: Path, secrets: Path | None, data: Path) -> backup.Place:
    folders = {backup.SITE: site, **({backup.SECRETS: secrets} if secrets else {})}
    return backup.Place(redis, name, folders, data, own_credentials(None))


def _report(done: str, made: Backup, file: Path) -> None:
    files = ", ".join(f"{len(content)} files of the {name}" for name, content in made.folders.items())
    print_line(f"{done} site {made.site}: {len(made.keys)} keys of Redis, {files}: {file}")
