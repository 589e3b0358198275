"""The film of a drive: one picture every 4 s, with what each robot knows at that time."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from fog_runtime.configuration.site import load_site
from fognav_experiments.comparison import runner
from fognav_experiments.comparison.drives import Timeline, draw
from fognav_experiments.comparison.film import FRAME_S, Film, UnfilmedDriveError
from fognav_experiments.comparison.records import Record

ESTIG = Path(__file__).parents[2] / "sites" / "estig"
PINK, RED = (246, 178, 178), (208, 40, 40)


def a_record(**changes):
    return Record(
        **{
            "setup": "fog", "run": 2, "route": "ab", "seed": 1, "area": "z4", "moment": "before", "trigger_m": 0.0,
            "outcome": "reached", "reason": "", "success": True, "distance_m": 1.0, "time_s": 10.0, "planned_m": 1.0,
            "paths": 1, "contacts": 0, "stops": [], "min_clearance_m": None, "barrier_distance_m": None,
            "pose_error_m": 0.0, "reaction_s": None, "received_bytes": 0, "operator_commands": 1, "route_areas": [],
            "cpu_s": {}, "jobs": 1, "load": 0.0, "wall_s": 1.0, "version": "",
        } | changes
    )  # fmt: skip


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    site = load_site(ESTIG)
    drawn = draw(runner.read_spec(site, ESTIG), 1, 2)[0]
    start = (site.site.places["a"].x, site.site.places["a"].y)
    records = [
        a_record(
            setup=setup, time_s=time_s, distance_m=time_s / 10.0,
            timeline=Timeline(
                poses=[(0.1 * step, start[0], start[1] + 0.01 * step) for step in range(int(10 * time_s))],
                paths=[], areas=[(0.0, drawn.area, False), (6.0, drawn.area, True)], barrier_at=5.0,
            ),
        )
        for setup, time_s in (("default", 20.0), ("fog", 10.0))
    ]  # fmt: skip
    file = tmp_path_factory.mktemp("film") / "film.gif"
    size = Film(site, drawn, records).write(file)
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


def test_a_drive_that_was_recorded_without_what_is_to_be_seen_is_refused_by_name():
    with pytest.raises(UnfilmedDriveError, match="0002-ab-fog has nothing to show"):
        Film(load_site(ESTIG), draw(runner.read_spec(load_site(ESTIG), ESTIG), 1, 2)[0], [a_record()])
