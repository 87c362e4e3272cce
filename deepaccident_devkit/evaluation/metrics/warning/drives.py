"""`Drive`: one agent's recording of a scenario, sample by sample, and the scores of predictors in it."""

from __future__ import annotations

import math
import zlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from typing import Final, Literal, get_args

import numpy as np

from deepaccident_devkit.arrays import FloatArray, FrozenArrays, IntArray
from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.metrics.alarms.truth import REFERENCES, UNPLACED_NOTE, Involvement
from deepaccident_devkit.evaluation.metrics.attributes import cluster_of
from deepaccident_devkit.evaluation.metrics.evaluator import Counts
from deepaccident_devkit.evaluation.metrics.warning.recordings import UNPLACED, Kind, surest
from deepaccident_devkit.evaluation.metrics.warning.series import ScoreSeries
from deepaccident_devkit.taxonomy import FRAME_PERIOD

ScoresOf = Literal["pair", "recording"]
"""What a sample's score in an accident recording is: that of its surest right alarm, or of its surest alarm."""
GIVEN: Final = "given"
TRIVIAL: Final = ("always", "never", "random per frame", "random per recording")
PREDICTORS: Final = (GIVEN, *TRIVIAL, *REFERENCES)
"""Rows of every table: the predictions, four predictors that know nothing, and two that know the present."""
GROUPS: Final = (*get_args(Involvement), "unknown")
"""Of recordings, never pooled: by `Involvement`; `unknown` where no context says it."""
_MOST_FRAMES: Final = 10_000
"""Of a recording; the longest have some hundred."""
_PLACE: Final = itemgetter("recording", "frame")
_COLUMN: Final[Mapping[ScoresOf, int]] = {name: column for column, name in enumerate(get_args(ScoresOf))}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drive(FrozenArrays):
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
    kind: Kind
    part: int
    frame: IntArray
    end: int
    scores: Mapping[str, FloatArray]


PART: Final = "part"
"""Under this name counts hold those of several samples, whose recordings are never put together with others'."""


def parts_of(counts: Collection[Counts]) -> list[Sequence[Counts]]:
    """The samples' counts: those by themselves, then each group of them that was pooled."""
    return [[each for each in counts if PART not in each], *(each[PART] for each in counts if PART in each)]


def drives_of(parts: Sequence[Collection[Counts]]) -> list[Drive]:
    """The recordings of each part's samples, by name; those of unplaced accidents (`recordings.UNPLACED`) left out."""
    return [
        _drive(name, list(those), part)
        for part, counts in enumerate(parts)
        for name, those in groupby(
            sorted((each for each in counts if each["kind"] != UNPLACED), key=_PLACE), key=itemgetter("recording")
        )
    ]


def left_out_notes(samples: Collection[Counts]) -> Iterator[str]:
    """What is said of samples and alarms that do not count."""
    unplaced = sum(each["kind"] == UNPLACED for each in samples)
    if unplaced:
        yield UNPLACED_NOTE.format(unplaced)
    beyond = sum(each["beyond"] for each in samples)
    if beyond:
        yield f"{beyond} alarms are for later than the horizon and do not count"


def series_of(drives: Sequence[Drive], predictor: str, scores_of: ScoresOf, draw: int = 0) -> ScoreSeries:
    """The scores of some recordings, a column a step: the smallest from a sample to the next of any of them.

    Lengths must not tell which recordings end in an accident. So twins end where their accident does, and others at
    the latest after the median length of the accidents.

    Args:
        drives: the recordings.
        predictor: of `PREDICTORS`.
        scores_of: whose alarms count where somebody collides.
        draw: of a random predictor.
    """
    gaps = [int(np.diff(each.frame).min()) for each in drives if len(each.frame) > 1]
    step = max(min(gaps, default=1), 1)
    begin = np.array([each.frame[0] for each in drives], dtype=np.float64)
    columns = [np.rint((each.frame - each.frame[0]) / step).astype(np.int64) for each in drives]
    scores = np.full((len(drives), 1 + max((int(each[-1]) for each in columns), default=0)), np.nan)
    for row, (drive, column) in enumerate(zip(drives, columns, strict=True)):
        known = drive.scores.get(predictor)
        scores[row, column] = _trivial(predictor, drive, draw) if known is None else known[:, _COLUMN[scores_of]]
    kinds = np.array([each.kind for each in drives])
    toa = (np.array([each.end for each in drives], dtype=np.float64) - begin) / step
    if (kinds == "accident").any():
        toa[kinds == "others"] = np.minimum(toa, np.median(toa[kinds == "accident"]))[kinds == "others"]
    return ScoreSeries(scores=scores, positive=kinds == "accident", toa=toa, fps=1 / (step * FRAME_PERIOD))


def twin_pairs(drives: Sequence[Drive]) -> IntArray:
    """(P, 2) rows of the accident recordings and of their twins', of one part each."""
    rows = {(each.story, each.part, each.kind): row for row, each in enumerate(drives)}
    pairs = [
        (row, rows.get((each.story, each.part, "twins"))) for row, each in enumerate(drives) if each.kind == "accident"
    ]
    return np.array([pair for pair in pairs if pair[1] is not None], dtype=np.int64).reshape(-1, 2)


def _drive(name: str, samples: Sequence[Counts], part: int) -> Drive:
    first = samples[0]
    scenario, _, agent = name.rpartition("/")
    frame = np.array([each["frame"] for each in samples], dtype=np.int64)
    if not (frame.min() >= 0 and frame.max() <= _MOST_FRAMES):  # a column each: else one could ask for gigabytes
        raise EvaluationError(f"{name}: expected frames up to {_MOST_FRAMES:,}, found {frame.min()} to {frame.max()}")
    kind: Kind = first["kind"]
    ends = [each["frame"] + each["to_end"] for each in samples if each["to_end"] is not None]
    given = [[*each["alarms"], *([score, 0] for score in each["unjudged"])] for each in samples]
    scores = {GIVEN: _scores(surest(each, kind) for each in given)}
    for number, each in enumerate(REFERENCES):
        known = [sample["references"][number] if sample["references"] else [None, None] for sample in samples]
        scores[each] = _scores(known)
    return Drive(
        name=name,
        story=f"{cluster_of(scenario)}/{agent}",
        group=first["involvement"] or GROUPS[-1],
        kind=kind,
        part=part,
        frame=frame,
        end=ends[0] if kind != "others" and ends else int(frame[-1]) + 1,
        scores=scores,
    )


def _scores(pairs: Iterable[Sequence[float | None]]) -> FloatArray:
    """(S, 2) of pairs of scores, None for no alarm."""
    scores = np.array([[math.nan if each is None else each for each in pair] for pair in pairs], dtype=np.float64)
    return np.nan_to_num(scores.reshape(-1, 2), nan=-np.inf, neginf=-np.inf)


def _trivial(predictor: str, drive: Drive, draw: int) -> FloatArray:
    """(S,) scores of a predictor that knows nothing; random ones are seeded by the recording and the draw."""
    if predictor in ("always", "never"):
        return np.full(len(drive.frame), 1.0 if predictor == "always" else -np.inf)
    source = np.random.default_rng([zlib.crc32(drive.name.encode()), TRIVIAL.index(predictor), draw])
    frames = 1 if predictor == "random per recording" else int(drive.frame[-1]) + 1
    return source.random(frames)[drive.frame % frames]


def by_group(drives: Sequence[Drive]) -> Iterator[tuple[str, list[Drive]]]:
    """Group → its recordings, of the groups that there are."""
    for group in GROUPS:
        chosen = [each for each in drives if each.group == group]
        if chosen:
            yield group, chosen
