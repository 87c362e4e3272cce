"""Studies of baselines: what is made and kept, what is made again, and what is written."""

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from report_page import page_of
from studies import BASELINES, killed, written

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

Run = Callable[..., StudyReport]


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the small study has run."""
    folder = tmp_path_factory.mktemp("studies")
    run_study(read_recipe(str(written(folder, BASELINES))), folder / "out", workers=1)
    return folder / "out"


@pytest.fixture
def run(out: Path, tmp_path: Path) -> Run:
    """Runs the small study, with changes, in the same folder."""

    def of(name: str = "other", **changes: Any) -> StudyReport:
        return run_study(
            read_recipe(str(written(tmp_path, {**BASELINES, **changes}, name))), out, workers=1
        )

    return of


def summary_of(out: Path, name: str = "mine") -> dict[str, Any]:
    told: dict[str, Any] = json.loads((out / name / "study.json").read_text(encoding="utf-8"))
    return told


def kept(out: Path) -> dict[str, int]:
    """The cells that were made, and when."""
    return {
        path.name: path.stat().st_mtime_ns for path in (out / "cells" / "kept" / "row").iterdir()
    }


def test_the_numbers_are_those_of_their_rows(out: Path) -> None:
    found = {name: row["groups"][ALL] for name, row in summary_of(out)["rows"].items()}
    assert (
        found["labels, all"]["iou_100"]["value"] == found["labels, all"]["vpq_100"]["value"] == 100
    )
    assert (
        found["labels, all"]["hidden_foreground"]["value"]
        == found["sees all"]["hidden_detected"]["value"]
        == 1
    )
    assert (
        found["labels, single"]["hidden_foreground"]["value"]
        == found["sees single"]["hidden_detected"]["value"]
        == 0
    )
    assert found["nothing"]["iou_100"]["value"] == found["nothing"]["seen_foreground"]["value"] == 0
    assert (
        found["everything"]["hidden_foreground"]["value"]
        == 1
        > found["everything"]["iou_100"]["value"] / 100
        > 0
    )
    assert found["late 0.5 s"]["iou_100"]["value"] < found["late 0.0 s"]["iou_100"]["value"]
    assert found["sees single"]["iou_100"]["value"] < found["sees all"]["iou_100"]["value"] < 100
    assert all(
        each["low"] is None and each["seeds"] == {} for each in found["nothing"].values()
    )  # of two pairs


def test_groups_are_of_pairs_and_of_samples(out: Path) -> None:
    groups = summary_of(out)["groups"]
    assert groups[ALL] == groups["accidents"] == {"samples": 16, "pairs": 2}  # with the twins
    assert groups["long"] == {"samples": 0, "pairs": 0}
    assert groups["impact_step=no impact"] == {"samples": 8, "pairs": 2}
    assert summary_of(out)["rows"]["nothing"]["groups"]["long"]["apa"]["value"] is None


def test_a_row_has_the_numbers_that_evaluate_gives(out: Path) -> None:
    summary = summary_of(out)
    cells = {each["name"]: each for each in summary["cells"]}
    release = DeepAccident(dataroot=out / "release" / cells["test"]["key"], verbose=False)
    assert (cells["test"]["scenarios"], len(release.scenario)) == (4, 4)
    (split,) = (out / "splits").iterdir()
    selection = SampleSelection(split=str(split), scope="all", agents=("ego_vehicle",))
    setup = EvaluationSetup(task="motion", protocol="paper", switches={"labels": "released"})
    results = out / "row" / cells["sees all"]["key"] / "motion"
    found = evaluate_results(release, results, setup, selection, workers=1).result.ranges["100x100"]
    assert summary["rows"]["sees all"]["groups"][ALL]["iou_100"]["value"] == found.iou


def test_the_headline_and_the_differences(out: Path) -> None:
    summary = summary_of(out)
    rows, headline = summary["rows"], summary["headline"]
    more, less = (
        rows[name]["groups"]["accidents"]["iou_100"]["value"]
        for name in ("sees all", "sees single")
    )
    assert (headline["value"], headline["verdict"]) == (pytest.approx(more - less), "not decided")
    assert [(each["row"], each["less"]) for each in summary["comparisons"]] == [
        ("sees all", "sees single"),
        ("labels, all", "nothing"),
    ]
    assert summary["comparisons"][1]["groups"][ALL]["iou_100"]["value"] == 100


def test_the_counts_give_all_numbers_without_the_release(out: Path, tmp_path: Path) -> None:
    told, counted = summary_of(out), read_counts(out / "mine" / "counts.json.gz")
    again = json.loads(json.dumps(summarised(counted)))
    assert again == {name: told[name] for name in again}
    (tmp_path / "counts.json.gz").write_bytes(b"no")
    with pytest.raises(ResultsError, match=r"no counts of a study .*; run the study again"):
        read_counts(tmp_path / "counts.json.gz")


def test_tables_and_page(out: Path) -> None:
    with (out / "mine" / "tables" / "rows.csv").open(encoding="utf-8", newline="") as file:
        heading, *lines = csv.reader(file)
    assert heading == ["row", "group", "number", "value", "low", "high"]
    summary = summary_of(out)
    told = summary["rows"]["sees all"]["groups"][ALL]["iou_100"]["value"]
    assert ["sees all", ALL, "iou_100", str(told), "", ""] in lines
    page = page_of(out / "mine" / "index.html")
    assert "A small <study>" in page.text  # escaped: it is no tag
    assert summary["headline"]["text"].replace("`", "") in page.text
    assert {name for name in summary["rows"] if name not in page.text} == set()
    assert sorted(path.name for path in (out / "mine" / "figures").iterdir()) == [
        "over_latency.png",
        "rows.png",
    ]


def test_rows_that_are_there_are_not_made_again(out: Path, run: Run) -> None:
    before = kept(out)
    assert len(before) == 7  # `sees all` and `late 0.0 s` are one
    told = (out / "mine" / "counts.json.gz").read_bytes()
    run(name="mine")
    assert (kept(out), (out / "mine" / "counts.json.gz").read_bytes()) == (before, told)
    run(rows=[*BASELINES["rows"], {"name": "standing", "baseline": "standing"}])
    after = kept(out)
    assert len(after.keys() - before.keys()) == 1
    assert {name: after[name] for name in before} == before
    releases = [*(out / "release").iterdir()]
    run(
        test={"release": "test", "horizon": 1.0},
        rows=[{"name": "nothing", "trivial": "nothing"}],
        compare=[],
        headline=None,
    )
    assert len(kept(out).keys() - after.keys()) == 1
    assert [*(out / "release").iterdir()] == releases


def test_the_same_bits_twice_and_after_a_kill(out: Path, tmp_path: Path) -> None:
    path = written(tmp_path, BASELINES)
    killed(path, tmp_path / "out", "deepaccident_devkit.plugins.study.cells", "predictions_of", 2)
    assert len(kept(tmp_path / "out")) == 2
    killed(
        path, tmp_path / "out", "deepaccident_devkit.plugins.study.predict", "predict_detections", 5
    )  # amid a row
    before = kept(tmp_path / "out")
    run_study(read_recipe(str(path)), tmp_path / "out", workers=2)
    after = kept(tmp_path / "out")
    assert before.items() < after.items()
    for name in ("counts.json.gz", "tables/rows.csv", "tables/comparisons.csv", "figures/rows.png"):
        assert (tmp_path / "out" / "mine" / name).read_bytes() == (out / "mine" / name).read_bytes()


def test_a_release_that_is_there(out: Path, tmp_path: Path) -> None:
    (made,) = {each["key"] for each in summary_of(out)["cells"] if each["kind"] == "release"}
    given = {**BASELINES, "releases": {"test": {"dataroot": str(out / "release" / made)}}}
    run_study(read_recipe(str(written(tmp_path, given))), tmp_path / "out", workers=1)
    assert (tmp_path / "out" / "mine" / "counts.json.gz").read_bytes() == (
        out / "mine" / "counts.json.gz"
    ).read_bytes()


def test_what_cannot_be_run_says_where(run: Run) -> None:
    with pytest.raises(
        SomeFailedError, match=r"row/.*: late: latency: 1\.5 s reaches back before the first frame"
    ):
        run(
            rows=[{"name": "late", "baseline": "standing", "latency": 1.5}],
            compare=[],
            headline=None,
        )
    with pytest.raises(ConfigError, match=r"other: groups\.mine: .*town_hall"):
        run(groups={"mine": ["town_hall=big"]}, headline=None)
    with pytest.raises(
        ConfigError, match="other: test: where: no pair of scenarios matches; change the filters"
    ):
        run(test={"release": "test", "where": ["length>=900"]})


def test_figures_of_a_paper(run: Run, out: Path) -> None:
    with style("ieee-column"):
        run(name="paper")
    assert (out / "paper" / "figures" / "rows.pdf").read_bytes().startswith(b"%PDF")
