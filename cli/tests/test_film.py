"""The film of a drive: one picture every 4 s, with what each robot knows at that time."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from fog_runtime.site import load_site
from fognav.film import FRAME_S, Film, Recording
from fognav_experiments.comparison import runner
from fognav_experiments.comparison.draws import draw

ESTIG = Path(__file__).parents[2] / "sites" / "estig"
PINK, RED = (246, 178, 178), (208, 40, 40)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    site = load_site(ESTIG)
    drawn = draw(runner.read_spec(site, ESTIG), 1, 2)[0]
    start = (site.site.places["a"].x, site.site.places["a"].y)
    recordings = [
        Recording(
            setup, poses=[(0.1 * step, (start[0], start[1] + 0.01 * step)) for step in range(int(10 * time_s))],
            blocked=[(0.0, drawn.area, False), (6.0, drawn.area, True)], barrier_at=5.0, time_s=time_s,
            distance_m=time_s / 10.0,
        )
        for setup, time_s in (("default", 20.0), ("fog", 10.0))
    ]  # fmt: skip
    file = tmp_path_factory.mktemp("film") / "film.gif"
    size = Film(site, drawn, recordings).write(file)
    assert size == file.stat().st_size < 200_000
    shown = []
    with Image.open(file) as film:
        for number in range(film.n_frames):
            film.seek(number)
            whole = film.convert("RGB")
            half = whole.width // 2
            boxes = ((0, 0, half, whole.height), (half, 0, whole.width, whole.height))
            shown.append([whole.crop(box) for box in boxes])
    return shown


def colours(picture):
    return {colour for _, colour in picture.getcolors(10_000)}


def test_the_film_lasts_until_the_last_robot_has_arrived(pictures):
    assert len(pictures) == round(20.0 / FRAME_S) + 1
    first, last = pictures[3][1], pictures[-1][1]
    assert first.tobytes() == last.tobytes(), "the robot that has arrived moves on"


def test_only_the_robot_that_the_fog_tells_knows_of_the_blocked_area(pictures):
    before, after = pictures[1], pictures[2]
    assert all(RED not in colours(panel) for panel in before)
    assert all(RED in colours(panel) for panel in after)
    assert [PINK in colours(panel) for panel in after] == [False, True]
