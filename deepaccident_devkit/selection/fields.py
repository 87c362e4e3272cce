"""The fields to find scenarios and to group results by: a name and a set of values each."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

from deepaccident_devkit import taxonomy
from deepaccident_devkit.collisions.twins import twin_of
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import FieldError, NotAvailableError
from deepaccident_devkit.support.text import columns_text, possible_text
from deepaccident_devkit.tables.columns import Choice, Column, Number, Struct
from deepaccident_devkit.tables.records import table_spec
from deepaccident_devkit.v2x import accident_visibility, collision, hidden_collider
from deepaccident_devkit.v2x.agents import VISIBILITIES

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import ScenarioRecord

FieldValue = str | int | float | bool | None
_Read = Callable[[Dataset, "ScenarioRecord"], FieldValue | tuple[FieldValue, ...]]
_ReadAll = Callable[[Dataset, "Sequence[ScenarioRecord]"], Iterable[FieldValue]]
FieldKind = Literal["word", "number", "measure", "flag"]

_STRAIGHT: Final = "straight_straight"
TURNING: Final = "one_of_the_agents_turning"
_WEATHER_GROUPS: Final = {"Rain": "Rainy", "Cloudy": "Cloudy", "Clear": "Clear"}
_MOVING_PAIR_DOCS: Final = {
    "min_ttc": "Least time to collision of moving pairs (s).",
    "min_pet": "Least post-encroachment time of moving pairs (s).",
    "min_gap": "Least gap between moving pairs (m).",
    "max_drac": "The most deceleration that a moving pair needs to avoid a crash (m/s²).",
}
_SHORT_NAMES = {"type": "scenario_type", "length": "num_frames"}
# Columns of arbitrary words with so few values that results can be grouped by them.
_GROUPED_COLUMNS: Final = ("scenario_type", "town")
_KNOWN_VALUES: dict[str, Sequence[str | int]] = {
    "town": taxonomy.TOWNS,
    "weather": taxonomy.WEATHERS,
    "road_type": taxonomy.ROAD_TYPES,
    "spawn_side": taxonomy.SPAWN_SIDES,
    "ego_direction": taxonomy.DIRECTIONS,
    "other_direction": taxonomy.DIRECTIONS,
    "accident_type": range(1, 13),
}


@dataclass(frozen=True, slots=True)
class Field:
    """A property that scenarios can be found by.

    Attributes:
        name: Name in filters.
        kind: Kind of its values; a number is whole, a measure is a float.
        doc: Meaning, for people.
        read: Function for a scenario's value, None where unknown; of several in a tuple, one must
            match a filter.
        known: Values that are possible in the complete release; empty where they are not known or
            not limited.
        costly: Whether reading it opens more than the scenario's record.
        groups: Whether it has so few values that results can be grouped by it.
        read_all: Function for the values of many scenarios in their order, if that is more than
            `read` of each.
    """

    name: str
    kind: FieldKind
    doc: str
    read: _Read
    known: Sequence[str | int] = ()
    costly: bool = False
    groups: bool = False
    read_all: _ReadAll | None = None

    @property
    def shown(self) -> str:
        """Possible values, as a filter has them."""
        if self.kind == "word" and self.known:
            return ", ".join(map(str, self.known))
        descriptions = {"flag": "true, false", "number": "numbers", "measure": "numbers"}
        return descriptions.get(self.kind, "words")

    def values(
        self, dataset: Dataset, scenarios: Sequence[ScenarioRecord]
    ) -> Iterable[FieldValue | tuple[FieldValue, ...]]:
        """Return its values of scenarios, in their order."""
        if self.read_all is not None:
            return self.read_all(dataset, scenarios)
        return (self.read(dataset, scenario) for scenario in scenarios)


def field_of(name: str) -> Field:
    """Return the field of a filter; raises FieldError."""
    field = FIELDS.get(full_name(name))
    if field is None:
        possible = possible_text(name, [*FIELDS, *_SHORT_NAMES])
        raise FieldError(
            f"scenarios cannot be found by '{name}'; the fields are {possible}; "
            "`deepaccident info --fields` says what each is"
        )
    return field


def full_name(name: str) -> str:
    """Return the full name of a field or attribute in small letters, also of a short name."""
    return _SHORT_NAMES.get(name.lower(), name.lower())


def fields_text() -> str:
    """Return all fields as a table: names, also short ones, values and meanings."""
    names = {name: f"{name}, {short_name}" for short_name, name in _SHORT_NAMES.items()}
    rows = [("field", "values", "meaning")]
    for field in FIELDS.values():
        rows.append((names.get(field.name, field.name), field.shown, field.doc))
    return columns_text(rows, left=3)


def group_texts(dataset: Dataset, scenario: ScenarioRecord) -> dict[str, str | None]:
    """Return a scenario's values, as texts, of all fields to group by; None for unknown."""
    return {
        name: _text(field.read(dataset, scenario)) for name, field in FIELDS.items() if field.groups
    }


def _text(value: Any) -> str | None:
    if value is None:
        return None
    if isinstance(value, bool):
        return str(value).lower()
    return str(value)


def _column_field(column: Column) -> Field:
    """Return the field of a column of the scenario table."""
    kind: FieldKind = "word"
    if isinstance(column.kind, Number):
        kind = "flag" if column.kind.dtype == "bool" else "number"
    choices = column.kind.values if isinstance(column.kind, Choice) else ()
    known = _KNOWN_VALUES.get(column.field, choices)

    def read(_: Dataset, scenario: ScenarioRecord) -> Any:
        return scenario[column.field]  # type: ignore[literal-required]

    return Field(
        column.field,
        kind,
        column.kind.doc,
        read,
        known,
        groups=column.field in _GROUPED_COLUMNS or bool(known) or kind == "flag",
    )


def _collision_reader(name: str) -> _Read:
    """Return a function that reads a field of meta's collision; None without a collision."""

    def read(_: Dataset, scenario: ScenarioRecord) -> Any:
        record = scenario["collision"]
        value = record and record[name]  # type: ignore[literal-required]
        if isinstance(value, list):
            return tuple(value)
        return value

    return read


def _ended_in_collision(_: Dataset, scenario: ScenarioRecord) -> bool | None:
    if scenario["weather"] is None:  # The scenario has no meta.
        return None
    return scenario["collision"] is not None


def _collision_status(_: Dataset, scenario: ScenarioRecord) -> str | None:
    record = scenario["collision"]
    if record is None:
        return None if scenario["weather"] is None else "no_collision"
    if "pedestrian" in record["classes"]:
        return "collides_with_pedestrian"
    return "collides_between_vehicles"


def _weather_group(_: Dataset, scenario: ScenarioRecord) -> str | None:
    weather = scenario["weather"]
    if weather:
        for word, name in _WEATHER_GROUPS.items():
            if word in weather:
                return name
    return weather


def _time_of_day_group(_: Dataset, scenario: ScenarioRecord) -> str | None:
    time_of_day = scenario["time_of_day"]
    return time_of_day and ("Night" if time_of_day == "Night" else "Daytime")


def _trajectory_type(_: Dataset, scenario: ScenarioRecord) -> str | None:
    road = scenario["road_type"]
    directions = (scenario["ego_direction"], scenario["other_direction"])
    if road is None or None in directions:
        return None
    is_straight = road.startswith("four") and directions == ("straight", "straight")
    return _STRAIGHT if is_straight else TURNING


def _closing_speed(dataset: Dataset, scenario: ScenarioRecord) -> float | None:
    if scenario["collision"] is None:
        return None
    try:
        contact = collision(dataset, scenario)
    except NotAvailableError:  # No label shows the pair.
        return None
    if contact is None or math.isnan(contact.closing_speed):
        return None
    return contact.closing_speed


def _hidden_collider(dataset: Dataset, scenario: ScenarioRecord) -> bool | None:
    accident = scenario if scenario["collision"] is not None else twin_of(dataset, scenario)
    if accident is None:
        return None
    return hidden_collider(dataset, accident)


def _moving_pair_field(name: str) -> Field:
    """Return a field that is a measure of a scenario's interactions."""

    def read_all(dataset: Dataset, scenarios: Sequence[ScenarioRecord]) -> Iterable[float | None]:
        # Other fields do not need this module.
        from deepaccident_devkit.interactions.scenario import each_of_moving_pairs

        return each_of_moving_pairs(name, dataset, scenarios)

    def read(dataset: Dataset, scenario: ScenarioRecord) -> float | None:
        return next(iter(read_all(dataset, [scenario])))

    return Field(name, "measure", _MOVING_PAIR_DOCS[name], read, costly=True, read_all=read_all)


_DERIVED_FIELDS = (
    Field(
        "weather_group",
        "word",
        "The released evaluation's three.",
        _weather_group,
        tuple(_WEATHER_GROUPS.values()),
        groups=True,
    ),
    Field(
        "time_of_day_group",
        "word",
        "The released evaluation's two.",
        _time_of_day_group,
        ("Daytime", "Night"),
        groups=True,
    ),
    Field(
        "trajectory_type",
        "word",
        "Straight_straight at four-way junctions alone.",
        _trajectory_type,
        (_STRAIGHT, TURNING),
        groups=True,
    ),
    Field(
        "collision",
        "flag",
        "Whether meta names a collision; unknown without meta.",
        _ended_in_collision,
        groups=True,
    ),
    Field(
        "collision_status",
        "word",
        "Who collides.",
        _collision_status,
        ("no_collision", "collides_with_pedestrian", "collides_between_vehicles"),
        groups=True,
    ),
    Field(
        "collision_ids",
        "number",
        "Actors of the colliding pair, one of which must match.",
        _collision_reader("ids"),
    ),
    Field(
        "collision_classes",
        "word",
        "Those of the colliding pair, one of which must match.",
        _collision_reader("classes"),
        taxonomy.CATEGORIES,
    ),
    Field(
        "collision_agents",
        "word",
        "Those of the colliding pair, one of which must match.",
        _collision_reader("agents"),
        taxonomy.VEHICLE_AGENTS,
    ),
    Field(
        "spawn_relation",
        "word",
        "As meta names it.",
        _collision_reader("spawn_relation"),
        groups=True,
    ),
    Field(
        "contact_side",
        "word",
        "As meta names it.",
        _collision_reader("contact_side"),
        taxonomy.CONTACT_SIDES,
        groups=True,
    ),
    Field("impact", "measure", "As meta has it.", _collision_reader("impact")),
    Field(
        "closing_speed",
        "measure",
        "Speed with which the pair approaches before contact (m/s).",
        _closing_speed,
        costly=True,
    ),
    *map(_moving_pair_field, _MOVING_PAIR_DOCS),
    Field(
        "accident_visibility",
        "word",
        "Whether ego sees the accident coming.",
        accident_visibility,
        VISIBILITIES,
        costly=True,
    ),
    Field(
        "hidden_collider",
        "flag",
        "Whether one of the pair is hidden from ego, 2 to 1 s before the impact; "
        "of a twin, in its accident.",
        _hidden_collider,
        costly=True,
        groups=True,
    ),
)
_COLUMN_FIELDS = [
    _column_field(column)
    for column in table_spec("scenario").columns
    if not isinstance(column.kind, Struct)
]
FIELDS: Final = {field.name: field for field in (*_COLUMN_FIELDS, *_DERIVED_FIELDS)}
"""All fields by name: the columns of the scenario table, and fields derived from them."""
