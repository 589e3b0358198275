"""What the pictures of panels show: nothing where there was no data, and nothing beyond the plot."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

FOLDER = Path(__file__).parents[2] / "deploy" / "grafana"


@pytest.fixture
def drawn(monkeypatch):
    """Return a function that draws one panel of a series over 100 s, and returns its axes."""
    monkeypatch.syspath_prepend(FOLDER)
    import panel_picture  # noqa: PLC0415  # it lies beside the program that uses it
    from panels import Panel  # noqa: PLC0415  # same

    def draw(kind, points):
        axes = Figure().add_subplot()
        panel = Panel("Title", "About", (("up", "name"),), kind)
        panel_picture.draw_panel(axes, panel, [panel_picture.Series("name", points)], seconds=100.0)
        return axes

    return draw


def bands(axes):
    """Return from when to when bands are drawn, and how high they are."""
    boxes = [path.get_extents() for drawn in axes.collections for path in drawn.get_paths()]
    return sorted((round(box.x0, 3), round(box.x1, 3), round(box.height, 2)) for box in boxes)


def test_line_is_broken_where_there_was_no_data(drawn):
    line = drawn("lines", [(at, 1.0) for at in (-90.0, -80.0, -70.0, -30.0, -20.0)]).lines[0]
    np.testing.assert_array_equal(line.get_ydata(), [1.0, 1.0, 1.0, np.nan, 1.0, 1.0])


@pytest.mark.parametrize("points", [[(-10.0, 1.0)], [(-10.0, 1.0), (-5.0, 1.0)], [(-60.0, 1.0), (1e-6, 1.0)]])
def test_state_ends_at_the_plot_s_border(drawn, points):
    found = bands(drawn("states", points))
    assert found[0][0] == points[0][0]
    assert max(end for _, end, _ in found) <= 0.0


def test_state_that_is_not_so_is_told_from_one_of_which_there_is_no_data(drawn):
    found = bands(drawn("states", [(-90.0, 0.0), (-80.0, 0.0), (-40.0, 1.0), (-30.0, 1.0)]))
    assert found == [(-90.0, -80.0, 0.04), (-80.0, -70.0, 0.04), (-40.0, -30.0, 0.9), (-30.0, -20.0, 0.9)]
