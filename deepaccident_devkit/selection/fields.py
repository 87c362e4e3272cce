"""The fields that a scenario can be found by and results be grouped by: one name and one set of values each."""

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
_OF_MOVING_PAIRS: Final = {
    "min_ttc": "Least time to collision of moving pairs (s).",
    "min_pet": "Least post-encroachment time of moving pairs (s).",
    "min_gap": "Least gap between moving pairs (m).",
    "max_drac": "The most deceleration that a moving pair needs to avoid a crash (m/s²).",
}
_SHORT = {"type": "scenario_type", "length": "num_frames"}
# Columns of words that are not limited, yet few.
_FEW: Final = ("scenario_type", "town")
_KNOWN: dict[str, Sequence[str | int]] = {
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
    """Something that a scenario can be found by.

    Attributes:
        name: as a filter names it.
        kind: of its values; a number is whole, a measure is a float.
        doc: what it means, for people.
        read: its value of a scenario, None where unknown; several in a tuple, of which a filter wants one.
        known: the values it can have in the whole release; empty where that is not known or not limited.
        costly: whether reading it opens more than the scenario's record.
        groups: whether it has so few values that results can be grouped by it.
        read_all: its values of many scenarios in their order, where that is more than `read` of each.
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
        """The values that it can have, as a filter has them."""
        if self.kind != "word" or not self.known:
            return {"flag": "true, false", "number": "numbers", "measure": "numbers"}.get(
                self.kind, "words"
            )
        return ", ".join(map(str, self.known))

    def values(
        self, dataset: Dataset, scenarios: Sequence[ScenarioRecord]
    ) -> Iterable[FieldValue | tuple[FieldValue, ...]]:
        """Its values of scenarios, in their order."""
        if self.read_all is not None:
            return self.read_all(dataset, scenarios)
        return (self.read(dataset, scenario) for scenario in scenarios)


def field_of(name: str) -> Field:
    """The field that a filter names; raises FieldError."""
    field = FIELDS.get(full_name(name))
    if field is None:
        possible = possible_text(name, [*FIELDS, *_SHORT])
        raise FieldError(
            f"scenarios cannot be found by '{name}'; the fields are {possible}; `deepaccident info --fields` says what "
            "each is"
        )
    return field


def full_name(name: str) -> str:
    """The full name of a field or attribute in small letters, also of a short one."""
    return _SHORT.get(name.lower(), name.lower())


def fields_text() -> str:
    """All fields as a table: names, short ones too, values and meanings."""
    short = {name: f"{name}, {other}" for other, name in _SHORT.items()}
    rows = [(short.get(each.name, each.name), each.shown, each.doc) for each in FIELDS.values()]
    return columns_text([("field", "values", "meaning"), *rows], left=3)


def group_texts(dataset: Dataset, scenario: ScenarioRecord) -> dict[str, str | None]:
    """The values of a scenario for all fields that results can be grouped by, as texts; None unknown."""
    return {
        name: _text(field.read(dataset, scenario)) for name, field in FIELDS.items() if field.groups
    }


def _text(value: Any) -> str | None:
    return None if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def _column(column: Column) -> Field:
    """The field that is a column of the scenario table."""
    kind: FieldKind = "word"
    if isinstance(column.kind, Number):
        kind = "flag" if column.kind.dtype == "bool" else "number"
    known = _KNOWN.get(column.field, column.kind.values if isinstance(column.kind, Choice) else ())

    def read(_: Dataset, scenario: ScenarioRecord) -> Any:
        return scenario[column.field]  # type: ignore[literal-required]

    return Field(
        column.field,
        kind,
        column.kind.doc,
        read,
        known,
        groups=column.field in _FEW or bool(known) or kind == "flag",
    )


def _of_collision(name: str) -> _Read:
    """What meta says of the collision; None without one."""

    def read(_: Dataset, scenario: ScenarioRecord) -> Any:
        told = scenario["collision"]
        value = told and told[name]  # type: ignore[literal-required]
        return tuple(value) if isinstance(value, list) else value

    return read


def _ended_in_collision(_: Dataset, scenario: ScenarioRecord) -> bool | None:
    return (
        None if scenario["weather"] is None else scenario["collision"] is not None
    )  # no weather: no meta


def _collision_status(_: Dataset, scenario: ScenarioRecord) -> str | None:
    told = scenario["collision"]
    if told is None:
        return None if scenario["weather"] is None else "no_collision"
    return (
        "collides_with_pedestrian"
        if "pedestrian" in told["classes"]
        else "collides_between_vehicles"
    )


def _weather_group(_: Dataset, scenario: ScenarioRecord) -> str | None:
    weather = scenario["weather"]
    return weather and next(
        (name for word, name in _WEATHER_GROUPS.items() if word in weather), weather
    )


def _time_of_day_group(_: Dataset, scenario: ScenarioRecord) -> str | None:
    time_of_day = scenario["time_of_day"]
    return time_of_day and ("Night" if time_of_day == "Night" else "Daytime")


def _trajectory_type(_: Dataset, scenario: ScenarioRecord) -> str | None:
    road, directions = (
        scenario["road_type"],
        (scenario["ego_direction"], scenario["other_direction"]),
    )
    if road is None or None in directions:
        return None
    return (
        _STRAIGHT if road.startswith("four") and directions == ("straight", "straight") else TURNING
    )


def _closing_speed(dataset: Dataset, scenario: ScenarioRecord) -> float | None:
    if scenario["collision"] is None:
        return None
    try:
        contact = collision(dataset, scenario)
    except NotAvailableError:  # no label shows the pair
        return None
    return None if contact is None or math.isnan(contact.closing_speed) else contact.closing_speed


def _hidden_collider(dataset: Dataset, scenario: ScenarioRecord) -> bool | None:
    accident = scenario if scenario["collision"] is not None else twin_of(dataset, scenario)
    return None if accident is None else hidden_collider(dataset, accident)


def _of_moving_pairs(name: str) -> Field:
    """One of the fields that are measures of a scenario's interactions."""

    def read_all(dataset: Dataset, scenarios: Sequence[ScenarioRecord]) -> Iterable[float | None]:
        from deepaccident_devkit.interactions.scenario import (
            each_of_moving_pairs,
        )  # other fields do without it

        return each_of_moving_pairs(name, dataset, scenarios)

    def read(dataset: Dataset, scenario: ScenarioRecord) -> float | None:
        return next(iter(read_all(dataset, [scenario])))

    return Field(name, "measure", _OF_MOVING_PAIRS[name], read, costly=True, read_all=read_all)


_DERIVED = (
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
        _of_collision("ids"),
    ),
    Field(
        "collision_classes",
        "word",
        "Those of the colliding pair, one of which must match.",
        _of_collision("classes"),
        taxonomy.CATEGORIES,
    ),
    Field(
        "collision_agents",
        "word",
        "Those of the colliding pair, one of which must match.",
        _of_collision("agents"),
        taxonomy.VEHICLE_AGENTS,
    ),
    Field(
        "spawn_relation", "word", "As meta names it.", _of_collision("spawn_relation"), groups=True
    ),
    Field(
        "contact_side",
        "word",
        "As meta names it.",
        _of_collision("contact_side"),
        taxonomy.CONTACT_SIDES,
        groups=True,
    ),
    Field("impact", "measure", "As meta has it.", _of_collision("impact")),
    Field(
        "closing_speed",
        "measure",
        "Speed with which the pair approaches before contact (m/s).",
        _closing_speed,
        costly=True,
    ),
    *map(_of_moving_pairs, _OF_MOVING_PAIRS),
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
        "Whether one of the pair is hidden from ego, 2 to 1 s before the impact; of a twin, in its accident.",
        _hidden_collider,
        costly=True,
        groups=True,
    ),
)
FIELDS: Final = {
    field.name: field
    for field in (
        *(
            _column(column)
            for column in table_spec("scenario").columns
            if not isinstance(column.kind, Struct)
        ),
        *_DERIVED,
    )
}
"""All fields by name: the columns of the scenario table, and what is derived from them."""
