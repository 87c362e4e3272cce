"""What the accident metrics say: `AccidentResult`, the same for all protocols."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from types import MappingProxyType
from typing import Any, Final

DISTANCES: Final = (5.0, 10.0, 15.0)
"""Metres: how far off a predicted accident may be."""
NAMED: Final = ("meta", "another", "none", "unknown")
"""Whom the truth of a sample names: the pair of the meta file, another one, nobody; or the pair was not told."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AccidentsWithin:
    """Accidents counted with one distance allowed.

    Attributes:
        distance: metres allowed.
        tp: predicted within the distance.
        fp: predicted, but elsewhere or without any.
        fn: missed.
        accuracy: tp / (tp + fp / 2 + fn / 2); NaN where nothing is counted.
        id_error: share of the true positives that name others; None if the protocol says nothing of it.
        position_error: metres, mean over the true positives; likewise.
        time_error: seconds, mean over the true positives; likewise.
    """

    distance: float
    tp: int
    fp: int
    fn: int
    accuracy: float
    id_error: float | None
    position_error: float | None
    time_error: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class AccidentResult:
    """Accident metrics of some samples.

    Attributes:
        within: by the distance allowed (`DISTANCES`).
        apa: accident prediction accuracy, the mean of the accuracies; in [0, 1], NaN where nothing is counted.
        id_error: share of the true positives that name others; None where the protocol has no value.
        position_error: metres; likewise.
        time_error: seconds; likewise.
        samples: how many.
        positives: samples whose truth has an accident.
        negatives: those without.
        truths: whom the samples' truths name, counts by `NAMED`.
        notes: sentences that a reader of the numbers should know.
        beside: results of other choices that are always printed along, by `name=value`.
    """

    within: Mapping[float, AccidentsWithin]
    apa: float
    id_error: float | None
    position_error: float | None
    time_error: float | None
    samples: int
    positives: int
    negatives: int
    truths: Mapping[str, int]
    notes: tuple[str, ...] = ()
    beside: Mapping[str, AccidentResult] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Freeze the mappings."""
        object.__setattr__(self, "within", MappingProxyType(dict(self.within)))
        object.__setattr__(self, "truths", MappingProxyType(dict(self.truths)))
        object.__setattr__(self, "beside", MappingProxyType(dict(self.beside)))

    def as_dict(self) -> dict[str, Any]:
        """All of it, as JSON can hold it; `within` by the distance as text ("5")."""
        values = {name: getattr(self, name) for name in self.__dataclass_fields__}
        values["within"] = {f"{distance:g}": asdict(each) for distance, each in self.within.items()}
        beside = {name: result.as_dict() for name, result in self.beside.items()}
        return values | {"truths": dict(self.truths), "notes": list(self.notes), "beside": beside}
