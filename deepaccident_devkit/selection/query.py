"""`find`: the scenarios that filters let through."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.selection.conditions import (
    Condition,
    Filter,
    FilterValue,
    condition_of,
    keyword_filter,
    parse_where,
)
from deepaccident_devkit.selection.fields import field_of

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import ScenarioRecord


def find(dataset: Dataset, *where: str, **filters: FilterValue) -> list[ScenarioRecord]:
    """The scenarios that meet all filters, in the order of the table; without filters all of them.

    Fields: every column of the scenario table (`town`, `weather`, `num_frames`, …); `collision` and what meta says of
    it (`contact_side`, `impact`, `collision_classes`, …); the groups of `--by` (`weather_group`, …); `closing_speed` in
    m/s; how near moving pairs come (`min_ttc`, `min_pet`, `min_gap`, `max_drac`); `accident_visibility` and
    `hidden_collider`.
    `deepaccident_devkit.selection` explains fields, values and texts in full.

    Args:
        dataset: the release.
        where: filters as texts, as `--where` takes them: `town=Town03,Town05`, `weather!=Clear`, `length>=50`.
        filters: filters as keywords: field=value; a list, tuple or set for any of several; for numbers also `"40..60"`
            and `">=50"`; None for unknown.

    Returns:
        Fresh records, the caller's own.

    Raises:
        FieldError: there is no such field.
        ChoiceError: the field cannot have such a value, or a text is no filter.

    Examples:
        >>> da.find(town=["Town03", "Town05"], collision=True, length="50..")  # doctest: +SKIP
        >>> da.find(
        ...     "closing_speed>=10", time_of_day="Night", accident_visibility="invisible"
        ... )  # doctest: +SKIP
        >>> da.find(min_ttc="..1.5", collision=False)  # doctest: +SKIP
    """
    scenarios = dataset.scenario[:]
    wanted = [
        *map(parse_where, where),
        *(keyword_filter(name, value) for name, value in filters.items()),
    ]
    conditions = [_condition(dataset, scenarios, each) for each in wanted]
    for condition in sorted(
        conditions, key=lambda each: each.field.costly
    ):  # those last, on the few that are left
        values = condition.field.values(dataset, scenarios)
        scenarios = [
            scenario
            for scenario, value in zip(scenarios, values, strict=True)
            if condition.holds(value)
        ]
    return scenarios


def _condition(dataset: Dataset, scenarios: list[ScenarioRecord], wanted: Filter) -> Condition:
    """A filter, checked against its field and the words that this release has of it."""
    field = field_of(wanted.name)
    here: set[Any] = set()
    if field.kind == "word" and not field.costly:
        for scenario in scenarios:
            value = field.read(dataset, scenario)
            here.update(value if isinstance(value, tuple) else (value,))
    return condition_of(wanted, field, here)
