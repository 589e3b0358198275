"""What the pictures of panels show: nothing where there was no data, and nothing beyond the plot."""

from pathlib import Path

import pytest
from PIL import Image, ImageColor

FOLDER = Path(__file__).parents[2] / "deploy" / "grafana"


@pytest.fixture
def drawn(tmp_path, monkeypatch):
    """Return a function that draws one panel of a series over 100 s, and returns where its colour is, x by y."""
    monkeypatch.syspath_prepend(FOLDER)
    import panel_picture  # noqa: PLC0415  # it lies beside the program that uses it
    from panels import Panel  # noqa: PLC0415  # same

    def draw(kind, points):
        file = tmp_path / "page.png"
        panel = Panel("Title", "About", (("up", "name"),), kind)
        panel_picture.draw_page(file, "Page", [(panel, [panel_picture.Series("name", points)])], seconds=100.0)
        picture, colour = Image.open(file).convert("RGB"), ImageColor.getrgb(panel_picture._COLOURS[0])
        left = panel_picture._LEFT
        width = panel_picture._WIDTH - left - panel_picture._RIGHT
        found = {
            x for x in range(picture.width) for y in range(picture.height) if picture.getpixel((x, y)) == colour
        }  # fmt: skip
        legend = {x for x in found if left + width + 8 <= x <= left + width + 15}
        return {round(100 * (x - left) / width) - 100 for x in found - legend}

    return draw


def test_line_is_broken_where_there_was_no_data(drawn):
    found = drawn("lines", [(at, 1.0) for at in (-90.0, -80.0, -70.0, -30.0, -20.0)])
    assert {-85, -75, -25} <= found
    assert found.isdisjoint(range(-67, -33))


@pytest.mark.parametrize("points", [[(-10.0, 1.0)], [(-10.0, 1.0), (-5.0, 1.0)], [(-60.0, 1.0), (1e-6, 1.0)]])
def test_state_ends_at_the_plot_s_border(drawn, points):
    found = drawn("states", points)
    assert min(found) == pytest.approx(points[0][0], abs=1)
    assert max(found) <= 0


def test_state_that_is_not_so_is_told_from_one_of_which_there_is_no_data(drawn):
    found = drawn("states", [(-90.0, 0.0), (-80.0, 0.0), (-40.0, 1.0), (-30.0, 1.0)])
    assert {-85, -35} <= found
    assert found.isdisjoint(range(-67, -43))
