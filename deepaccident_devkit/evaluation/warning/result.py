"""`WarningResult`: what `WarningEvaluator.compute` returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from deepaccident_devkit.arrays import FloatArray, FrozenArrays
from deepaccident_devkit.evaluation.frozen_mappings import FrozenMappings


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WarningCurve(FrozenArrays):
    """What would be if only alarms of at least a score were raised, the surest first; arrays are read-only.

    R scores: all that change something, or if there are more than `WarningProtocol.curve_rows` as many of them, evenly
    by rank. Arrays and not rows of numbers, since row n of a bootstrap's resample is of another score.

    Attributes:
        threshold: (R,) float64 the lowest score that is raised, falling.
        detection_rate: (R,) float64 as `WarningResult` has it, at the protocol's `curve_lead`; NaN without recordings.
        mean_warning: (R,) float64 likewise, seconds; NaN where nobody is warned.
        false_alarms_per_minute: (R,) float64 where nobody collides; NaN without such recordings.
        false_alarms_in_accidents: (R,) float64 a minute of the accident recordings; NaN without them.
    """

    threshold: FloatArray
    detection_rate: FloatArray
    mean_warning: FloatArray
    false_alarms_per_minute: FloatArray
    false_alarms_in_accidents: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WarningResult(FrozenArrays, FrozenMappings):
    """How early accidents are warned of, and how often alarms are false. NaN: nothing to count.

    A recording is what one agent saw of one scenario. Its kinds: `accident`; `normal` for nobody collides, which is
    `twins`, of which the scenario's twin is an accident, and `others` (those without a twin in the release, too). In
    accident recordings only samples before the impact count.

    Attributes:
        samples: how many.
        recordings: by kind.
        minutes: by kind: what the samples cover. Each stands for the smallest step from a sample to the next in its
            recording (of all recordings, where it has only one), so that a missing sample is not counted.
        warned_share: share of the accident recordings with a right alarm.
        mean_warning: seconds from the first right alarm to the impact, mean over the recordings that have one.
        median_warning: likewise.
        warning_seconds: (W,) float64 likewise, of each of them, ascending; read-only.
        lasting_share: share of the accident recordings with a right alarm that lasts: one at every sample to the last,
            none of them missing.
        mean_lasting: seconds from the beginning of such to the impact, mean over the recordings that have it.
        median_lasting: likewise.
        mean_reach: seconds from the first sample to the impact, mean over the accident recordings: no warning can be
            longer.
        detection_rate: seconds before the impact → share of the accident recordings with a right alarm that early or
            earlier, within half a recorded frame.
        detection_recordings: seconds before the impact → the recordings that is a share of: with samples as early.
        false_alarms: by kind. Samples with a false alarm one after another have one together; a missing sample ends it.
        false_alarms_per_minute: by kind.
        alarms: how many alarms are judged.
        precision: share of them that are right.
        unjudged: alarms that nothing can refute: nobody collides, and they are for later than the recording goes on.
        curve: the same over the score.
        notes: sentences that a reader of the numbers should know.
    """

    samples: int
    recordings: Mapping[str, int]
    minutes: Mapping[str, float]
    warned_share: float
    mean_warning: float
    median_warning: float
    warning_seconds: FloatArray
    lasting_share: float
    mean_lasting: float
    median_lasting: float
    mean_reach: float
    detection_rate: Mapping[float, float]
    detection_recordings: Mapping[float, int]
    false_alarms: Mapping[str, int]
    false_alarms_per_minute: Mapping[str, float]
    alarms: int
    precision: float
    unjudged: int
    curve: WarningCurve
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Freeze arrays and mappings."""
        FrozenArrays.__post_init__(self)
        FrozenMappings.__post_init__(self)
