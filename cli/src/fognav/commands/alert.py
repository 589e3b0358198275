"""`fognav alert`: what needs somebody's attention in a running system."""

from datetime import UTC, datetime
from typing import Annotated

import typer

from fognav.operate.fog import find_fog
from fognav.operate.options import FogOption, JsonOption
from fognav.operate.systems import AGGREGATOR
from fognav.output import exit_codes, print_answer, print_json

alert_app = typer.Typer(help="List and acknowledge alerts of areas and nodes.", no_args_is_help=True)


@alert_app.command("list", epilog="Example: fognav alert list --json")
def alert_list(*, fog: FogOption = None, json: JsonOption = False) -> None:
    """List areas that are unknown or blocked for long, and nodes that are unknown for long."""
    with exit_codes():
        alerts = find_fog(fog).get(AGGREGATOR, "/api/v1/alerts")
        if json:
            print_json({"alerts": alerts})
            return
        for alert in alerts:
            since = datetime.fromtimestamp(alert["since"], UTC).astimezone().isoformat(" ", "seconds")
            seen = f" [{alert['acknowledged_by']} looks after it]" if alert["acknowledged_by"] else ""
            print_answer(f"{alert['id']}: since {since}, {alert['reason']}{seen}")
        if not alerts:
            print_answer("no alerts")


@alert_app.command("acknowledge", epilog="Example: fognav alert acknowledge area-unknown.z1")
def alert_acknowledge(
    alert: Annotated[str, typer.Argument(metavar="ALERT", help="The alert's id, as fognav alert list shows it.")],
    *,
    fog: FogOption = None,
    json: JsonOption = False,
) -> None:
    """Tell others that you look after an alert. It stays until its cause ends."""
    with exit_codes():
        seen = find_fog(fog).send("PUT", AGGREGATOR, f"/api/v1/alerts/{alert}/acknowledgement")
        if json:
            print_json({"alert": seen})
        else:
            print_answer(f"{alert} is acknowledged by {seen['acknowledged_by']}")
