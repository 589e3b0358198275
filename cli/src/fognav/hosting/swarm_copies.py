"""Two copies of what a floor runs, on machines of its own: the services of a stack with three machines.

Two machines run everything but Prometheus and Grafana, the third one Redis and a Sentinel alone, so that two of three
can always tell who is cut off. Services take turns by their lease (ADR 12), the servers share all that they have, and
each gateway asks the copy that leads. Names of the second and third machine's services end in `-2` and `-3`.
"""

import copy
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from fog_runtime.credentials import Credentials, to_toml
from fog_runtime.security.users import PEER
from fog_supervisor import configurations
from fog_supervisor.configurations import SENTINEL_PORT, STORE, Peer

_Part = dict[str, Any]

MACHINES: Final = 3
SERVICES: Final = ("hazard-aggregator", "map-service", "planner", "console-service")
_TWICE: Final = ("mosquitto", "mosquitto-relay", "zenoh", *SERVICES, "gateway")
_REDIS: Final = "redis"
_SENTINEL: Final = "sentinel"
_COPY: Final = "./deploy/redis/copy:/etc/redis/copy:ro"
_GATEWAYS: Final = "gateways"
"""The name of both gateways for those that believe them."""
_PORTS: Final = {"AGGREGATOR": 8001, "MAP": 8002, "PLANNER": 8003}
"""Where each gateway has the services by themselves."""
_LEADER: Final = """\
		lb_policy first
		lb_try_duration 3s
		health_uri /leads
		health_interval 500ms
		health_timeout 1s
"""
"""How a gateway finds the copy that leads; what comes during a takeover waits for it."""
_UPSTREAM: Final = re.compile(rf"reverse_proxy ({'|'.join(SERVICES)}):8000 {{\n")
_TARGET: Final = re.compile(rf'"({"|".join(SERVICES)}):8000"')
_GIVE_UP: Final = {"net.ipv4.tcp_retries2": 5}
"""After 13 s without an acknowledgement a connection ends, rather than after 15 minutes: zenoh waits for that before it
gives a link up to whose other end it sends much, and so for a router that was cut off."""
_PROCESS: Final = '"([^:]+):.*"'


def named(service: str, machine: int) -> str:
    """Return what a service is called on one of the floor's machines, which count from 1."""
    return service if machine == 1 else f"{service}-{machine}"


HOSTS: Final = tuple(
    named(server, machine)
    for server in ("mosquitto", _REDIS, _SENTINEL, "zenoh", "gateway")
    for machine in range(1, MACHINES + 1)
)
"""The names by which the copies reach one another's servers."""


def with_copies(base: Mapping[str, Any]) -> _Part:
    """Return a compose file's services and networks with the copies, each with its `x-machine`.

    `x-of` is the service that it is a copy of. The others are on the first machine.
    """
    services: _Part = {}
    for name, service in base["services"].items():
        for machine in range(1, MACHINES + 1):
            if machine == 1 or (machine == 2 and name in _TWICE) or name == _REDIS:
                made = _on(copy.deepcopy(service), name, machine)
                services[named(name, machine)] = made
                if name == _REDIS:
                    services[named(_SENTINEL, machine)] = _sentinel(made)
    return {**base, "services": services, "networks": {**base["networks"], "brokers": {"internal": True}}}


def _on(service: _Part, name: str, machine: int) -> _Part:
    """Return a service as it is on one of the machines."""
    service |= {"x-machine": machine, "x-of": name}
    other = 3 - machine
    both = (machine, other)
    if machine > 1:  # two machines with the same label by mistake must not share data
        service["volumes"] = [re.sub(r"^([a-z-]+)(?<!-locks):", rf"\1-{machine}:", each) for each in service["volumes"]]
    if name in (*SERVICES, "zenoh"):
        service["sysctls"] = _GIVE_UP
    if name in SERVICES:
        sentinels = ",".join(f"{named(_SENTINEL, each)}:{SENTINEL_PORT}" for each in range(1, MACHINES + 1))
        service["environment"] = {
            **service["environment"],
            "FOGNAV_REDIS_URL": f"rediss+sentinel://{sentinels}/{STORE}/0?wait=1",
            "FOGNAV_ZENOH_CONNECT": ",".join(f"tls/{named('zenoh', each)}:7447" for each in both),
            "FOGNAV_MQTT_URL": ",".join(f"mqtts://{named('mosquitto', each)}:8883" for each in both),
            "FOGNAV_HTTP_GATEWAY": _GATEWAYS,
        }
    match name:
        case "console-service":
            urls = {
                f"FOGNAV_{each}_URL": f"https://{named('gateway', machine)}:{port}" for each, port in _PORTS.items()
            }
            service["environment"] |= urls
        case "gateway":
            service["networks"] = {"outside": None, "web": {"aliases": [_GATEWAYS]}}
        case "zenoh":
            service["command"] += [f"--connect=tls/{named('zenoh', other)}:7447", "--credentials=/run/locks/peer.toml"]
        case "mosquitto-relay":
            brokers = {"brokers": {"aliases": ["mosquitto"]}} if machine == 1 else {}
            service["networks"] = {"nodes": {"aliases": [named("mosquitto", machine)]}, **brokers}
        case "mosquitto" if machine == 2:
            # It connects to the other one's relay; still only its own relay reaches it.
            service["networks"] = ["brokers"]
            service["command"] += ["/run/locks/mosquitto.conf"]
        case "redis":
            service["volumes"].append(_COPY)
            service["command"] = ["sh", "/etc/redis/copy", *([_REDIS] if machine > 1 else [])]
    return service


def _sentinel(redis: _Part) -> _Part:
    """Return the Sentinel beside a Redis server."""
    check = f"redis-cli --tls --cacert /run/locks/authority.pem -p {SENTINEL_PORT} ping | grep -q PONG"
    data = named(_SENTINEL, redis["x-machine"])
    return {
        **copy.deepcopy(redis),
        "x-of": _SENTINEL,
        "command": ["sh", "/etc/redis/copy", "sentinel"],
        "volumes": [_COPY, "sentinel-locks:/run/locks:ro", f"{data}:/data"],
        "mem_limit": "64m",
        "healthcheck": {**redis["healthcheck"], "test": ["CMD-SHELL", check]},
    }


def shared_secrets(secrets: Mapping[str, Mapping[str, bytes]], peer: Credentials) -> dict[str, dict[str, bytes]]:
    """Return all services' secrets, with those of `peer`, by which copies know one another."""
    found = {name: dict(secrets[name]) for name in secrets}
    authority = peer.authority.encode()
    for machine in range(1, MACHINES + 1):
        of_redis = {**found[_REDIS], "copies.conf": configurations.replicated(_peer(peer, "redis", machine)).encode()}
        watches = f"{_REDIS} {configurations.REDIS_PORT}"
        text = configurations.sentinel(watches, "/data", _peer(peer, "redis", machine, _SENTINEL))
        kept = {name: found[_REDIS][name] for name in ("server.pem", "server.key", "authority.pem")}
        found[named(_SENTINEL, machine)] = {**kept, "sentinel.conf": text.encode()}
        found[named(_REDIS, machine)] = of_redis
    router = to_toml(PEER, authority=peer.authority, passwords={"zenoh": peer.passwords["zenoh"]})
    found["zenoh"]["peer.toml"] = router.encode()
    for name in _TWICE:
        found[named(name, 2)] = dict(found[name])
    broker = configurations.deployed()["mosquitto/mosquitto.conf"]
    broker += configurations.bridge("mosquitto:8883", _peer(peer, "mqtt", 1))
    found[named("mosquitto", 2)] |= {"mosquitto.conf": broker.encode(), "authority.pem": authority}
    return found


def _peer(peer: Credentials, server: str, machine: int, program: str = "") -> Peer:
    return Peer(name=named(program or server, machine), user=peer.user, password=peer.passwords[server])  # type: ignore[index]  # one of three


def shared_files(deploy: Path) -> dict[str, bytes]:
    """Return the configuration files that say of two copies, by their paths below `deploy`."""
    gateway = (deploy / "gateway" / "Caddyfile").read_text("utf-8")
    gateway, doubled = _UPSTREAM.subn(rf"reverse_proxy \1:8000 \1-2:8000 {{\n{_LEADER}", gateway)
    gateway = gateway.replace("in [502, 504]", "in [502, 503, 504]")
    prometheus = (deploy / "prometheus" / "prometheus.yml").read_text("utf-8")
    prometheus, asked = _TARGET.subn(r'"\1:8000", "\1-2:8000"', prometheus)
    assert doubled == asked == len(SERVICES), "the gateway or Prometheus names a service in another way"
    # Alerts and dashboards name a service, whichever copy it is.
    prometheus = prometheus.replace(_PROCESS, '"([^:]+?)(?:-2)?:.*"', 1)
    return {"gateway/Caddyfile": gateway.encode(), "prometheus/prometheus.yml": prometheus.encode()}
