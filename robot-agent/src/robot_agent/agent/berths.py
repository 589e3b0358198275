"""The floors of its building that a robot knows, and its own durable record of the one that it is on (ADR 76)."""

from __future__ import annotations

import time
import tomllib
from typing import TYPE_CHECKING, Annotated, Final, TypeVar

import msgspec
from msgspec import structs

from fog_contracts.messages import Berth, Id
from fog_runtime import logs
from fog_runtime.clock import boot_id
from fog_runtime.configuration.settings import SettingsError
from fog_runtime.files import atomic_write

if TYPE_CHECKING:
    from pathlib import Path

    from fog_runtime.configuration.settings import CommonSettings

_log = logs.get("agent")

POSE_FILE: Final = "pose.json"
_FILE: Final = "floor.json"
RESTART_S: Final = 60.0
"""How long a start of the agent takes at most, on a slow computer."""
_REMEDY: Final = "docs/campus.md has an example"


S = TypeVar("S", bound="CommonSettings")


class _Floor(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How a robot reaches a floor; files are relative to the list."""

    zenoh_connect: str
    site_dir: str
    operator_key: str
    credentials: str = ""


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    first: Id
    floors: Annotated[dict[Id, _Floor], msgspec.Meta(min_length=1, max_length=200)]


class _Record(msgspec.Struct, frozen=True):
    """The record as it is stored; `boot` and `at`: if the robot was enabled, in which run of its computer, and when."""

    berth: Berth
    boot: str = ""
    at: float = 0.0


class Berths:
    """The list of floors, and the record; whoever copies `floor.json` to another computer doubles the robot."""

    def __init__(self, file: Path, listed: _File, data_dir: Path) -> None:
        """Read the record; raises `SettingsError` for one that can't be read: nobody guesses where a robot is."""
        self._file, self._listed = file, listed
        self._folder = data_dir
        self._record = self._read()
        self.berth = self._record.berth
        if self.berth.floor not in listed.floors:
            raise SettingsError(
                f"{file}: the robot is on {self.berth.floor} ({data_dir / _FILE}), which is not in the list: add it"
            )

    @property
    def floors(self) -> list[str]:
        """The ids of the floors' sites."""
        return list(self._listed.floors)

    def settings(self, settings: S) -> S:
        """Return the settings with which the agent joins the floor that the robot is on, and no other."""
        floor, folder = self._listed.floors[self.berth.floor], self._file.parent
        return structs.replace(
            settings,
            site=self.berth.floor,
            site_dir=folder / floor.site_dir,
            zenoh_connect=floor.zenoh_connect,
            operator_key_file=folder / floor.operator_key,
            credentials_file=folder / floor.credentials if floor.credentials else None,
        )

    def store(self, berth: Berth, *, enabled: bool) -> None:
        """Write the record durably, and forget the pose, which is one on the map of the floor before; blocks.

        Raises `OSError`.
        """
        self._write(_Record(berth, boot_id(), time.monotonic()) if enabled else _Record(berth))
        (self._folder / POSE_FILE).unlink(missing_ok=True)

    def take_enabled(self) -> bool:
        """Return whether this start is the one by which an enabled robot has changed its floor; once. Blocks.

        Not after another start of its computer, nor later than a planned one takes: then a person has to look first.
        Nor if it can't be recorded that this was the one: on a full disk the robot waits for an operator.
        """
        record, self._record = self._record, _Record(self.berth)
        if not record.boot:
            return False
        try:
            self._write(self._record)
        except OSError as error:
            remedy = "make room on its disk; the robot waits to be enabled"
            _log.error("floor_not_stored", floor=self.berth.floor, reason=str(error), remedy=remedy)
            return False
        return record.boot == boot_id() and 0.0 <= time.monotonic() - record.at <= RESTART_S

    def _write(self, record: _Record) -> None:
        atomic_write(self._folder / _FILE, msgspec.json.encode(record))

    def _read(self) -> _Record:
        file = self._folder / _FILE
        try:
            return msgspec.json.decode(file.read_bytes(), type=_Record)
        except FileNotFoundError:
            return _Record(Berth(floor=self._listed.first))
        except (OSError, msgspec.DecodeError, UnicodeDecodeError) as error:
            raise SettingsError(
                f"{file}, which says on which floor the robot is, can't be read: {error}. Restore it, or remove it to "
                f"begin on {self._listed.first} again: floors that have handed the robot over then refuse it until an "
                "operator there has said that it is back"
            ) from error


def read_berths(file: Path | None, data_dir: Path) -> Berths | None:
    """Return the floors that the robot knows; None without a list of floors. Raises `SettingsError`."""
    if file is None:
        return None
    try:
        listed = msgspec.convert(tomllib.loads(file.read_text("utf-8")), _File)
    except OSError as error:
        raise SettingsError(f"the list of floors {file} can't be read: {error.strerror}. {_REMEDY}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, msgspec.ValidationError) as error:
        raise SettingsError(f"the list of floors {file}: {error}. {_REMEDY}") from error
    if listed.first not in listed.floors:
        raise SettingsError(f"{file}: first: there is no floor {listed.first!r} in the list. {_REMEDY}")
    return Berths(file, listed, data_dir)
