"""The page's files as the running console-service serves them."""

from pathlib import Path

import httpx
import pytest

pytestmark = pytest.mark.live


@pytest.fixture
def page(tmp_path: Path) -> Path:
    folder = tmp_path / "page"
    (folder / "assets").mkdir(parents=True)
    (folder / "index.html").write_text("<!doctype html><title>console</title>")
    (folder / "assets" / "app-0a1b2c3d.js").write_text("console.log('here');\n" * 100)
    (tmp_path / "secret.txt").write_text("secret")
    return folder


@pytest.mark.smoke
async def test_page_may_load_its_own_files_only_and_those_with_a_hash_are_kept_for_good(fog, page):
    fog.start("console_service", FOGNAV_PAGE_DIR=str(page))
    async with httpx.AsyncClient(base_url=await fog.ready("console_service")) as client:
        index = await client.get("/")
        assert "<title>console</title>" in index.text
        assert "default-src 'none'" in index.headers["content-security-policy"]
        assert "unsafe" not in index.headers["content-security-policy"]
        assert index.headers["cache-control"] == "no-cache"
        script = await client.get("/assets/app-0a1b2c3d.js", headers={"Accept-Encoding": "gzip"})
        assert script.headers["content-encoding"] == "gzip"
        assert "immutable" in script.headers["cache-control"]
        assert script.text.startswith("console.log")
        assert (await client.get("/robots/r1")).text == index.text, "the page knows what its own paths mean"
        for path in ("/assets/none.js", "/..%2fsecret.txt", "/assets/../../secret.txt"):
            refused = await client.get(path)
            assert (refused.status_code, refused.headers["content-type"]) == (404, "application/problem+json")
            assert "secret" not in refused.json().get("detail", "").replace("secret.txt", "")
        assert (await client.post("/", json={})).status_code == 405
        (page / "index.html").write_text("<!doctype html><title>upgraded</title>")
        assert "upgraded" in (await client.get("/")).text


async def test_without_a_built_page_a_sentence_says_so(fog, tmp_path):
    fog.start("console_service", FOGNAV_PAGE_DIR=str(tmp_path / "none"))
    async with httpx.AsyncClient(base_url=await fog.ready("console_service")) as client:
        answer = await client.get("/")
    assert (answer.status_code, answer.headers["content-type"]) == (200, "text/plain; charset=utf-8")
    assert "not built" in answer.text
