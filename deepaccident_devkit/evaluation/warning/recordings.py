"""Recordings that warnings are evaluated on: counts of samples, and scores of recordings.

`ScoreSeries` holds the scores of many recordings, frame by frame; `AlarmRuns` holds the durations
of their alarms.
"""

from __future__ import annotations

import zlib
from collections.abc import Collection, Iterator, Mapping, Sequence
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

# In columns. Times are decimal numbers, which floats only approximate.
_COLUMN_TOLERANCE = 1e-6
# Seconds per minute.
MINUTE: Final = 60.0
# An alarm is correct if its two positions are, in total, less than this far from the positions of
# the colliding pair; this is the position error of the protocol `paper`.
_RIGHT_POSITION_M = 10.0
# Kinds of a recording: with a collision; without one, although the scenario's twin has one; without
# one, and no twin with an accident is known.
_Kind = Literal["accident", "twins", "others"]
KINDS: Final[tuple[_Kind, ...]] = get_args(_Kind)
# Replaces the kind of a recording with a collision if no label shows both actors
# (`BoxTruth.unplaced`). Such samples are counted but not evaluated, since no alarm in them can be
# called correct or false.
UNPLACED: Final = "unplaced"
# The score of a sample in an accident recording is the highest score of its correct alarms (`pair`)
# or of all its alarms (`recording`).
ScoresOf = Literal["pair", "recording"]
GIVEN_SCORES: Final = "given"
TRIVIAL: Final = ("always", "never", "random per frame", "random per recording")
# Rows of every table: the evaluated predictions, four predictors that know nothing, and two that
# know the current frame.
PREDICTORS: Final = (GIVEN_SCORES, *TRIVIAL, *REFERENCES)
GROUPS: Final = (*get_args(Involvement), "unknown")
"""Groups of recordings by `Involvement`, never pooled; `unknown` if no context states it."""
# Largest frame number of a recording; the longest recordings have a few hundred frames.
_MAX_FRAMES = 10_000
_SCORE_COLUMNS: Mapping[ScoresOf, int] = {
    name: column for column, name in enumerate(get_args(ScoresOf))
}
# Key of counts that contain the counts of several samples; their recordings are never joined with
# the recordings of other samples.
PART: Final = "part"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScoreSeries(FrozenArrays):
    """A predictor's accident scores at each frame of N recordings.

    Arrays are read-only.

    Attributes:
        scores: (N, T) float64, higher means more certain; −inf if no threshold raises an alarm; NaN
            after a recording's end and for missing frames.
        positive: (N,) bool, True for recordings that end in an accident.
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
        """(N, T) bool, True for scores that count: not missing, and before the impact."""
        columns = np.arange(self.scores.shape[1])
        is_before_impact = columns < self.toa[:, None]
        has_score = ~np.isnan(self.scores)
        return np.asarray(has_score & is_before_impact)

    def highest(self) -> FloatArray:
        """Return the highest score of each recording, shape (N,); −inf if it has no score."""
        highest = np.max(self.scores, axis=1, initial=-np.inf, where=self.valid)
        return np.asarray(highest)

    def before(self, seconds: float) -> FloatArray:
        """Return the scores of the M columns within `seconds` before `toa`, the latest first.

        Returns:
            Scores, shape (N, M); NaN for missing scores.
        """
        moment_count = round(seconds * self.fps)
        moments = 1 + np.arange(moment_count)
        exact_columns = self.toa[:, None] - moments
        columns = np.ceil(exact_columns - _COLUMN_TOLERANCE).astype(np.int64)
        is_frame = (columns >= 0) & (columns < self.scores.shape[1])
        columns[~is_frame] = 0
        rows = np.arange(len(self.toa))[:, None]
        has_score = is_frame & self.valid[rows, columns]
        return np.where(has_score, self.scores[rows, columns], np.nan)

    def first(self, thresholds: FloatArray) -> IntArray:
        """Return the first column in which the score reaches a threshold.

        Args:
            thresholds: Smallest scores that raise an alarm, shape (K,).

        Returns:
            Columns, shape (N, K); T where no score reaches the threshold.
        """
        valid_scores = np.where(self.valid, self.scores, -np.inf)
        running_highest = np.maximum.accumulate(valid_scores, axis=1)
        columns = np.empty((len(valid_scores), len(thresholds)), dtype=np.int64)
        for row, highest in enumerate(running_highest):
            columns[row] = np.searchsorted(highest, thresholds, side="left")
        return columns

    def leads(self, thresholds: FloatArray) -> FloatArray:
        """Return the lead times: from the first score that reaches a threshold to the accident.

        Args:
            thresholds: Smallest scores that raise an alarm, shape (K,).

        Returns:
            Lead times in seconds, shape (N, K); NaN where no score reaches the threshold.
        """
        columns = self.first(thresholds).astype(np.float64)
        is_missing = columns >= self.scores.shape[1]
        columns[is_missing] = np.nan
        lead_columns = self.toa[:, None] - columns
        return np.asarray(lead_columns / self.fps)


def shares(part: AnyArray, total: AnyArray) -> FloatArray:
    """Divide parts (N,) by totals (N,); the result is 0 where a total is 0."""
    zeros = np.zeros(len(total))
    return np.asarray(np.divide(part, total, out=zeros, where=total > 0))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AlarmRuns(FrozenArrays):
    """The R runs of successive frames in alarm in N recordings; arrays are read-only.

    Attributes:
        row: (R,) int64, index of the recording.
        begin: (R,) int64, first column of the run.
        length: (R,) int64, number of columns of the run.
        shape: Number N of recordings, and number T of columns.
        fps: Columns per second.
    """

    row: IntArray
    begin: IntArray
    length: IntArray
    shape: tuple[int, int]
    fps: float

    @classmethod
    def of(cls, alarm: BoolArray, fps: float) -> AlarmRuns:
        """Find the runs of True in alarms (N, T), which have one row per recording.

        A missing frame is False, so it ends a run.
        """
        edges = np.diff(alarm.astype(np.int8), axis=1, prepend=0, append=0)
        row, begin = np.nonzero(edges == 1)
        _, end = np.nonzero(edges == -1)
        recording_count, column_count = alarm.shape
        return cls(
            row=row,
            begin=begin,
            length=end - begin,
            shape=(recording_count, column_count),
            fps=fps,
        )

    def braking_seconds(self, reaction: float) -> FloatArray:
        """Return for how many seconds a driver who obeys alarms brakes in each recording, (N,).

        Each run adds max(0, its duration − `reaction`), where `reaction` is the reaction time in
        seconds.
        """
        durations = self.length / self.fps
        braking_durations = np.maximum(durations - reaction, 0.0)
        seconds = np.bincount(self.row, braking_durations, self.shape[0])
        return np.asarray(seconds.astype(np.float64))

    def first_lasting(self, reaction: float) -> IntArray:
        """Return the first column of the first run that is longer than the reaction time, (N,).

        It is T if no run is longer. Shorter runs cost nothing, since the driver does not brake.
        """
        durations = self.length / self.fps
        outlasts_reaction = durations > reaction
        recording_count, column_count = self.shape
        columns = np.full(recording_count, column_count, dtype=np.int64)
        np.minimum.at(columns, self.row[outlasts_reaction], self.begin[outlasts_reaction])
        return columns


def sample_counts(
    token: str,
    prediction: Prediction,
    label: MotionLabels | None,
    context: AccidentContext,
) -> Counts:
    """Count one sample; all warning protocols use the same counts.

    An alarm that predicts an accident beyond the horizon does not count. The true impact may be
    further ahead than the model can predict, unlike in APA: an early alarm with the correct pair or
    position is a warning. Cells of maps are coarse, so maps raise more false alarms than explicit
    accidents.

    Returns:
        `recording`: scenario and agent; `frame`: number of the frame in the recording; `kind` (or
        `UNPLACED`) and `involvement` of the recording; `ahead`: recorded frames to the impact, None
        without one; `to_end`: the same, but for a twin the frames to the accident's impact;
        `alarms`: [score, whether it is correct] of each alarm, in descending order of score;
        `unjudged`: scores of the alarms that nothing can refute; `beyond`: number of alarms that
        predict an accident beyond the horizon; `references`: for each of `REFERENCES` the scores of
        its highest-scoring correct alarm and of its highest-scoring alarm, empty if there is none.

    Raises:
        EvaluationError: If the token is not a sample token, the context lacks something, or the
            prediction is neither motion nor accidents.
    """
    recording, frame = _recording_and_frame(token)
    truth = context.truth
    time_to_end = context.time_to_end
    if truth is None or time_to_end is None:
        raise EvaluationError(
            "context: to evaluate warnings, the evaluator needs to know what happens and when; "
            "give accident_context(dataset, sample, horizon=2.0)"
        )
    all_alarms = named_alarms(checked_prediction(prediction), label, truth, AccidentReading())
    alarms_within_horizon = within_horizon(all_alarms, truth)
    time_to_impact = context.time_to_impact
    kind = _kind(context) if truth.unplaced is None else UNPLACED
    judged_alarms = []
    unjudged_scores = []
    for alarm, ids in alarms_within_horizon:
        # what happens after the recording's end is unknown, unless an accident has ended it
        if time_to_impact is not None or alarm.time <= time_to_end + TIME_TOLERANCE_S:
            is_right = _is_right(alarm, ids, truth, context)
            judged_alarms.append([alarm.score, int(is_right)])
        else:
            unjudged_scores.append(alarm.score)
    time_to_last_frame = context.time_to_twin_impact if kind == "twins" else time_to_impact
    return {
        "recording": recording,
        "frame": frame,
        "kind": kind,
        "involvement": context.involvement,
        "ahead": _recorded_frames(time_to_impact),
        "to_end": _recorded_frames(time_to_last_frame),
        "alarms": judged_alarms,
        "unjudged": unjudged_scores,
        "beyond": len(all_alarms) - len(alarms_within_horizon),
        "references": _reference_scores(kind, truth, context),
    }


def _recorded_frames(seconds: float | None) -> int | None:
    """Convert a time in seconds to a number of recorded frames; None stays None."""
    if seconds is None:
        return None
    return round(seconds / FRAME_PERIOD)


def _reference_scores(
    kind: str, truth: BoxTruth, context: AccidentContext
) -> list[list[float | None]]:
    """Return the result of `surest_scores` for the alarms of each reference predictor."""
    scores = []
    for alarms in context.references.values():
        judged_alarms = []
        for alarm in alarms:
            is_right = _is_right(alarm, alarm.ids, truth, context)
            judged_alarms.append([alarm.score, int(is_right)])
        scores.append(surest_scores(judged_alarms, kind))
    return scores


def surest_scores(alarms: Sequence[Sequence[float]], kind: str) -> list[float | None]:
    """Return the highest score of the correct alarms and of all alarms; None without alarms.

    In a recording without a collision, no alarm is correct; both are then the highest of all
    scores.

    Args:
        alarms: [score, whether it is correct] of each alarm.
        kind: Kind of the recording, one of `KINDS`.
    """
    scores = [score for score, _ in alarms]
    highest = max(scores, default=None)
    if kind != "accident":
        return [highest, highest]
    right_scores = [score for score, is_right in alarms if is_right]
    return [max(right_scores, default=None), highest]


def _recording_and_frame(token: object) -> tuple[str, int]:
    """Split a sample token into its recording and its frame number.

    Raises:
        EvaluationError: If the token is not a sample token.
    """
    recording = ""
    frame = ""
    if isinstance(token, str):
        recording, _, frame = token.rpartition("/")
    if not recording or not frame.isdecimal():
        raise EvaluationError(
            "token: expected the token of a sample, such as "
            f"type1_subtype1_accident/Town03_…/ego_vehicle/045, found {token!r}, as warnings are "
            "counted by recording"
        )
    return recording, int(frame)


def _kind(context: AccidentContext) -> _Kind:
    """Return the kind of a sample's recording, one of `KINDS`."""
    if context.time_to_impact is not None:
        return "accident"
    return "twins" if context.twin else "others"


def _is_right(
    accident: Accident, ids: Pair | None, truth: BoxTruth, context: AccidentContext
) -> bool:
    """Return whether an alarm names the colliding pair, in either order, or its positions."""
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
    """Scores of one agent's recording of a scenario, with its frames and kind; read-only arrays.

    Attributes:
        name: Scenario and agent.
        story: Scenario without its ending, and agent; a recording and its twin have the same.
        group: One of `GROUPS`.
        kind: One of `KINDS`: whether there is a collision here or in the twin.
        part: Index of the part of the samples that the recording belongs to.
        frame: (S,) int64 frame numbers of the samples, ascending.
        end: Frame of the impact; for a twin the frame of the accident's impact; otherwise the frame
            after the last sample.
        scores: Predictor, except the ones in `TRIVIAL` → (S, 2) scores of its highest-scoring
            correct alarm and of its highest-scoring alarm; −inf if there is none. The two are equal
            in recordings without a collision.
    """

    name: str
    story: str
    group: str
    kind: _Kind
    part: int
    frame: IntArray
    end: int
    scores: Mapping[str, FloatArray]


def split_counts(counts: Collection[Counts]) -> list[Sequence[Counts]]:
    """Split counts into parts: first all single samples together, then each pooled part."""
    single_samples = [sample for sample in counts if PART not in sample]
    pooled_parts = [sample[PART] for sample in counts if PART in sample]
    return [single_samples, *pooled_parts]


def recordings_of(parts: Sequence[Collection[Counts]]) -> list[Recording]:
    """Build the recordings of each part, sorted by name; unplaced accidents are left out."""
    recordings = []
    for part, counts in enumerate(parts):
        placed_samples = [sample for sample in counts if sample["kind"] != UNPLACED]
        placed_samples.sort(key=itemgetter("recording", "frame"))
        for name, samples in groupby(placed_samples, key=itemgetter("recording")):
            recordings.append(_recording(name, list(samples), part))
    return recordings


def left_out_notes(samples: Collection[Counts]) -> list[str]:
    """Return sentences that say which samples and alarms do not count."""
    unplaced_samples = sum(sample["kind"] == UNPLACED for sample in samples)
    late_alarms = sum(sample["beyond"] for sample in samples)
    return not_counted_notes(unplaced_samples, late_alarms)


def series_of(
    recordings: Sequence[Recording], predictor: str, scores_of: ScoresOf, draw: int = 0
) -> ScoreSeries:
    """Arrange the scores of recordings in a series, one column per step.

    A step is the smallest gap between successive samples in any of the recordings. The length of a
    recording must not reveal whether it ends in an accident. So twins end where their accident
    does, and other recordings end no later than the median length of the accidents.

    Args:
        recordings: One per row of the series.
        predictor: One of `PREDICTORS`.
        scores_of: Which alarms count in a recording with a collision; see
            `CleanWarnings.scores_of`.
        draw: Index of the draw; only random predictors depend on it.
    """
    step, columns = _step_and_columns(recordings)
    last_column = max((int(row[-1]) for row in columns), default=0)
    scores = np.full((len(recordings), 1 + last_column), np.nan)
    for row, recording in enumerate(recordings):
        predicted_scores = recording.scores.get(predictor)
        if predicted_scores is None:
            scores[row, columns[row]] = _trivial_scores(predictor, recording, draw)
        else:
            scores[row, columns[row]] = predicted_scores[:, _SCORE_COLUMNS[scores_of]]
    kinds = np.array([recording.kind for recording in recordings])
    begins = np.array([recording.frame[0] for recording in recordings], dtype=np.float64)
    ends = np.array([recording.end for recording in recordings], dtype=np.float64)
    toa = (ends - begins) / step
    is_accident = kinds == "accident"
    is_other = kinds == "others"
    if is_accident.any():
        median_toa = np.median(toa[is_accident])
        toa[is_other] = np.minimum(toa[is_other], median_toa)
    return ScoreSeries(scores=scores, positive=is_accident, toa=toa, fps=1 / (step * FRAME_PERIOD))


def _step_and_columns(recordings: Sequence[Recording]) -> tuple[int, list[IntArray]]:
    """Return the number of frames per column, and the columns of each recording's samples."""
    smallest_gaps = []
    for recording in recordings:
        if len(recording.frame) > 1:
            gaps = np.diff(recording.frame)
            smallest_gaps.append(int(gaps.min()))
    step = max(min(smallest_gaps, default=1), 1)
    columns = []
    for recording in recordings:
        offset = recording.frame - recording.frame[0]
        columns.append(np.rint(offset / step).astype(np.int64))
    return step, columns


def twin_pairs(recordings: Sequence[Recording]) -> IntArray:
    """Return the indices of accident recordings and of their twins in the same part, (P, 2)."""
    twin_rows = {}
    for row, recording in enumerate(recordings):
        if recording.kind == "twins":
            twin_rows[recording.story, recording.part] = row
    pairs = []
    for row, recording in enumerate(recordings):
        twin_row = twin_rows.get((recording.story, recording.part))
        if recording.kind == "accident" and twin_row is not None:
            pairs.append((row, twin_row))
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _recording(name: str, samples: Sequence[Counts], part: int) -> Recording:
    """Build a recording from its samples, which must be sorted by frame.

    Raises:
        EvaluationError: If a frame number is negative or too large.
    """
    scenario, _, agent = name.rpartition("/")
    frame = np.array([sample["frame"] for sample in samples], dtype=np.int64)
    # each frame is a column: without a limit one number could ask for gigabytes
    if not (frame.min() >= 0 and frame.max() <= _MAX_FRAMES):
        raise EvaluationError(
            f"{name}: expected frames up to {_MAX_FRAMES:,}, found {frame.min()} to {frame.max()}"
        )
    kind: _Kind = samples[0]["kind"]
    end_frames = []
    given_scores = []
    for sample in samples:
        if sample["to_end"] is not None:
            end_frames.append(sample["frame"] + sample["to_end"])
        unjudged_alarms = [[score, 0] for score in sample["unjudged"]]
        given_scores.append(surest_scores([*sample["alarms"], *unjudged_alarms], kind))
    scores = {GIVEN_SCORES: _score_pairs(given_scores)}
    for number, reference in enumerate(REFERENCES):
        reference_scores = []
        for sample in samples:
            references = sample["references"]
            reference_scores.append(references[number] if references else [None, None])
        scores[reference] = _score_pairs(reference_scores)
    return Recording(
        name=name,
        story=f"{cluster_of(scenario)}/{agent}",
        group=samples[0]["involvement"] or GROUPS[-1],
        kind=kind,
        part=part,
        frame=frame,
        end=end_frames[0] if kind != "others" and end_frames else int(frame[-1]) + 1,
        scores=scores,
    )


def _score_pairs(pairs: Sequence[Sequence[float | None]]) -> FloatArray:
    """Convert pairs of scores to an array (S, 2); None (no alarm) becomes −inf."""
    # numpy reads None as NaN
    scores = np.array(pairs, dtype=np.float64).reshape(-1, 2)
    return np.nan_to_num(scores, nan=-np.inf, neginf=-np.inf)


def _trivial_scores(predictor: str, recording: Recording, draw: int) -> FloatArray:
    """Compute the scores (S,) of a predictor that knows nothing.

    Random predictors are seeded by the recording and the draw.
    """
    if predictor == "always":
        return np.full(len(recording.frame), 1.0)
    if predictor == "never":
        return np.full(len(recording.frame), -np.inf)
    seed = [zlib.crc32(recording.name.encode()), TRIVIAL.index(predictor), draw]
    generator = np.random.default_rng(seed)
    if predictor == "random per recording":
        return np.full(len(recording.frame), generator.random())
    frame_count = int(recording.frame[-1]) + 1
    return generator.random(frame_count)[recording.frame]


def group_recordings(recordings: Sequence[Recording]) -> Iterator[tuple[str, list[Recording]]]:
    """Yield the name of each group that has recordings, with the recordings."""
    for group in GROUPS:
        members = [recording for recording in recordings if recording.group == group]
        if members:
            yield group, members
