"""The published studies: the pages have what is kept of them, and every APA follows from the kept
counts.
"""

import importlib
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from deepaccident_devkit.plugins.study import read_recipe
from deepaccident_devkit.plugins.study.numbers import numbers_of_rows
from deepaccident_devkit.plugins.study.summary import ALL

TOP = Path(__file__).parents[4]
NAMES = [path.name.split(".")[0] for path in (TOP / "benchmarks" / "studies").glob("*.json.xz")]


@pytest.fixture(scope="module")
def pages() -> Iterator[Any]:
    """The script that writes them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(TOP))
        yield importlib.import_module("benchmarks.pages.model")


def test_the_pages_have_what_is_kept(pages: Any) -> None:
    found = pages.studies()
    assert found.keys() == set(NAMES) - {pages.ROAD}
    tables, told = ((TOP / "docs" / f"{name}.md").read_text() for name in ("model_tables", "model"))
    assert all(pages.study_text(name, each) in tables for name, each in found.items())
    assert pages.findings_table(found) in tables
    assert pages.answer_table(found["agents"]) in told
    assert " ".join(found["agents"]["headline"]["text"].split()) in " ".join(told.split())
    assert (
        pages.road_text(pages.kept(pages.ROAD)["summary"])
        in (TOP / "docs" / "nuscenes.md").read_text()
    )


def parts(numbers: dict[str, Any]) -> list[float]:
    """The APA, the ends of its interval, and that of each seed."""
    apa = numbers["apa"]
    return [
        math.nan if each is None else each
        for each in (apa["value"], apa["low"], apa["high"], *apa["seeds"].values())
    ]


@pytest.mark.parametrize("name", NAMES)
def test_they_were_made_by_the_recipes_that_ship(name: str, pages: Any) -> None:
    recipe, told = read_recipe(name), pages.kept(name)["summary"]
    kept = told["recipe"]
    assert (kept["weights"], kept["seeds"]) == (recipe.weights, list(recipe.seeds))
    assert [row["name"] for row in kept["rows"]] == [row.name for row in recipe.rows]
    assert [[each["row"], each["less"]] for each in told["comparisons"]] == [
        list(pair) for pair in recipe.pairs
    ]


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [name for name in NAMES if name != "road"]
)  # which has no accidents
def test_every_apa_follows_from_the_kept_counts(name: str, pages: Any) -> None:
    """Of all samples; the groups go the same way."""
    kept = pages.kept(name)
    rows, summary, tokens = pages.accident_rows(kept), kept["summary"], kept["groups"][ALL]
    for row, each in summary["rows"].items():
        assert parts(numbers_of_rows(tokens, rows[row])) == pytest.approx(
            parts(each["groups"][ALL]), nan_ok=True
        )
    for each in summary["comparisons"]:
        found = numbers_of_rows(tokens, rows[each["row"]], rows[each["less"]])
        assert parts(found) == pytest.approx(parts(each["groups"][ALL]), nan_ok=True)
