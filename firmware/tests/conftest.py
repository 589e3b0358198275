"""The firmware's core, compiled once for all tests of the firmware."""

import os
import tempfile
from pathlib import Path

import msgspec
import pytest

from fog_contracts.site import NodeSite, Sonar
from fognav_sim.nodes import FLAGS, Core, FirmwareError, FirmwareNode, build_library, find_compiler, find_firmware

SITE = NodeSite(id="n1", area="z1", x=0.0, y=0.0, theta=0.0, sonars=[Sonar(range_limit=2.0), Sonar(range_limit=2.5)])

UNDEFINED = ("-g", "-fsanitize=undefined", "-fno-sanitize-recover=all")
"""What the core's tests are compiled with: undefined behaviour ends them. Of its memory the whole firmware's tests and
the fuzzer tell: the address sanitizer needs a program of its own."""


class Ranges:
    """A stand-in for the world: the sonars measure the given ranges (m)."""

    def __init__(self, *metres):
        self.metres = metres

    def sonar(self, _node, index):
        return self.metres[index]


@pytest.fixture(scope="session")
def compiler():
    try:
        return find_compiler()
    except FirmwareError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def built(tmp_path_factory):
    """Where what is compiled goes, and the further options: those that count lines, when `.ci/firmware` asks for it."""
    if counted := os.environ.get("FOGNAV_FIRMWARE_COVERAGE"):
        # Each worker of a run, and each run, counts its own: another one's compilation would void what was counted.
        return Path(tempfile.mkdtemp(dir=counted)), ("--coverage", "-O0")
    return tmp_path_factory.mktemp("firmware"), ()


@pytest.fixture(scope="session")
def library(compiler, built):
    folder, counted = built
    return build_library(folder, (*FLAGS, *UNDEFINED, *counted))


@pytest.fixture(scope="session")
def core(library):
    return Core(library)


@pytest.fixture(scope="session")
def make_node(core):
    """Make a node with two sonars that begins at 100 s; members of the site's node can be given."""

    def make(**members):
        return FirmwareNode(core, msgspec.structs.replace(SITE, **members), 7, 100.0)

    return make


@pytest.fixture
def run():
    """Run a node for so many seconds in front of ranges; return its readings."""
    moments = {}

    def run(node, metres, seconds):
        start = moments.get(id(node), 100.0)
        moments[id(node)] = start + seconds
        steps = range(1, round(seconds * 100) + 1)
        return [reading for step in steps for reading in node.poll(Ranges(*metres), start + step * 0.01)]

    return run


@pytest.fixture(scope="session")
def firmware():
    return find_firmware()


@pytest.fixture(scope="session")
def recordings():
    folder = Path(os.environ.get("FOGNAV_DATA") or find_firmware().parents[1] / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"no data: {folder} does not exist; FOGNAV_DATA names another folder")
    return folder
