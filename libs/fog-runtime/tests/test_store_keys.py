"""What each service may write in Redis follows from the keys that its store uses."""

from fog_runtime.locks.users import SERVICES, redis_line
from fog_runtime.stores import store_scripts
from fog_runtime.stores.audit import KINDS


def test_every_service_has_its_keys_and_no_key_has_two_writers():
    assert store_scripts.OWN.keys() == store_scripts.AUDITED.keys() == SERVICES.keys()
    keys = [key for own in store_scripts.OWN.values() for key in own]
    assert len(keys) == len(set(keys))
    assert not set(keys) & set(store_scripts.BOOKKEEPING)


def test_every_kind_of_the_audit_trail_has_a_writer():
    assert {kind for kinds in store_scripts.AUDITED.values() for kind in kinds} == set(KINDS)


def test_line_of_a_service_names_each_of_its_keys_below_its_site():
    for service, own in store_scripts.OWN.items():
        line = redis_line(service, "secret", "lab").split()
        assert {f"~fog:lab:{key}" for key in own} <= set(line)
        others = {key for other, keys in store_scripts.OWN.items() if other != service for key in keys}
        assert not {f"~fog:lab:{key}" for key in others} & set(line)
        assert "secret" not in line
