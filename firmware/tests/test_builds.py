"""The core compiles for the board, and no input makes it fault."""

import json
import os
import random
import shutil
import struct
import subprocess

import pytest

INPUTS = int(os.environ.get("FOGNAV_FUZZ_INPUTS", "5000"))
WARNINGS = ("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Werror")
BOARD = (
    "-std=c++17",
    "-Os",
    "-mlongcalls",
    "-ffreestanding",
    "-fno-exceptions",
    "-fno-rtti",
    "-fno-threadsafe-statics",
)
SETTINGS = {
    "site": "lab",
    "node": "n1",
    "wifi_name": "caf\u00e9",
    "broker": "fog.lan",
    "sonars": [{"trigger": 14, "echo": 5, "range_limit_m": 1.5}, {"trigger": 12, "echo": 4, "range_limit_m": 2}],
}
BOARD_C_LIBRARY = "/usr/lib/xtensa-lx106-elf/include"


def sources(firmware, *libraries):
    return sorted(str(file) for library in libraries for file in (firmware / "lib" / library / "src").glob("*.cpp"))


def includes(firmware):
    return [f"-I{firmware / folder}" for folder in ("include", "lib/node_core/src", "lib/node_edge/src")]


def run(*command):
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.parametrize(
    ("library", "foreign", "code"),
    [
        ("node_core", {"memcmp", "memcpy", "memset", "strlen"}, 16),
        ("node_edge", {"memcmp", "memcpy", "memset", "strlen", "strcmp", "strstr", "snprintf"}, 20),
    ],
)
def test_libraries_compile_for_the_esp8266_with_its_c_library_alone(firmware, tmp_path, library, foreign, code):
    compiler = shutil.which("xtensa-lx106-elf-g++")
    if compiler is None:
        pytest.skip("no xtensa-lx106-elf-g++: apt-get install gcc-xtensa-lx106 picolibc-xtensa-lx106-elf")
    objects = []
    for source in sources(firmware, library):
        objects.append(str(tmp_path / f"{len(objects)}.o"))
        headers = ("-isystem", BOARD_C_LIBRARY, *includes(firmware))
        run(compiler, *BOARD, *WARNINGS, *headers, "-c", source, "-o", objects[-1])
    undefined = run("xtensa-lx106-elf-nm", "--undefined-only", *objects)
    names = {line.split()[-1] for line in undefined.splitlines() if line.strip().startswith("U ")}
    # Only what the board's C library and the compiler's own have, and our own: no heap, no C++ runtime.
    others = {name for name in names if not name.startswith("__") and "fognav" not in name}
    assert others <= foreign
    sizes = run("xtensa-lx106-elf-size", "--totals", *objects).splitlines()[-1].split()
    assert int(sizes[0]) < code * 1024
    assert int(sizes[1]) + int(sizes[2]) == 0, "it has no variables of its own"


def test_variables_heap_and_stack_fit_into_an_esp8266(firmware):
    if shutil.which("xtensa-lx106-elf-g++") is None or shutil.which("g++") is None:
        pytest.skip("no xtensa-lx106-elf-g++: apt-get install gcc-xtensa-lx106 picolibc-xtensa-lx106-elf")
    printed = run(str(firmware.parent / ".ci" / "firmware-budget"))
    # The deepest that is known: an offer of an update, on its way from the broker.
    assert "MqttClient::loop()" in printed
    assert "Updater::offer" in printed


@pytest.mark.drive
def test_no_input_makes_the_node_fault(firmware, compiler, tmp_path):
    program, inputs = tmp_path / "fuzz", tmp_path / "inputs"
    sanitizers = (
        "-g",
        "-O1",
        "-fsanitize=address,undefined",
        "-fno-sanitize-recover=all",
        "-fno-exceptions",
        "-fno-rtti",
    )
    files = [*sources(firmware, "node_core", "node_edge"), str(firmware / "host" / "fuzz" / "fuzz.cpp")]
    run(
        compiler,
        "-std=c++17",
        *sanitizers,
        *WARNINGS,
        *includes(firmware),
        *files,
        "-o",
        str(program),
    )
    chance = random.Random(int(os.environ.get("FOGNAV_SEED", "1")))
    with inputs.open("wb") as file:
        for _ in range(INPUTS):
            data = fuzzed(chance)
            file.write(struct.pack("<I", len(data)) + data)
    assert run(str(program), str(inputs)) == f"{INPUTS} inputs\n"


def fuzzed(chance):
    """A configuration with a few bytes changed, bytes at random, or a program of many steps and edges."""
    kind = chance.randrange(4)
    if kind == 0:
        nested = {"a": [1, {"b": None}], "": -1.5e-3}
        config = {
            "version": 1,
            "range_limit_m": [1.5, 2],
            "no_echo_is_clear": [True, False],
            "pause_ms": 50,
            "x": nested,
        }
        data = bytearray(json.dumps(config).encode())
        for _ in range(chance.randrange(6)):
            data[chance.randrange(len(data))] = chance.randrange(256)
        return bytes(data[: chance.randrange(len(data) + 1)] if chance.random() < 0.3 else data)
    if kind == 1:
        data = bytearray(json.dumps(SETTINGS).encode())
        data[chance.randrange(len(data))] = chance.randrange(256)
        return bytes(data)
    if kind == 2:
        return chance.randbytes(chance.randrange(600))
    # Steps (5) with small times, edges (2, 3) of the sonars, now and then a calibration (0).
    program = (
        (
            chance.choice((5, 5, 5, 5, 2, 3)) if chance.random() < 0.995 else 0,
            chance.randrange(256),
            chance.choice((2, 4, 6)),
        )
        for _ in range(3000)
    )
    return bytes(byte for step in program for byte in step)
