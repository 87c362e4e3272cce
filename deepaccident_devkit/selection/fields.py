"""The fields by which scenarios are found and results are grouped, each with its values."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

from deepaccident_devkit import taxonomy
from deepaccident_devkit.collisions.twins import twin_of
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import FieldError, NotAvailableError
from deepaccident_devkit.support.text import columns_text, meant_text, possible_text
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

_STRAIGHT = "straight_straight"
TURNING: Final = "one_of_the_agents_turning"
_WEATHER_GROUPS = {"Rain": "Rainy", "Cloudy": "Cloudy", "Clear": "Clear"}
_MOVING_PAIR_DOCS = {
    "min_ttc": "Least time to collision of moving pairs (s).",
    "min_pet": "Least post-encroachment time of moving pairs (s).",
    "min_gap": "Least gap between moving pairs (m).",
    "max_drac": "The most deceleration that a moving pair needs to avoid a crash (m/s²).",
}
_SHORT_NAMES = {"type": "scenario_type", "length": "num_frames"}
# Text columns with few enough values to group results by.
_GROUPED_COLUMNS = ("scenario_type", "town")
_KNOWN_VALUES = {
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
    """A property by which scenarios can be found.

    Attributes:
        name: Name in filters.
        kind: Kind of its values; a `number` is whole, and a `measure` is a float.
        doc: Description for users.
        read: Function that returns a scenario's value, None if unknown. A tuple means several
            values; one must match a filter.
        known: Values that are possible in the complete release; empty if they are unknown or
            unlimited.
        costly: Whether reading the value needs more than the scenario's record.
        groups: Whether the field has few enough values to group results by.
        read_all: Function that returns the values of many scenarios, in their order, if this is
            faster than calling `read` for each scenario; otherwise None.
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
        """Possible values, as filters name them."""
        if self.kind == "word" and self.known:
            return ", ".join(map(str, self.known))
        descriptions = {"flag": "true, false", "number": "numbers", "measure": "numbers"}
        return descriptions.get(self.kind, "words")

    def values(
        self, dataset: Dataset, scenarios: Sequence[ScenarioRecord]
    ) -> Iterable[FieldValue | tuple[FieldValue, ...]]:
        """Return the values of scenarios, in their order."""
        if self.read_all is not None:
            return self.read_all(dataset, scenarios)
        return (self.read(dataset, scenario) for scenario in scenarios)


def find_field(name: str) -> Field:
    """Return the field with a name; raise FieldError if it is unknown."""
    field = FIELDS.get(full_name(name))
    if field is None:
        names = [*FIELDS, *_SHORT_NAMES]
        raise FieldError(
            f"no field '{name}' to find scenarios by; the fields are {possible_text(name, names)} "
            f"(`deepaccident info --fields` explains them){meant_text(name, names)}"
        )
    return field


def full_name(name: str) -> str:
    """Return the full name, in lower case, of a field or attribute that may be abbreviated."""
    return _SHORT_NAMES.get(name.lower(), name.lower())


def fields_text() -> str:
    """Return all fields as a text table of names, short forms, values and meanings."""
    names = {name: f"{name}, {short_name}" for short_name, name in _SHORT_NAMES.items()}
    rows = [("field", "values", "meaning")]
    for field in FIELDS.values():
        rows.append((names.get(field.name, field.name), field.shown, field.doc))
    return columns_text(rows, left=3)


def group_texts(dataset: Dataset, scenario: ScenarioRecord) -> dict[str, str | None]:
    """Return field → value as text (None if unknown), for all fields that form groups."""
    texts = {}
    for name, field in FIELDS.items():
        if field.groups:
            texts[name] = _to_text(field.read(dataset, scenario))
    return texts


def _to_text(value: Any) -> str | None:
    if value is None:
        return None
    if isinstance(value, bool):
        return str(value).lower()
    return str(value)


def _make_column_field(column: Column) -> Field:
    """Make the field for a column of the scenario table."""
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


def _make_collision_reader(name: str) -> _Read:
    """Return a function that reads a field of the collision in meta; None without a collision."""

    def read(_: Dataset, scenario: ScenarioRecord) -> Any:
        record = scenario["collision"]
        if record is None:
            return None
        value = record[name]  # type: ignore[literal-required]
        if isinstance(value, list):
            return tuple(value)
        return value

    return read


def _read_collision(_: Dataset, scenario: ScenarioRecord) -> bool | None:
    if scenario["weather"] is None:  # meta is missing
        return None
    return scenario["collision"] is not None


def _read_collision_status(_: Dataset, scenario: ScenarioRecord) -> str | None:
    record = scenario["collision"]
    if record is None:
        return None if scenario["weather"] is None else "no_collision"
    if "pedestrian" in record["classes"]:
        return "collides_with_pedestrian"
    return "collides_between_vehicles"


def _read_weather_group(_: Dataset, scenario: ScenarioRecord) -> str | None:
    weather = scenario["weather"]
    if weather:
        for word, name in _WEATHER_GROUPS.items():
            if word in weather:
                return name
    return weather


def _read_time_of_day_group(_: Dataset, scenario: ScenarioRecord) -> str | None:
    time_of_day = scenario["time_of_day"]
    if time_of_day in (None, "", "Night"):
        return time_of_day
    return "Daytime"


def _read_trajectory_type(_: Dataset, scenario: ScenarioRecord) -> str | None:
    road = scenario["road_type"]
    directions = (scenario["ego_direction"], scenario["other_direction"])
    if road is None or None in directions:
        return None
    is_straight = road.startswith("four") and directions == ("straight", "straight")
    return _STRAIGHT if is_straight else TURNING


def _read_closing_speed(dataset: Dataset, scenario: ScenarioRecord) -> float | None:
    if scenario["collision"] is None:
        return None
    try:
        contact = collision(dataset, scenario)
    except NotAvailableError:  # the pair is never labelled together
        return None
    if contact is None or math.isnan(contact.closing_speed):
        return None
    return contact.closing_speed


def _read_hidden_collider(dataset: Dataset, scenario: ScenarioRecord) -> bool | None:
    accident = scenario if scenario["collision"] is not None else twin_of(dataset, scenario)
    if accident is None:
        return None
    return hidden_collider(dataset, accident)


def _make_moving_pair_field(name: str) -> Field:
    """Make the field for a measure of a scenario's interactions."""

    def read_all(dataset: Dataset, scenarios: Sequence[ScenarioRecord]) -> Iterable[float | None]:
        # Imported here, since other fields do not need it.
        from deepaccident_devkit.interactions.scenario import iterate_measure

        return iterate_measure(name, dataset, scenarios)

    def read(dataset: Dataset, scenario: ScenarioRecord) -> float | None:
        return next(iter(read_all(dataset, [scenario])))

    return Field(name, "measure", _MOVING_PAIR_DOCS[name], read, costly=True, read_all=read_all)


_DERIVED_FIELDS = (
    Field(
        "weather_group",
        "word",
        "The three weather groups of the released evaluation.",
        _read_weather_group,
        tuple(_WEATHER_GROUPS.values()),
        groups=True,
    ),
    Field(
        "time_of_day_group",
        "word",
        "Day or night, as in the released evaluation.",
        _read_time_of_day_group,
        ("Daytime", "Night"),
        groups=True,
    ),
    Field(
        "trajectory_type",
        "word",
        "Paths of the pair; straight_straight occurs only at four-way junctions.",
        _read_trajectory_type,
        (_STRAIGHT, TURNING),
        groups=True,
    ),
    Field(
        "collision",
        "flag",
        "Whether meta names a collision; unknown without meta.",
        _read_collision,
        groups=True,
    ),
    Field(
        "collision_status",
        "word",
        "Who collides.",
        _read_collision_status,
        ("no_collision", "collides_with_pedestrian", "collides_between_vehicles"),
        groups=True,
    ),
    Field(
        "collision_ids",
        "number",
        "Actor ids of the colliding pair; one must match.",
        _make_collision_reader("ids"),
    ),
    Field(
        "collision_classes",
        "word",
        "Classes of the colliding pair; one must match.",
        _make_collision_reader("classes"),
        taxonomy.CATEGORIES,
    ),
    Field(
        "collision_agents",
        "word",
        "Agents in the colliding pair; one must match.",
        _make_collision_reader("agents"),
        taxonomy.VEHICLE_AGENTS,
    ),
    Field(
        "spawn_relation",
        "word",
        "Where the pair was spawned, in meta's words.",
        _make_collision_reader("spawn_relation"),
        groups=True,
    ),
    Field(
        "contact_side",
        "word",
        "Where the contact was, in meta's words.",
        _make_collision_reader("contact_side"),
        taxonomy.CONTACT_SIDES,
        groups=True,
    ),
    Field("impact", "measure", "Impulse of the contact by meta.", _make_collision_reader("impact")),
    Field(
        "closing_speed",
        "measure",
        "Speed at which the pair approaches before contact (m/s).",
        _read_closing_speed,
        costly=True,
    ),
    *map(_make_moving_pair_field, _MOVING_PAIR_DOCS),
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
        "Whether one of the pair is hidden from ego, 2 to 1 s before the impact; a twin has the "
        "value of its accident.",
        _read_hidden_collider,
        costly=True,
        groups=True,
    ),
)
_COLUMN_FIELDS = [
    _make_column_field(column)
    for column in table_spec("scenario").columns
    if not isinstance(column.kind, Struct)
]
FIELDS: Final = {field.name: field for field in (*_COLUMN_FIELDS, *_DERIVED_FIELDS)}
"""All fields by name: the columns of the scenario table, and fields derived from them."""
