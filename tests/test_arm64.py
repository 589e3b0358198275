"""The images' programs on 64-bit ARM, the processor of a Raspberry Pi: each pin has a wheel, each program is loaded.

Loading a program imports all that it needs. The router is started, too, until it is ready, and the map service's
kernels are compiled. All but the wheels needs an emulator and a Debian of that processor, and takes minutes;
FOGNAV_ARM64_ROOT names its folder:

    apt-get install qemu-user-static debootstrap
    debootstrap --arch arm64 --variant=minbase --include=python3 bookworm FOLDER

(for the second stage the kernel has to run the emulator: the package binfmt-support lets it).
"""

import functools
import os
import re
import shutil
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest
import yaml

from fog_supervisor import net

ROOT: Final = Path(__file__).parents[1]
PLATFORM: Final = "aarch64-manylinux_2_36"
"""Debian 12, of which Raspberry Pi OS is made."""
EMULATOR: Final = "qemu-aarch64-static"
ARM64: Final = os.environ.get("FOGNAV_ARM64_ROOT", "")
SERVICES: Final = yaml.safe_load((ROOT / "docker-compose.yml").read_text("utf-8"))["services"]
IMAGES: Final = {
    service["build"]["args"]["NAME"]: service["build"]["args"] for service in SERVICES.values() if "build" in service
}
"""What each of our images is built of, by the name of its pins."""
PINS: Final = sorted({*IMAGES, "robot-agent", "robot-camera", "fognav-cli", "build", "sbom"})
"""What a Raspberry Pi installs: in containers, as a robot, without containers."""


def uv() -> str:
    """Return the installer that the launcher has got."""
    candidates = [ROOT / ".fognav" / part / "bin" / "uv" for part in ("uv", "uv-env")]
    found = next((str(path) for path in candidates if path.exists()), None) or shutil.which("uv")
    if found is None:
        pytest.skip("needs uv: run ./fognav --version, which gets it")
    return found


@functools.cache
def emulated_version() -> str:
    """Return the version of Debian's interpreter: some packages are needed by older ones alone."""
    python = [
        EMULATOR,
        "-L",
        ARM64,
        f"{ARM64}/usr/bin/python3",
        "-c",
        "import platform; print(platform.python_version())",
    ]
    return subprocess.run(python, capture_output=True, text=True, timeout=300, check=True).stdout.strip()


def install(target: Path, *arguments: str) -> None:
    """Install packages for ARM into a folder; skips the test where no registry can be reached."""
    command = [uv(), "pip", "install", "--quiet", "--python", sys.executable, "--python-platform", PLATFORM]
    if ARM64:
        command += ["--python-version", emulated_version()]
    command += ["--target", str(target), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False, cwd=ROOT)
    if "error sending request" in done.stderr or "dns error" in done.stderr:
        pytest.skip("no package registry can be reached")
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", PINS)
def test_every_pinned_package_has_a_wheel_for_arm(name, tmp_path):
    only_wheels = (
        "--no-deps",
        "--only-binary",
        ":all:",
        "--require-hashes",
        "--requirements",
        f"requirements/{name}.txt",
    )
    install(tmp_path, "--dry-run", *only_wheels)


def test_a_package_without_a_wheel_for_arm_would_be_noticed(tmp_path):
    with pytest.raises(AssertionError, match=r"no wheels|no usable wheels|No solution"):
        install(tmp_path, "--dry-run", "--only-binary", ":all:", "--no-deps", "intel-openmp==2024.2.0")


class Arm64:
    """One image's packages, installed for ARM, and Debian's interpreter for it."""

    def __init__(self, name: str, folder: Path) -> None:
        build = IMAGES[name]
        self.module: str = build["MODULE"]
        package = (ROOT / build["MEMBERS"].split()[-1] / "src" / self.module.replace(".", "/")).is_dir()
        self.program = f"{self.module}.__main__" if package else self.module
        pinned, own = folder / "pinned", folder / "own"
        install(pinned, "--only-binary", ":all:", "--require-hashes", "--requirements", f"requirements/{name}.txt")
        install(own, "--no-deps", "--no-build-isolation", *build["MEMBERS"].split())
        self.environment = {"PATH": os.environ["PATH"], "PYTHONPATH": f"{pinned}:{own}", "HOME": str(folder)}
        self.environment["NUMBA_CACHE_DIR"] = str(folder / "numba")

    def command(self, *arguments: str) -> list[str]:
        return [EMULATOR, "-L", ARM64, f"{ARM64}/usr/bin/python3", *arguments]

    def run(self, *arguments: str, timeout_s: float = 900.0) -> str:
        done = subprocess.run(
            self.command(*arguments),
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout


needs_emulator = [
    pytest.mark.skipif(not ARM64, reason="set FOGNAV_ARM64_ROOT to a Debian for arm64 (see this file)"),
    pytest.mark.skipif(shutil.which(EMULATOR) is None, reason=f"needs {EMULATOR}: apt-get install qemu-user-static"),
    pytest.mark.timeout(3600),
    pytest.mark.live,
]


@pytest.fixture(scope="module", params=[pytest.param(name, marks=needs_emulator) for name in sorted(IMAGES)])
def image(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Arm64]:
    folder = tmp_path_factory.mktemp("arm64")
    yield Arm64(request.param, folder)
    shutil.rmtree(folder)


def test_program_of_each_image_is_loaded_on_arm(image):
    load = f"import importlib, platform; importlib.import_module({image.program!r}); print(platform.machine())"
    assert image.run("-c", load).split() == ["aarch64"]


@pytest.mark.parametrize("name", [pytest.param("router", marks=needs_emulator)])
def test_router_answers_on_arm_that_it_is_ready(name, tmp_path):
    router, ports = Arm64(name, tmp_path), [net.free_port(), net.free_port()]
    options = ["--listen", f"tcp/127.0.0.1:{ports[0]}", "--health-port", str(ports[1])]
    with (tmp_path / "log").open("wb") as log:
        process = subprocess.Popen(
            router.command("-m", router.module, *options), env=router.environment, stdout=log, stderr=log
        )
    try:
        deadline = time.monotonic() + 300.0
        while True:
            try:
                with urllib.request.urlopen(f"http://127.0.0.1:{ports[1]}/readyz", timeout=30) as answer:
                    assert answer.status == 200
                break
            except (OSError, urllib.error.HTTPError):
                assert process.poll() is None, (tmp_path / "log").read_text()
                assert time.monotonic() < deadline, (tmp_path / "log").read_text()
                time.sleep(0.5)
        process.terminate()
        assert process.wait(120) == 0
    finally:
        process.kill()
        process.wait()


@pytest.mark.parametrize("name", [pytest.param("map-service", marks=needs_emulator)])
def test_kernels_are_compiled_and_cached_on_arm(name, tmp_path):
    service = Arm64(name, tmp_path)
    assert re.search(r"4 of 4 kernels", service.run("-m", "fog_kernels.warm", "map", timeout_s=3000.0))
    assert list((tmp_path / "numba").rglob("*.nbi"))
