"""Whose keys in Redis are whose, and how a service notices that Redis lost something."""

import pytest

from fog_runtime.security.users import SERVICES, redis_line
from fog_runtime.stores import records
from fog_runtime.stores.records import KINDS
from fog_runtime.stores.redis_connection import LOST, StoreError, StoreIdentity, StoreLostError


def verify(identity: StoreIdentity, generation: str, writes: dict[str, int]) -> None:
    identity.verify(identity.expectation(), generation, writes)


def test_identity_is_remembered_over_a_restart_and_another_store_is_refused(tmp_path):
    marker = tmp_path / "new" / "planner.lab.store"
    first = StoreIdentity(marker)
    assert first.expectation().generation == ""
    verify(first, "", {})
    verify(first, "g1", {"zones": 3})
    assert first.guard("zones") == {"generation": "g1", "table": "zones", "acknowledged": 3}
    restarted = StoreIdentity(marker)
    assert restarted.expectation().generation == "g1"
    for generation, text in (("", "was emptied"), ("g2", "was replaced by another store")):
        with pytest.raises(StoreLostError, match=f"Redis {text}.*restore.*accept.*operations.md"):
            verify(restarted, generation, {})
        assert LOST._value.get() == 1
    restarted.adopt("g2", {})
    assert LOST._value.get() == 0
    verify(StoreIdentity(marker), "g2", {})


def test_store_with_fewer_writes_than_acknowledged_ones_has_lost_some():
    identity = StoreIdentity(None)
    verify(identity, "g1", {"zones": 3})
    identity.acknowledge("zones", 5)
    identity.acknowledge("zones", 4)  # the replies of two writes may overtake one another
    identity.acknowledge("areas", 1)
    verify(identity, "g1", {"zones": 6, "areas": 1})
    for writes in ({"zones": 4, "areas": 1}, {"zones": 5}):
        with pytest.raises(StoreLostError, match="went back to an older state"):
            verify(identity, "g1", writes)


def test_marker_that_cannot_be_read_or_written_is_named_with_the_remedy(tmp_path):
    (tmp_path / "folder.store").mkdir()
    with pytest.raises(StoreError, match=r"folder\.store can't be read .*: delete it"):
        verify(StoreIdentity(tmp_path / "folder.store"), "g1", {})
    (tmp_path / "file").touch()
    with pytest.raises(StoreError, match=r"can't be (read|written) "):
        verify(StoreIdentity(tmp_path / "file" / "x.store"), "g1", {})


def test_write_that_is_acknowledged_while_an_older_answer_travels_is_no_loss():
    identity = StoreIdentity(None)
    first = [identity.expectation() for _ in range(2)]
    for expected in first:  # two checks at once of a new store, the second of which was answered before the first
        identity.verify(expected, "g1", {})
    expected = identity.expectation()
    identity.acknowledge("zones", 1)
    identity.verify(expected, "g1", {})
    with pytest.raises(StoreLostError):
        verify(identity, "g1", {})
    verify(identity, "g1", {"zones": 1})
    assert LOST._value.get() == 0


def test_every_service_has_its_keys_and_no_key_has_two_writers():
    assert records.OWN.keys() == records.AUDITED.keys() == SERVICES.keys() - records.READ.keys()
    keys = [key for own in records.OWN.values() for key in own]
    assert len(keys) == len(set(keys))
    assert not set(keys) & set(records.BOOKKEEPING)


def test_every_kind_of_the_audit_trail_has_a_writer():
    assert {kind for kinds in records.AUDITED.values() for kind in kinds} == set(KINDS)


def test_line_of_a_service_names_each_of_its_keys_below_its_site():
    for service, own in records.OWN.items():
        line = redis_line(service, "secret", "lab").split()
        assert {f"~fog:lab:{key}" for key in own} <= set(line)
        others = {key for other, keys in records.OWN.items() if other != service for key in keys}
        assert not {f"~fog:lab:{key}" for key in others} & set(line)
        assert "secret" not in line
