"""The documentation's site: what it shows, and that no link in it leads nowhere."""

import os
import re
import shutil
import tomllib
from pathlib import Path

import pytest

from fognav import documentation, system
from fognav.documentation import rest_page

ROOT = Path(__file__).parents[2]
BUILDER = system.find_tool(ROOT, "docs", "zensical")
needs_builder = pytest.mark.skipif(BUILDER is None, reason="./fognav docs installs what builds the documentation")


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """A repository with a document that links to a source, to a folder and to a picture."""
    for path, text in {
        "README.md": "# Us\n\n[core](part/core.py), [part](part), ![](docs/it.svg), [web](https://x.org), [us](#us)\n",
        "docs/it.svg": "<svg xmlns='http://www.w3.org/2000/svg'/>",
        "docs/zensical.toml": '[project]\nsite_name = "Small"\ndocs_dir = "pages"\n',
        "part/core.py": '"""Decides."""\n',
        "part/edge.py": "# No docstring\n",
    }.items():
        (tmp_path / "small" / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "small" / path).write_text(text)
    return tmp_path / "small"


def places(entry: object) -> list[str]:
    """The paths in a part of the navigation."""
    if isinstance(entry, str):
        return [entry]
    return [path for each in (entry.values() if isinstance(entry, dict) else entry) for path in places(each)]


def test_documents_are_shown_as_they_are_but_for_links_to_sources_and_folders(small: Path) -> None:
    shown = documentation.gather(small)["README.md"]
    links = "[core](part/core.py.md), [part](part/README.md), ![](docs/it.svg), [web](https://x.org), [us](#us)"
    assert shown == f"# Us\n\n{links}\n"


def test_linked_sources_and_folders_have_pages(small: Path) -> None:
    pages = documentation.gather(small)
    assert set(pages) == {"README.md", "docs/it.svg", "part/core.py.md", "part/README.md"}
    assert '\n# `part/core.py`\n\n````````python\n"""Decides."""\n````````\n' in pages["part/core.py.md"]
    assert pages["part/README.md"].endswith("\n- [`core.py`](core.py.md): Decides.\n- `edge.py`\n")


def test_page_of_what_is_gone_is_removed(small: Path, tmp_path: Path) -> None:
    documentation.write(small, tmp_path / "site", {})
    (small / "README.md").write_text("# Us\n")
    documentation.write(small, tmp_path / "site", {})
    left = {file.relative_to(tmp_path / "site/pages").as_posix() for file in (tmp_path / "site/pages").rglob("*.*")}
    assert left == {"README.md", "reference/rest.md"}


def test_every_document_has_a_place_in_the_navigation() -> None:
    settings = tomllib.loads((ROOT / "docs/zensical.toml").read_text("utf-8"))
    listed = places(settings["project"]["nav"])
    documents = {path.relative_to(ROOT).as_posix() for path in (*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"))}
    assert {path for path in documents if not path.startswith(tuple(listed))} == set(), "add them to docs/zensical.toml"
    assert {path for path in listed if not (ROOT / path).exists()} == {"reference/rest.md"}


def test_rest_reference_has_types_limits_and_answers() -> None:
    schema = {
        "properties": {"speed": {"anyOf": [{"type": "number", "maximum": 2.5}, {"type": "null"}], "default": None}}
    }
    answer = {"description": "Done", "content": {"application/json": {"schema": {"$ref": "#/components/schemas/Zone"}}}}
    put = {"description": "Draw.", "security": [{}], "responses": {"200": answer}}
    page = rest_page({"maps": {"paths": {"/zones": {"put": put}}, "components": {"schemas": {"Zone": schema}}}})
    assert "## maps\n\n### `PUT /zones`\n\nDraw.\n\nNeeds a token.\n" in page
    assert "| 200 | [Zone](#zone) | Done |" in page
    assert "| `speed` | number or null | <= `2.5` | `null` |" in page


@needs_builder
@pytest.mark.parametrize("link", ["part/gone.py", "#nowhere"])
def test_link_that_leads_nowhere_is_named_with_its_place(small: Path, tmp_path: Path, link: str) -> None:
    with (small / "README.md").open("a") as file:
        file.write(f"\n[gone]({link})\n")
    documentation.write(small, tmp_path / "site", {})
    assert "README.md:5:" in documentation.build(BUILDER, tmp_path / "site")


@needs_builder
@pytest.mark.timeout(600)  # 15 s of computing, on a busy machine
@pytest.mark.drive
def test_site_of_this_checkout_is_built_strictly_and_loads_nothing_from_elsewhere(tmp_path: Path) -> None:
    built = os.environ.get("FOGNAV_BUILT_SITE")  # by `./fognav docs`, as .ci/run has, and without a warning
    site = Path(built) if built else tmp_path / "site"
    if not built:
        documentation.write(ROOT, tmp_path, documentation.rest_routes())
        assert documentation.build(BUILDER, tmp_path) == ""
    pages = [file.read_text("utf-8") for file in site.rglob("*.html")]
    assert len(pages) > 100
    loaded = re.compile(r'<(?:script|img|iframe|source)[^>]* src="?(?:https?:)?//|<link[^>]* href="?(?:https?:)?//')
    assert [found[0] for page in pages if (found := loaded.search(page))] == []
    assert (site / "python" / "fog_contracts" / "channels.html").is_file()
    if not built:
        shutil.rmtree(site)  # 30 MB
