import pytest

from fog_contracts.commands import KEY_BYTES
from fog_runtime.http import load_tokens
from fog_runtime.keys import make_keys


def test_the_token_opens_what_the_tokens_file_guards(tmp_path):
    made = make_keys(tmp_path / "keys")
    assert sorted(file.name for file in made) == ["admin.token", "operator.key", "tokens.toml"]
    token = (tmp_path / "keys" / "admin.token").read_text().strip()
    caller = load_tokens(tmp_path / "keys" / "tokens.toml").caller(token)
    assert caller is not None
    assert caller.role == "admin"
    assert len(bytes.fromhex((tmp_path / "keys" / "operator.key").read_text())) >= KEY_BYTES


def test_what_is_there_stays(tmp_path):
    make_keys(tmp_path)
    before = {file.name: file.read_text() for file in tmp_path.iterdir()}
    assert make_keys(tmp_path) == []
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == before


def test_secrets_are_for_their_owner_only(tmp_path):
    assert {file.stat().st_mode & 0o077 for file in make_keys(tmp_path)} == {0}


def test_half_a_pair_is_refused_by_name(tmp_path):
    make_keys(tmp_path)
    (tmp_path / "tokens.toml").unlink()
    with pytest.raises(FileExistsError, match=r"admin\.token"):
        make_keys(tmp_path)
