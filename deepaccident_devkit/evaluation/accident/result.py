"""What the accident metrics say: `AccidentResult`, the same for all protocols."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from deepaccident_devkit.evaluation.frozen_mappings import FrozenMappings

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
class AccidentResult(FrozenMappings):
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
