"""From accidents foreseen and true to counts: what the protocols `paper` and `boxes` share."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.evaluation.accident.protocol import AccidentContext
from deepaccident_devkit.evaluation.accident.reading import TIE, even
from deepaccident_devkit.evaluation.accident.result import DISTANCES
from deepaccident_devkit.evaluation.accident.tallies import ERRORS, Tally, sample_tally
from deepaccident_devkit.evaluation.evaluator import Counts
from deepaccident_devkit.evaluation.variants import with_others

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
        return with_others(
            self,
            {
                "errors_at": DISTANCES,
                "limit_counts": (False, True),
                "far_is_missed": (False, True),
                "time_tolerance": (None, 0.5),
            },
        )

    def hit(self, alarms: Sequence[Alarm], distance: float) -> Alarm | None:
        """The first alarm that foresees the true accident within a distance."""
        return next((alarm for alarm in alarms if self._is_within(alarm, distance)), None)

    def _is_within(self, alarm: Alarm, distance: float) -> bool:
        position, time = alarm["position"], alarm["time"]
        if position is None or position >= distance + (TIE if self.limit_counts else -TIE):
            return False
        return self.time_tolerance is None or abs(time) <= self.time_tolerance + _TIME_SLACK


def foreseen(
    position: float | None = None, time: float | None = None, id_error: int | None = None, **more: float
) -> dict[str, Any]:
    """An `Alarm`, of whose positions those that differ by less than `TIE` are equal; `more` is kept with it."""
    position = None if position is None else float(even(np.asarray(position)))
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


def alarms_tally(sample: Counts, alarms: Sequence[Alarm], scoring: Scoring) -> Tally:
    """What one sample adds.

    Args:
        sample: its counts, of which `positive` and `named` are read.
        alarms: its, the most important one first.
        scoring: when they count.
    """
    return sample_tally(sample, [_within(sample, alarms, each, scoring) for each in DISTANCES])


def _within(sample: Counts, alarms: Sequence[Alarm], distance: float, scoring: Scoring) -> dict[str, Any]:
    hit = scoring.hit(alarms, distance) if sample["positive"] else None
    missed = sample["positive"] and hit is None and (scoring.far_is_missed or not alarms)
    errors = {name: None if hit is None else hit[name] for name in ERRORS}
    return {
        "tp": int(hit is not None),
        "fp": len(alarms) - int(hit is not None),
        "fn": int(missed),
        **{name: [] if error is None else [abs(error)] for name, error in errors.items()},
    }


_TIME_SLACK: Final = 1e-6
"""Seconds: moments are decimal numbers, which binary ones only come near."""
