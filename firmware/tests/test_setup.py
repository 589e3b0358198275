"""The set-up portal, messages that come in parts, and updates over the air, without a board."""

import ctypes
import hashlib
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fog_contracts import channels as ch
from fog_contracts.codec import encode
from fog_contracts.messages import NodeUpdate

FORM = {
    "site": "lab", "node": "n1", "wifi_name": 'caf\u00e9 "1"', "wifi_password": "se\\cret", "broker": "fog.lan",
    "user": "n1", "password": "p", "tls": "1", "profile": "thesis", "range_limit_m_0": "1.8",
}  # fmt: skip
PEM = "-----BEGIN CERTIFICATE-----\nMIIB\n-----END CERTIFICATE-----\n"


def submitted(core, form, before=None):
    """Return node.json of a form, or what is wrong with it; `before` is the one that the node has."""
    flat = [text.encode() for pair in form.items() for text in pair]
    pairs = (ctypes.c_char_p * (len(flat) + 1))(*flat, None)
    buffer = ctypes.create_string_buffer(2049)
    function = core["fognav_form_settings"]
    function.restype = ctypes.c_char_p
    had = b"" if before is None else json.dumps(before, indent=1).encode()
    problem = function(pairs, had, buffer, ctypes.c_uint32(len(buffer)))
    return json.loads(buffer.value) if problem is None else problem.decode()


def test_form_becomes_settings(core):
    expected = {name: text for name, text in FORM.items() if not name.startswith("range")}
    assert submitted(core, FORM) == {**expected, "tls": True, "port": 8883, "sonars": [{"range_limit_m": 1.8}]}
    assert submitted(core, {**FORM, "tls": ""}).keys() == expected.keys() - {"tls"} | {"sonars"}, "TLS by default"
    plain = submitted(core, {**FORM, "tls": "0", "range_limit_m_1": "2,25"})
    assert (plain["tls"], plain["port"]) == (False, 1883)
    assert plain["sonars"] == [{"range_limit_m": 1.8}, {"range_limit_m": 2.25}]


BEFORE = {
    "site": "lab", "node": "n1", "wifi_name": "old", "wifi_password": "secret", "broker": "fog.lan", "port": 8884,
    "tls": True, "user": "n1", "password": "p", "button": 0, "update_key": "04" + "ab" * 64, "every_reading": True,
    "sonars": [
        {"sensor": "vl53l1x", "shutdown": 13, "range_limit_m": 1.8, "range_max_m": 2.3},
        {"trigger": 12, "echo": 14, "range_limit_m": 2, "no_echo_is_clear": True},
        {"sensor": "vl53l1x", "shutdown": 15, "range_limit_m": 1},
    ],
    "values": [{"kind": "gas", "sensor": "analog", "full_scale_v": 3.3}],
}  # fmt: skip


def test_form_changes_what_is_filled_in_and_leaves_all_else_of_the_settings(core):
    empty = dict.fromkeys(FORM, "")
    assert submitted(core, empty, BEFORE) == BEFORE
    password = {"wifi_password": "secret12"}
    assert submitted(core, {**empty, **password}, BEFORE) == {**BEFORE, **password}
    assert submitted(core, {**empty, "tls": "0"}, BEFORE) == {**BEFORE, "tls": False, "port": 1883}
    first, second, third = BEFORE["sonars"]
    limits = {"range_limit_m_0": "1.5", "range_limit_m_1": "2.5"}
    changed = [{**first, "range_limit_m": 1.5}, {**second, "range_limit_m": 2.5}, third]
    assert submitted(core, {**empty, **limits}, BEFORE) == {**BEFORE, "sonars": changed}
    one = {**BEFORE, "sonars": [{"range_limit_m": 1.8}]}
    more = [{"range_limit_m": 1.8}, {"range_limit_m": 2.0}]
    assert submitted(core, {**empty, "range_limit_m_1": "2"}, one)["sonars"] == more


@pytest.mark.parametrize(
    ("name", "of_it"), [("wifi_name", {"wifi_password": "secret12"}), ("broker", {"user": "n2", "password": "q"})]
)
def test_other_network_or_broker_is_not_given_the_passwords_of_the_one_before_and_may_have_none(core, name, of_it):
    empty, other = dict.fromkeys(FORM, ""), {name: "another"}
    rest = {key: value for key, value in BEFORE.items() if key not in of_it}
    assert submitted(core, {**empty, **other}, BEFORE) == {**rest, **other}
    assert submitted(core, {**empty, **other, **of_it}, BEFORE) == {**BEFORE, **other, **of_it}
    merged = submitted(core, {**empty, **other}, {**BEFORE, "second_broker": "b"})
    assert ("second_broker" in merged) == (name != "broker")


def test_settings_that_are_not_valid_leave_nothing_in_a_form(core):
    damaged = {**BEFORE, "broker": ""}
    assert submitted(core, FORM, damaged) == submitted(core, FORM)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"site": ""}, "site is missing"),
        ({"broker": ""}, "broker is missing"),
        ({"range_limit_m_0": ""}, "range limit of the first sensor"),
        ({"range_limit_m_0": "far"}, "not in metres"),
        ({"range_limit_m_0": "1.8m"}, "not in metres"),
        ({"range_limit_m_0": "1234"}, "not in metres"),
        ({"range_limit_m_0": "21"}, "20 m"),
        ({"wifi_name": "x" * 3000}, "too long"),
        ({"wifi_name": "x" * 300}, "too long"),
        ({"profile": "best"}, "neither standard"),
        ({"provisioning": "{}"}, "site is missing"),
        ({"provisioning": "x" * 3000}, "longer than 2 KB"),
    ],
)
def test_form_that_lacks_something_is_refused_in_words(core, change, words):
    assert words in submitted(core, {**FORM, **change})


@given(st.dictionaries(st.sampled_from(sorted(FORM)), st.text(st.characters(codec="utf-8", exclude_characters="\0"))))
def test_whatever_is_typed_gives_settings_that_say_the_same_or_is_refused(core, typed):
    found = submitted(core, {**FORM, **typed})
    if isinstance(found, dict):
        for name in ("wifi_name", "wifi_password", "broker"):
            visible = "".join(c for c in typed.get(name, FORM[name]) if c >= " " and c != "\x7f")
            assert found.get(name, "") == visible


def test_provisioning_file_counts_before_the_fields(core):
    settings = {
        "site": "estig", "node": "n2", "wifi_name": "w", "broker": "b", "sonars": [{"range_limit_m": 1}],
    }  # fmt: skip
    assert submitted(core, {**FORM, "provisioning": json.dumps(settings)}) == settings


@pytest.mark.parametrize(
    ("pem", "tls", "words"),
    [
        (PEM, True, None),
        (b"", False, None),
        ("", True, "ca.pem is missing"),
        ("MIIB", True, "no certificate"),
        (PEM * 100, True, "longer than 4 KB"),
    ],
)
def test_certificate_of_the_portal(core, pem, tls, words):
    function = core["fognav_authority_problem"]
    function.restype = ctypes.c_char_p
    found = function(pem.encode() if isinstance(pem, str) else pem, int(tls))
    assert found is None if words is None else words in found.decode()


def test_page_has_every_field_that_the_form_reads(core):
    function = core["fognav_portal_page"]
    function.restype = ctypes.c_char_p
    page = function().decode()
    assert all(f"name={name}" in page for name in [*FORM, "provisioning", "authority", "range_limit_m_1"])
    name = ctypes.create_string_buffer(16)
    core["fognav_portal_name"](ctypes.c_uint32(0x1200ABCD), name)
    assert name.value == b"fognav-00abcd"


class Portal:
    """The switch of a portal, whose button a test holds; a step takes 100 ms."""

    def __init__(self, core, *, has_settings):
        self._core = core
        new = core["fognav_portal_new"]
        new.restype = ctypes.c_void_p
        self._portal = ctypes.c_void_p(new(int(has_settings)))
        self._now = 2**32 - 2000

    def run(self, seconds, *, pressed=False):
        for _ in range(round(seconds * 10)):
            self._now += 100
            is_open = self._core["fognav_portal_step"](self._portal, int(pressed), ctypes.c_uint32(self._now % 2**32))
        return bool(is_open)

    def request(self):
        self._core["fognav_portal_request"](self._portal, ctypes.c_uint32(self._now % 2**32))

    def close(self):
        self._core["fognav_portal_free"](self._portal)


@pytest.fixture
def portal(core):
    made = Portal(core, has_settings=True)
    yield made
    made.close()


class Inbox:
    """What a node lab/n1 receives."""

    def __init__(self, core):
        new, self._take = core["fognav_inbox_new"], core["fognav_inbox_take"]
        new.restype = ctypes.c_void_p
        self._free = core["fognav_inbox_free"]
        self._inbox = ctypes.c_void_p(new(b"lab", b"n1"))

    def part(self, topic, part, index, total):
        text, size = ctypes.create_string_buffer(1024), ctypes.c_uint32()
        found = self._take(
            self._inbox, topic.encode(), part, ctypes.c_uint32(len(part)), ctypes.c_uint32(index),
            ctypes.c_uint32(total), text, ctypes.byref(size),
        )  # fmt: skip
        return (found, text.raw[: size.value]) if found >= 0 else None

    def close(self):
        self._free(self._inbox)


@pytest.fixture
def inbox(core):
    made = Inbox(core)
    yield made
    made.close()


TOPICS = [channel.key(site="lab", node="n1") for channel in (ch.NODE_CONFIG, ch.NODE_COMMAND, ch.NODE_UPDATE)]


@given(st.lists(st.tuples(st.sampled_from([0, 1, 2]), st.binary(max_size=32), st.integers(1, 8)), max_size=8))
def test_several_messages_are_each_put_together_of_their_parts(core, messages):
    inbox = Inbox(core)
    for kind, text, part in messages:
        pieces = range(0, len(text), part) if text else [0]
        taken = [inbox.part(TOPICS[kind], text[at : at + part], at, len(text)) for at in pieces]
        assert taken[-1] == (kind, text)
        assert taken[:-1] == [None] * (len(taken) - 1)
    inbox.close()


def test_message_that_is_too_long_foreign_or_incomplete_is_left_out(inbox):
    assert inbox.part(TOPICS[0], b"x" * 100, 0, 1025) is None
    assert inbox.part(TOPICS[0], b"x" * 100, 100, 1025) is None
    assert inbox.part(TOPICS[1], b"x" * 33, 0, 33) is None
    assert inbox.part("fog/v1/lab/nodes/n2/command", b"calibrate", 0, 9) is None
    assert inbox.part(TOPICS[0], b"ab", 0, 6) is None
    assert inbox.part(TOPICS[0], b"ef", 4, 6) is None  # a part is missing
    assert inbox.part(TOPICS[0], b"abc", 0, 2) is None
    assert inbox.part(TOPICS[1], b"calibrate", 0, 9) == (1, b"calibrate")


IMAGE = bytes(range(256)) * 20


class UpdateBoard:
    """A board that is updated: a test chooses what fails."""

    RUNNING = 5

    def __init__(self, core, remembered=0):
        self.calls, self.flash, self.remembered, self.started = [], b"", None, False
        self.good, self.reachable, self.room, self.writable, self.accepts = True, True, True, True, True
        self.sends = IMAGE
        self.stalls_at = self.lost_at = len(IMAGE) + 1
        self._core, self._now, self._sent = core, 2**32 - 1000, 0
        integer, text, data = ctypes.c_int, ctypes.c_char_p, ctypes.POINTER(ctypes.c_uint8)
        size = ctypes.c_uint32
        kinds = {
            "signature_is_good": (integer, text, size, data, size), "open": (integer, text, size),
            "fetch": (integer, data, size), "close": (None,), "begin_flash": (integer, size),
            "write_flash": (integer, data, size), "commit_flash": (integer,), "abandon_flash": (None,),
            "begin_hash": (None,), "add_to_hash": (None, data, size), "end_hash": (None, data),
            "remember": (None, size), "restart": (None,),
        }  # fmt: skip
        table = type("Table", (ctypes.Structure,), {"_fields_": [(n, ctypes.CFUNCTYPE(*k)) for n, k in kinds.items()]})
        self._table = table(*(ctypes.CFUNCTYPE(*kind)(getattr(self, "_" + name)) for name, kind in kinds.items()))
        new = core["fognav_updater_new"]
        new.restype = ctypes.c_void_p
        self._updater = ctypes.c_void_p(new(ctypes.byref(self._table), size(self.RUNNING), size(remembered)))
        self._offer, self._step = core["fognav_updater_offer"], core["fognav_updater_step"]
        self._offer.restype = self._step.restype = text

    def _signature_is_good(self, text, size, signature, length):
        self.signed, self.signature = text[:size].decode(), bytes(signature[:length])
        return self.good

    def _open(self, url, size):
        self.calls.append(("open", url.decode(), size))
        self._sent = 0
        return self.reachable

    def _fetch(self, buffer, size):
        if self._sent >= self.lost_at:
            return -1
        if self._sent >= self.stalls_at:
            return 0
        piece = self.sends[self._sent : self._sent + min(size, 300)]
        ctypes.memmove(buffer, piece, len(piece))
        self._sent += len(piece)
        return len(piece)

    def _close(self):
        self.calls.append(("close",))

    def _begin_flash(self, _size):
        self.flash = b""
        return self.room

    def _write_flash(self, data, size):
        self.flash += bytes(data[:size])
        return self.writable

    def _commit_flash(self):
        return self.accepts

    def _abandon_flash(self):
        self.calls.append(("abandon",))

    def _begin_hash(self):
        self._hash = hashlib.sha256()

    def _add_to_hash(self, data, size):
        self._hash.update(bytes(data[:size]))

    def _end_hash(self, buffer):
        ctypes.memmove(buffer, self._hash.digest(), 32)

    def _remember(self, number):
        self.remembered = number

    def _restart(self):
        self.started = True

    def offer(self, **change):
        message = NodeUpdate(**{
            "number": 6, "board": "d1-mini", "size": len(IMAGE), "sha256": hashlib.sha256(IMAGE).hexdigest(),
            "signature": "3006020101020101", "url": "http://fog.local/n1.bin", **change,
        })  # fmt: skip
        return self.offer_text(encode(ch.NODE_UPDATE, message))

    def offer_text(self, text):
        now = ctypes.c_uint32(self._now % 2**32)
        found = self._offer(self._updater, text, ctypes.c_uint32(len(text)), now)
        return found and found.decode()

    def run(self, seconds):
        """Return the problems of that time."""
        problems = []
        for _ in range(round(seconds * 10)):
            self._now += 100
            found = self._step(self._updater, ctypes.c_uint32(self._now % 2**32))
            if found is not None:
                problems.append(found.decode())
        return problems

    @property
    def busy(self):
        return bool(self._core["fognav_updater_busy"](self._updater))

    def close(self):
        self._core["fognav_updater_free"](self._updater)


@pytest.fixture
def board(core):
    made = UpdateBoard(core)
    yield made
    made.close()


def test_signed_update_is_fetched_in_pieces_checked_and_started(board):
    assert board.offer() is None
    assert board.signed == f"fognav-firmware\nd1-mini\n6\n{len(IMAGE)}\n{hashlib.sha256(IMAGE).hexdigest()}\n"
    assert board.signature == bytes.fromhex("3006020101020101")
    assert board.run(10) == []
    assert board.flash == IMAGE
    assert (board.remembered, board.started, board.busy) == (6, True, False)
    assert board.calls == [("open", "http://fog.local/n1.bin", len(IMAGE)), ("close",)]


@pytest.mark.parametrize(
    ("change", "words"),
    [({"number": 4}, "older than what runs"), ({"board": "d1-mini32"}, "another board")],
)
def test_update_that_does_not_fit_is_refused(board, change, words):
    assert words in board.offer(**change)
    assert board.run(10) == []
    assert board.calls == []


@pytest.mark.parametrize("remembered", [6, 7])
def test_what_runs_or_was_installed_is_not_installed_again(core, remembered):
    """Even an image that calls itself older than the number with which it was signed."""
    board = UpdateBoard(core, remembered)
    found = board.offer()
    assert ("did not stay" if remembered == 6 else "older") in found
    assert board.run(10) == []
    assert board.calls == []
    board.close()


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ({"reachable": False}, "does not answer"),
        ({"room": False}, "too large"),
        ({"writable": False}, "can't be written"),
        ({"lost_at": 600}, "was lost"),
        ({"stalls_at": 600}, "nothing for 30 s"),
        ({"sends": IMAGE[:-1] + b"x"}, "not what was signed"),
    ],
)
def test_update_that_fails_is_tried_three_times_and_starts_nothing(board, fault, words):
    for name, value in fault.items():
        setattr(board, name, value)
    assert board.offer() is None
    problems = board.run(1100)
    assert len(board.flash) < len(IMAGE), "a board may take a flash that is complete for an image to start"
    assert len(problems) == 3
    assert all(words in problem for problem in problems)
    assert not board.started
    assert board.remembered is None
    assert board.offer() is None  # the broker delivers it again with each connection
    assert not board.busy
    assert board.offer(number=7) is None
    assert board.busy


def test_update_that_was_refused_does_not_count_as_tried_once_it_is_signed_well(board):
    """After another one that failed: a forged offer must not keep the true one of its number away."""
    board.reachable = False
    assert board.offer() is None
    assert len(board.run(1100)) == 3
    board.reachable, board.good = True, False
    assert "not signed by the key" in board.offer(number=7)
    board.good = True
    assert board.offer(number=7) is None
    assert board.run(10) == []
    assert board.remembered == 7


def test_update_that_fails_once_succeeds_five_minutes_later(board):
    board.reachable = False
    assert board.offer() is None
    assert len(board.run(1)) == 1
    board.reachable = True
    assert board.run(290) == []
    assert not board.started
    assert board.run(30) == []
    assert board.started


def test_offer_with_a_corrected_address_is_taken_between_the_attempts_of_the_wrong_one(board):
    board.reachable = False
    assert board.offer(url="http://fog.local/misspelt.bin") is None
    assert len(board.run(1)) == 1
    board.reachable = True
    assert board.offer() is None
    assert board.run(10) == []
    assert (board.started, board.remembered) == (True, 6)


def test_newer_offer_ends_the_fetch_of_an_older_one_and_a_refused_one_does_not(board):
    board.stalls_at = 600
    assert board.offer() is None
    assert board.run(1) == []
    assert "older" in board.offer(number=4)
    assert board.offer() is None
    assert board.calls == [("open", "http://fog.local/n1.bin", len(IMAGE))], "what is under way goes on"
    board.stalls_at = 10**9
    assert board.offer(number=7) is None
    assert board.calls[1:] == [("close",), ("abandon",)]
    assert board.run(10) == []
    assert (board.started, board.remembered) == (True, 7)


def test_update_that_the_board_itself_refuses_is_not_tried_again(board):
    board.accepts = False
    assert board.offer() is None
    assert "the board refuses" in board.run(10)[0]
    assert not board.started
    assert board.offer() is None
    assert not board.busy


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{}", "lacks its"),
        ("[]", "not a JSON object"),
        ('{"number": 1.5}', "whole number"),
        ('{"size": 5000000}', "whole number"),
        ('{"sha256": "xy"}', "64 hexadecimal"),
        ('{"signature": "xy"}', "hexadecimal"),
        ('{"url": 3}', "wrong type"),
        ('{"more": [1]}', "lacks its"),
    ],
)
def test_malformed_offer_is_refused_in_words(board, text, words):
    assert words in board.offer_text(text.encode())


def test_withdrawn_offer_is_not_fetched_any_further_and_may_come_again(board):
    board.stalls_at = 600
    assert board.offer() is None
    assert board.run(1) == []
    assert board.offer_text(b"") is None
    assert board.calls[1:] == [("close",), ("abandon",)]
    assert board.run(1000) == []
    assert not board.busy
    board.stalls_at = 10**9
    assert board.offer() is None
    assert board.run(10) == []
    assert board.started
