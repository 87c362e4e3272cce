"""`deepaccident safety`: text, JSON, pages and files of its topics."""

import json
from functools import partial
from pathlib import Path

import pytest
from support.command_calls import invoke_command
from support.damaged_releases import damage_release
from support.report_page import read_report
from support.text_contents import missing_parts

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.plugins.safety import avoidability_report
from deepaccident_devkit.support.text import counted

pytestmark = pytest.mark.slow


run = partial(invoke_command, "safety")


def test_from_a_damaged_release_to_a_page(own_release: Path, tmp_path: Path) -> None:
    damaged, out = damage_release(own_release), tmp_path / "out"
    options = ("--replays", 1, "--on-error", "skip", "--workers", 1)

    output = run("report", own_release, "--out", out, *options).output

    dataset = damaged.dataset
    accidents = [token for token in damaged.whole if dataset.get("scenario", token)["collision"]]
    num_accidents = counted(len(accidents), "accident")
    assert f"{num_accidents} of {counted(len(dataset.scenario), 'scenario')}; " in output
    assert f"open {out / 'report.html'} in a browser" in output
    assert len(list((out / "replays").iterdir())) == 1
    page = read_report(out / "report.html").text
    assert missing_parts(page, *accidents, damaged.broken, damaged.without_meta) == []


@pytest.mark.parametrize(("replays", "num_files"), [("None", 0), ("all", 1)])
def test_a_report_of_some_scenarios_has_the_chosen_number_of_replays(
    da_motion: DeepAccident, tmp_path: Path, replays: str, num_files: int
) -> None:
    options = ("--workers", 1, "--where", "collision=true", "--replays", replays)
    output = run("report", da_motion.dataroot, "--out", tmp_path, *options).output
    assert "1 accident of 1 scenario\n" in output
    assert len(list(tmp_path.glob("replays/*"))) == num_files
    assert (tmp_path / "accidents.csv").is_file()


def test_text_and_files(da_motion: DeepAccident, tmp_path: Path) -> None:
    options = ("--workers", 1, "--style", "ieee-page", "--no-title", "--out", tmp_path)
    text = run("avoidability", da_motion.dataroot, *options).stdout

    report = avoidability_report(da_motion, workers=1)
    assert report.to_text() in text
    title = next(line for line in text.splitlines() if line.endswith("need"))
    group = title.split(":")[0].replace("-", "_")
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "avoidability.json",
        "avoidability_last_moments.csv",
        "avoidability_left_out.csv",
        "avoidability_outcome_shares.csv",
        "avoidability_secondary_contacts.csv",
        "avoidability_self_check.csv",
        f"avoidability_{group}.pdf",
        f"avoidability_{group}.png",
    ]
    assert (tmp_path / "avoidability.json").read_text(encoding="utf-8") == report.to_json()
    assert "wrote 7 files" in text
    figure = (tmp_path / f"avoidability_{group}.pdf").read_bytes()
    assert b"/MediaBox [ 0 0 515" in figure  # 7.16 inches of 72 points


def test_json_of_chosen_scenarios(da_motion: DeepAccident, tmp_path: Path) -> None:
    options = ("--json", "--where", "collision=false", "--out", tmp_path)
    result = run("avoidability", da_motion.dataroot, *options)
    report = json.loads(result.stdout)
    assert report["accidents"] == []
    assert report["skipped"] == {}
    assert "wrote 6 files" in result.stderr
