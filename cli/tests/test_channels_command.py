"""`fognav channels`, and that the generated files of the checkout are up to date."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from fog_contracts.generate.acl import mqtt_acl, zenoh_acl
from fog_contracts.generate.header import firmware_header
from fognav import checkout, generated
from fognav.__main__ import app

runner = CliRunner()


@pytest.mark.parametrize("name", generated.FILES)
def test_generated_file_is_up_to_date(name: str) -> None:
    committed = (checkout.root() / name).read_text("utf-8")
    assert committed == generated.FILES[name](), f"{name} is out of date. Run: {generated.WRITE}"


def test_routes_of_all_services_are_in_the_document() -> None:
    text = generated.markdown()
    for route in ("PUT /api/v1/areas/{area_id}", "POST /api/v1/zones", "PUT /api/v1/robots/{robot}/goal"):
        assert text.count(f"| `{route}` |") == 1


def test_printed_formats_equal_the_generated_files() -> None:
    assert runner.invoke(app, ["channels", "--format", "header"]).stdout == firmware_header()
    assert runner.invoke(app, ["channels", "--format", "acl"]).stdout == mqtt_acl() + zenoh_acl()
    assert runner.invoke(app, ["channels", "--format", "acl", "--broker", "mqtt"]).stdout == mqtt_acl()
    assert runner.invoke(app, ["channels"]).stdout == generated.markdown()


def test_lists_for_a_site_name_it_and_its_robots() -> None:
    done = runner.invoke(app, ["channels", "--format", "acl", "--broker", "zenoh", "--site", "estig"])
    assert done.exit_code == 0
    assert done.stdout == zenoh_acl("estig", ["r1"])


@pytest.mark.parametrize(
    "arguments", [["--broker", "mqtt"], ["--format", "header", "--site", "estig"], ["--format", "acl", "--site", "x/y"]]
)
def test_options_that_do_not_match_the_format_are_wrong_use(arguments: list[str]) -> None:
    assert runner.invoke(app, ["channels", *arguments]).exit_code == 2


def test_stale_file_is_listed_by_check_and_updated_by_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkout, "root", lambda: tmp_path)
    monkeypatch.setattr(generated, "FILES", {"a/acl": mqtt_acl, "b/header.h": firmware_header})
    assert runner.invoke(app, ["channels", "--check"]).exit_code == 1
    assert "a/acl, b/header.h" in runner.invoke(app, ["channels", "--write"]).output
    assert runner.invoke(app, ["channels", "--check"]).exit_code == 0
    (tmp_path / "a" / "acl").write_text("# by hand\n")
    done = runner.invoke(app, ["channels", "--check"])
    assert done.exit_code == 1
    assert "a/acl: out of date. Run: ./fognav channels --write" in done.output
    assert "up to date" not in runner.invoke(app, ["channels", "--write"]).output
    assert (tmp_path / "a" / "acl").read_text() == mqtt_acl()
    assert "up to date" in runner.invoke(app, ["channels", "--write"]).output


@pytest.mark.parametrize("seed", ["1", "2"])
@pytest.mark.drive
def test_generated_files_do_not_depend_on_the_hash_seed(seed: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "fognav", "channels", "--check"],
        env={**os.environ, "PYTHONHASHSEED": seed}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
