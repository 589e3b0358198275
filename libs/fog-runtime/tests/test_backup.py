"""Backups of a real Redis and of folders: what is restored is what was there, and nothing is half done."""

import asyncio
import contextlib
import io
import os
import stat
import tarfile
from pathlib import Path

import pytest
from redis.asyncio import Redis

from fog_runtime import backup
from fog_runtime.backup import BackupError, read_archive
from fog_runtime.stores.redis_connection import StoreLostError
from fog_runtime.stores.redis_store import RedisStore
from fog_supervisor.servers import Server, start_redis

pytestmark = pytest.mark.live
NOW = 1_800_000_000.0


@pytest.fixture
def redis(tmp_path: Path):
    with start_redis(tmp_path / "redis") as server:
        yield server


@pytest.fixture
def other(tmp_path: Path):
    """Another Redis, on an empty machine."""
    with start_redis(tmp_path / "other-redis") as server:
        yield server


def place(folder: Path, redis: Server) -> backup.Place:
    folders = {backup.SITE: folder / "site", backup.SECRETS: folder / "secrets", backup.MAPS: folder / "maps"}
    return backup.Place(redis.url, "test", folders, folder / "data")


@pytest.fixture
def here(tmp_path, redis):
    found = place(tmp_path / "here", redis)
    for name, files in {"site": {"site.toml": "id", "maps/floor.pgm": "P5"}, "secrets": {"operator.key": "ab"}}.items():
        for path, text in files.items():
            file = found.folders[name] / path
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text)
    (found.folders["secrets"] / "operator.key").chmod(0o600)
    return found


async def fill(redis: Server) -> None:
    async with Redis.from_url(redis.url) as raw:
        await raw.hset("fog:test:zones", mapping={"z1": '{"version": 3}', "z2": b"\x00\xff"})
        await raw.set("fog:test:generation", "abc")
        await raw.set("fog:test:idempotency:1", "done", px=3_600_000)
        await raw.set("fog:test:short-lived", "somebody", px=9_000)
        await raw.zadd("fog:test:order", {"a": 1.5})
        for number in range(300):
            await raw.xadd("fog:test:audit:zone", {"who": "anna", "n": number})
        await raw.set("fog:elsewhere:generation", "of another site")


async def content(redis: Server) -> dict[bytes, bytes]:
    async with Redis.from_url(redis.url) as raw:
        return {name: await raw.dump(name) for name in await raw.keys("*")}


async def test_empty_machine_gets_everything_of_the_site_back(tmp_path, here, redis, other):
    await fill(redis)
    file = tmp_path / "backup.tar.gz"
    here.folders[backup.MAPS].mkdir()  # of a fog that was given another map
    (here.folders[backup.MAPS] / "in-force.json").write_text("{}")
    await backup.create(file, here, NOW)
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert (here.data_dir / backup.STAMP).exists()
    there = place(tmp_path / "there", other)
    restored = await backup.restore(file, there, replace=False)
    assert (restored.site, restored.created) == ("test", NOW)
    expected = await content(redis)
    for name in (b"fog:elsewhere:generation", b"fog:test:short-lived"):
        expected.pop(name, None)
    assert await content(other) == expected
    async with Redis.from_url(other.url) as raw:
        assert 3_000_000 < await raw.pttl("fog:test:idempotency:1") <= 3_600_000
        assert await raw.xlen("fog:test:audit:zone") == 300
    for name in ("site/site.toml", "site/maps/floor.pgm", "secrets/operator.key", "maps/in-force.json"):
        assert (tmp_path / "there" / name).read_bytes() == (tmp_path / "here" / name).read_bytes()
    assert stat.S_IMODE((tmp_path / "there/secrets/operator.key").stat().st_mode) == 0o600


async def test_backup_during_writes_has_zones_and_their_count_of_one_moment(tmp_path, here, redis, other):
    async def write() -> None:
        async with Redis.from_url(redis.url) as raw:
            for number in range(100_000):
                async with raw.pipeline(transaction=True) as pipe:
                    pipe.hset("fog:test:zones", f"z{number}", "{}")
                    pipe.hset("fog:test:writes", "zones", number + 1)
                    await pipe.execute()

    writing = asyncio.create_task(write())
    for number in range(5):
        file = tmp_path / f"{number}.tar.gz"
        await backup.create(file, here, NOW)
        await backup.restore(file, place(tmp_path / "there", other), replace=True)
        async with Redis.from_url(other.url) as raw:
            assert await raw.hlen("fog:test:zones") == int(await raw.hget("fog:test:writes", "zones") or 0)
    assert not writing.done()
    writing.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await writing


async def test_what_is_there_is_replaced_only_when_that_is_wanted(tmp_path, here, redis):
    await fill(redis)
    file = tmp_path / "backup.tar.gz"
    await backup.create(file, here, NOW)
    async with Redis.from_url(redis.url) as raw:
        await raw.hset("fog:test:zones", "z9", "drawn later")
    with pytest.raises(BackupError, match=r"keys of site test already: nothing was changed\. --replace"):
        await backup.restore(file, here, replace=False)
    async with Redis.from_url(redis.url) as raw:
        assert await raw.hexists("fog:test:zones", "z9")
        await backup.restore(file, here, replace=True)
        assert await raw.hkeys("fog:test:zones") == [b"z1", b"z2"]
        assert await raw.get("fog:elsewhere:generation") == b"of another site"


async def test_map_that_was_put_into_force_after_the_backup_is_so_no_more_once_it_is_restored(tmp_path, here, redis):
    await fill(redis)
    file = tmp_path / "backup.tar.gz"
    await backup.create(file, here, NOW)
    later = here.folders[backup.MAPS] / "in-force.json"
    later.parent.mkdir()
    later.write_text('{"name": "aaaaaaaaaaaaaaaa", "over": "bbbbbbbbbbbbbbbb"}')
    async with Redis.from_url(redis.url) as raw:
        await raw.delete(*await raw.keys("fog:test:*"))
    with pytest.raises(BackupError, match=r"in-force\.json names a map, and the backup has none: nothing was changed"):
        await backup.restore(file, here, replace=False)
    assert later.exists()
    await backup.restore(file, here, replace=True)
    assert not later.exists()


@pytest.mark.parametrize("apart", [False, True])
async def test_services_that_ran_here_before_take_the_restored_store_for_theirs(tmp_path, here, redis, other, apart):
    def store(of: backup.Place, service: str) -> RedisStore:
        return RedisStore(of.redis_url, "test", service=service, data_dir=of.own_data.get(service, of.data_dir))

    services = ("hazard-aggregator", "map-service", "planner")
    there = place(tmp_path / "there", other)
    if apart:
        there = there._replace(own_data={each: tmp_path / "there" / each for each in services})
    for node, started in ((here, services), (there, services[:2])):
        for each in started:
            async with store(node, each) as made:
                await made.check()
    file = tmp_path / "backup.tar.gz"
    await backup.create(file, here, NOW)
    await backup.restore(file, there, replace=True)
    for each in services:
        async with store(there, each) as restored:
            await restored.check()
    async with Redis.from_url(other.url) as raw:  # and they notice a loss after it
        await raw.delete(*await raw.keys("fog:test:*"))
    async with store(there, "planner") as emptied:
        with pytest.raises(StoreLostError, match="was emptied"):
            await emptied.check()


async def test_backup_is_not_restored_under_a_running_service(tmp_path, here, redis):
    await fill(redis)
    file = tmp_path / "backup.tar.gz"
    await backup.create(file, here, NOW)
    before = await content(redis)
    async with Redis.from_url(redis.url) as raw:
        await raw.set("fog:test:map-service:lease", "somebody")
        with pytest.raises(BackupError, match="map-service of site test runs: nothing was changed"):
            await backup.restore(file, here, replace=True)
        await raw.delete("fog:test:map-service:lease")
    before.pop(b"fog:test:map-service:lease", None)
    assert await content(redis) == before


async def test_files_of_somebody_else_are_not_overwritten_without_consent(tmp_path, here, redis, other):
    file = tmp_path / "backup.tar.gz"
    await backup.create(file, here, NOW)
    there = place(tmp_path / "there", other)
    there.folders["site"].mkdir(parents=True)
    (there.folders["site"] / "site.toml").write_text("another site")
    with pytest.raises(BackupError, match=r"site\.toml exists already: nothing was changed"):
        await backup.restore(file, there, replace=False)
    assert (there.folders["site"] / "site.toml").read_text() == "another site"
    assert not there.folders["secrets"].exists()


async def test_another_sites_folder_is_never_overwritten(tmp_path, here, redis, other):
    (here.folders["site"] / "site.toml").write_text('id = "test"\n')
    file = tmp_path / "backup.tar.gz"
    await fill(redis)
    await backup.create(file, here, NOW)
    there = place(tmp_path / "there", other)
    there.folders["site"].mkdir(parents=True)
    site = there.folders["site"] / "site.toml"
    site.write_text('id = "upstairs"\n')
    with pytest.raises(
        BackupError, match="has the site upstairs, and the backup is of the site test: nothing was changed"
    ):
        await backup.restore(file, there, replace=True)
    assert site.read_text() == 'id = "upstairs"\n'
    assert await content(other) == {}
    site.write_text("id = damaged")
    await backup.restore(file, there, replace=True)
    assert site.read_text() == 'id = "test"\n'


async def test_backup_never_replaces_a_device(tmp_path, here, redis):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(BackupError, match=r"pipe can't be written \(it is no regular file\): name a file"):
        await backup.create(pipe, here, NOW)
    assert stat.S_ISFIFO(pipe.stat().st_mode)


async def test_backup_by_a_link_is_written_where_the_link_leads(tmp_path, here, redis):
    (tmp_path / "link.tar.gz").symlink_to(tmp_path / "backup.tar.gz")
    for _ in range(2):
        await backup.create(tmp_path / "link.tar.gz", here, NOW)
    assert (tmp_path / "link.tar.gz").is_symlink()
    assert read_archive(tmp_path / "backup.tar.gz").site == "test"


def damaged_in_the_middle(data: bytes) -> bytes:
    return data[: len(data) // 2] + bytes([data[len(data) // 2] ^ 0x55]) + data[len(data) // 2 + 1 :]


def with_another_zone(data: bytes) -> bytes:
    """The same archive with a changed part, packed again, so that gzip and tar find nothing."""
    packed = io.BytesIO()
    with tarfile.open(fileobj=io.BytesIO(data)) as old, tarfile.open(fileobj=packed, mode="w:gz") as new:
        for member in old:
            stream = old.extractfile(member)
            assert stream is not None
            body = stream.read()
            if member.name.endswith("site.toml"):
                body = b"xx"
            new.addfile(member, io.BytesIO(body))
    return packed.getvalue()


@pytest.mark.parametrize(
    "damage", [damaged_in_the_middle, with_another_zone, lambda data: data[:-200], lambda _data: b"", lambda _: b"\x1f"]
)
async def test_damaged_backup_is_refused_and_nothing_is_changed(tmp_path, here, redis, other, damage):
    await fill(redis)
    file = tmp_path / "backup.tar.gz"
    await backup.create(file, here, NOW)
    file.write_bytes(damage(file.read_bytes()))
    with pytest.raises(BackupError, match="damaged"):
        await backup.restore(file, place(tmp_path / "there", other), replace=True)
    assert await content(other) == {}
    assert not (tmp_path / "there").exists()


async def test_backup_without_redis_says_so_and_leaves_no_file(tmp_path, here, redis):
    redis.stop()
    with pytest.raises(BackupError, match="Redis"):
        await backup.create(tmp_path / "backup.tar.gz", here, NOW)
    assert not (tmp_path / "backup.tar.gz").exists()
    assert not (here.data_dir / backup.STAMP).exists()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files to others")
async def test_secrets_stay_those_of_the_services(tmp_path, here, redis, other):
    os.chown(here.folders["secrets"] / "operator.key", 10001, 10001)
    file = tmp_path / "backup.tar.gz"
    await backup.create(file, here, NOW)
    await backup.restore(file, place(tmp_path / "there", other), replace=False)
    assert (tmp_path / "there/secrets/operator.key").stat().st_uid == 10001


async def test_path_that_leads_out_of_the_folder_is_refused(tmp_path, here, redis):
    file = tmp_path / "backup.tar.gz"
    await backup.create(file, here, NOW)
    good = read_archive(file)
    evil = good._replace(folders={"site": {"../../etc/passwd": good.folders["site"]["site.toml"]}})
    with pytest.raises(BackupError, match="unexpected part"):
        backup.write_archive(tmp_path / "evil.tar.gz", evil)


def test_command_backs_up_and_restores(tmp_path, here, redis, monkeypatch, capsys):
    (here.folders["site"] / "site.toml").write_text('id = "test"\n')
    monkeypatch.setenv("FOGNAV_SITE", "test")
    monkeypatch.setenv("FOGNAV_SITE_DIR", str(here.folders["site"]))
    monkeypatch.setenv("FOGNAV_DATA_DIR", str(here.data_dir))
    monkeypatch.setenv("FOGNAV_REDIS_URL", redis.url)
    monkeypatch.setenv("FOGNAV_TOKENS_FILE", str(here.folders["secrets"] / "tokens.toml"))
    asyncio.run(fill(redis))
    file = tmp_path / "b.tar.gz"
    assert backup.main(["create", str(file)]) == 0
    assert (
        "backed up site test: 5 keys of Redis, 2 files of the site, 1 files of the secrets" in capsys.readouterr().out
    )
    assert backup.main(["restore", str(file)]) == 1
    assert "--replace deletes them" in capsys.readouterr().err
    assert backup.main(["restore", "--replace", str(file)]) == 0
    assert "restored site test" in capsys.readouterr().out
