"""The site of benchmarks that run real processes: a floor without areas and robots."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from fog_runtime.configuration.maps import save_map

if TYPE_CHECKING:
    from pathlib import Path

    from fog_contracts.grid import StaticMap

SITE: Final = "bench"


def write_site(folder: Path, floor: StaticMap) -> None:
    """Write a site without areas and robots."""
    save_map(folder / "map", floor)
    (folder / "site.toml").write_text(f'id = "{SITE}"\nmap = "map.yaml"\n', "utf-8")
