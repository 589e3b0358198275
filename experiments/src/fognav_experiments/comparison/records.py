"""The result of each drive, one file each, written atomically; and all of them in one compressed file.

What was there when a run was killed is kept. A machine that drove for hours is replaced, and what it drove would be
lost with it: from the archive, small enough for version control, a report is made again, and the drives that are
missing are added on another machine. It is a text of one JSON document per line, compressed by xz: the first line says
of which experiment, every further one is a record with the name of its folder.
"""

from __future__ import annotations

import csv
import lzma
from typing import TYPE_CHECKING, Any, Final, Generic, Literal, Protocol, TypeVar

import msgspec

from fog_runtime.files import SHARED, atomic_write
from fognav_experiments.comparison.drives import ATTEMPT, KINDS, ComparedDrive, MeasuredDrive, Timeline, drive_name

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from fognav_experiments.comparison.drives import Kind, Setup


LOCKSTEP: Final = "drives"
"""Folder of the records in lockstep."""
MOVE_BASE: Final = ("global planning", "layers", "local planning")
"""Components of a robot whose work the process `move_base` of the ROS navigation stack holds."""
ON_ROBOT: Final = (*MOVE_BASE, "localization", "safety and wheels", "messages", "lidar driver", "guardian")
ALIKE: Final = ("localization", "safety and wheels", "lidar driver", "guardian")
"""Components of a robot that do the same work in every setup."""
ON_FOG: Final = ("aggregator", "map-service", "planner")
OF_FOG: Final[dict[Setup, tuple[str, ...]]] = {
    "default": (),
    "lean": (),
    "full": ("aggregator", "map-service"),
    "fog": ON_FOG,
}
"""What a setup uses of the fog: in lockstep the rest runs too, and is no part of the setup."""


class Record(ComparedDrive, frozen=True, kw_only=True):
    """One drive in lockstep: times are those of the simulated clock, `cpu_s` is CPU time (s) by component.

    `barrier_distance_m`: smallest distance between the obstacle and the robot's rim. `reaction_s`: from the obstacle's
    first reading to the first wheel command on a new path, where there was one. `jobs`: drives that this machine ran at
    the same time. `timeline`: what a film shows. `ready`: the robot was ready in its setup when the drive began; before
    that was waited for, `default` and `full` began 2 s late. `core`: on which one of the machine it was driven.
    `sitting`: that of the drives of this run and route which were made one after another.
    """

    planned_m: float
    contacts: int
    barrier_distance_m: float | None
    pose_error_m: float
    reaction_s: float | None
    received_bytes: int
    operator_commands: int
    cpu_s: dict[str, float]
    jobs: int
    wall_s: float
    track: list[tuple[float, float]] = msgspec.field(default_factory=list)
    timeline: Timeline | None = None
    ready: bool | msgspec.UnsetType = msgspec.UNSET
    core: int | msgspec.UnsetType = msgspec.UNSET
    sitting: str | msgspec.UnsetType = msgspec.UNSET

    @property
    def name(self) -> str:
        """Name of the record's file, without suffix."""
        return drive_name(self.run, self.route, self.setup)

    def cpu_percent(self, components: Iterable[str]) -> float:
        """Return the share of one core (%) that these components took on average over the drive."""
        used = sum(self.cpu_s.get(component, 0.0) for component in components)
        return 100.0 * used / self.time_s if self.time_s else 0.0


Draws = Literal["thesis", "floor"]
"""Of what routes are drawn: of the few of the site's `experiment.toml`, or at random over the floor."""


LOAD_RATIO: Final = 1.5
"""CPU times of drives are compared only if the machine's load differed by less than this."""


def loaded_alike(records: Iterable[ComparedDrive]) -> bool:
    """Whether the machine was loaded alike at the end of these drives; each is a load of 1 by itself."""
    loads = [max(1.0, record.load) for record in records]
    return max(loads) < LOAD_RATIO * min(loads)


def comparable(records: Sequence[Record]) -> bool:
    """Whether CPU times of these drives can be compared: one commit, one sitting, and a like load."""
    return len({(r.commit, r.jobs, str(r.sitting)) for r in records}) == 1 and loaded_alike(records)


class Asked(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What a folder of records is about: it must be the same when it is resumed.

    `robot`: base, lidar and a hash of all settings of the robot file that was driven; empty: the thesis's robot.
    """

    site: str
    site_digest: str
    seed: int
    draws: Draws = "thesis"
    robot: str = ""


class FolderError(ValueError):
    """The folder can't be used; the message names the remedy."""


def machines(experiment: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return what an experiment's drives were measured on: the first machine, and those that went on with it."""
    return [experiment["measured_on"], *experiment.get("also_on", [])]


def _with_machines(experiment: dict[str, Any], others: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return an experiment's description with the machines of `others` that it does not name yet."""
    known = [_lasting(machine) for machine in machines(experiment)]
    new = []
    for machine in others:
        if (lasting := _lasting(machine)) not in known:
            known.append(lasting)
            new.append(machine)
    return experiment | {"also_on": [*experiment.get("also_on", []), *new]} if new else experiment


def _lasting(measured_on: Mapping[str, Any]) -> dict[str, Any]:
    """Return what does not change from one start of the command to the next: each drive has load and commit itself."""
    machine = {name: value for name, value in measured_on.get("machine", {}).items() if name != "load"}
    return {"machine": machine, "versions": measured_on.get("versions", {})}


class _Named(Protocol):
    @property
    def name(self) -> str: ...


N = TypeVar("N", bound=_Named)


class DriveFiles(Generic[N]):
    """Records of one kind, a file each."""

    def __init__(self, path: Path, kind: type[N]) -> None:
        self.path = path
        self._kind = kind

    def has(self, name: str) -> bool:
        """Whether there is a record with this name."""
        return self._file(name).exists()

    def write(self, record: N) -> None:
        """Write a record; either it is there as a whole afterwards, or not at all. Raises `FolderError`."""
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            atomic_write(self._file(record.name), msgspec.json.encode(record), mode=SHARED)
        except OSError as error:
            raise FolderError(f"{self.path} can't be written: {error.strerror}. Name another folder") from error

    def attempts(self, name: str) -> list[N]:
        """Return the records of a drive: the first one, and those that were made because it had failed."""
        return [*self.read(name), *self.read(f"{name}{ATTEMPT}*")]

    def read(self, names: str = "*") -> list[N]:
        """Return all records by run, route and setup, or those of such names; raises `FolderError` for a broken one."""
        records = []
        for file in sorted(self.path.glob(f"{names}.json")):
            try:
                records.append(msgspec.json.decode(file.read_bytes(), type=self._kind))
            except (OSError, msgspec.DecodeError) as error:
                raise FolderError(f"{file} can't be read: {error}. Remove it, and run the experiment again") from error
        return records

    def pack(self, head: Mapping[str, Any]) -> bytes:
        """Return all records as an archive of one kind, whose first line says what they were measured on."""
        lines = [msgspec.json.encode(head), *map(msgspec.json.encode, self.read())]
        return lzma.compress(b"\n".join(lines) + b"\n", check=lzma.CHECK_SHA256, preset=9 | lzma.PRESET_EXTREME)

    def unpack(self, file: Path) -> None:
        """Add the records of such an archive that are not here; without one there are none. Raises `FolderError`."""
        try:
            lines = _decompressed(file).splitlines()[1:] if file.exists() else []
            records = [msgspec.json.decode(line, type=self._kind) for line in lines]
        except (OSError, EOFError, lzma.LZMAError, msgspec.DecodeError, ValueError) as error:
            raise _damaged(file, error) from error
        for record in records:
            if not self.has(record.name):
                self.write(record)

    def _file(self, name: str) -> Path:
        return self.path / f"{name}.json"


class Folder:
    """A folder with the records of an experiment, and `experiment.json`, which says of which one."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.drives = DriveFiles(path / LOCKSTEP, Record)
        """Those in lockstep."""

    def begin(self, asked: Asked, machine: dict[str, Any]) -> None:
        """Create the folder, or verify that it is about the same experiment; raises `FolderError`.

        `machine`: what the drives that follow are measured on and with; the folder lists every one that differs.
        """
        self.adopt({"asked": msgspec.to_builtins(asked), "measured_on": machine})

    def adopt(self, experiment: dict[str, Any]) -> None:
        """Create the folder as one of an `experiment` that another folder describes, or add its machines to it.

        Raises `FolderError` if the folder is about another experiment.
        """
        file = self.path / "experiment.json"
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            known = msgspec.json.decode(file.read_bytes()) if file.exists() else None
        except (OSError, msgspec.DecodeError) as error:
            raise FolderError(f"{self.path} can't be used: {error}. Name another folder") from error
        if known is not None and known["asked"] != experiment["asked"]:
            raise FolderError(
                f"{self.path} holds drives of another experiment ({known['asked']}, not {experiment['asked']}): name "
                "another folder"
            )
        document = experiment if known is None else _with_machines(known, machines(experiment))
        if document != known:
            atomic_write(file, msgspec.json.format(msgspec.json.encode(document)), mode=SHARED)

    def description(self) -> dict[str, Any]:
        """Return what was asked, and what the first drives were measured on; raises `FolderError` if there are none."""
        try:
            found: dict[str, Any] = msgspec.json.decode((self.path / "experiment.json").read_bytes())
        except OSError as error:
            raise FolderError(f"{self.path} holds no experiment: run `fognav experiment` first") from error
        return found

    def measured(self, kind: Kind) -> DriveFiles[MeasuredDrive]:
        """Return the records of drives by real processes."""
        return DriveFiles(self.path / kind, MeasuredDrive)

    def add(self, other: Folder, *, only_measured: bool = False) -> int:
        """Add the records of another folder that this one does not have; return how many these are.

        `only_measured`: only those by real processes. Raises `FolderError` if it is about another experiment.
        """
        self.adopt(other.description())
        added = 0 if only_measured else _add(self.drives, other.drives)
        return added + sum(_add(self.measured(kind), other.measured(kind)) for kind in KINDS)

    def read_drives(self, run: int, route: str, setups: Iterable[str]) -> list[Record]:
        """Return the records of a run's route in these setups; raises `FolderError` if one is missing."""
        known = {record.name: record for record in self.drives.read()}
        wanted = [drive_name(run, route, setup) for setup in setups]
        if missing := [name for name in wanted if name not in known]:
            raise FolderError(
                f"{self.path} holds no drive {', '.join(missing)}: run `fognav experiment --only {run} --out "
                f"{self.path}` first"
            )
        return [known[name] for name in wanted]


def _add(files: DriveFiles[N], others: DriveFiles[N]) -> int:
    new = [record for record in others.read() if not files.has(record.name)]
    for record in new:
        files.write(record)
    return len(new)


def write_csv(path: Path, records: Sequence[Record]) -> None:
    """Write one row per drive; CPU as s by component, and as % of a core for what `move_base` held and in all."""
    left_out = {"cpu_s", "track", "modes", "timeline", "ready", "ends", "core", "sitting"}
    fields = [field for field in Record.__struct_fields__ if field not in left_out]
    shares = {"move_base": MOVE_BASE, "robot": ON_ROBOT}
    header = [
        *fields,
        *(f"cpu_{name.replace(' ', '_')}_s" for name in (*ON_ROBOT, *ON_FOG)),
        *(f"cpu_{name}_percent" for name in (*shares, "fog")),
    ]
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        for record in records:
            values = [getattr(record, field) for field in fields]
            writer.writerow([
                *("; ".join(value) if isinstance(value, list) else value for value in values),
                *(round(record.cpu_s.get(name, 0.0), 4) for name in (*ON_ROBOT, *ON_FOG)),
                *(round(record.cpu_percent(components), 3) for components in shares.values()),
                round(record.cpu_percent(OF_FOG[record.setup]), 3),
            ])  # fmt: skip


ARCHIVE: Final = "drives.jsonl.xz"
_FORMAT: Final = 1
_FOLDERS: Final = (LOCKSTEP, *KINDS)
_MOST_BYTES: Final = 1 << 30
"""Bytes that the records of an archive may have together when they are decompressed."""


class _Head(msgspec.Struct, frozen=True, kw_only=True):
    """The first line: what `experiment.json` of the folder says."""

    format: int
    experiment: dict[str, Any]


class _Machine(msgspec.Struct, frozen=True, kw_only=True):
    """What drives were measured on, as far as a folder compares it."""

    machine: dict[str, Any] = msgspec.field(default_factory=dict)
    versions: dict[str, Any] = msgspec.field(default_factory=dict)


class _Experiment(msgspec.Struct, frozen=True, kw_only=True):
    """What a folder needs of its `experiment.json`: without it nothing could be read there any more."""

    asked: Asked
    measured_on: _Machine
    also_on: list[_Machine] = msgspec.field(default_factory=list)


class _Line(msgspec.Struct, frozen=True, kw_only=True):
    folder: str
    record: msgspec.Raw


def pack_archive(folder: Folder) -> bytes:
    """Return all records of a folder as an archive; the same records give the same bytes. Raises `FolderError`."""
    lines = [msgspec.json.encode(_Head(format=_FORMAT, experiment=folder.description()))]
    lines += [msgspec.json.encode({"folder": LOCKSTEP, "record": record}) for record in folder.drives.read()]
    for kind in KINDS:
        lines += [msgspec.json.encode({"folder": kind, "record": drive}) for drive in folder.measured(kind).read()]
    text = b"\n".join(lines) + b"\n"
    return lzma.compress(text, check=lzma.CHECK_SHA256, preset=9 | lzma.PRESET_EXTREME)


def write_archive(folder: Folder, file: Path) -> int:
    """Write a folder's archive, as a whole or not at all; return its size in bytes. Raises `FolderError`."""
    data = pack_archive(folder)
    try:
        atomic_write(file, data, mode=SHARED)
    except OSError as error:
        raise FolderError(f"{file} can't be written: {error.strerror}. Name another file") from error
    return len(data)


def unpack_archive(file: Path, folder: Folder, wanted: Asked | None = None) -> int:
    """Add the records of an archive that the folder does not have; return how many these are.

    What the folder has already, it keeps. Nothing is written if the archive is damaged, or of another experiment than
    the folder's or the one that is `wanted`; then it raises `FolderError`.
    """
    experiment, records = _read_archive(file)
    try:
        asked = msgspec.convert(experiment, _Experiment).asked
    except msgspec.ValidationError as error:
        raise _damaged(file, error) from error
    if wanted is not None and asked != wanted:
        raise FolderError(f"{file} holds drives of another experiment ({asked}, not {wanted}): leave --from out")
    folder.adopt(experiment)
    added = 0
    for record in records:
        files = folder.drives if isinstance(record, Record) else folder.measured(record.kind)
        if not files.has(record.name):
            files.write(record)  # type: ignore[arg-type]  # a folder of records of its own kind
            added += 1
    return added


def _read_archive(file: Path) -> tuple[dict[str, Any], list[Record | MeasuredDrive]]:
    """Return what an archive is about, and its records."""
    try:
        lines = iter(_decompressed(file).splitlines())
        head = msgspec.json.decode(next(lines, b""), type=_Head)
        if head.format != _FORMAT:
            raise FolderError(f"{file} has format {head.format}: read it with a newer version of Fognav")
        return head.experiment, list(_records(lines))
    except (OSError, EOFError, lzma.LZMAError, msgspec.DecodeError, ValueError) as error:
        if isinstance(error, FolderError):
            raise
        raise _damaged(file, error) from error


def _decompressed(file: Path) -> bytes:
    with lzma.open(file) as packed:
        text = packed.read(_MOST_BYTES + 1)
    if len(text) > _MOST_BYTES:
        raise ValueError(f"it has more than {_MOST_BYTES} bytes")
    return text


def _records(lines: Iterator[bytes]) -> Iterator[Record | MeasuredDrive]:
    for number, line in enumerate(lines, start=2):
        found = msgspec.json.decode(line, type=_Line)
        if found.folder not in _FOLDERS:
            raise ValueError(f"line {number} is of a folder {found.folder!r}, which no experiment has")
        record = (
            msgspec.json.decode(found.record, type=Record)
            if found.folder == LOCKSTEP
            else msgspec.json.decode(found.record, type=MeasuredDrive)
        )
        # The name becomes that of a file.
        if "/" in record.name or "\\" in record.name or "\0" in record.name:
            raise ValueError(f"line {number} is a drive with the name {record.name!r}, which is none of a file")
        yield record


def _damaged(file: Path, error: Exception) -> FolderError:
    return FolderError(f"{file} is no archive of an experiment, or damaged: {error}. Fetch it again, or leave it out")
