"""`deepaccident safety`: text, JSON, pages and files of its topics."""

import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from damaged_releases import damaged_release
from report_page import page_of

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.safety import avoidability_report

pytestmark = pytest.mark.slow


def run(*arguments: object) -> Result:
    return CliRunner().invoke(deepaccident, ["safety", *map(str, arguments)])


def test_from_a_damaged_release_to_a_page(own_release: Path, tmp_path: Path) -> None:
    damaged = damaged_release(own_release)
    out = tmp_path / "out"
    result = run("report", own_release, "--out", out, "--replays", "1", "--on-error", "skip", "--workers", "1")
    assert result.exit_code == 0, result.output
    accidents = [token for token in damaged.whole if damaged.dataset.get("scenario", token)["collision"]]
    assert f"{len(accidents)} accidents of {len(damaged.dataset.scenario)} scenarios; " in result.output
    assert f"open {out / 'report.html'} in a browser" in result.output
    assert len(list((out / "replays").iterdir())) == 1
    text = page_of(out / "report.html").text
    assert all(token in text for token in (*accidents, damaged.broken, damaged.without_meta))


def test_some_scenarios_and_no_replays(da_motion: DeepAccident, tmp_path: Path) -> None:
    usual = ("report", da_motion.dataroot, "--out", tmp_path / "out", "--workers", "1")
    result = run(*usual, "--where", "collision=true", "--replays", "None")
    assert result.exit_code == 0, result.output
    assert "1 accidents of 1 scenarios\n" in result.output
    assert not (tmp_path / "out" / "replays").exists()
    assert (tmp_path / "out" / "accidents.csv").is_file()
    none = run(*usual, "--where", "length=1000..2000")
    assert none.exit_code == 2
    assert "no scenario matches --where" in none.output


def test_how_many_replays(da_motion: DeepAccident, tmp_path: Path) -> None:
    wrong = run("report", da_motion.dataroot, "--out", tmp_path, "--replays", "-1")
    assert wrong.exit_code == 2
    assert "expected a number, all or none, found '-1'" in wrong.output
    every = run("report", da_motion.dataroot, "--out", tmp_path, "--replays", "all", "--workers", "1")
    assert every.exit_code == 0, every.output
    assert len(list((tmp_path / "replays").iterdir())) == 1


def test_text_and_files(da_motion: DeepAccident, tmp_path: Path) -> None:
    text = run("avoidability", da_motion.dataroot, "--workers", 1, "--out", tmp_path).stdout
    report = avoidability_report(da_motion, workers=1)
    assert report.to_text() in text
    group = next(line for line in text.splitlines() if line.endswith("need")).split(":")[0].replace("-", "_")
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "avoidability.json",
        "avoidability_last_moments.csv",
        "avoidability_left_out.csv",
        "avoidability_outcome_shares.csv",
        "avoidability_secondary_contacts.csv",
        "avoidability_self_check.csv",
        f"avoidability_{group}.png",
    ]
    assert (tmp_path / "avoidability.json").read_text(encoding="utf-8") == report.to_json()
    assert "written: 7 files" in text


def test_json_of_chosen_scenarios(da_motion: DeepAccident, tmp_path: Path) -> None:
    words = ("avoidability", da_motion.dataroot, "--json", "--where", "collision=false", "--out", tmp_path)
    result = run(*words)
    told = json.loads(result.stdout)
    assert told["accidents"] == []
    assert told["skipped"] == {}
    assert "written: 6 files" in result.stderr


def test_what_a_topic_needs(tmp_path: Path) -> None:
    for words, told in {
        ("report", "release"): "Missing option '--out'",
        ("raport", "release"): "'raport' is not one of",
        ("lead-time", "release", "a/b"): "SCENARIO changes nothing with lead-time",
    }.items():
        result = run(*words)
        assert (result.exit_code, told in result.output) == (2, True), result.output
