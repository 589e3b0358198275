"""docs/security.md: each claim names a test that shows it, and each such test exists."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "security.md").read_text("utf-8")
SHOWN_BY = re.compile(r"`(?P<file>[\w/-]+/test_\w+\.py)::(?P<name>test_\w+)`")


def functions_in(file: str) -> set[str]:
    tree = ast.parse((ROOT / file).read_text("utf-8"))
    return {
        node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    }  # fmt: skip


def test_each_claim_names_an_existing_test() -> None:
    rows = [line for line in TEXT.partition("## Claims")[2].splitlines() if line.startswith("| ")][1:]
    assert len(rows) >= 15
    for row in rows:
        named = SHOWN_BY.findall(row)
        assert named, f"no test shows: {row}"
        for file, name in named:
            assert name in functions_in(file), f"{file} has no {name}"


def test_each_test_of_access_is_named_by_a_claim() -> None:
    written = {name for name in functions_in("tests/security/test_access.py") if name.startswith("test_")}
    assert written <= {name for _, name in SHOWN_BY.findall(TEXT)}
