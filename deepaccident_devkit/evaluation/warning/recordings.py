"""The recordings of warnings: what one sample adds, and a recording's samples with the scores of predictors.

`ScoreSeries` are the scores of many, frame by frame; `AlarmRuns` say how long their alarms last.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from typing import Final, Literal, get_args

import numpy as np

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.alarms import (
    Pair,
    named_alarms,
    position_difference,
    within_horizon,
)
from deepaccident_devkit.evaluation.breakdowns import cluster_of
from deepaccident_devkit.evaluation.evaluator import Counts
from deepaccident_devkit.evaluation.map_accidents import TIE, AccidentReading
from deepaccident_devkit.evaluation.predictions import Accident, Prediction, checked_prediction
from deepaccident_devkit.evaluation.truth import (
    REFERENCES,
    SLACK,
    AccidentContext,
    BoxTruth,
    Involvement,
    not_counted_notes,
)
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.support.arrays import (
    AnyArray,
    BoolArray,
    FloatArray,
    FrozenArrays,
    IntArray,
)
from deepaccident_devkit.taxonomy import FRAME_PERIOD

# Columns: times are decimal numbers, which binary numbers only approximate.
_SLACK: Final = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScoreSeries(FrozenArrays):
    """How sure a predictor is, at each frame of N recordings, that an accident comes; arrays are read-only.

    Attributes:
        scores: (N, T) float64, higher is surer; −inf where no threshold makes an alarm of it; NaN after a recording's
            end, and where a frame is missing.
        positive: (N,) bool, whether the recording ends in an accident.
        toa: (N,) float64, time of the accident: the column of the impact, which is no frame of the recording any more.
            Of recordings without an accident the column after the last one that counts.
        fps: columns a second.
    """

    scores: FloatArray
    positive: BoolArray
    toa: FloatArray
    fps: float

    @property
    def valid(self) -> BoolArray:
        """(N, T) whether there is a score that counts: all from the impact on do not exist."""
        return np.asarray(
            ~np.isnan(self.scores) & (np.arange(self.scores.shape[1]) < self.toa[:, None])
        )

    def highest(self) -> FloatArray:
        """(N,) the highest score of each recording; −inf without any."""
        return np.asarray(np.max(self.scores, axis=1, initial=-np.inf, where=self.valid))

    def before(self, seconds: float) -> FloatArray:
        """(N, M) scores at the M moments of the last seconds before `toa`, the latest first; NaN without a score."""
        moments = np.arange(1, round(seconds * self.fps) + 1)
        column = np.ceil(self.toa[:, None] - moments - _SLACK).astype(np.int64)
        there = (column >= 0) & (column < self.scores.shape[1])
        rows = np.arange(len(self.toa))[:, None]
        return np.where(
            there, np.where(self.valid, self.scores, np.nan)[rows, column * there], np.nan
        )

    def first(self, thresholds: FloatArray) -> IntArray:
        """(N, K) the first column with a score of at least each of K thresholds; T where there is none."""
        so_far = np.maximum.accumulate(np.where(self.valid, self.scores, -np.inf), axis=1)
        first = np.array(
            [np.searchsorted(row, thresholds, side="left") for row in so_far], dtype=np.int64
        )
        return first.reshape(len(so_far), len(thresholds))

    def leads(self, thresholds: FloatArray) -> FloatArray:
        """(N, K) seconds from the first score of at least each of K thresholds to `toa`; NaN where there is none."""
        first = self.first(thresholds).astype(np.float64)
        first[first >= self.scores.shape[1]] = np.nan
        return np.asarray((self.toa[:, None] - first) / self.fps)


def shares(part: AnyArray, whole: AnyArray) -> FloatArray:
    """Parts of wholes (N,); 0 where a whole is 0."""
    return np.asarray(np.divide(part, whole, out=np.zeros(len(whole)), where=whole > 0))


MINUTE: Final = 60.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AlarmRuns(FrozenArrays):
    """The R runs of alarmed frames of N recordings; arrays are read-only.

    Attributes:
        row: (R,) int64 which recording.
        begin: (R,) int64 first column.
        length: (R,) int64 columns.
        shape: N recordings and T columns.
        fps: columns a second.
    """

    row: IntArray
    begin: IntArray
    length: IntArray
    shape: tuple[int, int]
    fps: float

    @classmethod
    def of(cls, alarm: BoolArray, fps: float) -> AlarmRuns:
        """The runs in (N, T) alarms: a row a recording, False also where a frame is missing, which ends a run."""
        edges = np.diff(alarm.astype(np.int8), axis=1, prepend=0, append=0)
        row, begin = np.nonzero(edges == 1)
        _, end = np.nonzero(edges == -1)
        count, columns = alarm.shape
        return cls(row=row, begin=begin, length=end - begin, shape=(count, columns), fps=fps)

    def braking_seconds(self, reaction: float) -> FloatArray:
        """(N,) seconds in which a driver brakes who obeys: of each run max(0, its duration − the reaction time)."""
        left = np.maximum(self.length / self.fps - reaction, 0.0)
        return np.asarray(np.bincount(self.row, left, self.shape[0]).astype(np.float64))

    def first_lasting(self, reaction: float) -> IntArray:
        """(N,) first column of the first run that outlasts the reaction, so that it costs something; T for none."""
        lasting = self.length / self.fps > reaction
        first = np.full(self.shape[0], self.shape[1], dtype=np.int64)
        np.minimum.at(first, self.row[lasting], self.begin[lasting])
        return first


# Of a recording: somebody collides; nobody does, but in the scenario's twin; nobody does, and none there is known.
_Kind = Literal["accident", "twins", "others"]
# Metres: an alarm is right whose positions differ by less in sum from where the pair meets, as errors of `paper`.
_NEAR: Final = 10.0
KINDS: Final[tuple[_Kind, ...]] = get_args(_Kind)
# In place of the kind: somebody collides, but no label shows with whom (`BoxTruth.unplaced`); such samples are counted
# and left out, since no alarm in them can be called right or false.
UNPLACED: Final = "unplaced"


def sample_counts(
    token: str,
    prediction: Prediction,
    label: MotionLabels | None,
    context: AccidentContext,
) -> Counts:
    """What one sample adds, the same for all warning protocols.

    An alarm for later than the horizon does not count. Unlike an accident that counts for APA, the impact may be later
    than the model looks ahead: an early alarm with the right pair or the right place is a warning. Cells of maps are
    coarse, so that they raise more false alarms than explicit accidents.

    Returns:
        `recording`: scenario and agent; `frame`: its number there; `kind` (or `UNPLACED`) and `involvement` of the
        recording; `ahead`: recorded frames to the impact, None without one; `to_end`: the same, of a twin to the
        accident's impact;
        `alarms`: [score, whether it is right], the surest first; `unjudged`: scores of those that nothing can refute;
        `beyond`: how many are for later than the horizon, and so none; `references`: of each of `REFERENCES` the scores
        of its surest right alarm and its surest one, empty without any.

    Raises:
        EvaluationError: the token is no sample's, the context lacks something, or the prediction is neither motion nor
            accidents.
    """
    recording, frame = _place(token)
    truth, to_end = context.truth, context.time_to_end
    if truth is None or to_end is None:
        raise EvaluationError(
            "context: warnings need to know what happens, and when; give accident_context(dataset, sample, horizon=2.0)"
        )
    raised = named_alarms(checked_prediction(prediction), label, truth, AccidentReading())
    within = within_horizon(raised, truth)
    ahead, kind = context.time_to_impact, _kind(context) if truth.unplaced is None else UNPLACED
    judged = [each for each in within if ahead is not None or each[0].time <= to_end + SLACK]
    end = context.time_to_twin_impact if kind == "twins" else ahead
    return {
        "recording": recording,
        "frame": frame,
        "kind": kind,
        "involvement": context.involvement,
        "ahead": None if ahead is None else round(ahead / FRAME_PERIOD),
        "to_end": None if end is None else round(end / FRAME_PERIOD),
        "alarms": [[each[0].score, int(_is_right(*each, truth, context))] for each in judged],
        "unjudged": [each[0].score for each in within if each not in judged]
        if len(judged) < len(within)
        else [],
        "beyond": len(raised) - len(within),
        "references": [
            surest(
                [[each.score, int(_is_right(each, each.ids, truth, context))] for each in alarms],
                kind,
            )
            for alarms in context.references.values()
        ],
    }


def surest(alarms: Sequence[Sequence[float]], kind: str) -> list[float | None]:
    """The scores of the surest right alarm and of the surest one, None for none; [score, whether it is right] of each.

    Where nobody collides no alarm is right, and both are of the surest one.
    """
    best = max((score for score, _ in alarms), default=None)
    return [
        max((score for score, right in alarms if right), default=None)
        if kind == "accident"
        else best,
        best,
    ]


def _place(token: object) -> tuple[str, int]:
    recording, _, frame = token.rpartition("/") if isinstance(token, str) else ("", "", "")
    if not recording or not frame.isdecimal():
        raise EvaluationError(
            f"token: expected a sample's, such as type1_subtype1_accident/Town03_…/ego_vehicle/045, found {token!r}: "
            "warnings are counted by recording"
        )
    return recording, int(frame)


def _kind(context: AccidentContext) -> _Kind:
    if context.time_to_impact is not None:
        return "accident"
    return "twins" if context.twin else "others"


def _is_right(
    accident: Accident, ids: Pair | None, truth: BoxTruth, context: AccidentContext
) -> bool:
    """Whether an alarm names the pair that collides, in either order, or the place where they meet."""
    if context.time_to_impact is None or context.pair is None:
        return False
    if ids is not None and set(ids) == set(context.pair):
        return True
    return (
        truth.impact is not None
        and position_difference(accident.positions, truth.impact.positions) < _NEAR - TIE
    )


# What a sample's score in an accident recording is: that of its surest right alarm, or of its surest alarm.
ScoresOf = Literal["pair", "recording"]
GIVEN: Final = "given"
TRIVIAL: Final = ("always", "never", "random per frame", "random per recording")
# Rows of every table: the predictions, four predictors that know nothing, and two that know the present.
PREDICTORS: Final = (GIVEN, *TRIVIAL, *REFERENCES)
GROUPS: Final = (*get_args(Involvement), "unknown")
"""Of recordings, never pooled: by `Involvement`; `unknown` where no context says it."""
# Of a recording; the longest have some hundred.
_MOST_FRAMES: Final = 10_000
_PLACE: Final = itemgetter("recording", "frame")
_COLUMN: Final[Mapping[ScoresOf, int]] = {
    name: column for column, name in enumerate(get_args(ScoresOf))
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recording(FrozenArrays):
    """What one agent's recording of a scenario says; arrays are read-only.

    Attributes:
        name: scenario and agent.
        story: the same of its twin, too: scenario without the ending, and agent.
        group: of `GROUPS`.
        kind: whether somebody collides, or in the twin.
        part: which of several groups of samples it is of.
        frame: (S,) int64 frame numbers of the samples, ascending.
        end: frame of the impact; of a twin, that of the accident's impact; else the one after the last sample.
        scores: predictor, except those of `TRIVIAL` → (S, 2) of its surest right alarm and of its surest one, −inf
            without one; equal where nobody collides.
    """

    name: str
    story: str
    group: str
    kind: _Kind
    part: int
    frame: IntArray
    end: int
    scores: Mapping[str, FloatArray]


# Under this name counts hold those of several samples, whose recordings are never put together with others'.
PART: Final = "part"


def parts_of(counts: Collection[Counts]) -> list[Sequence[Counts]]:
    """The samples' counts: those by themselves, then each group of them that was pooled."""
    return [
        [each for each in counts if PART not in each],
        *(each[PART] for each in counts if PART in each),
    ]


def recordings_of(parts: Sequence[Collection[Counts]]) -> list[Recording]:
    """The recordings of each part's samples, by name; those of unplaced accidents (`UNPLACED`) left out."""
    return [
        _recording(name, list(those), part)
        for part, counts in enumerate(parts)
        for name, those in groupby(
            sorted((each for each in counts if each["kind"] != UNPLACED), key=_PLACE),
            key=itemgetter("recording"),
        )
    ]


def left_out_notes(samples: Collection[Counts]) -> list[str]:
    """Say which samples and alarms do not count."""
    return not_counted_notes(
        sum(each["kind"] == UNPLACED for each in samples), sum(each["beyond"] for each in samples)
    )


def series_of(
    recordings: Sequence[Recording], predictor: str, scores_of: ScoresOf, draw: int = 0
) -> ScoreSeries:
    """The scores of some recordings, a column a step: the smallest from a sample to the next of any of them.

    Lengths must not tell which recordings end in an accident. So twins end where their accident does, and others at
    the latest after the median length of the accidents.

    Args:
        recordings: the recordings.
        predictor: of `PREDICTORS`.
        scores_of: whose alarms count where somebody collides.
        draw: of a random predictor.
    """
    gaps = [int(np.diff(each.frame).min()) for each in recordings if len(each.frame) > 1]
    step = max(min(gaps, default=1), 1)
    begin = np.array([each.frame[0] for each in recordings], dtype=np.float64)
    columns = [np.rint((each.frame - each.frame[0]) / step).astype(np.int64) for each in recordings]
    scores = np.full(
        (len(recordings), 1 + max((int(each[-1]) for each in columns), default=0)), np.nan
    )
    for row, (recording, column) in enumerate(zip(recordings, columns, strict=True)):
        known = recording.scores.get(predictor)
        scores[row, column] = (
            _trivial(predictor, recording, draw) if known is None else known[:, _COLUMN[scores_of]]
        )
    kinds = np.array([each.kind for each in recordings])
    toa = (np.array([each.end for each in recordings], dtype=np.float64) - begin) / step
    if (kinds == "accident").any():
        toa[kinds == "others"] = np.minimum(toa, np.median(toa[kinds == "accident"]))[
            kinds == "others"
        ]
    return ScoreSeries(
        scores=scores, positive=kinds == "accident", toa=toa, fps=1 / (step * FRAME_PERIOD)
    )


def twin_pairs(recordings: Sequence[Recording]) -> IntArray:
    """(P, 2) rows of the accident recordings and of their twins', of one part each."""
    rows = {(each.story, each.part, each.kind): row for row, each in enumerate(recordings)}
    pairs = [
        (row, rows.get((each.story, each.part, "twins")))
        for row, each in enumerate(recordings)
        if each.kind == "accident"
    ]
    return np.array([pair for pair in pairs if pair[1] is not None], dtype=np.int64).reshape(-1, 2)


def _recording(name: str, samples: Sequence[Counts], part: int) -> Recording:
    first = samples[0]
    scenario, _, agent = name.rpartition("/")
    frame = np.array([each["frame"] for each in samples], dtype=np.int64)
    if not (
        frame.min() >= 0 and frame.max() <= _MOST_FRAMES
    ):  # a column each: else one could ask for gigabytes
        raise EvaluationError(
            f"{name}: expected frames up to {_MOST_FRAMES:,}, found {frame.min()} to {frame.max()}"
        )
    kind: _Kind = first["kind"]
    ends = [each["frame"] + each["to_end"] for each in samples if each["to_end"] is not None]
    given = [[*each["alarms"], *([score, 0] for score in each["unjudged"])] for each in samples]
    return Recording(
        name=name,
        story=f"{cluster_of(scenario)}/{agent}",
        group=first["involvement"] or GROUPS[-1],
        kind=kind,
        part=part,
        frame=frame,
        end=ends[0] if kind != "others" and ends else int(frame[-1]) + 1,
        scores={
            GIVEN: _scores(surest(each, kind) for each in given),
            **{
                name: _scores(
                    each["references"][number] if each["references"] else [None, None]
                    for each in samples
                )
                for number, name in enumerate(REFERENCES)
            },
        },
    )


def _scores(pairs: Iterable[Sequence[float | None]]) -> FloatArray:
    """(S, 2) of pairs of scores, None for no alarm."""
    scores = np.array(
        [[math.nan if each is None else each for each in pair] for pair in pairs], dtype=np.float64
    )
    return np.nan_to_num(scores.reshape(-1, 2), nan=-np.inf, neginf=-np.inf)


def _trivial(predictor: str, recording: Recording, draw: int) -> FloatArray:
    """(S,) scores of a predictor that knows nothing; random ones are seeded by the recording and the draw."""
    if predictor in ("always", "never"):
        return np.full(len(recording.frame), 1.0 if predictor == "always" else -np.inf)
    source = np.random.default_rng(
        [zlib.crc32(recording.name.encode()), TRIVIAL.index(predictor), draw]
    )
    frames = 1 if predictor == "random per recording" else int(recording.frame[-1]) + 1
    return source.random(frames)[recording.frame % frames]


def by_group(recordings: Sequence[Recording]) -> Iterator[tuple[str, list[Recording]]]:
    """Group → its recordings, of the groups that there are."""
    for group in GROUPS:
        chosen = [each for each in recordings if each.group == group]
        if chosen:
            yield group, chosen
