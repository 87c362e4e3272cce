"""The published studies: the pages show their stored summaries, and every APA follows from the
stored counts.
"""

import importlib
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from deepaccident_devkit.plugins.study import read_recipe
from deepaccident_devkit.plugins.study.numbers import numbers_of_rows
from deepaccident_devkit.plugins.study.summary import ALL, headline_text

REPOSITORY = Path(__file__).parents[4]
STUDY_NAMES = [
    path.name.split(".")[0] for path in (REPOSITORY / "benchmarks" / "studies").glob("*.json.xz")
]


@pytest.fixture(scope="module")
def pages() -> Iterator[Any]:
    """Import the script that writes the pages."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(REPOSITORY))
        yield importlib.import_module("benchmarks.pages.model")


def test_the_pages_show_the_stored_summaries(pages: Any) -> None:
    summaries = pages.read_summaries()
    assert summaries.keys() == set(STUDY_NAMES) - {pages.ROAD}
    tables_page = (REPOSITORY / "docs" / "model_tables.md").read_text()
    model_page = (REPOSITORY / "docs" / "model.md").read_text()
    road_page = (REPOSITORY / "docs" / "nuscenes.md").read_text()
    assert pages.studies_table(summaries) in tables_page
    assert pages.findings_table(summaries) in tables_page
    assert pages.answer_table(summaries["agents"]) in model_page
    assert headline_text(summaries["agents"]["headline"]) in " ".join(model_page.split())
    assert pages.road_text(pages.read_study(pages.ROAD)["summary"]) in road_page


@pytest.mark.parametrize("name", STUDY_NAMES)
def test_every_row_of_a_stored_study_is_shown(name: str, pages: Any) -> None:
    summary = pages.read_study(name)["summary"]
    lines = pages.study_rows(name, summary).splitlines()
    assert [line.split("`")[1] for line in lines[2:]] == list(summary["rows"])


def test_a_study_that_is_not_kept_is_refused_by_name(pages: Any) -> None:
    result = CliRunner().invoke(pages.commands, ["show", "nothing"])
    assert result.exit_code == 2
    assert "'nothing' is not one of 'agents'" in result.output


def apa_numbers(numbers: dict[str, Any]) -> list[float]:
    """Return the APA, the ends of its interval, and the APA of each seed."""
    apa = numbers["apa"]
    values = (apa["value"], apa["low"], apa["high"], *apa["seeds"].values())
    return [math.nan if value is None else value for value in values]


@pytest.mark.parametrize("name", STUDY_NAMES)
def test_studies_were_made_by_the_shipped_recipes(name: str, pages: Any) -> None:
    recipe, summary = read_recipe(name), pages.read_study(name)["summary"]
    stored_recipe = summary["recipe"]
    assert stored_recipe["weights"] == recipe.weights
    assert stored_recipe["seeds"] == list(recipe.seeds)
    assert [row["name"] for row in stored_recipe["rows"]] == [row.name for row in recipe.rows]
    pairs = [(comparison["row"], comparison["less"]) for comparison in summary["comparisons"]]
    assert pairs == [tuple(pair) for pair in recipe.pairs]


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [name for name in STUDY_NAMES if name != "road"]
)  # the road has no accidents
def test_every_apa_follows_from_the_stored_counts(name: str, pages: Any) -> None:
    """Compare only the numbers of all samples; groups are computed in the same way."""
    study = pages.read_study(name)
    evaluators, summary = pages.accident_evaluators(study), study["summary"]
    tokens = study["groups"][ALL]
    for row, stored_row in summary["rows"].items():
        numbers = apa_numbers(numbers_of_rows(tokens, evaluators[row]))
        assert numbers == pytest.approx(apa_numbers(stored_row["groups"][ALL]), nan_ok=True)
    for comparison in summary["comparisons"]:
        row, other_row = evaluators[comparison["row"]], evaluators[comparison["less"]]
        numbers = apa_numbers(numbers_of_rows(tokens, row, other_row))
        assert numbers == pytest.approx(apa_numbers(comparison["groups"][ALL]), nan_ok=True)
