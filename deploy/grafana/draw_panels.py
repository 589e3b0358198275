"""Draws what each panel of the dashboards shows, by the same queries, without Grafana: one PNG for each page.

Run: python deploy/grafana/draw_panels.py --prometheus http://127.0.0.1:9090 --out FOLDER [--minutes 5] [--rate 1m]
"""

import argparse
import json
import re
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from panel_picture import Series, draw_page
from panels import DASHBOARDS, Panel

_SAMPLES: Final = 240
"""Of each series, over the whole time."""
_LABEL: Final = re.compile(r"\{\{(\w+)\}\}")


def series_of(prometheus: str, panel: Panel, *, minutes: float, rate: str) -> list[Series]:
    """Ask Prometheus what a panel shows over the last minutes; times in s before now.

    `rate` is the window over which counters are derived. Raises `SystemExit` for a query that Prometheus refuses.
    """
    now = time.time()
    found: list[Series] = []
    for query, legend in panel.queries:
        parameters = {
            "query": query.replace("$__rate_interval", rate).replace("$robot", ".+"),
            "start": f"{now - 60 * minutes}",
            "end": f"{now}",
            "step": f"{60 * minutes / _SAMPLES}",
        }
        url = f"{prometheus}/api/v1/query_range?{urllib.parse.urlencode(parameters)}"
        try:
            with urllib.request.urlopen(url, timeout=30.0) as answer:  # noqa: S310  # the address that the user gives
                results = json.load(answer)["data"]["result"]
        except (urllib.error.URLError, KeyError) as error:
            raise SystemExit(f"{url}: {error}. Is Prometheus there, and the query valid?") from error
        for result in results:
            points = [(float(at) - now, float(value)) for at, value in result["values"] if value != "NaN"]
            found.append(Series(_named(legend, result["metric"]), points))
    return sorted(found, key=lambda each: each.name)


def _named(legend: str, labels: Mapping[str, str]) -> str:
    return _LABEL.sub(lambda found: labels.get(found[1], ""), legend)


def main() -> None:
    """Draw every page as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--prometheus", default="http://127.0.0.1:9090", metavar="URL")
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--minutes", type=float, default=5.0, help="how far back")
    parser.add_argument("--rate", default="1m", help="window of rates")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for page in DASHBOARDS:
        panels = [
            (panel, series_of(options.prometheus, panel, minutes=options.minutes, rate=options.rate))
            for _, row in page.rows
            for panel in row
        ]
        draw_page(options.out / f"{page.uid}.png", page.title, panels, seconds=60 * options.minutes)


if __name__ == "__main__":
    main()
