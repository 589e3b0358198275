"""One source for the servers' configurations: deployed servers are configured like those of demo and tests."""

import re
from pathlib import Path

import pytest
import yaml

from fog_contracts.channels import CHANNELS
from fog_runtime import broker, router
from fog_runtime.security.site_security import SiteSecurity
from fog_supervisor import configurations
from fog_supervisor.net import LOOPBACK
from fog_supervisor.servers import (
    mosquitto_program,
    redis_program,
    router_program,
    start_mosquitto,
    start_redis,
    start_router,
)

ROOT = Path(__file__).parents[3]
INSTANCE_SETTINGS = ("listener ", "persistence_location ", "user ", "bind ", "tls-port ", "dir ")


def shared_lines(text: str) -> list[str]:
    """Return the lines that must be the same for every instance of a server."""
    return [line for line in text.splitlines() if line and not line.startswith(INSTANCE_SETTINGS)]


def test_deployed_configurations_are_up_to_date() -> None:
    assert configurations.stale(ROOT / "deploy") == []


def test_stale_configuration_is_reported_with_the_remedy(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert configurations.main(["--write", str(tmp_path)]) == 0
    assert configurations.main(["--check", str(tmp_path)]) == 0
    (tmp_path / "redis" / "redis.conf").write_text("appendfsync everysec\n")
    assert configurations.main(["--check", str(tmp_path)]) == 1
    assert "redis.conf is stale: run python -m fog_supervisor.configurations --write" in capsys.readouterr().out


def test_private_servers_have_the_limits_durability_and_security_of_deployed_ones(tmp_path: Path) -> None:
    deployed = configurations.deployed()
    security = Path(configurations.DEPLOYED_SECURITY)
    mosquitto_program(tmp_path, 1, security=security)
    redis_program(tmp_path, 1, security=security)
    for name in ("mosquitto", "redis"):
        private = (tmp_path / f"{name}.conf").read_text()
        assert shared_lines(private) == shared_lines(deployed[f"{name}/{name}.conf"])
        assert "0.0.0.0" not in private


def test_compose_starts_the_relay_of_the_broker_with_the_arguments_of_a_private_one(tmp_path: Path) -> None:
    service = yaml.safe_load((ROOT / "docker-compose.yml").read_text())["services"]["mosquitto-relay"]
    assert service["entrypoint"] == ["python", "-m", broker.__name__]
    security = Path(configurations.DEPLOYED_SECURITY)
    private = mosquitto_program(tmp_path, 8883, address="0.0.0.0", security=security).command
    given = [text for argument in service["command"] for text in argument.split("=", 1)]
    assert given[: given.index("--to")] == list(private[3 : private.index("--configuration")])
    (listener,) = re.findall(r"^listener (.*)$", configurations.deployed()["mosquitto/mosquitto.conf"], re.MULTILINE)
    assert ["0", given[given.index("--to") + 1]] == listener.split()


def test_compose_starts_the_router_with_the_arguments_of_a_private_one() -> None:
    service = yaml.safe_load((ROOT / "docker-compose.yml").read_text())["services"]["zenoh"]
    given = [tuple(argument.split("=", 1)) for argument in service["command"]]
    endpoint = dict(given)["--listen"]
    security = configurations.DEPLOYED_SECURITY
    # Only in a container somebody asks the process itself whether it is well.
    routing = [pair for pair in given if not pair[0].startswith("--health-")]
    assert len(routing) == len(given) - 2
    assert [text for pair in routing for text in pair] == configurations.router_arguments(endpoint, security=security)
    assert service["build"]["args"]["MODULE"] == router.__name__
    private = router_program(7447, security=Path(security))
    arguments = configurations.router_arguments(private.url, security=security)
    assert list(private.command[1:]) == ["-m", router.__name__, *arguments]


def test_every_mqtt_message_fits_into_the_brokers_packet_limit() -> None:
    largest = max(channel.limit for channel in CHANNELS.values() if channel.transport == "mqtt")
    assert largest + 1024 < configurations.MQTT_PACKET_LIMIT  # topic and properties


@pytest.mark.live
def test_servers_start_in_a_folder_with_a_space_in_its_name(tmp_path: Path) -> None:
    security = SiteSecurity(tmp_path / "my credentials", "lab")
    security.make(["localhost", LOOPBACK])
    with (
        start_redis(tmp_path / "my data", security=security.folder("redis")) as redis,
        start_mosquitto(tmp_path / "my broker", security=security.folder("mosquitto")),
        start_router(tmp_path / "my router", security=security.folder("zenoh")),
    ):
        assert (redis.folder / "appendonlydir").exists()
