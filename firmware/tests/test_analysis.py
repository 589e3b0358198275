"""Static analysis of the firmware, by the tools that are installed."""

import shutil
import subprocess

import pytest

FOLDERS = ("include", "lib/node_core/src", "lib/node_edge/src")


def test_cppcheck_finds_nothing(firmware):
    if shutil.which("cppcheck") is None:
        pytest.skip("no cppcheck: apt-get install cppcheck")
    includes = [f"-I{firmware / folder}" for folder in FOLDERS]
    sources = [str(firmware / folder) for folder in ("lib", "src", "host")]
    options = ("--std=c++17", "--language=c++", "--enable=warning,performance,portability", "--quiet")
    done = subprocess.run(
        ["cppcheck", *options, "--error-exitcode=1", "-DESP8266", '-DFOGNAV_FIRMWARE="x"', *includes, *sources],
        check=False, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
