"""`find`: the scenarios that filters let through."""

from __future__ import annotations

from typing import TYPE_CHECKING

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

    Fields: `name`, `scenario_type` (short `type`), `town`, `weather`, `time_of_day`, `road_type`, `spawn_side`,
    `ego_direction`, `other_direction`, `split`, `signalized`, `designed_accident`, `collision` (bool), `accident_type`
    (1 to 12), `num_frames` (short `length`) and `visibility` (`visible`, `partial`, `invisible`: whether ego sees the
    accident coming). `deepaccident_devkit.selection` explains fields, values and texts in full.

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
        >>> da.find("weather!=Clear", time_of_day="Night", visibility="invisible")  # doctest: +SKIP
    """
    wanted = [*map(parse_where, where), *(keyword_filter(name, value) for name, value in filters.items())]
    scenarios = dataset.scenario[:]
    conditions = [_condition(dataset, scenarios, one) for one in wanted]
    for condition in sorted(conditions, key=lambda condition: condition.field.costly):
        scenarios = [record for record in scenarios if condition.holds(condition.field.read(dataset, record))]
    return scenarios


def _condition(dataset: Dataset, scenarios: list[ScenarioRecord], wanted: Filter) -> Condition:
    field = field_of(wanted.name)
    known_are_all = field.costly or field.kind != "word"
    return condition_of(wanted, field, () if known_are_all else (field.read(dataset, one) for one in scenarios))
