"""The console's page as it is built: its size, where its packages come from, and that it knows what robots say."""

import gzip
import json
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from console_service.forward import ForwardProblem
from fog_contracts.messages.areas import NodeCode
from fog_contracts.messages.fleet import ScheduleCode
from fog_contracts.messages.robots import PlanRefusal, ReasonCode, RefusalCode
from fognav import console_page

ROOT = Path(__file__).parents[1]
CONSOLE = ROOT / "console"
SIZE_MAX = 250_000
"""Bytes of the whole page, compressed as it is sent."""


@pytest.fixture(scope="session")
def page() -> Path:
    console_page.build(ROOT)
    return ROOT / "services/console-service/src/console_service/page"


def test_whole_page_is_small_and_holds_nothing_inline(page: Path) -> None:
    sent = {file: file.read_bytes() for file in page.rglob("*") if file.is_file()}
    assert sum(len(gzip.compress(data, 9)) for data in sent.values()) <= SIZE_MAX
    index = (page / "index.html").read_text("utf-8")
    assert not re.search(r"<style|style=|<script(?![^>]*\ssrc=)|https?://", index)


def test_wheel_of_the_service_carries_the_page(page: Path, tmp_path: Path) -> None:
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(build, cwd=page.parents[2], check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        carried = {name.removeprefix("console_service/page/") for name in archive.namelist() if "/page/" in name}
    assert carried == {str(file.relative_to(page)) for file in page.rglob("*") if file.is_file()}


def test_lock_file_names_packages_by_their_hash_and_no_registry() -> None:
    lock = json.loads((CONSOLE / "package-lock.json").read_text("utf-8"))
    packages = {name: entry for name, entry in lock["packages"].items() if name}
    assert packages
    assert all("integrity" in entry and "resolved" not in entry for entry in packages.values())


def test_page_says_in_portuguese_every_refusal_and_state_that_has_an_identifier_and_none_that_nobody_sends() -> None:
    known = set(re.findall(r"^  (\w+): ", (CONSOLE / "src/i18n/pt-codes.ts").read_text("utf-8"), re.MULTILINE))
    assert known >= {str(code) for codes in (NodeCode, PlanRefusal, RefusalCode, ScheduleCode) for code in codes}
    documented = set(re.findall(r"^\| `(\w+)` \|", (ROOT / "docs/channels.md").read_text("utf-8"), re.MULTILINE))
    assert known <= documented | {str(code) for code in ForwardProblem}


def test_page_knows_every_reason_of_a_robot() -> None:
    source = (CONSOLE / "src" / "reasons.ts").read_text("utf-8")
    assert set(re.findall(r"^  (\w+): reason\(", source, re.MULTILINE)) == {str(code) for code in ReasonCode}
