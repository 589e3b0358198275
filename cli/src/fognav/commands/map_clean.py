"""`fognav map clean`: a map is cleaned by commands, which are kept in a file and clean the next recording too."""

from __future__ import annotations

from pathlib import Path  # Typer reads annotations at run time
from typing import TYPE_CHECKING, Annotated, Final

import typer

from fog_runtime.configuration.maps import read_provenance, save_map
from fog_runtime.files import SHARED, atomic_write
from fognav.commands.map_files import MapArgument  # noqa: TC001  # Typer reads annotations at run time
from fognav.map_files import described, loaded, provenance
from fognav.operate.options import JsonOption  # noqa: TC001  # Typer reads annotations at run time
from fognav.output import FailedError, WrongUseError, check_writable, exit_codes, print_result, writing

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.grid import StaticMap
    from fog_mapping.cleaning import Cleaned, Cleaning

_HEADER: Final = """\
# Cleaning of {name}: each line is a command, in metres in the map as the lines above it leave it.
# Delete a line to undo it. fognav map clean applies all of them, also to a later recording of this floor.
map {name} {digits}
"""


def commands_file(map_file: Path) -> Path:
    """Return the file of a map's commands, beside it."""
    return map_file.with_suffix(".clean")


def map_clean(
    map_file: MapArgument,
    command: Annotated[
        list[str] | None,
        typer.Argument(metavar="[COMMAND NUMBERS...]", help="One more command, which is added to the file."),
    ] = None,
    *,
    commands: Annotated[
        Path | None, typer.Option("--commands", metavar="FILE", help="The commands; default: MAP.clean.")
    ] = None,
    onto: Annotated[
        Path | None,
        typer.Option(
            "--onto", metavar="OTHER.yaml", help="Lay the map onto another, such as a plan's, and clean it so."
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="PREFIX", help="PREFIX.yaml and .pgm are written: MAP-clean.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Clean a map by the commands of a text file, and write the result as another map.

    Commands: straighten [degrees]; speckles; islands; crop, erase, block, freeze LEFT BOTTOM RIGHT TOP; wall X Y X Y
    ...; free, unknown X Y X Y X Y ... (m). They hold in the frame of the file's first map: the map of a new recording
    is laid onto that by matching of walls, and refused if it doesn't fit (exit code 1).
    """
    with exit_codes():
        if onto is not None and commands is not None:
            raise WrongUseError(
                "--onto and --commands: the file of commands names the map that it is laid onto. Give one"
            )
        file = commands_file(onto or map_file) if commands is None else commands
        prefix = map_file.with_name(f"{map_file.stem}-clean") if out is None else out
        for suffix in (".yaml", ".pgm"):
            check_writable(Path(f"{prefix}{suffix}"))
        static = loaded(map_file)
        text = begun(file, map_file, static) if onto is None else begun(file, onto, loaded(onto))
        if command:
            text = with_lines(text, [" ".join(command)])
        read = read_commands(file, text)
        kept = [map_file, *([] if read.first is None else [file.parent / read.first[0]])]
        if Path(f"{prefix}.yaml").resolve() in [one.resolve() for one in kept]:
            raise WrongUseError(
                f"{prefix}.yaml would be replaced by what the commands make of it, and they could not be applied "
                "again. Name another --out"
            )
        if not read.commands and onto is None:
            raise WrongUseError(f"{file} has no commands: add one, as in fognav map clean {map_file} straighten")
        done = _cleaned(file, read, static)
        if command or not file.exists():
            save_commands(file, text)
        applied = [str(one) for one in read.commands]
        with writing(Path(f"{prefix}.yaml"), "Name another --out"):
            save_map(
                prefix, done.map, {**read_provenance(map_file), "cleaned": provenance(map_file, file), "by": applied}
            )
        values: dict[str, object] = {"file": f"{prefix}.yaml", "commands": applied, **described(done.map)}
        lines = [f"wrote {prefix}.yaml by {len(applied)} commands of {file}"]
        if done.alignment is not None and read.first is not None:
            x, y, theta = done.alignment.pose
            values["alignment"] = done.alignment._asdict()
            fit = f"{done.alignment.share:.0%} of the walls agree, {1000 * done.alignment.residual:.0f} mm rms"
            lines.insert(0, f"laid onto {read.first[0]} at ({x:.3f}, {y:.3f}), turned by {theta:.4f} rad: {fit}")
        print_result(values, *lines, json=json)


def begun(file: Path, map_file: Path, static: StaticMap) -> str:
    """Return the text of a file of commands, or how one for a map begins; raises `WrongUseError`."""
    from fog_mapping.cleaning import fingerprint  # noqa: PLC0415  # keeps the other commands fast

    if not file.exists():
        if file.parent.resolve() != map_file.parent.resolve():
            raise WrongUseError(
                f"there is no file {file}. A new one is made beside its first map: leave --commands out"
            )
        return _HEADER.format(name=map_file.name, digits=fingerprint(static))
    try:
        return file.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise WrongUseError(f"{file} can't be read: {error}. Name a text file of commands") from error


def with_lines(text: str, lines: Sequence[str]) -> str:
    """Return the text of a file of commands with more lines."""
    return "".join((text, "" if text.endswith("\n") or not text else "\n", *(f"{line}\n" for line in lines)))


def save_commands(file: Path, text: str) -> None:
    """Write a file of commands; raises `WrongUseError`."""
    with writing(file, "Name another file by --commands"):
        atomic_write(file, text.encode(), mode=SHARED)


def read_commands(file: Path, text: str) -> Cleaning:
    """Return the commands in the text of a file; raises `WrongUseError`."""
    from fog_mapping.cleaning import CommandError, read  # noqa: PLC0415  # keeps the other commands fast

    try:
        return read(text)
    except CommandError as error:
        raise WrongUseError(f"{file}, {error}") from error


def _cleaned(file: Path, read: Cleaning, static: StaticMap) -> Cleaned:
    """Return a map after the commands of a file; raises `WrongUseError`, and `FailedError` for another floor."""
    from fog_mapping.alignment import MisfitError  # noqa: PLC0415  # keeps the other commands fast
    from fog_mapping.cleaning import CommandError, clean, fingerprint  # noqa: PLC0415  # same

    if read.first is None:
        raise WrongUseError(
            f"{file} does not say in whose frame it is. Begin it with: map FILE {fingerprint(static)} (of this map)"
        )
    name, digits = read.first
    first = None
    if fingerprint(static) != digits:
        first = loaded(file.parent / name)
        if fingerprint(first) != digits:
            raise WrongUseError(
                f"{file} was made for another {name}: its cells have changed. Put that map back, and give a new "
                f"recording another name; or write `map {name} {fingerprint(first)}` if the frame is the same"
            )
    try:
        return clean(read.commands, static, first)
    except CommandError as error:
        raise WrongUseError(f"{file}, {error}") from error
    except MisfitError as error:
        raise FailedError(f"the map can't be laid onto {file.parent / name}: {error}") from error
