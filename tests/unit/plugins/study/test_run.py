"""Studies of baselines: what is made and stored, what is made again, and what is written."""

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.report_page import read_report
from support.study_recipes import BASELINE_RECIPE, kill_study, write_recipe
from support.text_contents import missing_parts

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ConfigError, ResultsError, SomeFailedError
from deepaccident_devkit.evaluation.runs import SampleSelection, evaluate_results
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.plugins.study import (
    StudyReport,
    read_counts,
    read_recipe,
    run_study,
    summarised,
)
from deepaccident_devkit.plugins.study.summary import ALL
from deepaccident_devkit.render import style

pytestmark = pytest.mark.slow

RunStudy = Callable[..., StudyReport]


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run the small study, and return its folder."""
    folder = tmp_path_factory.mktemp("studies")
    run_study(read_recipe(str(write_recipe(folder, BASELINE_RECIPE))), folder / "out", workers=1)
    return folder / "out"


@pytest.fixture
def run_again(out: Path, tmp_path: Path) -> RunStudy:
    """Return a function that runs the small study, with changes, in the same folder."""

    def run_changed(name: str = "other", **changes: Any) -> StudyReport:
        path = write_recipe(tmp_path, {**BASELINE_RECIPE, **changes}, name)
        return run_study(read_recipe(str(path)), out, workers=1)

    return run_changed


def read_summary(out: Path, name: str = "mine") -> dict[str, Any]:
    return json.loads((out / name / "study.json").read_text(encoding="utf-8"))


def row_times(out: Path) -> dict[str, int]:
    """Return the modification time of each stored row."""
    folder = out / "cells" / "kept" / "row"
    return {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}


def test_each_row_has_the_numbers_of_its_predictions(out: Path) -> None:
    rows = read_summary(out)["rows"]

    def value(row: str, number: str) -> float:
        return rows[row]["groups"][ALL][number]["value"]

    assert value("labels, all", "iou_100") == 100
    assert value("labels, all", "vpq_100") == 100
    assert value("labels, all", "hidden_foreground") == 1
    assert value("sees all", "hidden_detected") == 1
    assert value("labels, single", "hidden_foreground") == 0
    assert value("sees single", "hidden_detected") == 0
    assert value("nothing", "iou_100") == 0
    assert value("nothing", "seen_foreground") == 0
    assert value("everything", "hidden_foreground") == 1
    assert 0 < value("everything", "iou_100") < 100
    assert value("late 0.5 s", "iou_100") < value("late 0.0 s", "iou_100")
    assert value("sees single", "iou_100") < value("sees all", "iou_100") < 100
    for number in rows["nothing"]["groups"][ALL].values():  # two pairs are too few
        assert number["low"] is None
        assert number["seeds"] == {}


def test_groups_count_samples_and_pairs(out: Path) -> None:
    groups = read_summary(out)["groups"]
    assert groups[ALL] == groups["accidents"] == {"samples": 16, "pairs": 2}  # with the twins
    assert groups["long"] == {"samples": 0, "pairs": 0}
    assert groups["impact_step=no impact"] == {"samples": 8, "pairs": 2}
    assert read_summary(out)["rows"]["nothing"]["groups"]["long"]["apa"]["value"] is None


def test_a_row_has_the_numbers_that_evaluate_gives(out: Path) -> None:
    summary = read_summary(out)
    cells = {cell["name"]: cell for cell in summary["cells"]}
    release = DeepAccident(dataroot=out / "release" / cells["test"]["key"], verbose=False)
    assert (cells["test"]["scenarios"], len(release.scenario)) == (4, 4)
    (split,) = (out / "splits").iterdir()
    selection = SampleSelection(split=str(split), scope="all", agents=("ego_vehicle",))
    setup = EvaluationSetup(task="motion", protocol="paper", switches={"labels": "released"})
    results = out / "row" / cells["sees all"]["key"] / "motion"
    run = evaluate_results(release, results, setup, selection, workers=1)
    numbers = summary["rows"]["sees all"]["groups"][ALL]
    assert numbers["iou_100"]["value"] == run.result.ranges["100x100"].iou


def test_the_headline_and_the_differences_follow_from_the_rows(out: Path) -> None:
    summary = read_summary(out)
    rows, headline = summary["rows"], summary["headline"]
    sees_all = rows["sees all"]["groups"]["accidents"]["iou_100"]["value"]
    sees_single = rows["sees single"]["groups"]["accidents"]["iou_100"]["value"]
    assert headline["value"] == pytest.approx(sees_all - sees_single)
    assert headline["verdict"] == "not decided"
    first, second = summary["comparisons"]
    assert (first["row"], first["less"]) == ("sees all", "sees single")
    assert (second["row"], second["less"]) == ("labels, all", "nothing")
    assert second["groups"][ALL]["iou_100"]["value"] == 100


def test_the_counts_give_all_numbers_without_the_release(out: Path, tmp_path: Path) -> None:
    summary = read_summary(out)
    counts = read_counts(out / "mine" / "counts.json.gz")
    computed = json.loads(json.dumps(summarised(counts)))
    assert computed == {name: summary[name] for name in computed}
    (tmp_path / "counts.json.gz").write_bytes(b"no")
    with pytest.raises(ResultsError, match=r"no counts of a study .*; run the study again"):
        read_counts(tmp_path / "counts.json.gz")


def test_tables_page_and_figures_show_the_summary(out: Path) -> None:
    folder, summary = out / "mine", read_summary(out)
    with (folder / "tables" / "rows.csv").open(encoding="utf-8", newline="") as file:
        heading, *lines = csv.reader(file)
    assert heading == ["row", "group", "number", "value", "low", "high"]
    iou = summary["rows"]["sees all"]["groups"][ALL]["iou_100"]["value"]
    assert ["sees all", ALL, "iou_100", str(iou), "", ""] in lines

    page = read_report(folder / "index.html")
    assert "A small <study>" in page.text  # escaped: it is no tag
    assert summary["headline"]["text"].replace("`", "") in page.text
    assert not missing_parts(page.text, *summary["rows"])
    figures = sorted(path.name for path in (folder / "figures").iterdir())
    assert figures == ["over_latency.png", "rows.png"]


def test_stored_rows_are_not_made_again(out: Path, run_again: RunStudy) -> None:
    counts_file = out / "mine" / "counts.json.gz"
    before, counts = row_times(out), counts_file.read_bytes()
    assert len(before) == 7  # `sees all` and `late 0.0 s` are one
    run_again(name="mine")
    assert row_times(out) == before
    assert counts_file.read_bytes() == counts

    run_again(rows=[*BASELINE_RECIPE["rows"], {"name": "standing", "baseline": "standing"}])
    after = row_times(out)
    assert len(after) == len(before) + 1
    assert before.items() <= after.items()

    releases = [*(out / "release").iterdir()]
    run_again(
        test={"release": "test", "horizon": 1.0},
        rows=[{"name": "nothing", "trivial": "nothing"}],
        compare=[],
        headline=None,
    )
    assert len(row_times(out).keys() - after.keys()) == 1
    assert [*(out / "release").iterdir()] == releases


def test_a_study_gives_the_same_bits_twice_and_after_a_kill(out: Path, tmp_path: Path) -> None:
    path, killed_out = write_recipe(tmp_path, BASELINE_RECIPE), tmp_path / "out"
    package = "deepaccident_devkit.plugins.study"
    kill_study(path, killed_out, f"{package}.cells", "predictions_of", 2)
    assert len(row_times(killed_out)) == 2
    kill_study(path, killed_out, f"{package}.predict", "predict_detections", 5)  # within a row
    before = row_times(killed_out)
    run_study(read_recipe(str(path)), killed_out, workers=2)
    after = row_times(killed_out)
    assert before.items() < after.items()
    for name in ("counts.json.gz", "tables/rows.csv", "tables/comparisons.csv", "figures/rows.png"):
        assert (killed_out / "mine" / name).read_bytes() == (out / "mine" / name).read_bytes()


def test_an_existing_release_is_used(out: Path, tmp_path: Path) -> None:
    cells = read_summary(out)["cells"]
    (key,) = {cell["key"] for cell in cells if cell["kind"] == "release"}
    releases = {"test": {"dataroot": str(out / "release" / key)}}
    path = write_recipe(tmp_path, {**BASELINE_RECIPE, "releases": releases})
    run_study(read_recipe(str(path)), tmp_path / "out", workers=1)
    counts = (tmp_path / "out" / "mine" / "counts.json.gz").read_bytes()
    assert counts == (out / "mine" / "counts.json.gz").read_bytes()


def test_a_study_that_cannot_run_names_the_row_or_key(run_again: RunStudy) -> None:
    with pytest.raises(
        SomeFailedError,
        match=r"row/.*: late: latency: 1\.5 s reaches back from frame 006 to before the first",
    ):
        run_again(
            rows=[{"name": "late", "baseline": "standing", "latency": 1.5}],
            compare=[],
            headline=None,
        )
    with pytest.raises(ConfigError, match=r"other: groups\.mine: .*town_hall"):
        run_again(groups={"mine": ["town_hall=big"]}, headline=None)
    with pytest.raises(
        ConfigError, match="other: test: where: no scenario pair matches; change the filters"
    ):
        run_again(test={"release": "test", "where": ["length>=900"]})


def test_the_style_of_a_paper_writes_pdf_figures(run_again: RunStudy, out: Path) -> None:
    with style("ieee-column"):
        run_again(name="paper")
    assert (out / "paper" / "figures" / "rows.pdf").read_bytes().startswith(b"%PDF")
