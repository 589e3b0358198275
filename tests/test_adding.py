"""The additions that `docs/architecture.md` describes under "Adding to it", made in a copy of the sources.

Each addition edits only the files that the document names; then its check (`fixtures/adding`) runs on the copy with the
fixtures of the services' own tests: real brokers and real processes. Debounce rules and cost layers are proven by the
package in `fixtures/external-parts`, bases and lidars by the existing ones (`wire/test_every_part.py`).
"""

import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

pytestmark = pytest.mark.live

ROOT = Path(__file__).parents[1]
CHECKS = ROOT / "tests" / "fixtures" / "adding"
SOURCES = sorted({*ROOT.glob("*/src/*/__init__.py"), *ROOT.glob("*/*/src/*/__init__.py")})
COMPILED = "libs/fog-kernels"
"""The kernels stay where they are: their compiled code is found by their path."""

MESSAGES = "libs/fog-contracts/src/fog_contracts/messages"
CHANNELS = "libs/fog-contracts/src/fog_contracts/channels.py"
SHAPES = "libs/fog-contracts/src/fog_contracts/shapes.py"
AGGREGATOR = "services/hazard-aggregator/src/hazard_aggregator/core.py"
MAP_API = "services/map-service/src/map_service/api.py"


@dataclass(frozen=True)
class Edit:
    """One place of a file: the line that `anchor` finds, and the text that is put before, after or at the end of it."""

    file: str
    anchor: str
    before: str = ""
    after: str = ""
    behind: str = ""

    def make(self, folder: Path) -> None:
        """Edit the file in a folder; the anchor has to be there once."""
        path = folder / self.file
        text, found = re.subn(
            rf"^.*{self.anchor}.*\n",
            lambda line: f"{self.before}{line[0].rstrip()}{self.behind}\n{self.after}",
            path.read_text("utf-8"),
            flags=re.MULTILINE,
        )
        assert found == 1, (
            f"{found} lines of {self.file} match {self.anchor!r}, by which this test finds the place of its edit: "
            "give a new anchor, and check whether 'Adding to it' in docs/architecture.md still names the right files"
        )
        path.write_text(text, "utf-8")


MESSAGE = (
    Edit(f"{MESSAGES}/nodes.py", r"^class NodeUpdate\(", before='''\
class NodeBattery(Message, frozen=True, kw_only=True):
    """Voltage of a node's battery."""

    volts: Annotated[float, Meta(ge=0.0, le=30.0, extra={"unit": "V"})]


'''),
    Edit(f"{MESSAGES}/robots.py", r"^class CommandReply\(", before='''\
class RobotApproach(Message, frozen=True, kw_only=True):
    """A node that a robot is about to pass, and why."""

    node: Id
    reason: Sentence = ""


'''),
    Edit(CHANNELS, r"^AREA_HAZARD +=", before="""\
NODE_BATTERY      = _mqtt( "node_battery",      V1 + "nodes/{node}/battery",          m.NodeBattery,    limit=64,
    publishers=(NODE,),          subscribers=(AGGREGATOR,),       durability=VOLATILE, qos=0)
"""),
    Edit(CHANNELS, r"^LIVE +=", before="""\
ROBOT_APPROACH    = _pub(  "robot_approach",    FOG + "robots/{robot}/approach",  m.RobotApproach,  limit=64,
    publishers=(ROBOT,),   subscribers=(AGGREGATOR,),      durability=VOLATILE)
"""),
    Edit(AGGREGATOR, r"^    from fog_contracts\.messages import", before="""\
    from fog_contracts.messages import NodeBattery, RobotApproach
"""),
    Edit(AGGREGATOR, r"^from fog_contracts import channels as ch$", before="""\
import msgspec

"""),
    Edit(AGGREGATOR, r"^from hazard_aggregator\.publications import", before="""\
from hazard_aggregator.publications import node_config
"""),
    Edit(AGGREGATOR, r"^            ch\.NODE_READING: ", before="""\
            ch.NODE_BATTERY: self._on_battery,
            ch.ROBOT_APPROACH: self._on_approach,
"""),
    Edit(AGGREGATOR, r"^    def tick\(", before='''\
    def _on_battery(self, ids: Ids, battery: NodeBattery, _at: Moment) -> list[Publication]:
        """Let a node whose battery is low measure once a second only."""
        return self._pause(ids["node"], 1000) if battery.volts < 3.4 else []

    def _on_approach(self, _ids: Ids, approach: RobotApproach, _at: Moment) -> list[Publication]:
        """Let a node that a robot is about to pass measure as often as it can."""
        return self._pause(approach.node, 10)

    def _pause(self, name: str, pause_ms: int) -> list[Publication]:
        if name not in self.nodes:
            raise RefusedMessageError(f"there is no node {name}")
        config = msgspec.structs.replace(node_config(self.nodes[name]), pause_ms=pause_ms)
        return [Publication(ch.NODE_CONFIG, config, {"node": name})]

'''),
)  # fmt: skip

ROUTE = (
    Edit(MAP_API, r"^from typing import ", before="""\
from typing import Annotated
"""),
    Edit(MAP_API, r"^class ZoneList\(", before='''\
class Extension(Message, frozen=True, kw_only=True):
    """For how much longer a zone holds, from now on."""

    minutes: Annotated[int, msgspec.Meta(ge=1, le=480)]


'''),
    Edit(MAP_API, r'^    @routes\.delete\("/api/v1/zones/', before='''\
    @routes.post(
        "/api/v1/zones/{zone_id}/extension", raises=[ZoneError, ConflictError, StoreError], problems=NO_SUCH_ZONE
    )
    async def extend_zone(zone_id: str, body: Body[Extension], caller: Operator) -> Answer[Zone]:
        """Let a zone hold for so many more minutes."""
        old = _find_zone(service, zone_id)
        longer = msgspec.structs.replace(old, expires_at=clock.stamp() + 60.0 * body.minutes)
        zone = await service.zones.replace(longer, old.version, caller.name)
        return Answer(zone, etag(zone.version))

'''),
)  # fmt: skip

SHAPE = (
    Edit(f"{MESSAGES}/maps.py", r"^Shape = ", before='''\
class RingShape(Message, frozen=True, kw_only=True, tag="ring", tag_field="type"):
    """Everything between two circles around one centre."""

    centre: PointXY
    inner: Annotated[float, Meta(gt=0.0, le=1000.0, extra={"unit": "m"})]
    outer: Annotated[float, Meta(gt=0.0, le=1000.0, extra={"unit": "m"})]


''', behind=" | RingShape"),
    Edit(SHAPES, r"^from fog_contracts\.messages import", before="""\
from fog_contracts.messages import RingShape
"""),
    Edit(SHAPES, r"^KINDS: ", before="""\
class _Ring(ShapeKind[RingShape]):
    def normalized(self, shape: RingShape) -> RingShape:
        if shape.inner >= shape.outer:
            raise ShapeError("inner", "the ring has no area: give an inner radius below the outer one")
        return shape

    def contains(self, shape: RingShape, x: float, y: float) -> bool:
        return shape.inner <= math.dist(shape.centre, (x, y)) <= shape.outer

    def spans(self, shape: RingShape, geometry: GridGeometry) -> Spans:
        disc = rasterize_line([shape.centre], self.normalized(shape).outer, geometry)
        # A disc is drawn larger by half a cell's diagonal: the hole has to be smaller by that.
        hole = rasterize_line([shape.centre], shape.inner - math.sqrt(2.0) * geometry.resolution, geometry)
        x, y = hole.window.x - disc.window.x, hole.window.y - disc.window.y
        disc.mask[y : y + hole.window.height, x : x + hole.window.width] &= ~hole.mask
        return mask_spans(disc)


""", after="""\
    RingShape: _Ring(),
"""),
)  # fmt: skip


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkout with all three additions, and what follows from them generated as the document says.

    It has all sources but the kernels, no tests, and what `fognav channels` and the checks look for.
    """
    folder = tmp_path_factory.mktemp("checkout")
    without = shutil.ignore_patterns("__pycache__", "static")
    for file in SOURCES:
        package = file.parent.relative_to(ROOT)
        if not package.is_relative_to(COMPILED):
            shutil.copytree(ROOT / package, folder / package, ignore=without)
    shutil.copytree(ROOT / "sites" / "estig", folder / "sites" / "estig", ignore=without)
    (folder / "requirements").mkdir()
    (folder / "tests" / "support").mkdir(parents=True)
    (folder / "docs").mkdir(exist_ok=True)
    for name in (
        "fognav",
        "pyproject.toml",
        "conftest.py",
        "services/conftest.py",
        "tests/support/lateness.py",
        "tests/support/programs.py",
        "docs/security.md",
    ):
        shutil.copy(ROOT / name, folder / name)
    for edit in (*MESSAGE, *ROUTE, *SHAPE):
        edit.make(folder)
    run(folder, "-m", "fognav", "channels", "--write")
    return folder


def run(folder: Path, *arguments: str | Path) -> None:
    """Run Python on the sources in a folder; show what it printed when it fails."""
    done = try_to_run(folder, *arguments)
    assert done.returncode == 0, done.stdout + done.stderr


def try_to_run(folder: Path, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run Python on the sources in a folder."""
    paths = [str(folder / file.parents[1].relative_to(ROOT)) for file in SOURCES]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in paths if Path(path).is_dir())}
    environment.pop("PYTEST_ADDOPTS", None)
    command = [sys.executable, *map(str, arguments)]
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=150, check=False
    )


@pytest.fixture(scope="module")
def checked(checkout: Path) -> str:
    """Run the checks of all additions beside the services' tests, in one process; return what pytest printed."""
    targets = [Path(shutil.copy(file, checkout / "services")) for file in sorted(CHECKS.glob("check_*.py"))]
    done = try_to_run(checkout, "-m", "pytest", "-v", "-p", "no:cacheprovider", *targets)
    return done.stdout + done.stderr


def assert_passed(name: str, checked: str) -> None:
    """Find that the check of an addition has run, and that all its tests passed."""
    outcomes = re.findall(rf"^services/check_{name}\.py::\S+ ([A-Z]+)", checked, re.MULTILINE)
    assert set(outcomes) == {"PASSED"}, checked


@pytest.mark.long
def test_message_is_added_by_its_type_its_row_and_its_handlers(checkout: Path, checked: str) -> None:
    for file, words in {
        "docs/channels.md": ("fog/v1/<site>/nodes/<node>/battery", "### RobotApproach"),
        "deploy/mosquitto/acl": ("pattern write fog/v1/+/nodes/%u/battery",),
        "deploy/zenoh/acl.json5": ("fog/*/robots/*/approach",),
        "firmware/include/fognav_contract.h": ("#define FOGNAV_NODE_BATTERY_TOPIC ", "FOGNAV_NODE_BATTERY_VOLTS_MAX"),
    }.items():
        text = (checkout / file).read_text("utf-8")
        assert all(word in text for word in words), (file, words)
    assert_passed("message", checked)


@pytest.mark.long
def test_route_is_added_by_one_function(checkout: Path, checked: str) -> None:
    assert (
        "| `POST /api/v1/zones/{zone_id}/extension` | Let a zone hold for so many more minutes. |  | Extension "
        "| 200 Zone | 401, 403, 404, 408, 409, 412, 413, 422, 500, 503 | yes |"
    ) in (checkout / "docs" / "channels.md").read_text("utf-8")
    assert_passed("route", checked)


@pytest.mark.long
def test_zone_shape_is_added_by_its_message_and_its_class(checkout: Path, checked: str) -> None:
    assert "### RingShape" in (checkout / "docs" / "channels.md").read_text("utf-8")
    assert_passed("shape", checked)


# --- The document ---------------------------------------------------------------------------------------------------


def entry(addition: str) -> str:
    """Return the row of one addition in the table of "Adding to it"."""
    section = (ROOT / "docs" / "architecture.md").read_text("utf-8").split("## Adding to it")[1].split("\n## ")[0]
    rows = dict(re.findall(r"^\| (an? .+?) \|(.+)$", section, re.MULTILINE))
    assert addition in rows, f"docs/architecture.md, 'Adding to it', has no row for {addition!r}, only {sorted(rows)}"
    return rows[addition]


@pytest.mark.parametrize(
    ("addition", "edits"), [("a message", MESSAGE), ("a REST route", ROUTE), ("a zone shape", SHAPE)]
)
def test_document_links_the_files_that_an_addition_edits(addition: str, edits: Sequence[Edit]) -> None:
    assert {edit.file for edit in edits} <= set(re.findall(r"\]\(\.\./([^)#]+)\)", entry(addition)))


def test_document_names_exactly_the_groups_of_entry_points() -> None:
    registered = set()
    for file in [*ROOT.glob("*/pyproject.toml"), *ROOT.glob("*/*/pyproject.toml")]:
        registered |= set(tomllib.loads(file.read_text("utf-8"))["project"].get("entry-points", {}))
    parts = (ROOT / "docs" / "adding-a-base-or-lidar.md").read_text("utf-8")
    rows = entry("a debounce rule") + entry("a cost layer") + entry("a profile of navigation") + entry("a command")
    named = set(re.findall(r"`(fognav\.[a-z_.]+)`", rows))
    named |= set(re.findall(r'entry-points\."(fognav\.[a-z_]+)"', parts))
    assert named == {group for group in registered if group.startswith("fognav.")}


def test_document_shows_the_declared_entry_points() -> None:
    text = (ROOT / "docs" / "adding-a-base-or-lidar.md").read_text("utf-8")
    ours = tomllib.loads((ROOT / "robot-agent" / "pyproject.toml").read_text("utf-8"))["project"]["entry-points"]
    shown = [
        tomllib.loads(block)["project"]["entry-points"] for block in re.findall(r"```toml\n(.+?)```", text, re.DOTALL)
    ]
    assert shown
    for groups in shown:
        for group, names in groups.items():
            assert names.items() <= ours[group].items()
