"""Where other machines reach a server of this process; the routes are the kernel's own."""

import pytest

from fog_runtime.machine.own_address import reachable_address


def test_server_on_every_address_is_announced_with_the_address_on_the_way_to_the_fog():
    assert reachable_address("0.0.0.0", 9100, ["tcp/127.0.0.1:7447"]) == "127.0.0.1:9100"


def test_server_on_one_address_is_announced_with_it():
    assert reachable_address("192.0.2.7", 9100, ["tcp/127.0.0.1:7447"]) == "192.0.2.7:9100"


def test_server_on_the_loopback_is_announced_to_a_fog_on_the_same_machine():
    assert reachable_address("127.0.0.1", 9100, ["tcp/127.0.0.1:7447"]) == "127.0.0.1:9100"


def test_endpoint_that_nobody_knows_is_passed_over():
    endpoints = ["tcp/nowhere.invalid:7447", "tcp/127.0.0.1:7447?rel=1"]
    assert reachable_address("0.0.0.0", 9100, endpoints) == "127.0.0.1:9100"


def test_address_of_version_6_is_put_in_brackets():
    assert reachable_address("::", 9100, ["tcp/[::1]:7447"]) in ("[::1]:9100", "")  # empty: a kernel without IPv6


@pytest.mark.parametrize("endpoints", [[], ["tcp/nowhere.invalid:7447"], ["tcp/127.0.0.1"], ["tcp/127.0.0.1:door"]])
def test_nothing_is_announced_without_a_way_to_the_fog(endpoints):
    assert reachable_address("0.0.0.0", 9100, endpoints) == ""


def test_loopback_is_not_announced_to_a_fog_elsewhere(monkeypatch):
    monkeypatch.setattr("fog_runtime.machine.own_address._own_side", lambda _towards: "192.0.2.20")
    assert reachable_address("127.0.0.1", 9100, ["tcp/192.0.2.1:7447"]) == ""
    assert reachable_address("localhost", 9100, ["tcp/192.0.2.1:7447"]) == ""
