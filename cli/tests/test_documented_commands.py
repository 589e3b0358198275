"""Every command that a document tells people to type exists, and has the options that it is given there.

Their values, and a command's arguments, are not looked at.
"""

import re
import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner

from fognav.__main__ import app

ROOT = Path(__file__).parents[2]
DOCUMENTS = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md"), ROOT / "firmware" / "README.md"])
COMMANDS = re.compile(r"^(?:[A-Z_]+=\S+ )*(?:\./)?fognav (.*)$")


def documented(document: Path) -> list[str]:
    blocks = re.findall(r"```sh\n(.*?)```", document.read_text("utf-8"), re.DOTALL)
    lines = [line for block in blocks for line in re.sub(r"\\\n\s*", " ", block).splitlines()]
    parts = [part.strip() for line in lines for part in re.split(r" && | \| |; | & ?$", line)]
    return [found[1] for part in parts if (found := COMMANDS.match(part))]


def problem(words: list[str]) -> str | None:
    """Return what the command line finds wrong with the names of a command and its options, which it does not run."""
    done = CliRunner().invoke(app, [*words, "--help"])
    return None if done.exit_code == 0 else done.output


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_documented_commands_are_accepted(document: Path) -> None:
    lines = {line: shlex.split(re.split(r" [<>]", line)[0], comments=True) for line in documented(document)}
    assert {line: found for line, words in lines.items() if (found := problem(words)) is not None} == {}


def test_commands_are_found_in_the_documents_and_a_wrong_one_is_told() -> None:
    assert sum(len(documented(document)) for document in DOCUMENTS) > 55
    assert "No such option" in str(problem(["up", "--flor", "x"]))
    assert "No such command" in str(problem(["upp"]))


def test_commands_that_the_console_and_messages_name_exist() -> None:
    texts = [(path, r"\bfognav ") for path in (ROOT / "console" / "src").rglob("*.ts*")]
    parts = ("cli", "robot-agent", "libs", "services", "experiments")
    texts += [(path, r"`(?:\./)?fognav ") for part in parts for path in (ROOT / part).rglob("src/**/*.py")]
    named = {
        found.strip()
        for path, before in texts
        for found in re.findall(before + r"([a-z][a-z-]*(?: [a-z][a-z-]*)?)", path.read_text("utf-8"))
    }
    assert "token create" in named
    assert {words: found for words in sorted(named) if (found := problem(words.split())) is not None} == {}
