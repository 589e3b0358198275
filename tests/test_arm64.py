"""On 64-bit ARM, a Raspberry Pi's processor: each pin has a wheel. `compose/test_arm64_images.py` runs the images."""

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest
import yaml

ROOT: Final = Path(__file__).parents[1]
PLATFORM: Final = "aarch64-manylinux_2_36"
"""Debian 12, of which Raspberry Pi OS is made."""
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


def install(target: Path, *arguments: str) -> None:
    """Install packages for ARM into a folder; skips the test where no registry can be reached."""
    command = [uv(), "pip", "install", "--quiet", "--python", sys.executable, "--python-platform", PLATFORM]
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
