"""`deepaccident safety avoidability`: text, JSON, and files."""

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.safety import avoidability_report

pytestmark = pytest.mark.slow


def run(*arguments: object) -> tuple[str, str]:
    result = CliRunner().invoke(deepaccident, ["safety", "avoidability", *map(str, arguments)], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout, result.stderr


def test_text_and_files(da_motion: DeepAccident, tmp_path: Path) -> None:
    text, _ = run(da_motion.dataroot, "--workers", 1, "--out", tmp_path)
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
    text, other = run(da_motion.dataroot, "--json", "--where", "collision=false", "--out", tmp_path)
    told = json.loads(text)
    assert told["accidents"] == []
    assert told["skipped"] == {}
    assert "written: 6 files" in other
