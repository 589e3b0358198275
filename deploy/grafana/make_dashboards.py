"""Writes Grafana's dashboards (`deploy/grafana/dashboards/*.json`) from the table in `panels.py`.

Run: python deploy/grafana/make_dashboards.py [--check]. With --check nothing is written, and the exit code is 1 if a
file is out of date.
"""

import sys
from itertools import count
from pathlib import Path
from typing import Final, cast

from grafana_foundation_sdk.builders import common, dashboard, prometheus, stat, statetimeline, timeseries
from grafana_foundation_sdk.cog.encoder import JSONEncoder
from grafana_foundation_sdk.models.common import StackingMode, TimeZoneBrowser
from grafana_foundation_sdk.models.dashboard import (
    DashboardCursorSync,
    DataSourceRef,
    DynamicConfigValue,
    GridPos,
    VariableRefresh,
)
from panels import DASHBOARDS, Dashboard, Panel

FOLDER: Final = Path(__file__).parent / "dashboards"
_SOURCE: Final = DataSourceRef(type_val="prometheus", uid="prometheus")
_WIDTH: Final = 24
_HEIGHT: Final = 8
_RECORDED: Final = "recorded "
"""Legends of baselines begin so: lines to compare with, drawn dashed."""

AnyPanel = timeseries.Panel | statetimeline.Panel | stat.Panel


def _empty(panel: Panel) -> AnyPanel:
    if panel.kind == "states":
        return statetimeline.Panel().merge_values(merge_values=True).row_height(0.8)
    if panel.kind == "number":
        return stat.Panel()
    lines = timeseries.Panel().line_width(1).fill_opacity(10)
    if any(legend.startswith(_RECORDED) for _, legend in panel.queries):
        dashed = common.LineStyle().fill("dash").dash([8.0, 6.0]).build()
        lines = lines.override_by_regexp(
            f"^{_RECORDED}",
            [
                DynamicConfigValue(id_val="custom.lineStyle", value=dashed),
                DynamicConfigValue(id_val="custom.fillOpacity", value=0),
            ],
        )
    if panel.kind == "stacked":
        lines = lines.stacking(common.StackingConfig().mode(StackingMode.NORMAL).group("A")).fill_opacity(40)
    return lines


def _panel(panel: Panel, x: int, y: int) -> AnyPanel:
    made = _empty(panel).title(panel.title).description(panel.about).unit(panel.unit).datasource(_SOURCE)
    for number, (expression, legend) in enumerate(panel.queries):
        query = prometheus.Dataquery().expr(expression).legend_format(legend).ref_id(chr(ord("A") + number))
        made = made.with_target(query)
    if panel.needs:
        made = made.no_value(f"no data: this needs {panel.needs}")
    return cast("AnyPanel", made.grid_pos(GridPos(h=_HEIGHT, w=panel.width, x=x, y=y)))


def _text(page: Dashboard) -> str:
    made = (
        dashboard.Dashboard(f"Fognav: {page.title}")
        .uid(page.uid)
        .tags(["fognav"])
        .timezone(TimeZoneBrowser)
        .time("now-30m", "now")
        .refresh("10s")
        .tooltip(DashboardCursorSync.CROSSHAIR)
        .readonly()
    )
    if page.by_robot:
        made = made.with_variable(
            dashboard.QueryVariable("robot")
            .label("Robot")
            .datasource(_SOURCE)
            .query("label_values(fognav_robot_mode, robot)")
            .refresh(VariableRefresh.ON_TIME_RANGE_CHANGED)
            .multi(multi=True)
            .include_all(include_all=True)
            .all_value(".+")
        )
    y, ids = 0, count(1)
    for title, panels in page.rows:
        made = made.with_row(dashboard.Row(title).id(next(ids)).grid_pos(GridPos(h=1, w=_WIDTH, x=0, y=y)))
        y, x = y + 1, 0
        for panel in panels:
            if x + panel.width > _WIDTH:
                x, y = 0, y + _HEIGHT
            made = made.with_panel(_panel(panel, x, y).id(next(ids)))
            x += panel.width
        y += _HEIGHT
    return f"{JSONEncoder(sort_keys=True, indent=1).encode(made.build())}\n"


def main() -> int:
    """Write the files, or compare them."""
    check = "--check" in sys.argv[1:]
    stale = []
    for page in DASHBOARDS:
        file, text = FOLDER / f"{page.uid}.json", _text(page)
        if not file.exists() or file.read_text("utf-8") != text:
            stale.append(file.name)
            if not check:
                file.write_text(text, "utf-8")
    if stale:
        print(f"{'out of date: run this without --check:' if check else 'wrote'} {', '.join(stale)}")
    return 1 if check and stale else 0


if __name__ == "__main__":
    raise SystemExit(main())
