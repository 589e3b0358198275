"""Whoever silences a checker says why, beside it."""

import io
import re
import subprocess
import tokenize
from pathlib import Path

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


def test_every_silenced_checker_carries_its_reason() -> None:
    silent = {str(path.relative_to(ROOT)): unexplained(path.read_text("utf-8")) for path in sources()}
    assert len(silent) > 100
    assert {name: found for name, found in silent.items() if found} == {}
