"""Who gets the places of strangers, and whose turn is next."""

from fog_runtime.admission import FEW, Places

KNOWN = "192.168.7.9"


class Waiting:
    """A connection that wants a place."""

    def __init__(self, source):
        self.source = source
        self.places = None


def add(places, *sources):
    """Return whose connections were displaced by new ones of these sources."""
    displaced = [places.add(Waiting(source)) for source in sources]
    return [each.source for each in displaced if each is not None]


def take(places, number):
    """Return whose turn it is, one after another."""
    turns = []
    for _ in range(number):
        visitor = places.next()
        turns.append(visitor.source)
        places.remove(visitor)
    return turns


def test_oldest_of_the_source_with_the_most_is_displaced():
    places = Places(3)
    assert add(places, "a", "b", "b", "c") == ["b"]
    assert take(places, 3) == ["a", "b", "c"]


def test_source_from_which_somebody_was_admitted_keeps_its_place_among_many_others_and_is_next():
    strangers = [f"10.0.0.{number}" for number in range(50)]
    places = Places(10, {KNOWN})
    assert KNOWN not in add(places, KNOWN, *strangers)
    assert KNOWN in take(places, 2)


def test_source_from_which_somebody_was_admitted_gets_no_more_when_many_wait_there():
    places = Places(10, {KNOWN})
    assert add(places, *[KNOWN] * 30, *"abc") == [KNOWN] * 23
    assert set(take(places, 4)) == {KNOWN, *"abc"}


def test_others_have_their_turn_while_few_wait_at_a_source_from_which_somebody_was_admitted():
    places = Places(20, {KNOWN})
    add(places, *"abc", *[KNOWN] * FEW)
    assert set(take(places, 6)) == {KNOWN, *"abc"}
