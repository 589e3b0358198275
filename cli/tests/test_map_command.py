"""`fognav map hazards`: the watched areas as the map has them."""

import json
from types import SimpleNamespace

from typer.testing import CliRunner

from fognav.__main__ import app
from fognav.commands import area
from fognav.programs import MAP_SERVICE


def view(area, state, penalty, cause, **more):
    return {"hazard": {"area": area, "state": state, "penalty": penalty, "cause": cause}, "confirmed": True, **more}


def test_hazards_are_listed_with_their_meaning_for_a_robot_and_whether_they_are_confirmed(monkeypatch):
    views = [
        view("z3", "unknown", 200, "node n3: silent", confirmed=False),
        view("z1", "clear", 0, ""),
        view("z2", "blocked", 254, "node n2: something at 0.80 m"),
    ]
    lines = [
        "z1: clear, passable",
        "z2: blocked, impassable (node n2: something at 0.80 m)",
        "z3: unknown, cost 200 (node n3: silent), not confirmed: the hazard-aggregator is silent",
    ]
    for found, printed in ((views, lines), ([], ["no watched areas"])):
        fog = SimpleNamespace(
            get=lambda service, path, found=found: {MAP_SERVICE: {"/api/v1/hazards": found}}[service][path]
        )
        monkeypatch.setattr(area, "find_fog", lambda _, fog=fog: fog)
        assert CliRunner().invoke(app, ["map", "hazards"]).output.splitlines() == printed
        assert json.loads(CliRunner().invoke(app, ["map", "hazards", "--json"]).stdout)["hazards"] == found
