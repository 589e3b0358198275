"""Map and masks go out as files of Nav2's map_server, and masks of others come in, cell by cell as Nav2 reads them."""

import asyncio
import json
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import numpy as np
import pytest
import yaml
from PIL import Image
from typer.testing import CliRunner

from fognav.__main__ import app

SHADES = (0, 3, 40, 51, 100, 150, 205, 230, 254, 255)
ZONES = {
    "shut": {"kind": "BLOCKED", "shape": {"type": "rectangle", "corner": [2.0, 2.0], "opposite": [3.0, 3.0]}},
    "slow": {"kind": "SPEED_LIMIT", "speed": 0.2, "shape": {"type": "rectangle", "corner": [4, 4], "opposite": [5, 5]}},
}


def nav2(file: Path) -> np.ndarray:
    """The grid of a map file by the rules of nav2_map_server (map_io.cpp), cell by cell, row 0 at the bottom."""
    keys = yaml.safe_load(file.read_text())
    with Image.open(file.parent / keys["image"]) as image:
        pixels = np.asarray(image.convert("L")).tolist()
    occupied, free = float(keys["occupied_thresh"]), float(keys["free_thresh"])

    def cell(pixel: int) -> int:
        shade = pixel / 255.0
        if keys["mode"] == "raw":
            return pixel if pixel <= 100 else -1
        occupancy = shade if keys["negate"] else 1.0 - shade
        if occupancy >= occupied:
            return 100
        if occupancy <= free:
            return 0
        return -1 if keys["mode"] == "trinary" else round((occupancy - free) / (occupied - free) * 100.0)

    return np.array([[cell(pixel) for pixel in row] for row in reversed(pixels)])


async def fognav(monkeypatch, url: str, tokens, *arguments: object) -> dict:
    """Run a command for the map-service at an address; return its JSON."""
    monkeypatch.setenv("FOGNAV_MAP_PORT", str(urlsplit(url).port))
    monkeypatch.setenv("FOGNAV_TOKEN", tokens["operator"]["Authorization"].removeprefix("Bearer "))
    command = [*map(str, arguments), "--json", "--fog", "127.0.0.1"]
    done = await asyncio.to_thread(CliRunner().invoke, app, command)
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


@pytest.mark.live
async def test_map_and_masks_go_out_as_nav2_reads_them_and_come_in_again(fog, tokens, tmp_path, monkeypatch):
    fog.start("map_service")
    url = await fog.ready("map_service")
    async with httpx.AsyncClient(base_url=url, headers=tokens["operator"], timeout=60) as client:
        for name, zone in ZONES.items():
            assert (await client.post("/api/v1/zones", json={"id": name, **zone})).is_success
        told = await fognav(monkeypatch, url, tokens, "map", "export", tmp_path / "out")
        assert told["files"] == ["keepout.png", "keepout.yaml", "map.pgm", "map.yaml", "speed.png", "speed.yaml"]
        plan, keepout, speed = (nav2(tmp_path / "out" / f"{name}.yaml") for name in ("map", "keepout", "speed"))
        assert plan.shape == keepout.shape == speed.shape == (120, 160)
        assert (plan[0] == 100).all(), "the wall"
        assert set(np.unique(plan)) <= {-1, 0, 100}
        assert (set(np.unique(keepout)), keepout[50, 50]) == ({0, 100}, 100)
        assert (set(np.unique(speed)), speed[90, 90]) == ({0, 20}, 20)
        for name in ZONES:
            await client.delete(f"/api/v1/zones/{name}")
        for kind in ("keepout", "speed"):
            file = tmp_path / "out" / f"{kind}.yaml"
            seen = await fognav(monkeypatch, url, tokens, "zone", "import", file, "--kind", kind)
            assert (seen["saved"], (await client.get("/api/v1/zones")).json()["zones"]) == (False, [])
        saved = await fognav(
            monkeypatch, url, tokens, "zone", "import", tmp_path / "out" / "keepout.yaml", "--save", "--id", "theirs",
            "--for", "2h", "--reason", "from Nav2",
        )  # fmt: skip
        (zone,) = (each["zone"] for each in saved["zones"])
        assert (zone["id"], zone["kind"], zone["reason"], zone["ttl_s"]) == (
            "theirs-1", "BLOCKED", "from Nav2", 7200.0
        )  # fmt: skip


@pytest.mark.live
async def test_mask_of_others_has_in_each_mode_the_cells_that_nav2_sees(shared_fog, tokens, tmp_path, monkeypatch):
    url = await shared_fog.ready("map_service")
    # Squares of each shade, apart from each other, on what the mode takes for free.
    for mode, negate, image in (
        ("trinary", 0, "pgm"), ("trinary", 1, "png"), ("scale", 0, "png"), ("scale", 1, "pgm"), ("raw", 0, "pgm"),
    ):  # fmt: skip
        blank = 0 if negate or mode == "raw" else 255
        pixels = np.full((40, 10 * len(SHADES)), blank, np.uint8)
        for number, shade in enumerate(SHADES):
            pixels[3 + number : 8 + number, 10 * number + 2 : 10 * number + 7] = shade
        Image.fromarray(pixels).save(tmp_path / f"mask.{image}")
        file = tmp_path / "mask.yaml"
        file.write_text(
            f"image: mask.{image}\nmode: {mode}\nresolution: 0.05\norigin: [1.0, 1.0, 0.0]\nnegate: {negate}\n"
            "occupied_thresh: 0.65\nfree_thresh: 0.196\n"
        )
        seen = nav2(file)
        told = await fognav(monkeypatch, url, tokens, "zone", "import", file)
        expected = {}
        for value in np.unique(seen[seen > 0]).tolist():
            expected["BLOCKED" if value >= 99 else f"PENALTY {value}"] = int((seen == value).sum())
        found: dict[str, int] = {}
        for each in told["zones"]:
            zone = each["zone"]
            value = round((zone["factor"] - 1.0) * 62.5 * 100 / 254) if zone["kind"] == "PENALTY" else 0
            name = f"PENALTY {value}" if value else zone["kind"]
            found[name] = found.get(name, 0) + each["cells"]
        assert found == expected, (mode, negate)


def test_mask_without_its_image_is_refused_with_the_place(tmp_path):
    (tmp_path / "mask.yaml").write_text("image: none.pgm\n")
    done = CliRunner().invoke(app, ["zone", "import", str(tmp_path / "mask.yaml")])
    assert (done.exit_code, "none.pgm can't be read" in done.output.replace("\n", " ")) == (2, True), done.output
