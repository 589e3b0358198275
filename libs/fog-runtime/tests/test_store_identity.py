"""What a service knows of the store that it uses: the marker file, and what counts as a loss."""

import pytest

from fog_runtime.redis_connection import StoreError
from fog_runtime.store_identity import LOST, StoreIdentity, StoreLostError


def test_identity_is_remembered_over_a_restart_and_another_store_is_refused(tmp_path):
    marker = tmp_path / "new" / "planner.lab.store"
    first = StoreIdentity(marker)
    assert not first.used_before
    first.verify("", {})
    first.verify("g1", {"zones": 3})
    assert first.guard("zones") == {"generation": "g1", "table": "zones", "acknowledged": 3}
    restarted = StoreIdentity(marker)
    assert restarted.used_before
    for generation, text in (("", "was emptied"), ("g2", "was replaced by another store")):
        with pytest.raises(StoreLostError, match=f"Redis {text}.*restore.*accept.*operations.md"):
            restarted.verify(generation, {})
        assert LOST._value.get() == 1
    restarted.adopt("g2", {})
    assert LOST._value.get() == 0
    assert StoreIdentity(marker).used_before
    StoreIdentity(marker).verify("g2", {})


def test_store_with_fewer_writes_than_acknowledged_ones_has_lost_some():
    identity = StoreIdentity(None)
    identity.verify("g1", {"zones": 3})
    identity.acknowledge("zones", 5)
    identity.acknowledge("zones", 4)  # the replies of two writes may overtake one another
    identity.acknowledge("areas", 1)
    identity.verify("g1", {"zones": 6, "areas": 1})
    for writes in ({"zones": 4, "areas": 1}, {"zones": 5}):
        with pytest.raises(StoreLostError, match="went back to an older state"):
            identity.verify("g1", writes)


def test_marker_that_cannot_be_read_or_written_is_named_with_the_remedy(tmp_path):
    (tmp_path / "folder.store").mkdir()
    with pytest.raises(StoreError, match=r"folder\.store can't be read .*: delete it"):
        StoreIdentity(tmp_path / "folder.store").verify("g1", {})
    (tmp_path / "file").touch()
    with pytest.raises(StoreError, match=r"can't be (read|written) "):
        StoreIdentity(tmp_path / "file" / "x.store").verify("g1", {})
