"""Zones as masks that Nav2's map_server reads, and painted masks as zones."""

from __future__ import annotations

import base64
import io

import httpx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from PIL import Image

from fog_contracts.grid import GridGeometry
from fog_contracts.shapes import polygon_spans
from fog_runtime.configuration.maps import load_occupancy
from map_service.formats.masks import MaskError, factor_of, keepout_values, parts_of

SIZE = 0.05
SHADES = arrays(np.int8, array_shapes(min_dims=2, max_dims=2, max_side=24), elements=st.sampled_from([0, 0, 30, 100]))


def widened(mask: np.ndarray) -> np.ndarray:
    """The cells of a mask, and the eight around each."""
    padded, (height, width) = np.pad(mask, 1), mask.shape
    return np.logical_or.reduce([padded[y : y + height, x : x + width] for y in range(3) for x in range(3)])


@settings(deadline=None)
@given(values=SHADES)
def test_parts_cover_every_painted_cell_and_at_most_one_cell_around(values):
    try:
        parts = parts_of(values)
    except MaskError:
        return
    geometry = GridGeometry(values.shape[1], values.shape[0], SIZE, 1.0, -2.0)
    for value in np.unique(values[values > 0]):
        covered = np.zeros(values.shape, np.bool_)
        for part in (part for part in parts if part.value == value):
            outline = [(1.0 + x * SIZE, -2.0 + y * SIZE) for x, y in part.outline]
            window, mask = polygon_spans(outline, geometry).to_mask()
            covered[window.rows, window.columns] |= mask
        painted = values == value
        assert covered[painted].all()
        assert widened(painted)[covered].all()
    assert sum(part.cells for part in parts) == np.count_nonzero(values)


def test_each_value_of_a_keepout_mask_becomes_a_zone_of_that_value():
    for value in range(1, 99):
        cost = round(62.5 * (factor_of(value) - 1.0))
        assert keepout_values(np.array([[cost]], np.uint8))[0, 0] == value


ZONES = {
    "wall": {"kind": "BLOCKED", "shape": {"type": "corridor", "line": [[1, 1], [3, 2], [4, 4]], "width": 0.3}},
    "hole": {"kind": "BLOCKED", "shape": {"type": "circle", "centre": [6.0, 3.0], "radius": 0.8}},
    "dear": {"kind": "PENALTY", "factor": 2.5, "shape": {"type": "circle", "centre": [6.0, 1.2], "radius": 0.5}},
    "slow": {"kind": "SPEED_LIMIT", "speed": 0.2, "shape": {"type": "rectangle", "corner": [1, 4], "opposite": [3, 5]}},
}


@pytest.mark.live
@pytest.mark.parametrize("kind", ["keepout", "speed"])
async def test_mask_goes_out_comes_in_and_goes_out_the_same_within_a_cell(fog, tokens, tmp_path, kind):
    fog.start("map_service")
    operator = tokens["operator"]
    async with httpx.AsyncClient(base_url=await fog.ready("map_service"), timeout=60) as client:

        async def taken_out() -> np.ndarray:
            for ending in ("png", "yaml"):
                answer = await client.get(f"/api/v1/masks/{kind}.{ending}")
                assert answer.status_code == 200
                (tmp_path / f"{kind}.{ending}").write_bytes(answer.content)
            occupancy = load_occupancy(tmp_path / f"{kind}.yaml")
            assert (occupancy.geometry.width, occupancy.geometry.origin_x, occupancy.yaw) == (160, 0.0, 0.0)
            return occupancy.values

        for name, zone in ZONES.items():
            answer = await client.put(f"/api/v1/zones/{name}", json=zone, headers={**operator, "If-None-Match": "*"})
            assert answer.status_code == 201, answer.text
        first = await taken_out()
        assert set(np.unique(first)) == ({0, 37, 100} if kind == "keepout" else {0, 20})
        body = {
            "kind": kind,
            "png": base64.b64encode((tmp_path / f"{kind}.png").read_bytes()).decode(),
            "yaml": (tmp_path / f"{kind}.yaml").read_text(),
            "id": "painted",
        }
        told = (await client.post("/api/v1/masks", json=body, headers=operator)).json()
        assert (told["saved"], len(told["zones"])) == (False, 3 if kind == "keepout" else 1)
        assert len((await client.get("/api/v1/zones")).json()["zones"]) == len(ZONES), "nothing is stored yet"
        for name in ZONES:
            await client.delete(f"/api/v1/zones/{name}", headers=operator)
        saved = await client.post("/api/v1/masks", json={**body, "save": True}, headers=operator)
        assert saved.status_code == 200, saved.text
        second = await taken_out()
        for value in np.unique(first[first > 0]):
            assert (second == value)[first == value].all()
            assert widened(first == value)[second == value].all()
        again = await client.post("/api/v1/masks", json={**body, "save": True}, headers=operator)
        assert again.status_code == 409


@pytest.mark.live
async def test_mask_that_is_none_is_refused_with_what_to_do(shared_fog, tokens):
    def png(width: int, height: int) -> str:
        data = io.BytesIO()
        Image.new("L", (width, height), 255).save(data, "PNG")
        return base64.b64encode(data.getvalue()).decode()

    async with httpx.AsyncClient(base_url=await shared_fog.ready("map_service"), timeout=60) as client:
        for change, field, problem in (
            ({"png": png(10, 10)}, "body.png", "paint on"),
            ({"png": png(160, 120)}, "body.png", "empty"),
            ({"png": "bm9uc2Vuc2U="}, "body.png", "save it as PNG"),
            ({"png": png(10, 10), "yaml": "resolution: 0.05"}, "body.yaml", "mask.yaml: origin"),
        ):
            answer = await client.post("/api/v1/masks", json={"kind": "keepout", **change}, headers=tokens["operator"])
            assert answer.status_code == 422
            (error,) = answer.json()["errors"]
            assert error["field"] == field
            assert problem in error["problem"], error
