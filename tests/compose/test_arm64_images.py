"""Our images for 64-bit ARM, the processor of a Raspberry Pi: built, started and looked into on an emulator of it.

This takes a quarter of an hour and more, so it runs only where FOGNAV_ARM64_BASE names a base image for that processor,
in an engine whose kernel runs the emulator (docs/operations.md, "Images for a Raspberry Pi, made elsewhere").
"""

from __future__ import annotations

import json
import os
import secrets
import subprocess
from typing import TYPE_CHECKING, Any, Final

import pytest
import yaml
from compose_project import BUILD_S, HEALTHY_S, MEGABYTES, ROOT, docker, has, skip_reason, wait

if TYPE_CHECKING:
    from collections.abc import Iterator

BASE: Final = os.environ.get("FOGNAV_ARM64_BASE", "")
PLATFORM: Final = "linux/arm64"
EMULATED: Final = 20.0
"""How much longer a program may take than on the machine's own processor."""
SERVICES: Final = yaml.safe_load((ROOT / "docker-compose.yml").read_text("utf-8"))["services"]
IMAGES: Final[dict[str, dict[str, Any]]] = {
    service["image"].removeprefix("fognav/"): service["build"] for service in SERVICES.values() if "build" in service
}
ALL: Final = sorted(IMAGES)
COMPILING: Final = [name for name in ALL if "KERNELS" in IMAGES[name]["args"]]

SKIP_REASON: Final = skip_reason() if BASE else "set FOGNAV_ARM64_BASE to a base image for arm64 (docs/operations.md)"
pytestmark = [
    pytest.mark.compose,
    pytest.mark.timeout(EMULATED * BUILD_S),
    pytest.mark.skipif(SKIP_REASON is not None, reason=SKIP_REASON or ""),
]


@pytest.fixture(scope="module")
def image(request: pytest.FixtureRequest) -> Iterator[str]:
    """Yield the name of one of our images, built for ARM, and remove it; the builder's cache keeps its layers."""
    name, build = f"fognav-arm64-test/{request.param}", IMAGES[request.param]
    arguments = [
        part for key, value in build["args"].items() if key != "REVISION" for part in ("--build-arg", f"{key}={value}")
    ]
    network = [] if has("network", "bridge") else ["--network", "host"]
    docker(
        "build", "--quiet", "--platform", PLATFORM, *network, "--file", str(ROOT / build["dockerfile"]), "--tag", name,
        "--build-arg", f"BASE={BASE}", *arguments, str(ROOT), timeout_s=EMULATED * BUILD_S,
    )  # fmt: skip
    yield name
    docker("image", "rm", name)


def python(image: str, *arguments: str) -> str:
    """Run the interpreter of an image as its containers do: without root, rights, network or a writable image."""
    cache = ("--env", "NUMBA_CACHE_DIR=/tmp/numba")
    locked = ("--read-only", "--tmpfs", "/tmp", "--cap-drop", "ALL", "--network", "none")
    return docker(
        "run", "--rm", "--platform", PLATFORM, *locked, *cache, "--entrypoint", "python", image, *arguments,
        timeout_s=EMULATED * HEALTHY_S,
    )  # fmt: skip


@pytest.mark.parametrize("image", ALL, indirect=True)
def test_image_for_arm_is_small_and_says_what_it_contains(image: str) -> None:
    (found,) = json.loads(docker("image", "inspect", image))
    assert found["Architecture"] == "arm64"
    size = found["Size"] / 1e6
    print(f"{image} {size:.0f} MB")  # noqa: T201  # shown by `pytest -s`
    assert size < MEGABYTES[image.rpartition("/")[2]]
    read = "print(open('/opt/fognav/sbom.json').read())"
    names = {each["name"] for each in json.loads(python(image, "-c", read))["components"]}
    assert names >= {"eclipse-zenoh", "msgspec", "libc6"}


@pytest.mark.parametrize("image", ALL, indirect=True)
def test_program_of_the_image_is_loaded_on_arm(image: str) -> None:
    module = IMAGES[image.rpartition("/")[2]]["args"]["MODULE"]
    load = f"""
import importlib, importlib.util, platform
package = importlib.util.find_spec({module!r}).submodule_search_locations is not None
importlib.import_module({module!r} + (".__main__" if package else ""))
print(platform.machine())
"""
    assert python(image, "-c", load).split() == ["aarch64"]


@pytest.mark.parametrize("image", COMPILING, indirect=True)
def test_kernels_of_the_image_are_compiled_on_arm(image: str) -> None:
    # Those of the map: four of them show that the compiler works, and the planner's would take an hour.
    assert "4 of 4 kernels" in python(image, "-m", "fog_kernels.warm", "map")


@pytest.fixture
def router(image: str) -> Iterator[str]:
    name = f"fognav-arm64-{secrets.token_hex(4)}"
    docker("run", "--detach", "--platform", PLATFORM, "--init", "--network", "none", "--name", name, image,
           "--listen=tcp/127.0.0.1:7447", "--health-port=8000")  # fmt: skip
    try:
        yield name
    finally:
        docker("rm", "--force", name)


@pytest.mark.parametrize("image", ["zenoh"], indirect=True)
def test_router_in_its_container_on_arm_becomes_healthy_and_stops(router: str) -> None:
    def state() -> dict[str, Any]:
        return dict(json.loads(docker("inspect", "--format", "{{json .State}}", router)))

    def missing() -> str | None:
        now = state()
        logged = subprocess.run(["docker", "logs", router], capture_output=True, text=True, timeout=60, check=False)
        assert now["Running"], logged.stdout + logged.stderr
        return None if now["Health"]["Status"] == "healthy" else f"{now['Health']}"

    wait(missing, EMULATED * HEALTHY_S)
    docker("stop", "--time", "120", router)
    assert state()["ExitCode"] == 0
