"""The archive of an experiment's records: it loses nothing, and a damaged or foreign one does no harm."""

from __future__ import annotations

import lzma

import msgspec
import pytest

from fognav_experiments.comparison import records
from fognav_experiments.comparison.drives import ComparedDrive, MeasuredDrive, Timeline
from fognav_experiments.comparison.records import ON_FOG, ON_ROBOT, Asked, Folder, FolderError, Record, machines
from fognav_experiments.comparison.report import publish

ASKED = Asked(site="ring", site_digest="0" * 16, seed=1)


def recorded_drive(setup, number):
    """Return a record with something in every field."""
    track = [(round(0.25 * step, 3), round(0.1 * number, 3)) for step in range(200)]
    return Record(
        setup=setup,
        run=1,
        route="ab",
        seed=7,
        area="z1",
        outcome="reached",
        success=True,
        distance_m=50.0 + number,
        time_s=180.5 + number,
        version="0.1.0",
        commit="0123456789ab",
        moment="under way",
        trigger_m=12.34,
        reason="the robot stands 0.05 m from its goal, without contact",
        paths=2,
        stops=["PROTECTIVE_STOP: no complete scan"] if number == 1 else [],
        route_areas=["z1"],
        modes={"HOLD": 1, "NORMAL": 2},
        min_clearance_m=0.299,
        load=1.25,
        planned_m=49.5,
        contacts=0,
        barrier_distance_m=None if number == 2 else 9.8,
        pose_error_m=0.086,
        reaction_s=0.15,
        received_bytes=5085,
        operator_commands=1,
        cpu_s={name: 0.25 * place + number for place, name in enumerate((*ON_ROBOT, *ON_FOG), start=1)},
        jobs=1,
        wall_s=20.1,
        track=track,
        timeline=Timeline(
            poses=[(float(step), x, y) for step, (x, y) in enumerate(track)],
            paths=[(0.0, [(0.0, 0.0), (50.0, 0.0)])],
            areas=[(3.5, "z1", True)],
            barrier_at=3.0,
        ),
    )


RECORDS = [recorded_drive(setup, number) for number, setup in enumerate(("default", "full", "fog"))]


@pytest.fixture
def recorded(tmp_path):
    """A folder with a route in three setups."""
    folder = Folder(tmp_path / "recorded")
    folder.begin(ASKED, {"commit": "none", "machine": {"cores": 2}})
    for record in RECORDS:
        folder.drives.write(record)
    return folder


def test_an_archive_is_small_and_gives_all_records_back(recorded, tmp_path):
    packed = tmp_path / records.ARCHIVE
    assert records.write_archive(recorded, packed) == packed.stat().st_size
    assert packed.stat().st_size < sum(file.stat().st_size for file in recorded.drives.path.iterdir()) / 2
    again = Folder(tmp_path / "again")
    assert records.unpack_archive(packed, again, ASKED) == 3
    assert again.drives.read() == recorded.drives.read()
    assert again.description() == recorded.description()
    assert records.pack_archive(again) == packed.read_bytes()


def test_drives_by_real_processes_are_in_the_archive_too(recorded, tmp_path):
    record = RECORDS[0]
    shared = {name: getattr(record, name) for name in ComparedDrive.__struct_fields__}
    live = MeasuredDrive(kind="live", plans=2, peak_mb={"robot-agent": 190.0}, **shared)
    before, after = Folder(tmp_path / "before"), Folder(tmp_path / "after")
    before.begin(ASKED, {})
    before.measured("live").write(live)
    records.write_archive(before, tmp_path / records.ARCHIVE)
    assert records.unpack_archive(tmp_path / records.ARCHIVE, after) == 1
    assert after.measured("live").read() == [live]
    assert after.drives.read() == []


def test_an_experiment_goes_on_with_an_archive_where_it_was(tmp_path):
    """One setup stands in the archive and another one in the folder: only the third one is due."""
    first, second = Folder(tmp_path / "first"), Folder(tmp_path / "second")
    first.begin(ASKED, {"machine": {"cores": 2, "load": 1.0}})
    first.drives.write(RECORDS[0])
    first.drives.write(RECORDS[1])
    records.write_archive(first, tmp_path / records.ARCHIVE)
    second.begin(ASKED, {"machine": {"cores": 4, "load": 1.0}})
    kept = msgspec.structs.replace(RECORDS[1], wall_s=-1.0)
    second.drives.write(kept)
    assert records.unpack_archive(tmp_path / records.ARCHIVE, second, ASKED) == 1
    assert second.drives.read() == [RECORDS[0], kept]
    assert records.unpack_archive(tmp_path / records.ARCHIVE, second, ASKED) == 0
    # Who went on with it elsewhere is named, and the same machine under another load only once.
    assert [machine["machine"]["cores"] for machine in machines(second.description())] == [4, 2]
    second.begin(ASKED, {"machine": {"cores": 2, "load": 9.0}})
    assert [machine["machine"]["cores"] for machine in machines(second.description())] == [4, 2]
    publish(second, tmp_path / "report")
    assert "| later machine cores | 2 |" in (tmp_path / "report" / "README.md").read_text("utf-8")


def test_from_a_report_s_archive_the_same_report_is_made_again(recorded, tmp_path):
    publish(recorded, tmp_path / "report")
    again = Folder(tmp_path / "again")
    records.unpack_archive(tmp_path / "report" / records.ARCHIVE, again)
    for file in publish(again, tmp_path / "second"):
        assert file.read_bytes() == (tmp_path / "report" / file.name).read_bytes(), file.name


def packed(*lines):
    return lzma.compress(b"".join(msgspec.json.encode(line) + b"\n" for line in lines))


EXPERIMENT = {"asked": msgspec.to_builtins(ASKED), "measured_on": {}}
HEAD = {"format": 1, "experiment": EXPERIMENT}


def headed(**experiment):
    """Return an archive without drives that says this of its experiment."""
    return packed({"format": 1, "experiment": experiment})


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda data: data[: len(data) // 2], "damaged: .*end-of-stream"),
        (lambda data: data[:200] + bytes([data[200] ^ 1]) + data[201:], "damaged"),
        (lambda _data: b"PK", "damaged"),
        (lambda _data: lzma.compress(b""), "damaged"),
        (lambda _data: packed(HEAD | {"format": 2}), "format 2: read it with a newer version"),
        (lambda _data: headed(measured_on={}), "damaged: .*`asked`"),
        (lambda _data: headed(asked=EXPERIMENT["asked"]), "damaged: .*`measured_on`"),
        (lambda _data: headed(**EXPERIMENT | {"measured_on": {"machine": 2}}), r"damaged: .*measured_on\.machine"),
        (lambda _data: headed(**EXPERIMENT, also_on=[None]), r"damaged: .*also_on\[0\]"),
        (lambda _data: packed(HEAD, {"folder": "elsewhere", "record": {}}), "line 2 is of a folder 'elsewhere'"),
        (lambda _data: packed(HEAD, {"folder": "drives", "record": {}}), "damaged: .*missing required field"),
    ],
)
def test_a_damaged_archive_is_refused_and_leaves_nothing_behind(recorded, tmp_path, damage, words):
    file = tmp_path / records.ARCHIVE
    file.write_bytes(damage(records.pack_archive(recorded)))
    with pytest.raises(FolderError, match=words) as refused:
        records.unpack_archive(file, Folder(tmp_path / "out"))
    assert str(file) in str(refused.value)
    assert not (tmp_path / "out").exists()


def test_an_archive_writes_no_file_outside_its_folder(tmp_path):
    record = msgspec.to_builtins(msgspec.structs.replace(RECORDS[0], route="/../../../evil"))
    (tmp_path / records.ARCHIVE).write_bytes(packed(HEAD, {"folder": "drives", "record": record}))
    with pytest.raises(FolderError, match="which is none of a file"):
        records.unpack_archive(tmp_path / records.ARCHIVE, Folder(tmp_path / "out"))
    assert [file.name for file in tmp_path.iterdir()] == [records.ARCHIVE]


def test_an_archive_of_another_experiment_is_refused(recorded, tmp_path):
    file = tmp_path / records.ARCHIVE
    records.write_archive(recorded, file)
    other = msgspec.structs.replace(ASKED, seed=2)
    with pytest.raises(FolderError, match="another experiment"):
        records.unpack_archive(file, Folder(tmp_path / "out"), other)
    assert not (tmp_path / "out").exists()
    Folder(tmp_path / "theirs").begin(other, {})
    with pytest.raises(FolderError, match="another experiment"):
        records.unpack_archive(file, Folder(tmp_path / "theirs"))
    assert Folder(tmp_path / "theirs").drives.read() == []
