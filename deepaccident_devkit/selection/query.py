"""`find`: the scenarios that match filters."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.selection.conditions import (
    Condition,
    Filter,
    FilterValue,
    check_condition,
    make_filter,
    parse_where,
)
from deepaccident_devkit.selection.fields import find_field

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import ScenarioRecord


def find(dataset: Dataset, *where: str, **filters: FilterValue) -> list[ScenarioRecord]:
    """Return the scenarios that match all filters, in the order of the table.

    Without filters, all scenarios are returned. Fields are all columns of the scenario table
    (`town`, `weather`, `num_frames`, …); `collision` and its fields in meta (`contact_side`,
    `impact`, `collision_classes`, …); the groups of `--by` (`weather_group`, …); `closing_speed` in
    m/s; measures of moving pairs (`min_ttc`, `min_pet`, `min_gap`, `max_drac`); and
    `accident_visibility` and `hidden_collider`. The docstring of `deepaccident_devkit.selection`
    explains fields, values and texts in full.

    Args:
        dataset: The release.
        where: Filters as texts, as for `--where`: `town=Town03,Town05`, `weather!=Clear`,
            `length>=50`.
        filters: Filters as keywords, field=value. A list, tuple or set matches any of its values;
            numbers can also be `"40..60"` or `">=50"`; None matches unknown values.

    Returns:
        Copies of the records, which you may change.

    Raises:
        FieldError: If a field is unknown.
        ChoiceError: If a value is impossible for its field, or a text is not a filter.

    Examples:
        >>> da.find(town=["Town03", "Town05"], collision=True, length="50..")  # doctest: +SKIP
        >>> da.find(
        ...     "closing_speed>=10", time_of_day="Night", accident_visibility="invisible"
        ... )  # doctest: +SKIP
        >>> da.find(min_ttc="..1.5", collision=False)  # doctest: +SKIP
    """
    scenarios = dataset.scenario[:]
    queries = [parse_where(text) for text in where]
    queries += [make_filter(name, value) for name, value in filters.items()]
    conditions = [_check_filter(dataset, scenarios, query) for query in queries]
    # Costly fields are read last, when few scenarios remain.
    for condition in sorted(conditions, key=lambda condition: condition.field.costly):
        values = condition.field.values(dataset, scenarios)
        pairs = zip(scenarios, values, strict=True)
        scenarios = [scenario for scenario, value in pairs if condition.holds(value)]
    return scenarios


def _check_filter(dataset: Dataset, scenarios: list[ScenarioRecord], query: Filter) -> Condition:
    """Check a filter against its field and the values that occur in this release."""
    field = find_field(query.name)
    words: set[Any] = set()
    if field.kind == "word" and not field.costly:
        for scenario in scenarios:
            value = field.read(dataset, scenario)
            words.update(value if isinstance(value, tuple) else (value,))
    return check_condition(query, field, words)
