"""`deepaccident safety report`: the page, its files, and what is said."""

from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from damaged_releases import damaged_release
from report_page import page_of

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident

pytestmark = pytest.mark.slow


def run(*arguments: object) -> Result:
    return CliRunner().invoke(deepaccident, ["safety", "report", *map(str, arguments)])


def test_from_a_damaged_release_to_a_page(own_release: Path, tmp_path: Path) -> None:
    damaged = damaged_release(own_release)
    out = tmp_path / "out"
    result = run(own_release, "--out", out, "--replays", "1", "--on-error", "skip", "--workers", "1")
    assert result.exit_code == 0, result.output
    accidents = [token for token in damaged.whole if damaged.dataset.get("scenario", token)["collision"]]
    assert f"{len(accidents)} accidents of {len(damaged.dataset.scenario)} scenarios; " in result.output
    assert f"open {out / 'report.html'} in a browser" in result.output
    assert len(list((out / "replays").iterdir())) == 1
    text = page_of(out / "report.html").text
    assert all(token in text for token in (*accidents, damaged.broken, damaged.without_meta))


def test_some_scenarios_and_no_replays(da_motion: DeepAccident, tmp_path: Path) -> None:
    usual = (da_motion.dataroot, "--out", tmp_path / "out", "--workers", "1")
    result = run(*usual, "--where", "collision=true", "--replays", "None")
    assert result.exit_code == 0, result.output
    assert "1 accidents of 1 scenarios\n" in result.output
    assert not (tmp_path / "out" / "replays").exists()
    assert (tmp_path / "out" / "accidents.csv").is_file()
    none = run(*usual, "--where", "length=1000..2000")
    assert none.exit_code == 2
    assert "no scenario matches --where" in none.output


def test_how_many_replays(da_motion: DeepAccident, tmp_path: Path) -> None:
    wrong = run(da_motion.dataroot, "--out", tmp_path, "--replays", "-1")
    assert wrong.exit_code == 2
    assert "expected a number, all or none, found '-1'" in wrong.output
    every = run(da_motion.dataroot, "--out", tmp_path, "--replays", "all", "--workers", "1")
    assert every.exit_code == 0, every.output
    assert len(list((tmp_path / "replays").iterdir())) == 1
