"""The files of a site's secrets: tokens with their hashes, and the key that signs commands."""

import json
import os
import resource
import subprocess
import sys
from contextlib import contextmanager

import pytest

from fog_contracts.commands import KEY_BYTES
from fog_runtime.http import load_tokens
from fog_runtime.keys import make_keys, read_operator_key, read_session_key
from fog_runtime.token_file import TokensError, audit_file, create_token, read_tokens, revoke_token


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "tokens.toml"
    path.touch(mode=0o640)
    return path


def test_created_token_is_accepted_and_a_revoked_one_refused_without_a_restart(file):
    tokens = load_tokens(file)
    anna, bert = create_token(file, "anna", "operator"), create_token(file, "bert", "viewer")
    assert [(found.name, found.role) for found in map(tokens.caller, (anna, bert)) if found is not None] == [
        ("anna", "operator"), ("bert", "viewer"),
    ]  # fmt: skip
    revoke_token(file, "anna")
    assert tokens.caller(anna) is None
    assert tokens.caller(bert) is not None


def test_file_holds_no_token_and_keeps_its_mode(file):
    token = create_token(file, "anna", "admin")
    assert token not in file.read_text()
    assert file.stat().st_mode & 0o777 == 0o640
    assert [entry.name for entry in read_tokens(file)] == ["anna"]


def test_each_change_leaves_an_audit_entry(file):
    create_token(file, "anna", "admin")
    revoke_token(file, "anna")
    entries = [json.loads(line) for line in audit_file(file).read_text().splitlines()]
    assert [(e["action"], e["name"], e.get("role")) for e in entries] == [
        ("create", "anna", "admin"), ("revoke", "anna", None),
    ]  # fmt: skip
    assert all(entry["who"] and entry["at"] for entry in entries)


def test_invalid_file_changes_nothing_and_a_missing_one_admits_nobody(file):
    token = create_token(file, "anna", "admin")
    tokens, valid = load_tokens(file), file.read_text()
    file.write_text("[[tokens]]\nname = ")
    assert tokens.caller(token) is not None
    file.unlink()
    assert tokens.caller(token) is None
    file.write_text(valid)
    assert tokens.caller(token) is not None


@pytest.mark.parametrize(
    ("name", "role", "reason"),
    [
        ("anna", "viewer", "anna has a token already. Revoke it first"),
        ('a"\n', "viewer", "a name has up to 100 letters"),
        ("bert", "king", "the roles are guest, viewer, operator, admin"),
        ("", "viewer", "a name has up to 100 letters"),
    ],
)
def test_impossible_entry_is_refused_and_changes_nothing(file, name, role, reason):
    create_token(file, "anna", "admin")
    before = file.read_text()
    with pytest.raises(TokensError, match=reason):
        create_token(file, name, role)
    assert file.read_text() == before
    assert len(audit_file(file).read_text().splitlines()) == 1


def test_unknown_name_is_refused_with_the_known_ones(file):
    create_token(file, "anna", "admin")
    with pytest.raises(TokensError, match=r"bert has no token. Tokens have: anna"):
        revoke_token(file, "bert")
    with pytest.raises(TokensError, match="can't be read"):
        revoke_token(file.with_name("none.toml"), "anna")


def run(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "fog_runtime.token_file", *arguments], capture_output=True, text=True, check=False
    )


def test_fog_node_manages_tokens_without_the_fognav_command(file):
    token = run(str(file), "create", "anna", "operator").stdout.strip()
    tokens = load_tokens(file)
    assert tokens.caller(token) is not None
    assert run(str(file), "list").stdout == "anna: operator\n"
    refused = run(str(file), "revoke", "bert")
    assert (refused.returncode, "bert has no token" in refused.stderr) == (1, True)


def test_concurrent_changes_are_all_kept(file):
    writers = [
        subprocess.Popen(
            [sys.executable, "-m", "fog_runtime.token_file", str(file), "create", f"n{i}", "viewer"],
            stdout=subprocess.DEVNULL,
        )
        for i in range(4)
    ]
    assert [writer.wait(60) for writer in writers] == [0] * 4
    assert sorted(entry.name for entry in read_tokens(file)) == ["n0", "n1", "n2", "n3"]


@pytest.mark.parametrize(("revision", "shown"), [("abc123", "abc123"), ("", "unknown")])
def test_metrics_name_version_and_revision(revision, shown):
    code = "from fog_runtime import metrics; print(metrics.exposition()[0].decode())"
    environment = {**os.environ, "FOGNAV_REVISION": revision}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert f'fognav_build_info{{revision="{shown}",version="' in done.stdout


def test_admin_token_is_accepted_by_its_tokens_file(tmp_path):
    created = make_keys(tmp_path / "keys")
    assert sorted(file.name for file in created) == ["admin.token", "operator.key", "session.key", "tokens.toml"]
    token = (tmp_path / "keys" / "admin.token").read_text().strip()
    caller = load_tokens(tmp_path / "keys" / "tokens.toml").caller(token)
    assert caller is not None
    assert caller.role == "admin"
    assert len(bytes.fromhex((tmp_path / "keys" / "operator.key").read_text())) >= KEY_BYTES


def test_existing_secrets_are_kept(tmp_path):
    make_keys(tmp_path)
    before = {file.name: file.read_text() for file in tmp_path.iterdir()}
    assert make_keys(tmp_path) == []
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == before


def test_secrets_are_readable_by_their_owner_only(tmp_path):
    assert {file.stat().st_mode & 0o077 for file in make_keys(tmp_path)} == {0}


@contextmanager
def full_disk(room):
    """Let no file get longer than `room` (bytes)."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize(("room", "missing"), [(0, ()), (60, ()), (0, ("operator.key", "session.key"))])
def test_secrets_for_which_a_disk_had_no_room_are_made_when_it_has(tmp_path, room, missing):
    if missing:
        make_keys(tmp_path)
        for name in missing:
            (tmp_path / name).unlink()
    with full_disk(room), pytest.raises(OSError, match="too large"):
        make_keys(tmp_path)
    make_keys(tmp_path)
    assert load_tokens(tmp_path / "tokens.toml").caller((tmp_path / "admin.token").read_text().strip()) is not None
    assert read_operator_key(tmp_path / "operator.key")
    assert read_session_key(tmp_path / "session.key")


def test_token_without_its_tokens_file_is_refused_by_name(tmp_path):
    make_keys(tmp_path)
    (tmp_path / "tokens.toml").unlink()
    with pytest.raises(FileExistsError, match=r"admin\.token"):
        make_keys(tmp_path)


def test_admin_token_that_is_kept_elsewhere_is_not_missed(tmp_path):
    make_keys(tmp_path)
    (tmp_path / "admin.token").unlink()
    before = (tmp_path / "tokens.toml").read_text()
    assert make_keys(tmp_path) == []
    assert (tmp_path / "tokens.toml").read_text() == before
