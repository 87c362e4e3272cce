"""The recordings of warnings: counts of one sample, and a recording's samples with their scores.

`ScoreSeries` are the scores of many recordings, frame by frame; `AlarmRuns` the durations of their
alarms.
"""

from __future__ import annotations

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
    TIME_TOLERANCE_S,
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

# Times are decimal numbers, which binary numbers only approximate.
_COLUMN_TOLERANCE: Final = 1e-6
MINUTE: Final = 60.0
# Distance in metres, as the position error of the protocol `paper`: an alarm is right if the
# distances of its two positions from where the pair meets add up to less.
_RIGHT_POSITION_M: Final = 10.0
# Kinds of a recording: somebody collides; nobody does, except in the scenario's twin; nobody does,
# and no twin with an accident is known.
_Kind = Literal["accident", "twins", "others"]
KINDS: Final[tuple[_Kind, ...]] = get_args(_Kind)
# Instead of the kind: somebody collides, but no label shows both (`BoxTruth.unplaced`). Such
# samples are counted and left out, since no alarm in them can be called right or false.
UNPLACED: Final = "unplaced"
# A sample's score in an accident recording is that of its surest right alarm, or of its surest one.
ScoresOf = Literal["pair", "recording"]
GIVEN: Final = "given"
TRIVIAL: Final = ("always", "never", "random per frame", "random per recording")
# Rows of every table: the predictions, four predictors that know nothing, and two that know the
# present.
PREDICTORS: Final = (GIVEN, *TRIVIAL, *REFERENCES)
GROUPS: Final = (*get_args(Involvement), "unknown")
"""Groups of recordings, never pooled: by `Involvement`; `unknown` where no context has it."""
# Largest frame number of a recording; the longest recordings have a few hundred frames.
_MAX_FRAMES: Final = 10_000
_RECORDING_AND_FRAME: Final = itemgetter("recording", "frame")
_SCORE_COLUMNS: Final[Mapping[ScoresOf, int]] = {
    name: column for column, name in enumerate(get_args(ScoresOf))
}
# Under this name counts hold the counts of several samples; their recordings are never joined with
# the recordings of other samples.
PART: Final = "part"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScoreSeries(FrozenArrays):
    """Confidence of a predictor that an accident comes, by frame of N recordings; read-only arrays.

    Attributes:
        scores: (N, T) float64, higher is surer; −inf where no threshold raises an alarm; NaN after
            a recording's end, and where a frame is missing.
        positive: (N,) bool, whether the recording ends in an accident.
        toa: (N,) float64, time of the accident: the column of the impact, just past the recording's
            frames; without an accident the column after the last one that counts.
        fps: Columns per second.
    """

    scores: FloatArray
    positive: BoolArray
    toa: FloatArray
    fps: float

    @property
    def valid(self) -> BoolArray:
        """(N, T) whether a score counts; from the impact on no score does."""
        is_before_impact = np.arange(self.scores.shape[1]) < self.toa[:, None]
        return np.asarray(~np.isnan(self.scores) & is_before_impact)

    def highest(self) -> FloatArray:
        """Return the highest score of each recording, shape (N,); −inf without any."""
        highest = np.max(self.scores, axis=1, initial=-np.inf, where=self.valid)
        return np.asarray(highest)

    def before(self, seconds: float) -> FloatArray:
        """Return the scores at the M moments of the last seconds before `toa`, the latest first.

        Returns:
            Scores, shape (N, M); NaN where there is none.
        """
        moments = np.arange(1, round(seconds * self.fps) + 1)
        column = np.ceil(self.toa[:, None] - moments - _COLUMN_TOLERANCE).astype(np.int64)
        is_frame = (column >= 0) & (column < self.scores.shape[1])
        rows = np.arange(len(self.toa))[:, None]
        valid_scores = np.where(self.valid, self.scores, np.nan)
        return np.where(is_frame, valid_scores[rows, column * is_frame], np.nan)

    def first(self, thresholds: FloatArray) -> IntArray:
        """Return the first column with a score that reaches each of K thresholds.

        Returns:
            Columns, shape (N, K); T where no score reaches the threshold.
        """
        valid_scores = np.where(self.valid, self.scores, -np.inf)
        running_highest = np.maximum.accumulate(valid_scores, axis=1)
        columns = np.array(
            [np.searchsorted(row, thresholds, side="left") for row in running_highest],
            dtype=np.int64,
        )
        return columns.reshape(len(running_highest), len(thresholds))

    def leads(self, thresholds: FloatArray) -> FloatArray:
        """Return the seconds from the first score of at least each of K thresholds to `toa`.

        Returns:
            Seconds, shape (N, K); NaN where no score reaches the threshold.
        """
        columns = self.first(thresholds).astype(np.float64)
        columns[columns >= self.scores.shape[1]] = np.nan
        return np.asarray((self.toa[:, None] - columns) / self.fps)


def shares(part: AnyArray, total: AnyArray) -> FloatArray:
    """Return parts divided by totals (N,); 0 where a total is 0."""
    zeros = np.zeros(len(total))
    return np.asarray(np.divide(part, total, out=zeros, where=total > 0))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AlarmRuns(FrozenArrays):
    """The R runs of alarmed frames of N recordings; arrays are read-only.

    Attributes:
        row: (R,) int64, row of the recording.
        begin: (R,) int64, first column.
        length: (R,) int64, number of columns.
        shape: N recordings and T columns.
        fps: Columns per second.
    """

    row: IntArray
    begin: IntArray
    length: IntArray
    shape: tuple[int, int]
    fps: float

    @classmethod
    def of(cls, alarm: BoolArray, fps: float) -> AlarmRuns:
        """Return the runs in alarms (N, T), one row per recording.

        A missing frame is False and so ends a run.
        """
        edges = np.diff(alarm.astype(np.int8), axis=1, prepend=0, append=0)
        row, begin = np.nonzero(edges == 1)
        _, end = np.nonzero(edges == -1)
        count, columns = alarm.shape
        return cls(row=row, begin=begin, length=end - begin, shape=(count, columns), fps=fps)

    def braking_seconds(self, reaction: float) -> FloatArray:
        """Return the seconds for which an obedient driver brakes in each recording, shape (N,).

        Each run adds max(0, its duration − the reaction time).
        """
        seconds = np.maximum(self.length / self.fps - reaction, 0.0)
        by_recording = np.bincount(self.row, seconds, self.shape[0])
        return np.asarray(by_recording.astype(np.float64))

    def first_lasting(self, reaction: float) -> IntArray:
        """Return the first column of the first run that outlasts the reaction, (N,); T for none.

        Shorter runs cost nothing, since the driver does not brake.
        """
        lasting = self.length / self.fps > reaction
        columns = np.full(self.shape[0], self.shape[1], dtype=np.int64)
        np.minimum.at(columns, self.row[lasting], self.begin[lasting])
        return columns


def sample_counts(
    token: str,
    prediction: Prediction,
    label: MotionLabels | None,
    context: AccidentContext,
) -> Counts:
    """Return what one sample adds, the same for all warning protocols.

    An alarm for later than the horizon does not count. Unlike an accident that counts for APA, the
    impact may be later than the model looks ahead: an early alarm with the right pair or the right
    position is a warning. Cells of maps are coarse, so they raise more false alarms than explicit
    accidents.

    Returns:
        `recording`: scenario and agent; `frame`: its number in the recording; `kind` (or
        `UNPLACED`) and `involvement` of the recording; `ahead`: recorded frames to the impact, None
        without one; `to_end`: the same, for a twin to the accident's impact; `alarms`: [score,
        whether it is right], the surest first; `unjudged`: scores of the alarms that nothing can
        refute; `beyond`: number of alarms for later than the horizon, which do not count;
        `references`: for each of `REFERENCES` the scores of its surest right alarm and of its
        surest one, empty without any.

    Raises:
        EvaluationError: the token is no sample's, the context lacks something, or the prediction is
            neither motion nor accidents.
    """
    recording, frame = _recording_and_frame(token)
    truth = context.truth
    time_to_end = context.time_to_end
    if truth is None or time_to_end is None:
        raise EvaluationError(
            "context: warnings need to know what happens, and when; give accident_context(dataset, "
            "sample, horizon=2.0)"
        )
    raised = named_alarms(checked_prediction(prediction), label, truth, AccidentReading())
    within = within_horizon(raised, truth)
    ahead = context.time_to_impact
    kind = _kind(context) if truth.unplaced is None else UNPLACED
    alarms = []
    unjudged = []
    for alarm, ids in within:
        if ahead is not None or alarm.time <= time_to_end + TIME_TOLERANCE_S:
            alarms.append([alarm.score, int(_is_right(alarm, ids, truth, context))])
        else:
            unjudged.append(alarm.score)
    end = context.time_to_twin_impact if kind == "twins" else ahead
    return {
        "recording": recording,
        "frame": frame,
        "kind": kind,
        "involvement": context.involvement,
        "ahead": _recorded_frames(ahead),
        "to_end": _recorded_frames(end),
        "alarms": alarms,
        "unjudged": unjudged,
        "beyond": len(raised) - len(within),
        "references": _reference_scores(kind, truth, context),
    }


def _recorded_frames(seconds: float | None) -> int | None:
    """Return a time as a number of recorded frames; None for None."""
    return None if seconds is None else round(seconds / FRAME_PERIOD)


def _reference_scores(
    kind: str, truth: BoxTruth, context: AccidentContext
) -> list[list[float | None]]:
    """Return what `surest` gives for each reference predictor's alarms."""
    scores = []
    for alarms in context.references.values():
        judged = [
            [alarm.score, int(_is_right(alarm, alarm.ids, truth, context))] for alarm in alarms
        ]
        scores.append(surest(judged, kind))
    return scores


def surest(alarms: Sequence[Sequence[float]], kind: str) -> list[float | None]:
    """Return the scores of the surest right alarm and of the surest alarm, None for none.

    Where nobody collides no alarm is right, and both scores are of the surest alarm.

    Args:
        alarms: [score, whether it is right] of each alarm.
        kind: Kind of the recording.
    """
    best = max((score for score, _ in alarms), default=None)
    if kind != "accident":
        return [best, best]
    return [max((score for score, is_right in alarms if is_right), default=None), best]


def _recording_and_frame(token: object) -> tuple[str, int]:
    """Return the recording and the frame number of a sample's token; raises EvaluationError."""
    recording, _, frame = token.rpartition("/") if isinstance(token, str) else ("", "", "")
    if not recording or not frame.isdecimal():
        raise EvaluationError(
            "token: expected a sample's, such as "
            f"type1_subtype1_accident/Town03_…/ego_vehicle/045, found {token!r}: warnings are "
            "counted by recording"
        )
    return recording, int(frame)


def _kind(context: AccidentContext) -> _Kind:
    """Return the kind of a sample's recording."""
    if context.time_to_impact is not None:
        return "accident"
    return "twins" if context.twin else "others"


def _is_right(
    accident: Accident, ids: Pair | None, truth: BoxTruth, context: AccidentContext
) -> bool:
    """Return whether an alarm names the colliding pair, in either order, or where they meet."""
    if context.time_to_impact is None or context.pair is None:
        return False
    if ids is not None and set(ids) == set(context.pair):
        return True
    if truth.impact is None:
        return False
    difference = position_difference(accident.positions, truth.impact.positions)
    return difference < _RIGHT_POSITION_M - TIE


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recording(FrozenArrays):
    """Scores and facts of one agent's recording of a scenario; arrays are read-only.

    Attributes:
        name: Scenario and agent.
        story: Scenario without its ending, and agent; its twin has the same.
        group: One of `GROUPS`.
        kind: Whether somebody collides here, or in the twin.
        part: Index of the group of samples that it belongs to.
        frame: (S,) int64 frame numbers of the samples, ascending.
        end: Frame of the impact; for a twin the frame of the accident's impact; otherwise the frame
            after the last sample.
        scores: Predictor, except the ones in `TRIVIAL` → scores (S, 2) of its surest right alarm
            and of its surest one, −inf without one; equal where nobody collides.
    """

    name: str
    story: str
    group: str
    kind: _Kind
    part: int
    frame: IntArray
    end: int
    scores: Mapping[str, FloatArray]


def parts_of(counts: Collection[Counts]) -> list[Sequence[Counts]]:
    """Return the samples' counts: first the samples on their own, then each pooled group."""
    single_samples = [sample for sample in counts if PART not in sample]
    groups = [sample[PART] for sample in counts if PART in sample]
    return [single_samples, *groups]


def recordings_of(parts: Sequence[Collection[Counts]]) -> list[Recording]:
    """Return the recordings of each part's samples, by name, without unplaced accidents."""
    recordings = []
    for part, counts in enumerate(parts):
        placed = [sample for sample in counts if sample["kind"] != UNPLACED]
        placed.sort(key=_RECORDING_AND_FRAME)
        for name, samples in groupby(placed, key=itemgetter("recording")):
            recordings.append(_recording(name, list(samples), part))
    return recordings


def left_out_notes(samples: Collection[Counts]) -> list[str]:
    """Return sentences on the samples and alarms that do not count."""
    unplaced = sum(sample["kind"] == UNPLACED for sample in samples)
    return not_counted_notes(unplaced, sum(sample["beyond"] for sample in samples))


def series_of(
    recordings: Sequence[Recording], predictor: str, scores_of: ScoresOf, draw: int = 0
) -> ScoreSeries:
    """Return the scores of some recordings, one column per step.

    The step is the smallest from a sample to the next one in any of them. Lengths must not reveal
    the recordings that end in an accident: twins end where their accident does, and other
    recordings at the latest after the median length of the accidents.

    Args:
        recordings: Recordings, the rows of the series.
        predictor: One of `PREDICTORS`.
        scores_of: Alarms that count where somebody collides.
        draw: Number of the draw of a random predictor.
    """
    step, columns = _steps_and_columns(recordings)
    begin = np.array([recording.frame[0] for recording in recordings], dtype=np.float64)
    last_column = max((int(row[-1]) for row in columns), default=0)
    scores = np.full((len(recordings), 1 + last_column), np.nan)
    for row, recording in enumerate(recordings):
        predicted = recording.scores.get(predictor)
        if predicted is None:
            scores[row, columns[row]] = _trivial(predictor, recording, draw)
        else:
            scores[row, columns[row]] = predicted[:, _SCORE_COLUMNS[scores_of]]
    kinds = np.array([recording.kind for recording in recordings])
    ends = np.array([recording.end for recording in recordings], dtype=np.float64)
    toa = (ends - begin) / step
    is_accident = kinds == "accident"
    is_other = kinds == "others"
    if is_accident.any():
        toa[is_other] = np.minimum(toa, np.median(toa[is_accident]))[is_other]
    return ScoreSeries(scores=scores, positive=is_accident, toa=toa, fps=1 / (step * FRAME_PERIOD))


def _steps_and_columns(recordings: Sequence[Recording]) -> tuple[int, list[IntArray]]:
    """Return the frames from column to column, and the columns of each recording's samples."""
    smallest_gaps = []
    for recording in recordings:
        if len(recording.frame) > 1:
            smallest_gaps.append(int(np.diff(recording.frame).min()))
    step = max(min(smallest_gaps, default=1), 1)
    columns = []
    for recording in recordings:
        offset = recording.frame - recording.frame[0]
        columns.append(np.rint(offset / step).astype(np.int64))
    return step, columns


def twin_pairs(recordings: Sequence[Recording]) -> IntArray:
    """Return rows of accident recordings and of their twins in the same part, shape (P, 2)."""
    rows = {}
    for row, recording in enumerate(recordings):
        rows[recording.story, recording.part, recording.kind] = row
    pairs = []
    for row, recording in enumerate(recordings):
        twin_row = rows.get((recording.story, recording.part, "twins"))
        if recording.kind == "accident" and twin_row is not None:
            pairs.append((row, twin_row))
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _recording(name: str, samples: Sequence[Counts], part: int) -> Recording:
    """Return the recording of some samples, in the order of their frames."""
    scenario, _, agent = name.rpartition("/")
    frame = np.array([sample["frame"] for sample in samples], dtype=np.int64)
    # each frame is a column: without a limit one number could ask for gigabytes
    if not (frame.min() >= 0 and frame.max() <= _MAX_FRAMES):
        raise EvaluationError(
            f"{name}: expected frames up to {_MAX_FRAMES:,}, found {frame.min()} to {frame.max()}"
        )
    kind: _Kind = samples[0]["kind"]
    ends = []
    surest_scores = []
    for sample in samples:
        if sample["to_end"] is not None:
            ends.append(sample["frame"] + sample["to_end"])
        unjudged = [[score, 0] for score in sample["unjudged"]]
        surest_scores.append(surest([*sample["alarms"], *unjudged], kind))
    scores = {GIVEN: _scores(surest_scores)}
    for number, reference in enumerate(REFERENCES):
        reference_scores = []
        for sample in samples:
            references = sample["references"] or [[None, None]] * len(REFERENCES)
            reference_scores.append(references[number])
        scores[reference] = _scores(reference_scores)
    return Recording(
        name=name,
        story=f"{cluster_of(scenario)}/{agent}",
        group=samples[0]["involvement"] or GROUPS[-1],
        kind=kind,
        part=part,
        frame=frame,
        end=ends[0] if kind != "others" and ends else int(frame[-1]) + 1,
        scores=scores,
    )


def _scores(pairs: Iterable[Sequence[float | None]]) -> FloatArray:
    """Return pairs of scores as an array (S, 2), −inf for None, which means no alarm."""
    # numpy reads None as NaN
    scores = np.array([*pairs], dtype=np.float64)
    return np.nan_to_num(scores.reshape(-1, 2), nan=-np.inf, neginf=-np.inf)


def _trivial(predictor: str, recording: Recording, draw: int) -> FloatArray:
    """Return the scores (S,) of a predictor that knows nothing.

    Random predictors are seeded by the recording and the draw.
    """
    if predictor == "always":
        return np.full(len(recording.frame), 1.0)
    if predictor == "never":
        return np.full(len(recording.frame), -np.inf)
    seed = [zlib.crc32(recording.name.encode()), TRIVIAL.index(predictor), draw]
    frames = 1 if predictor == "random per recording" else int(recording.frame[-1]) + 1
    return np.random.default_rng(seed).random(frames)[recording.frame % frames]


def by_group(recordings: Sequence[Recording]) -> Iterator[tuple[str, list[Recording]]]:
    """Yield each group that has recordings, and its recordings."""
    for group in GROUPS:
        members = [recording for recording in recordings if recording.group == group]
        if members:
            yield group, members
