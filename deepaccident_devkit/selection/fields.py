"""The fields that a scenario can be found by: where each value comes from and which values it can have."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from deepaccident_devkit import taxonomy
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import FieldError
from deepaccident_devkit.selection.accident_visibility import VISIBILITIES, accident_visibility
from deepaccident_devkit.text import possible_text

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import ScenarioRecord

Value = str | int | bool | None
_Read = Callable[[Dataset, "ScenarioRecord"], Value]


@dataclass(frozen=True, slots=True)
class Field:
    """Something that a scenario can be found by.

    Attributes:
        name: as a filter names it.
        kind: of its values.
        read: its value of a scenario, None where unknown.
        known: the values it can have in the whole release; empty where that is not known or not limited.
        costly: whether reading it opens more than the scenario's record.
    """

    name: str
    kind: Literal["word", "number", "flag"]
    read: _Read
    known: Sequence[str | int] = ()
    costly: bool = False


def field_of(name: str) -> Field:
    """The field that a filter names; raises FieldError."""
    field = _FIELDS.get(_ALIASES.get(name, name))
    if field is None:
        possible = possible_text(name, [*_FIELDS, *_ALIASES])
        raise FieldError(f"scenarios cannot be found by '{name}'; the fields are {possible}")
    return field


def _collision(_: Dataset, scenario: ScenarioRecord) -> bool | None:
    return None if scenario["weather"] is None else scenario["collision"] is not None  # no weather: no meta


def _visibility(dataset: Dataset, scenario: ScenarioRecord) -> str | None:
    return accident_visibility(dataset, scenario)


def _column(name: str) -> _Read:
    def read(_: Dataset, scenario: ScenarioRecord) -> Any:
        return scenario[name]  # type: ignore[literal-required]

    return read


_ALIASES = {"type": "scenario_type", "length": "num_frames"}
_WORDS: dict[str, Sequence[str]] = {
    "name": (),
    "scenario_type": (),
    "town": taxonomy.TOWNS,
    "weather": taxonomy.WEATHERS,
    "time_of_day": taxonomy.TIMES_OF_DAY,
    "road_type": taxonomy.ROAD_TYPES,
    "spawn_side": taxonomy.SPAWN_SIDES,
    "ego_direction": taxonomy.DIRECTIONS,
    "other_direction": taxonomy.DIRECTIONS,
    "split": taxonomy.SPLITS,
}
_ALL = (
    *(Field(name, "word", _column(name), known) for name, known in _WORDS.items()),
    Field("signalized", "flag", _column("signalized")),
    Field("designed_accident", "flag", _column("designed_accident")),
    Field("collision", "flag", _collision),
    Field("accident_type", "number", _column("accident_type"), range(1, 13)),
    Field("num_frames", "number", _column("num_frames")),
    Field("visibility", "word", _visibility, VISIBILITIES, costly=True),
)
_FIELDS = {field.name: field for field in _ALL}
