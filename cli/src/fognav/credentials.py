"""A site's certificates and users as the commands use them: their folder, and their errors in a user's words."""

import os
import pwd
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Final

import psutil
import typer

from fog_runtime.credentials import VARIABLE as CREDENTIALS_VARIABLE
from fog_runtime.credentials import Credentials, CredentialsError
from fog_runtime.security.authority import AuthorityError
from fog_runtime.security.site_security import SiteSecurity
from fog_runtime.security.users import SecurityError
from fognav.aside import require_no_upgrade
from fognav.output import FailedError, WrongUseError

VARIABLE: Final = "FOGNAV_CREDENTIALS_DIR"
_FORMER_VARIABLE: Final = "FOGNAV_LOCKS_DIR"
CredentialsOption = Annotated[
    Path | None,
    typer.Option(
        "--credentials",
        "--locks",
        metavar="DIR",
        help=f"Folder of the site's certificates and users; default: {VARIABLE}.",
    ),
]
FloorOption = Annotated[
    str | None,
    typer.Option("--floor", metavar="SITE", help="Id of its site; needed where the fog node serves several."),
]


def credentials_folder(given: Path | None) -> Path | None:
    """Return the folder that an option or the environment names, or None."""
    named = os.environ.get(VARIABLE) or os.environ.get(_FORMER_VARIABLE)
    return given or (Path(named) if named else None)


def named_folder(given: Path | None) -> Path:
    """Return the folder that an option or the environment names; raises `WrongUseError` without one."""
    folder = credentials_folder(given)
    if folder is None:
        raise WrongUseError(f"name the folder of the site's certificates and users with --credentials or {VARIABLE}")
    return folder


def open_security(given: Path | None) -> SiteSecurity:
    """Open the certificates and users in the folder that an option or the environment names.

    Raises `WrongUseError` without one, and `SecurityError`.
    """
    return SiteSecurity.open(named_folder(given))


def changeable_security(given: Path | None) -> SiteSecurity:
    """Open them to change them; raises as `open_security` and `require_changeable`."""
    require_changeable(named_folder(given))
    return open_security(given)


def user_on(security: SiteSecurity, floor: str | None, name: str) -> str:
    """Return how the servers call a robot or node.

    Raises `WrongUseError` where there are several floors and none is named, and `SecurityError` for an unknown one.
    """
    first, *further = security.sites
    if floor is None and further:
        raise WrongUseError(f"{name} of which floor? Name it with --floor: {', '.join((first, *further))}")
    return security.user_on(floor or first, name)


def require_changeable(folder: Path) -> None:
    """Raise `FailedError` while a folder's fog node is upgraded, and `WrongUseError` as `require_owner`."""
    require_owner(folder)
    require_no_upgrade(folder)


def require_owner(folder: Path) -> None:
    """Raise `WrongUseError` for another user's folder: root may write there what its owner's programs can't read then.

    One that is missing has no owner yet. Raises `OSError` if it can't be looked at.
    """
    if not folder.exists() or (owner := folder.stat().st_uid) == os.geteuid():
        return
    try:
        name = pwd.getpwuid(owner).pw_name
    except KeyError:
        name = f"#{owner}"
    raise WrongUseError(f"{folder} belongs to {name}, whose programs could not read what you write: run this as {name}")


def own_credentials(default: str | None = None) -> Credentials:
    """Return the credentials that the environment names, or those in the `default` file, or nobody's.

    Raises `WrongUseError` for a file that can't be used.
    """
    file = os.environ.get(CREDENTIALS_VARIABLE) or default
    try:
        return Credentials.read(Path(file) if file else None)
    except CredentialsError as error:
        raise WrongUseError(str(error)) from error


@contextmanager
def security_errors() -> Iterator[None]:
    """Turn errors of certificates and users into those of commands."""
    try:
        yield
    except (AuthorityError, SecurityError) as error:
        raise FailedError(str(error)) from error
    except OSError as error:
        if error.filename is None:
            raise FailedError(f"a file can't be used: {error.strerror or error}. Is the disk full (df)?") from error
        raise FailedError(f"{error.filename} can't be used: {error.strerror}. Run this as its owner") from error


def own_hosts() -> list[str]:
    """Return the names and addresses by which clients may reach this computer."""
    name = socket.gethostname()
    found = [name, f"{name}.local", "localhost"]
    for addresses in psutil.net_if_addrs().values():
        found += [each.address for each in addresses if each.family == socket.AF_INET]
    return list(dict.fromkeys(found))
