"""`find`: the scenarios that meet filters."""

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
    """Return the scenarios that meet all filters, in the order of the table.

    Without filters all scenarios are returned. Fields are every column of the scenario table
    (`town`, `weather`, `num_frames`, …); `collision` and its fields in meta (`contact_side`,
    `impact`, `collision_classes`, …); the groups of `--by` (`weather_group`, …); `closing_speed` in
    m/s; measures of moving pairs (`min_ttc`, `min_pet`, `min_gap`, `max_drac`);
    `accident_visibility` and `hidden_collider`. `deepaccident_devkit.selection` explains fields,
    values and texts in full.

    Args:
        dataset: The release.
        where: Filters as texts, as for `--where`: `town=Town03,Town05`, `weather!=Clear`,
            `length>=50`.
        filters: Filters as keywords: field=value; a list, tuple or set for any of several; for
            numbers also `"40..60"` and `">=50"`; None for unknown.

    Returns:
        Fresh records, which belong to the caller.

    Raises:
        FieldError: A field is unknown.
        ChoiceError: The field cannot have such a value, or a text is no filter.

    Examples:
        >>> da.find(town=["Town03", "Town05"], collision=True, length="50..")  # doctest: +SKIP
        >>> da.find(
        ...     "closing_speed>=10", time_of_day="Night", accident_visibility="invisible"
        ... )  # doctest: +SKIP
        >>> da.find(min_ttc="..1.5", collision=False)  # doctest: +SKIP
    """
    scenarios = dataset.scenario[:]
    queries = [parse_where(text) for text in where]
    queries += [keyword_filter(name, value) for name, value in filters.items()]
    conditions = [_check_filter(dataset, scenarios, query) for query in queries]
    # Costly fields come at the end, when few scenarios remain.
    for condition in sorted(conditions, key=lambda condition: condition.field.costly):
        values = condition.field.values(dataset, scenarios)
        pairs = zip(scenarios, values, strict=True)
        scenarios = [scenario for scenario, value in pairs if condition.holds(value)]
    return scenarios


def _check_filter(dataset: Dataset, scenarios: list[ScenarioRecord], query: Filter) -> Condition:
    """Return a filter, checked against its field and the field's words in this release."""
    field = field_of(query.name)
    words: set[Any] = set()
    if field.kind == "word" and not field.costly:
        for scenario in scenarios:
            value = field.read(dataset, scenario)
            words.update(value if isinstance(value, tuple) else (value,))
    return condition_of(query, field, words)
