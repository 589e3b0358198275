import pytest

from fog_contracts.commands import KEY_BYTES
from fog_runtime.http import load_tokens
from fog_runtime.keys import make_keys


def test_admin_token_is_accepted_by_its_tokens_file(tmp_path):
    created = make_keys(tmp_path / "keys")
    assert sorted(file.name for file in created) == ["admin.token", "operator.key", "tokens.toml"]
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
