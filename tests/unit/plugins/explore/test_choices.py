"""What a reader chose: it finds what `da.find` finds, its address comes back, its code runs."""

import shlex
import threading
from collections.abc import Iterator
from typing import Any
from unittest.mock import Mock
from urllib.parse import parse_qsl

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.plugins.explore.background import Jobs
from deepaccident_devkit.plugins.explore.choices import Choices, match_scenarios
from deepaccident_devkit.plugins.explore.scenarios import Scenarios
from deepaccident_devkit.selection.fields import FIELDS

FACETS = sorted(name for name, field in FIELDS.items() if field.groups)


def computed(da: DeepAccident) -> Scenarios:
    jobs = Jobs()
    made = Scenarios(da, jobs, workers=1)
    made.begin()
    assert jobs.wait(60)
    return made


@pytest.fixture(scope="module")
def scenarios(da: DeepAccident) -> Scenarios:
    """With all columns."""
    return computed(da)


@pytest.fixture
def waiting(da: DeepAccident) -> Iterator[Scenarios]:
    """Whose slow columns are never computed."""
    jobs, go_on = Jobs(), threading.Event()
    jobs.ask("other", "something slow", go_on.wait)
    yield Scenarios(da, jobs, workers=1)
    jobs.end()
    go_on.set()


def tokens(scenarios: Scenarios, **chosen: Any) -> list[str]:
    found = match_scenarios(scenarios, Choices(**chosen), {})
    assert (found.faults, found.waiting) == ((), ())
    return [scenarios.tokens[row] for row in found.rows.tolist()]


@pytest.mark.parametrize(
    "where",
    [
        ["collision=true"],
        ["town=Town03"],
        ["length>=5", "collision=false"],
        ["min_ttc<1.5"],
        ["accident_visibility=unknown"],
        ["scenario_type=type1_subtype1_accident"],
    ],
)
def test_a_query_finds_what_the_devkit_finds(
    da: DeepAccident, scenarios: Scenarios, where: list[str]
) -> None:
    assert tokens(scenarios, query="; ".join(where)) == [each["token"] for each in da.find(*where)]


@given(data=st.data())
def test_facets_find_what_the_devkit_finds(
    da: DeepAccident, scenarios: Scenarios, data: st.DataObject
) -> None:
    """Any values of any facets; beside a value stands how many choosing it alone of its field would
    give.
    """
    facets = {each.name: each for each in scenarios.facets()}
    names = data.draw(st.lists(st.sampled_from(sorted(facets)), unique=True, max_size=3))
    some = {
        name: st.lists(st.sampled_from(facets[name].values), unique=True, min_size=1)
        for name in names
    }
    chosen = {name: tuple(data.draw(values)) for name, values in some.items()}
    choices = Choices(facets=chosen)
    found = match_scenarios(scenarios, choices, {})
    assert [scenarios.tokens[row] for row in found.rows] == [
        each["token"] for each in da.find(*choices.filters)
    ]
    for name, each in ((name, each) for name, counts in found.counts.items() for each in counts):
        alone = Choices(facets={**chosen, name: (each["value"],)})
        assert (each["count"], each["chosen"]) == (
            len(da.find(*alone.filters)),
            each["value"] in chosen.get(name, ()),
        )


@given(
    facets=st.dictionaries(
        st.sampled_from(FACETS),
        st.lists(st.text(min_size=1, max_size=50), unique=True, min_size=1).map(tuple),
        max_size=3,
    ),
    query=st.text(),
    order=st.sampled_from(["up", "down"]),
    view=st.sampled_from(["grid", "table"]),
    page=st.integers(1, 999_999),
)
def test_an_address_says_all(facets: Any, query: str, order: Any, view: Any, page: int) -> None:
    choices = Choices(
        facets=facets, query=query.strip(), sort="lead", order=order, view=view, page=page
    )
    assert (
        Choices.of(parse_qsl(choices.address().removeprefix("?"), keep_blank_values=True))
        == choices
    )


@pytest.mark.parametrize(
    "given_",
    [
        [("page", "0")],
        [("page", "-1")],
        [("page", "x")],
        [("order", "x")],
        [("view", "x")],
        [("nonsense", "1")],
    ],
)
def test_what_makes_no_sense_is_left_out(given_: list[tuple[str, str]]) -> None:
    assert Choices.of(given_) == Choices()


def test_an_address_asks_for_no_more_than_a_page_has(scenarios: Scenarios) -> None:
    """Whoever made it: values that no facet has are few and short."""
    many = [f"{kind}{number}" for number in range(4000) for kind in ("T", "Town0")]
    asked = [
        (name, value)
        for name in (*FIELDS, "q", "sort", "order", "page")
        for value in (*many, "x" * 60_000)
    ]
    facets = {each.name: each.values for each in scenarios.facets()}
    towns = [("town", value) for value in facets["town"]]
    choices = Choices.of([*asked, *towns, *towns], scenarios)
    assert (
        sum(
            value not in facets.get(name, ())
            for name, each in choices.facets.items()
            for value in each
        )
        == 100
    )
    for each in (choices, Choices.of(asked), Choices.of([("q", ";".join(many))], scenarios)):
        assert sum(map(len, each.facets.values())) <= sum(map(len, facets.values())) + 100
        assert len(each.address()) < 20_000
        assert max(map(len, [each.sort, *each.filters])) < 5_000


def test_a_sort_puts_unknown_values_last_in_both_orders(scenarios: Scenarios) -> None:
    for column in ("lead", "lead_all", "min_ttc", "accident_visibility", "num_frames"):
        numbers = scenarios.numbers(column)
        for order in ("up", "down"):
            shown = numbers[
                [scenarios.row_of[each] for each in tokens(scenarios, sort=column, order=order)]
            ]
            known = shown[~np.isnan(shown)]
            assert np.isnan(shown[len(known) :]).all()
            assert known.tolist() == sorted(known.tolist(), reverse=order == "down")


def test_a_fault_is_told_and_the_rest_counts(scenarios: Scenarios) -> None:
    found = match_scenarios(
        scenarios, Choices(query="bogus=1; town=Atlantis; length>>3; collision=true"), {}
    )
    assert ["'bogus'" in found.faults[0], "Atlantis" in found.faults[1], len(found.faults)] == [
        True,
        True,
        3,
    ]
    assert [scenarios.tokens[row] for row in found.rows] == tokens(
        scenarios, query="collision=true"
    )


def test_a_value_that_no_scenario_has_finds_nothing(scenarios: Scenarios) -> None:
    # a field of one value is no facet, but counts
    assert (
        len(match_scenarios(scenarios, Choices(facets={"velocity_frame": ("lidar",)}), {}).rows)
        == 0
    )


@pytest.mark.parametrize(
    "choices",
    [
        Choices(query="min_ttc<2"),
        Choices(facets={"accident_visibility": ("visible",)}),
        Choices(sort="lead"),
    ],
)
def test_what_is_not_computed_yet_is_said(waiting: Scenarios, choices: Choices) -> None:
    found = match_scenarios(waiting, choices, {})
    (said,) = found.waiting
    assert (len(found.rows), "is being computed" in said) == (len(waiting), True)


def test_what_cannot_be_computed_is_said(da: DeepAccident, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "deepaccident_devkit.plugins.explore.scenarios.interactions_of",
        Mock(side_effect=MemoryError("too little")),
    )
    scenarios = computed(da)
    found = match_scenarios(scenarios, Choices(query="min_ttc<2"), {})
    assert found.waiting == ("min_ttc<2: cannot be computed (MemoryError: too little)",)
    assert tokens(scenarios, query="closing_speed>=0") != []


def test_the_code_finds_the_same(da: DeepAccident, scenarios: Scenarios, tmp_path: Any) -> None:
    chosen = {
        "facets": {"collision": ("true",), "town": (da.scenario[0]["town"],)},
        "query": "length>=2",
    }
    choices, wanted = Choices(**chosen), tokens(scenarios, **chosen)
    assert [each["token"] for each in eval(choices.python(), {"da": da})] == wanted  # noqa: S307
    program, *words, name = shlex.split(choices.command(str(da.dataroot)))
    done = CliRunner().invoke(deepaccident, [*words, str(tmp_path / name)], catch_exceptions=False)
    assert (program, done.exit_code) == ("deepaccident", 0)
    assert (tmp_path / "selection.txt").read_text().split("\n")[:-1] == [
        each.replace("/", " ") for each in wanted
    ]
