"""Choices of a reader match what `da.find` matches, can be read back from their address, and give
code that runs.
"""

import shlex
import threading
from collections.abc import Iterator
from pathlib import Path
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


def compute_columns(da: DeepAccident) -> Scenarios:
    jobs = Jobs()
    scenarios = Scenarios(da, jobs, workers=1)
    scenarios.begin()
    assert jobs.wait(60)
    return scenarios


@pytest.fixture(scope="module")
def scenarios(da: DeepAccident) -> Scenarios:
    return compute_columns(da)


@pytest.fixture
def uncomputed_scenarios(da: DeepAccident) -> Iterator[Scenarios]:
    """Return scenarios with slow columns that are never computed."""
    jobs, go_on = Jobs(), threading.Event()
    jobs.ask("other", "something slow", go_on.wait)
    yield Scenarios(da, jobs, workers=1)
    jobs.end()
    go_on.set()


def matching_tokens(scenarios: Scenarios, **choices: Any) -> list[str]:
    matches = match_scenarios(scenarios, Choices(**choices), {})
    assert (matches.faults, matches.waiting) == ({}, ())
    return [scenarios.tokens[row] for row in matches.rows.tolist()]


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
    tokens = matching_tokens(scenarios, query="; ".join(where))
    assert tokens == [scenario["token"] for scenario in da.find(*where)]


@given(data=st.data())
def test_facets_find_what_the_devkit_finds(
    da: DeepAccident, scenarios: Scenarios, data: st.DataObject
) -> None:
    """Any values of any facets can be chosen; the count beside a value is the number of scenarios
    that match when it is the only chosen value of its field.
    """
    facets = {facet.name: facet for facet in scenarios.facets()}
    names = data.draw(st.lists(st.sampled_from(sorted(facets)), unique=True, max_size=3))
    chosen_values = {}
    for name in names:
        values = st.lists(st.sampled_from(facets[name].values), unique=True, min_size=1)
        chosen_values[name] = tuple(data.draw(values))
    choices = Choices(facets=chosen_values)
    matches = match_scenarios(scenarios, choices, {})

    tokens = [scenarios.tokens[row] for row in matches.rows]
    assert tokens == [scenario["token"] for scenario in da.find(*choices.filters)]
    for name, counts in matches.counts.items():
        for entry in counts:
            value = entry["value"]
            filters = Choices(facets={**chosen_values, name: (value,)}).filters
            assert entry["count"] == len(da.find(*filters))
            assert entry["chosen"] == (value in chosen_values.get(name, ()))


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
def test_an_address_contains_all_choices(
    facets: Any, query: str, order: Any, view: Any, page: int
) -> None:
    choices = Choices(
        facets=facets, query=query.strip(), sort="lead", order=order, view=view, page=page
    )
    pairs = parse_qsl(choices.address().removeprefix("?"), keep_blank_values=True)
    assert Choices.of(pairs) == choices


@pytest.mark.parametrize(
    "pairs",
    [
        [("page", "0")],
        [("page", "-1")],
        [("page", "x")],
        [("order", "x")],
        [("view", "x")],
        [("nonsense", "1")],
    ],
)
def test_parameters_that_make_no_sense_are_left_out(pairs: list[tuple[str, str]]) -> None:
    assert Choices.of(pairs) == Choices()


def test_an_address_asks_for_no_more_than_a_page_has(scenarios: Scenarios) -> None:
    """Anybody can write an address: only a few short values that no facet has are accepted."""
    unknown_values = [f"{kind}{number}" for number in range(4000) for kind in ("T", "Town0")]
    pairs = []
    for name in (*FIELDS, "q", "sort", "order", "page"):
        for value in (*unknown_values, "x" * 60_000):
            pairs.append((name, value))
    known_values = {facet.name: facet.values for facet in scenarios.facets()}
    towns = [("town", value) for value in known_values["town"]]

    with_known_towns = Choices.of([*pairs, *towns, *towns], scenarios)
    num_unknown = 0
    for name, values in with_known_towns.facets.items():
        num_unknown += sum(value not in known_values.get(name, ()) for value in values)
    assert num_unknown == 100
    num_known = sum(map(len, known_values.values()))
    long_query = Choices.of([("q", ";".join(unknown_values))], scenarios)
    for choices in (with_known_towns, Choices.of(pairs), long_query):
        assert sum(map(len, choices.facets.values())) <= num_known + 100
        assert len(choices.address()) < 20_000
        assert max(map(len, [choices.sort, *choices.filters])) < 5_000


def test_a_sort_puts_unknown_values_last_in_both_orders(scenarios: Scenarios) -> None:
    for column in ("lead", "lead_all", "min_ttc", "accident_visibility", "num_frames"):
        values = scenarios.numbers(column)
        for order in ("up", "down"):
            tokens = matching_tokens(scenarios, sort=column, order=order)
            sorted_values = values[[scenarios.row_of[token] for token in tokens]]
            known = sorted_values[~np.isnan(sorted_values)]
            assert np.isnan(sorted_values[len(known) :]).all()
            assert known.tolist() == sorted(known.tolist(), reverse=order == "down")


def test_a_fault_is_reported_and_the_rest_counts(scenarios: Scenarios) -> None:
    choices = Choices(query="bogus=1; town=Atlantis; length>>3; collision=true")
    matches = match_scenarios(scenarios, choices, {})
    assert len(matches.faults) == 3
    assert list(matches.faults) == ["bogus=1", "town=Atlantis", "length>>3"]
    assert "'bogus'" in matches.faults["bogus=1"]
    assert "is not applied" in matches.faults["town=Atlantis"]
    tokens = [scenarios.tokens[row] for row in matches.rows]
    assert tokens == matching_tokens(scenarios, query="collision=true")


def test_a_value_that_no_scenario_has_finds_nothing(scenarios: Scenarios) -> None:
    """A field with one value is no facet, but its filter counts."""
    choices = Choices(facets={"velocity_frame": ("lidar",)})
    assert len(match_scenarios(scenarios, choices, {}).rows) == 0


@pytest.mark.parametrize(
    "choices",
    [
        Choices(query="min_ttc<2"),
        Choices(facets={"accident_visibility": ("visible",)}),
        Choices(sort="lead"),
    ],
)
def test_values_that_are_not_computed_yet_are_named(
    uncomputed_scenarios: Scenarios, choices: Choices
) -> None:
    matches = match_scenarios(uncomputed_scenarios, choices, {})
    (message,) = matches.waiting
    assert "is being computed" in message
    assert len(matches.rows) == len(uncomputed_scenarios)


def test_values_that_cannot_be_computed_are_named(
    da: DeepAccident, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "deepaccident_devkit.plugins.explore.scenarios.interactions_of",
        Mock(side_effect=MemoryError("too little")),
    )
    scenarios = compute_columns(da)
    matches = match_scenarios(scenarios, Choices(query="min_ttc<2"), {})
    assert matches.waiting == ("min_ttc<2 cannot be computed (MemoryError: too little)",)
    assert matching_tokens(scenarios, query="closing_speed>=0") != []


def test_the_code_finds_the_same(da: DeepAccident, scenarios: Scenarios, tmp_path: Path) -> None:
    facets = {"collision": ("true",), "town": (da.scenario[0]["town"],)}
    choices = Choices(facets=facets, query="length>=2")
    tokens = matching_tokens(scenarios, facets=facets, query="length>=2")
    scenarios_of_code = eval(choices.python(), {"da": da})  # noqa: S307
    assert [scenario["token"] for scenario in scenarios_of_code] == tokens

    program, *arguments, name = shlex.split(choices.command(str(da.dataroot)))
    arguments.append(str(tmp_path / name))
    result = CliRunner().invoke(deepaccident, arguments, catch_exceptions=False)
    assert (program, result.exit_code) == ("deepaccident", 0)
    lines = (tmp_path / "selection.txt").read_text().split("\n")[:-1]
    assert lines == [token.replace("/", " ") for token in tokens]
