"""Whoever silences a checker says why, beside it."""

import io
import re
import subprocess
import tokenize
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SILENCED = re.compile(r"#\s*(ruff:\s*noqa|noqa|type:\s*ignore|mypy:|pylint:|pragma:\s*no)")
EXPLAINED = re.compile(r"# (noqa: [A-Z0-9, ]+|type: ignore\[[a-z, -]+\])  # [\w`].*")
EXPLAINED_FOR_A_FILE = re.compile(r"# ruff: noqa: [A-Z0-9, ]+")


def sources() -> list[Path]:
    listed = subprocess.run(["git", "ls-files", "*.py"], cwd=ROOT, capture_output=True, text=True, check=False)
    return [ROOT / name for name in listed.stdout.split()] or sorted(ROOT.glob("*/**/src/**/*.py"))


def unexplained(source: str) -> list[str]:
    """Return the comments that silence a checker without a reason: behind it, or above it where it is for a file."""
    lines = source.splitlines()
    found = []
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type != tokenize.COMMENT or not SILENCED.match(token.string):
            continue
        above = lines[token.start[0] - 2].lstrip() if token.start[0] > 1 else ""
        explained = EXPLAINED.fullmatch(token.string) or (
            EXPLAINED_FOR_A_FILE.fullmatch(token.string) and above.startswith("# ") and not SILENCED.match(above)
        )
        if not explained:
            found.append(f"line {token.start[0]}: {token.string}")
    return found


def table(name: str) -> list[str]:
    """Return the lines of one table of pyproject.toml."""
    text = (ROOT / "pyproject.toml").read_text("utf-8")
    return text.partition(f"\n[{name}]\n")[2].partition("\n[")[0].splitlines()


def test_every_silenced_checker_carries_its_reason() -> None:
    silent = {str(path.relative_to(ROOT)): unexplained(path.read_text("utf-8")) for path in sources()}
    assert len(silent) > 100
    assert {name: found for name, found in silent.items() if found} == {}


@pytest.mark.parametrize(
    "source",
    [
        "import os  # noqa\n",
        "import os  # noqa: F401\n",
        "import os  # noqa: F401 - kept\n",
        "import os  # noqa: F401  #\n",
        "x: int = ''  # type: ignore\n",
        "x: int = ''  # type: ignore[assignment]\n",
        "if x:  # pragma: no cover\n    pass\n",
        "# mypy: ignore-errors\n",
        "# ruff: noqa: F401\nimport os\n",
        "import sys\n# ruff: noqa: F401\nimport os\n",
    ],
)
def test_an_exemption_without_a_reason_is_found(source: str) -> None:
    assert len(unexplained(source)) == 1


@pytest.mark.parametrize(
    "source",
    [
        "import os  # noqa: F401  # for those who import it from here\n",
        "import os  # noqa: F401, E402  # same\n",
        "x: int = ''  # type: ignore[assignment]  # no better type\n",
        "# All names are for others.\n# ruff: noqa: F401\nimport os\n",
        "x = '# noqa'\n",
    ],
)
def test_an_exemption_with_a_reason_passes(source: str) -> None:
    assert unexplained(source) == []


@pytest.mark.parametrize("name", ["tool.ruff.lint", "tool.ruff.lint.per-file-ignores"])
def test_every_rule_that_is_off_in_many_files_carries_its_reason(name: str) -> None:
    off = [line for line in table(name) if re.search(r'"[A-Z]+[0-9]*"', line) and not line.startswith("select")]
    assert len(off) > 3
    assert [line for line in off if not re.search(r"[],] +# \w", line)] == []


def test_every_exemption_of_mypy_carries_its_reason() -> None:
    lines = (ROOT / "pyproject.toml").read_text("utf-8").splitlines()
    following = [lines[i + 1] for i, line in enumerate(lines) if line == "[[tool.mypy.overrides]]"]
    assert [line for line in following if not line.startswith("# ")] == []
