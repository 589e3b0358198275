"""Finds the checkout: sites and tests are there, not in an installed package."""

import subprocess
from functools import cache
from pathlib import Path

from fognav.output import WrongUseError


@cache
def root() -> Path:
    """Return the checkout's folder; raises `WrongUseError` if this package was installed without one."""
    for folder in Path(__file__).resolve().parents:
        if (folder / "fognav").is_file() and (folder / "requirements").is_dir():
            return folder
    raise WrongUseError("this command works only in a checkout of Fognav: clone the repository and run ./fognav there")


@cache
def revision() -> str:
    """Return the commit of the checkout, or an empty text if it is not known."""
    try:
        command = ["git", "-C", str(root()), "rev-parse", "--short=12", "HEAD"]
        done = subprocess.run(command, check=False, capture_output=True, text=True)
    except (OSError, WrongUseError):
        return ""  # no git, or no checkout
    return done.stdout.strip()


def site_folder(name: Path | None) -> Path:
    """Return the folder of a site: `name` is a folder or the name of one in `sites/`; None means `estig`."""
    if name is None:
        return root() / "sites" / "estig"
    if (name / "site.toml").is_file():
        return name.resolve()
    if len(name.parts) == 1 and (root() / "sites" / name / "site.toml").is_file():
        return root() / "sites" / name
    if name.is_file():
        raise WrongUseError(f"{name} is a file, but a site is a folder with site.toml and a map: name its folder")
    known = ", ".join(sorted(file.parent.name for file in (root() / "sites").glob("*/site.toml")))
    raise WrongUseError(
        f"{name} is not a site: there is no {name / 'site.toml'}. Use one of sites/ ({known}), "
        "or create one with: fognav site new --map MAP.yaml --out DIR"
    )
