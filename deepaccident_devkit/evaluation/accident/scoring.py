"""From accidents foreseen and true to counts and means: what the protocols `paper` and `boxes` share."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.evaluation.accident.protocol import AccidentContext
from deepaccident_devkit.evaluation.accident.result import DISTANCES, NAMED, AccidentResult, AccidentsWithin
from deepaccident_devkit.evaluation.evaluator import Counts, ratio

Alarm = Mapping[str, Any]
"""An accident that is foreseen, as counts hold it: `position` (metres), `time` (seconds, later than the truth is
positive) and `id` (0 the same two, 1 others) differences from the truth; None where there is none or it is not known.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scoring:
    """When an accident counts as foreseen; the defaults are the protocol `paper`'s.

    Attributes:
        errors_at: metres: the errors are means over the true positives within this distance.
        limit_counts: a difference of exactly the distance allowed is within it, as in the released code.
        far_is_missed: an accident foreseen elsewhere is a false positive and leaves the true one missed; else it is
            only the former, as in the released code.
        time_tolerance: seconds: how far off in time an accident foreseen may be; None for any. The paper looks at
            positions alone.
    """

    errors_at: float = 10.0
    limit_counts: bool = False
    far_is_missed: bool = True
    time_tolerance: float | None = None

    def __post_init__(self) -> None:
        """Check the values; raises ConfigError."""
        if self.errors_at not in DISTANCES:
            raise ConfigError(f"errors_at: expected one of {', '.join(map(str, DISTANCES))}, found {self.errors_at!r}")
        if self.time_tolerance is not None and not self.time_tolerance >= 0:
            raise ConfigError(f"time_tolerance: expected seconds from 0, or None, found {self.time_tolerance!r}")

    def variants(self) -> dict[str, Scoring]:
        """This scoring with one choice made otherwise, by `name=value`; for explanations."""
        others: Mapping[str, tuple[Any, ...]] = {
            "errors_at": DISTANCES,
            "limit_counts": (False, True),
            "far_is_missed": (False, True),
            "time_tolerance": (None, 0.5),
        }
        return {
            f"{name}={value}": replace(self, **{name: value})
            for name, values in others.items()
            for value in values
            if value != getattr(self, name)
        }

    def hit(self, alarms: Sequence[Alarm], distance: float) -> Alarm | None:
        """The first alarm that foresees the true accident within a distance."""
        return next((alarm for alarm in alarms if self._is_within(alarm, distance)), None)

    def _is_within(self, alarm: Alarm, distance: float) -> bool:
        position, time = alarm["position"], alarm["time"]
        if position is None or position > distance or (position == distance and not self.limit_counts):
            return False
        return self.time_tolerance is None or abs(time) <= self.time_tolerance + _TIME_SLACK


def foreseen(
    position: float | None = None, time: float | None = None, id_error: int | None = None, **more: float
) -> dict[str, Any]:
    """An `Alarm`; `more` is kept with it."""
    return {"position": position, "time": time, "id": id_error, **more}


def position_difference(first: FloatArray, second: FloatArray) -> float:
    """The differences of two pairs of positions (2, 2), metres: the sum over the two, whichever way they fit better."""
    apart = np.linalg.norm(first[:, None] - second, axis=-1)
    return float(min(apart[0, 0] + apart[1, 1], apart[0, 1] + apart[1, 0]))


def named(pair: Iterable[int | None] | None, context: AccidentContext) -> str:
    """Whom a truth names, of `NAMED`.

    Args:
        pair: actor ids, None for one that is not known; None for no accident.
        context: of the sample.
    """
    if pair is None:
        return "none"
    actors = set(pair)
    if not context.known or None in actors:
        return "unknown"
    return "meta" if context.pair is not None and actors == set(context.pair) else "another"


def accident_result(
    samples: Sequence[Counts], alarms: Sequence[Sequence[Alarm]], scoring: Scoring, notes: Iterable[str] = ()
) -> AccidentResult:
    """The metrics of samples.

    Args:
        samples: their counts, of which `positive` and `named` are read.
        alarms: of each sample, the most important one first.
        scoring: when they count.
        notes: for the reader.
    """
    positive = [bool(sample["positive"]) for sample in samples]
    within = {distance: _within(positive, alarms, distance, scoring) for distance in DISTANCES}
    at = within[scoring.errors_at]
    names = Counter(sample["named"] for sample in samples)
    return AccidentResult(
        within=within,
        apa=math.fsum(each.accuracy for each in within.values()) / len(within),
        id_error=at.id_error,
        position_error=at.position_error,
        time_error=at.time_error,
        samples=len(samples),
        positives=sum(positive),
        negatives=len(samples) - sum(positive),
        truths={name: names[name] for name in NAMED},
        notes=tuple(notes),
    )


def _within(
    positive: Sequence[bool], alarms: Sequence[Sequence[Alarm]], distance: float, scoring: Scoring
) -> AccidentsWithin:
    found = [scoring.hit(each, distance) if true else None for true, each in zip(positive, alarms, strict=True)]
    hits = [alarm for alarm in found if alarm is not None]
    tp, fp = len(hits), sum(map(len, alarms)) - len(hits)
    fn = sum(
        true and alarm is None and (scoring.far_is_missed or not each)
        for true, alarm, each in zip(positive, found, alarms, strict=True)
    )
    return AccidentsWithin(
        distance=distance,
        tp=tp,
        fp=fp,
        fn=fn,
        accuracy=ratio(tp, tp + fp / 2 + fn / 2),
        id_error=_mean(alarm["id"] for alarm in hits),
        position_error=_mean(alarm["position"] for alarm in hits),
        time_error=_mean(None if alarm["time"] is None else abs(alarm["time"]) for alarm in hits),
    )


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return math.fsum(known) / len(known) if known else None


_TIME_SLACK: Final = 1e-6
"""Seconds: moments are decimal numbers, which binary ones only come near."""
