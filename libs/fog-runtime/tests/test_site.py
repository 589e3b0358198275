import re

import numpy as np
import pytest

from fog_contracts.geometry import contains_point
from fog_contracts.grid import GridGeometry, StaticMap
from fog_contracts.messages import AREAS_MAX
from fog_runtime.configuration.maps import save_map
from fog_runtime.configuration.site import SiteError, load_site

SITE = """
id = "lab"
name = "A small lab"

[places.door]
x = 1.0
y = 1.0

[places.desk]
x = 3.0
y = 1.0
theta = 1.5

[[areas]]
id = "a1"
number = 1
polygon = [[1.5, 1.5], [1.5, 0.5], [2.5, 0.5], [2.5, 1.5]]

[[nodes]]
id = "n1"
area = "a1"
x = 2.0
y = 1.95
theta = -1.57
sonars = [{ range_limit = 1.5 }, { angle = 0.2, range_limit = 1.5, no_echo_is_clear = true }]

[[robots]]
id = "r1"
start = { x = 0.5, y = 0.5, theta = 0 }
radius = 0.2

[demo]
start = "door"
goal = "desk"
areas = ["a1"]
"""

POLYGON = "polygon = [[1.5, 1.5], [1.5, 0.5], [2.5, 0.5], [2.5, 1.5]]"
OF_ANOTHER_AREA = f'cone_of = "n1"\n[[areas]]\nid = "a2"\n{POLYGON}'


@pytest.fixture
def folder(tmp_path):
    cells = np.zeros((20, 40), dtype=np.uint8)
    cells[-1, :] = 254
    cells[:, -1] = 255
    save_map(tmp_path / "map", StaticMap(GridGeometry(40, 20, 0.1, 0.0, 0.0), cells))
    (tmp_path / "site.toml").write_text(SITE)
    return tmp_path


def test_site_loads_with_its_map_and_counter_clockwise_areas(folder):
    loaded = load_site(folder)
    assert loaded.directory == folder
    assert loaded.map.geometry.bounds == (0.0, 0.0, 4.0, 2.0)
    assert loaded.site.areas[0].polygon == [(2.5, 1.5), (2.5, 0.5), (1.5, 0.5), (1.5, 1.5)][::-1]
    assert loaded.site.definitions()[0].nodes == ["n1"]
    assert loaded.site.nodes[0].sonars[1].no_echo_is_clear
    assert loaded.site.robots[0].start.x == 0.5


@pytest.mark.parametrize(
    ("old", "new", "field", "remedy"),
    [
        ('id = "lab"', 'id = "The Lab"', "id", "a-z0-9"),
        ("x = 1.0\n", "", "places.door", "`x`"),
        ("x = 1.0\n", "x = 9.0\n", "places.door", "off the map"),
        ("x = 1.0\n", "x = 3.95\n", "places.door", "occupied or unknown"),
        ("x = 0.5, y = 0.5", "x = 0.5, y = 1.95", "robots[0].start (r1)", "occupied"),
        ('area = "a1"', 'area = "a2"', "nodes[0].area", "one of: a1"),
        ("y = 1.95", "y = 2.95", "nodes[0] (n1)", "off the map"),
        ("[2.5, 0.5]", "[2.5, -0.5]", "areas[0].polygon (a1), vertex", "off the map"),
        ("[2.5, 0.5], [2.5, 1.5]", "[2.5, 1.5], [2.5, 0.5]", "areas[0].polygon (a1)", "crosses itself"),
        (f"{POLYGON}\n", "", "areas[0] (a1)", "Add `polygon`, or `cone_of`"),
        (POLYGON, f'{POLYGON}\ncone_of = "n1"', "areas[0].cone_of (a1)", "Leave out one"),
        (POLYGON, 'cone_of = "n7"', "areas[0].cone_of (a1): there is no node 'n7'", "one of the area's nodes: n1"),
        (
            POLYGON,
            'cone_of = "n1"',
            "areas[0].cone_of (a1): node n1 at (2, 1.95) sees nothing",
            "give the area a polygon",
        ),
        (POLYGON, OF_ANOTHER_AREA, "areas[0].cone_of (a1): node 'n1' watches area 'a2'", "(none defined)"),
        ("number = 1", "nummber = 1", "areas[0].nummber", "spelling"),
        ("angle = 0.2", "angel = 0.2", "nodes[0].sonars[1].angel", "spelling"),
        ('goal = "desk"', 'goal = "roof"', "demo.goal", "one of: desk, door"),
        ('areas = ["a1"]', 'areas = ["a7"]', "demo.areas[0]", "one of: a1"),
        ('id = "n1"', 'id = "planner"', "nodes[0].id", "name of a role"),
        ("[demo]", '[[zone_sources]]\nid = "console"\n[demo]', "zone_sources[0].id", "name of a role"),
        (
            "radius = 0.2",
            'radius = 0.2\nidle = { go = "hall" }',
            "robots[0].idle.go (r1)",
            "or a place of the site: desk, door",
        ),
        ("radius = 0.2", 'radius = 0.2\nidle = { go = "dock" }', "robots[0].idle.go (r1)", "Set `dock` of the robot"),
        ("[demo]", '[visitors]\nrobots = ["r9"]\n[demo]', "visitors.robots[0]", "Use one of"),
        ("[demo]", '[[zone_sources]]\nid = "n1"\n[demo]', "nodes.id and zone_sources.id", "twice"),
        (
            "[demo]",
            '[[robots]]\nid = "r1"\nstart = { x = 1, y = 1, theta = 0 }\nradius = 1\n[demo]',
            "robots.id",
            "twice",
        ),
        ("radius = 0.2\n", "", "robots[0]", "required field `radius`. Add `radius`, how far (m) the robot's body"),
        ('name = "A small lab"', 'map = "none.yaml"', "map", "none.yaml"),
        ("range_limit = 1.5 }, {", "range_limit = 9 }, {", "nodes[0].sonars[0].range_limit", "4.0"),
    ],
)
def test_invalid_site_is_refused_by_file_and_field_with_a_remedy(folder, old, new, field, remedy):
    assert SITE.count(old) >= 1
    changed = SITE.replace(old, new, 1)
    if new == OF_ANOTHER_AREA:
        changed = changed.replace('area = "a1"', 'area = "a2"')
    (folder / "site.toml").write_text(changed)
    with pytest.raises(SiteError) as refused:
        load_site(folder)
    text = str(refused.value)
    assert text.startswith(f"{folder / 'site.toml'}: {field}"), text
    assert remedy in text, text


MARKER = "[[markers]]\nid = 7\nx = 1.0\ny = 1.93\ntheta = -1.5708\n"


def test_marker_on_a_wall_that_looks_at_free_floor_is_part_of_the_site(folder):
    (folder / "site.toml").write_text(SITE + MARKER)
    (marker,) = load_site(folder).site.markers
    assert (marker.id, marker.x, marker.y, marker.theta, marker.size) == (7, 1.0, 1.93, -1.5708, 0.16)


@pytest.mark.parametrize(
    ("markers", "field", "problem"),
    [
        (MARKER + MARKER, "markers.id", "7 is used twice"),
        (MARKER.replace("-1.5708", "1.5708"), "markers[0] (7)", "looks at (1.00, 2.08), which is a wall or unknown"),
        (MARKER.replace("1.93", "2.2"), "markers[0] (7)", "off the map"),
        (MARKER.replace("x = 1.0", "x = 3.95"), "markers[0] (7)", "is a wall or unknown"),
        (MARKER.replace("id = 7", "id = 587"), "markers[0].id", "586"),
    ],
    ids=["doubled id", "faces its wall", "off the map", "beside the floor", "no such pattern"],
)
def test_marker_that_no_camera_would_see_and_a_doubled_one_are_named(folder, markers, field, problem):
    (folder / "site.toml").write_text(SITE + markers)
    with pytest.raises(SiteError) as error:
        load_site(folder)
    assert error.value.field == field
    assert problem in str(error.value)


def test_area_that_is_the_cone_of_a_node_has_the_place_that_the_node_sees(folder):
    text = SITE.replace(POLYGON, 'cone_of = "n1"').replace("y = 1.95", "y = 1.85")
    (folder / "site.toml").write_text(text)
    loaded = load_site(folder)
    (area,) = loaded.site.areas
    assert contains_point(area.polygon, 2.1, 0.7)
    assert min(y for _, y in area.polygon) == pytest.approx(1.85 - 1.5, abs=0.02)
    assert loaded.site.definitions()[0].cone_of == "n1"
    assert loaded.site.definitions()[0].polygon == area.polygon
    (folder / "site.toml").write_text(text.replace("x = 2.0", "x = 1.5"))
    moved = load_site(folder).site.areas[0]
    assert np.mean(moved.polygon, axis=0) == pytest.approx(np.mean(area.polygon, axis=0) - (0.5, 0.0), abs=0.02)


def test_site_may_have_as_many_areas_as_fit_into_a_heartbeat_and_no_more(folder):
    def with_areas(count: int) -> str:
        return SITE + "".join(f'[[areas]]\nid = "more{number}"\n{POLYGON}\n' for number in range(count - 1))

    assert len(load_site(folder, with_areas(AREAS_MAX)).site.areas) == AREAS_MAX
    with pytest.raises(SiteError, match=rf"site\.toml: areas: there are {AREAS_MAX + 1} areas, .*Remove some, or make"):
        load_site(folder, with_areas(AREAS_MAX + 1))


def test_invalid_toml_is_refused_with_its_line(folder):
    (folder / "site.toml").write_text(SITE.replace('name = "A small lab"', "name = A small lab"))
    with pytest.raises(
        SiteError, match=re.escape(f"{folder / 'site.toml'} is not valid TOML (Invalid value (at line 3")
    ):
        load_site(folder)


def test_missing_folder_is_refused_with_a_remedy(tmp_path):
    with pytest.raises(SiteError, match="check the path"):
        load_site(tmp_path / "nowhere")
