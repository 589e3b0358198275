"""Mutation tests: which changes are made of a module, and which of them a part's tests notice."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from typing import Any

import pytest

from fognav import checkout
from fognav.output import WrongUseError
from fognav_experiments import mutation
from fognav_experiments.mutants import mutants, mutate
from fognav_experiments.mutation import PARTS, ModuleScore, Survivor, parts_named, score


def changes(source: str) -> list[str]:
    return [f"{mutant.before} -> {mutant.after}" for mutant in mutants(source)]


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("a < b", ["a < b -> a <= b", "a < b -> a >= b"]),
        ("a == b", ["a == b -> a != b"]),
        ("a is None", ["a is None -> a is not None"]),
        ("a < b <= c", ["a < b <= c -> a <= b <= c", "a < b <= c -> a >= b <= c", "a < b <= c -> a < b < c",
                        "a < b <= c -> a < b > c"]),
        ("a and b", ["a and b -> a or b"]),
        ("a + b", ["a + b -> a - b"]),
        ("a / b", ["a / b -> a * b"]),
        ("not a", ["not a -> a"]),
        ("-a", ["-a -> a"]),
        ("max(a, b)", ["max(a, b) -> pass", "max(a, b) -> min(a, b)"]),
        ("x = all(a)", ["all(a) -> any(a)"]),
        ("x = True", ["True -> False"]),
        ("x = 3", ["3 -> 4"]),
        ("x = 0.5", ["0.5 -> 0.55"]),
        ("x = 1e-09", ["1e-09 -> 1.000000001"]),
        ("x = b'no'", ["b'no' -> b'noX'"]),
        ("x = 'lost'", ["'lost' -> 'lostX'"]),
        ("x = 'a sentence for people'", []),
        ("x: float = y", []),
        ("x: Literal['a'] = y", []),
        ("X = Literal['a', 'b']", []),
        ("import a", []),
        ("if TYPE_CHECKING:\n    x = 1", []),
        ("'''Text.'''", []),
        ("@d(x=True)\nclass A(B, frozen=True):\n    pass", []),
        ("self.a = b", ["self.a = b -> pass"]),
        ("a = b", []),
        ("x = a if b else c", ["a if b else c -> a if not b else c"]),
        ("log_event('end', code=3)", []),
    ],
)  # fmt: skip
def test_changes_of_code_that_runs(source: str, expected: list[str]) -> None:
    assert changes(source) == expected


def test_changed_module_differs_in_that_place_only() -> None:
    source = "def f(a):\n    if a > 1:\n        return a + 1\n    return 1\n"
    texts = {ast.unparse(mutate(source, mutant)) for mutant in mutants(source)}
    assert len(texts) == len(mutants(source)) == 6
    assert ast.unparse(ast.parse(source.replace("a > 1", "a > 2"))) in texts


def test_part_covers_every_module_of_its_package() -> None:
    files = {part.name: part.files(checkout.root()) for part in PARTS}
    folder = checkout.root() / "robot-agent/src/robot_agent/safety"
    assert set(files["safety"].values()) == set(folder.glob("*.py")) - {folder / "__init__.py"}
    assert "robot_agent.guardian.core" in files["guardian"]
    assert parts_named([]) == list(PARTS)
    with pytest.raises(WrongUseError, match="there is no part 'wheels': name one of safety, guardian"):
        parts_named(["wheels"])


def test_score_is_the_share_of_noticed_mutants_and_nine_of_ten_pass() -> None:
    mutant = mutants("x = 1")[0]
    good = ModuleScore("a.b", 10, [Survivor("a.b", mutant)])
    assert (good.killed, score([good])) == (9, 0.9)
    assert mutation.passes({"a": [good]})
    assert not mutation.passes({"a": [good._replace(mutants=9)]})
    assert score([]) == 1.0
    text = "\n".join(mutation.report_lines({"a": [good]}))
    assert "9 of 10 mutants noticed" in text
    assert "survives: a.b:1: x = 1: 1 -> 2" in text
    assert mutation.report_values({"a": [good]})["a"]["score"] == 0.9


def fognav(*arguments: str) -> tuple[int, dict[str, Any]]:
    command = [sys.executable, "-m", "fognav", "bench", "mutation", "--json", *arguments]
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("COVERAGE", "COV_CORE"))}
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=600, env=environment)
    assert done.stdout, done.stderr
    return done.returncode, json.loads(done.stdout)["parts"]


@pytest.mark.timeout(700)
@pytest.mark.long
def test_each_change_of_a_module_is_tried_and_those_that_no_test_notices_are_named() -> None:
    code, parts = fognav("--part", "guardian", "--module", "guardian.link")
    (link,) = (module for module in parts["guardian"]["modules"] if module["mutants"])
    assert link["module"] == "robot_agent.guardian.link"
    source = checkout.root() / "robot-agent/src/robot_agent/guardian/link.py"
    assert link["mutants"] == len(mutants(source.read_text("utf-8")))
    assert link["killed"] + len(link["survivors"]) == link["mutants"]
    assert link["killed"] > 0
    assert code == (parts["guardian"]["score"] < 0.9)
