from __future__ import annotations

import pytest

from fog_runtime.configuration import parts

GROUP = "fognav.test_parts"


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Return a function that writes the entry points of a distribution as if it were installed."""
    monkeypatch.syspath_prepend(tmp_path)

    def write(distribution: str, *lines: str) -> None:
        folder = tmp_path / f"{distribution}-1.0.dist-info"
        folder.mkdir()
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.0\n")
        (folder / "entry_points.txt").write_text("\n".join([f"[{GROUP}]", *lines]) + "\n")

    return write


def test_part_is_found_by_its_name(install):
    install("one", "pi = math:pi")
    install("two", "tau = math:tau")
    assert parts.names(GROUP) == ["pi", "tau"]
    assert parts.load(GROUP, "pi", float) == pytest.approx(3.14159, abs=1e-5)


def test_unknown_name_is_refused_with_the_known_ones(install):
    install("one", "pi = math:pi", "tau = math:tau")
    with pytest.raises(parts.PartError, match=r"no 'phi' \(known: pi, tau\)"):
        parts.load(GROUP, "phi", float)


def test_unknown_name_in_an_empty_group_is_refused():
    with pytest.raises(parts.PartError, match="known: none"):
        parts.load(GROUP, "pi", float)


def test_name_that_two_packages_register_is_refused(install):
    install("one", "pi = math:pi")
    install("two", "pi = math:e")
    with pytest.raises(parts.PartError, match="math:e of two, math:pi of one"):
        parts.load(GROUP, "pi", float)


@pytest.mark.parametrize(
    ("value", "text"),
    [("nowhere_at_all:x", "imported"), ("math:no_such", "imported"), ("broken_part:x", "broken on purpose")],
)
def test_part_that_cannot_be_imported_is_named(install, tmp_path, value, text):
    (tmp_path / "broken_part.py").write_text("raise ValueError('broken on purpose')\n")
    install("one", f"pi = {value}")
    with pytest.raises(parts.PartError, match=text):
        parts.load(GROUP, "pi", float)


def test_part_of_the_wrong_type_is_refused(install):
    install("one", "pi = math:pi")
    with pytest.raises(parts.PartError, match="is not a str"):
        parts.load(GROUP, "pi", str)
