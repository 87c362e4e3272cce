"""`find`: the scenarios that filters let through."""

from __future__ import annotations

from collections.abc import Callable
from operator import itemgetter
from typing import TYPE_CHECKING, Any

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.selection.conditions import Filter, FilterValue, condition_of, keyword_filter, parse_where
from deepaccident_devkit.selection.fields import Field, field_of

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import ScenarioRecord

_Test = Callable[["ScenarioRecord"], object]
_Choose = Callable[["list[ScenarioRecord]"], "list[ScenarioRecord]"]


def find(dataset: Dataset, *where: str | _Test, **filters: FilterValue) -> list[ScenarioRecord]:
    """The scenarios that meet all filters, in the order of the table; without filters all of them.

    Fields: every column of the scenario table (`town`, `weather`, `num_frames`, …); `collision` and what meta says of
    it (`contact_side`, `impact`, `collision_classes`, …); the groups of `--by` (`weather_group`, …); `closing_speed` in
    m/s; how near moving pairs come (`min_ttc`, `min_pet`, `min_gap`, `max_drac`); and `accident_visibility`.
    `deepaccident_devkit.selection` explains fields, values and texts in full.

    Args:
        dataset: the release.
        where: filters as texts, as `--where` takes them: `town=Town03,Town05`, `weather!=Clear`, `length>=50`; or as
            functions of a scenario's record.
        filters: filters as keywords: field=value; a list, tuple or set for any of several; for numbers also `"40..60"`
            and `">=50"`; None for unknown; or a function of the field's value, which is None where unknown.

    Returns:
        Fresh records, the caller's own.

    Raises:
        FieldError: there is no such field.
        ChoiceError: the field cannot have such a value, or a text is no filter.

    Examples:
        >>> da.find(town=["Town03", "Town05"], collision=True, length="50..")  # doctest: +SKIP
        >>> da.find("closing_speed>=10", time_of_day="Night", accident_visibility="invisible")  # doctest: +SKIP
        >>> da.find(min_ttc="..1.5", collision=False)  # doctest: +SKIP
        >>> da.find(lambda scenario: scenario["ego_direction"] == scenario["other_direction"])  # doctest: +SKIP
    """
    scenarios = dataset.scenario[:]
    tests = [
        (False, _those_for_which(each)) if callable(each) else _test(dataset, scenarios, parse_where(each))
        for each in where
    ]
    tests += [
        _reading(dataset, field_of(name), value)
        if callable(value)
        else _test(dataset, scenarios, keyword_filter(name, value))
        for name, value in filters.items()
    ]
    for _, choose in sorted(tests, key=itemgetter(0)):  # costly ones last, on the few that are left
        scenarios = choose(scenarios)
    return scenarios


def _those_for_which(test: _Test) -> _Choose:
    return lambda scenarios: [scenario for scenario in scenarios if test(scenario)]


def _test(dataset: Dataset, scenarios: list[ScenarioRecord], wanted: Filter) -> tuple[bool, _Choose]:
    """Whether a filter is costly, and the choice of records that it comes to."""
    field = field_of(wanted.name)
    here: set[Any] = set()
    if field.kind == "word" and not field.costly:
        for scenario in scenarios:
            value = field.read(dataset, scenario)
            here.update(value if isinstance(value, tuple) else (value,))
    return _reading(dataset, field, condition_of(wanted, field, here).holds)


def _reading(dataset: Dataset, field: Field, holds: Callable[[Any], object]) -> tuple[bool, _Choose]:
    def choose(scenarios: list[ScenarioRecord]) -> list[ScenarioRecord]:
        values = field.values(dataset, scenarios)
        return [scenario for scenario, value in zip(scenarios, values, strict=True) if holds(value)]

    return field.costly, choose
