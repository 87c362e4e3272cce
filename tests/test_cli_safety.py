"""`deepaccident safety`: text, JSON, pages and files of its topics."""

import json
from functools import partial
from pathlib import Path

import pytest
from damaged_releases import damaged_release
from report_page import page_of
from verbs import called

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.plugins.safety import avoidability_report
from deepaccident_devkit.support.text import counted

pytestmark = pytest.mark.slow


run = partial(called, "safety")


def test_from_a_damaged_release_to_a_page(own_release: Path, tmp_path: Path) -> None:
    damaged, out = damaged_release(own_release), tmp_path / "out"
    text = run(
        "report", own_release, "--out", out, "--replays", 1, "--on-error", "skip", "--workers", 1
    ).output
    accidents = [
        token for token in damaged.whole if damaged.dataset.get("scenario", token)["collision"]
    ]
    assert (
        f"{counted(len(accidents), 'accident')} of "
        f"{counted(len(damaged.dataset.scenario), 'scenario')}; " in text
    )
    assert f"open {out / 'report.html'} in a browser" in text
    assert len(list((out / "replays").iterdir())) == 1
    page = page_of(out / "report.html").text
    assert [
        each for each in (*accidents, damaged.broken, damaged.without_meta) if each not in page
    ] == []


@pytest.mark.parametrize(("wanted", "replays"), [("None", 0), ("all", 1)])
def test_some_scenarios_and_as_many_replays(
    da_motion: DeepAccident, tmp_path: Path, wanted: str, replays: int
) -> None:
    words = (
        "report",
        da_motion.dataroot,
        "--out",
        tmp_path,
        "--workers",
        1,
        "--where",
        "collision=true",
    )
    assert "1 accident of 1 scenario\n" in run(*words, "--replays", wanted).output
    assert len(list(tmp_path.glob("replays/*"))) == replays
    assert (tmp_path / "accidents.csv").is_file()


def test_text_and_files(da_motion: DeepAccident, tmp_path: Path) -> None:
    text = run(
        "avoidability",
        da_motion.dataroot,
        "--workers",
        1,
        "--style",
        "ieee-page",
        "--out",
        tmp_path,
    ).stdout
    report = avoidability_report(da_motion, workers=1)
    assert report.to_text() in text
    group = (
        next(line for line in text.splitlines() if line.endswith("need"))
        .split(":")[0]
        .replace("-", "_")
    )
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
    assert "written: 7 files" in text
    assert (
        b"/MediaBox [ 0 0 515" in (tmp_path / f"avoidability_{group}.pdf").read_bytes()
    )  # 7.16 inches of 72 points


def test_json_of_chosen_scenarios(da_motion: DeepAccident, tmp_path: Path) -> None:
    result = run(
        "avoidability",
        da_motion.dataroot,
        "--json",
        "--where",
        "collision=false",
        "--out",
        tmp_path,
    )
    told = json.loads(result.stdout)
    assert (told["accidents"], told["skipped"], "written: 6 files" in result.stderr) == (
        [],
        {},
        True,
    )
