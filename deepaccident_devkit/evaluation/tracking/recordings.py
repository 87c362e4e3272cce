"""Recordings as arrays: true and tracked boxes of all samples of one agent, and their matches."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, groupby, pairwise
from operator import itemgetter
from typing import Any, Final, TypeAlias

import numpy as np

from deepaccident_devkit.evaluation.evaluator import Counts
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, IntArray

BoxRows: TypeAlias = Any
"""A `np.recarray`: boxes of one side, sorted by sample, class and id, or pairs of boxes.

The columns of N boxes are `frame` (index of the sample), `class_index`, `id_index` (in the order of
the ids), `x`, `y` (centre in the world, metres) and `score`. The columns of P pairs are `truth` and
`track` (rows of the boxes) and `distance` (between the centres on the ground, metres).
"""
MATCH_SUMS: Final = (
    "true_boxes",
    "tracked_boxes",
    "matches",
    "distance",
    "id_switches",
    "fragments",
    "actors",
    "mostly_tracked",
    "mostly_lost",
)
"""Names of the sums of `match_sums`."""
_PAIR = [("truth", np.int64), ("track", np.int64), ("distance", np.float64)]
_BOX = [(name, np.int64) for name in ("frame", "class_index", "id_index")] + [
    (name, np.float64) for name in ("x", "y", "score")
]
# Sums are rounded to multiples of one over this number, so that sums below 2 million are exact.
_STEPS_PER_UNIT = 2.0**32
_MOSTLY_LOST = 0.2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackedRecording:
    """One agent's recording of a scenario. A group is one sample and class.

    Attributes:
        frame_number: (S,) frame numbers of the samples, ascending.
        class_count: Number C of classes; there are G = S · C groups.
        truth: True boxes.
        tracks: Tracked boxes.
    """

    frame_number: IntArray
    class_count: int
    truth: BoxRows
    tracks: BoxRows

    def key(self, boxes: BoxRows) -> IntArray:
        """Return the index of id and class of each box, shape (N,)."""
        return np.asarray(boxes.id_index * self.class_count + boxes.class_index)

    def group(self, boxes: BoxRows) -> IntArray:
        """Return the index of the group of each box, shape (N,)."""
        return np.asarray(boxes.frame * self.class_count + boxes.class_index)

    def sizes(self, boxes: BoxRows) -> IntArray:
        """Return the number of boxes in each group, (G,)."""
        group_count = len(self.frame_number) * self.class_count
        return np.bincount(self.group(boxes), minlength=group_count)

    def positions(self, counts: BoolArray) -> IntArray:
        """Return the position in time of the group of each true box, (N,).

        Args:
            counts: (G,) whether a group counts; the others have the position of the one before.
        """
        by_class = counts.reshape(-1, self.class_count)
        position = np.cumsum(by_class, axis=0, dtype=np.int64).reshape(-1)
        return np.asarray(position[self.group(self.truth)])

    def near_pairs(self, distance: float) -> BoxRows:
        """Return the pairs of each group that are nearer than a distance, metres."""
        sizes = self.sizes(self.tracks)
        groups = self.group(self.truth)
        # all pairs of a group: each true box is repeated, and its tracks are counted up
        truth = np.repeat(np.arange(len(groups)), sizes[groups])
        first_pairs = np.cumsum(sizes[groups]) - sizes[groups]
        first_tracks = (np.cumsum(sizes) - sizes)[groups]
        track = np.arange(len(truth)) + (first_tracks - first_pairs)[truth]
        x = self.truth.x[truth] - self.tracks.x[track]
        y = self.truth.y[truth] - self.tracks.y[track]
        columns = [truth, track, np.sqrt(x**2 + y**2)]
        pairs: BoxRows = np.rec.fromarrays(columns, dtype=_PAIR)
        return pairs[pairs.distance < distance]


def tracked_recordings(counts: Collection[Counts], class_count: int) -> Iterator[TrackedRecording]:
    """Yield the recordings of the samples that `TrackingEvaluator.update` counted, by name."""
    in_order = sorted(counts, key=itemgetter("recording", "frame"))
    for _, group in groupby(in_order, key=itemgetter("recording")):
        samples = list(group)
        yield TrackedRecording(
            frame_number=np.array([sample["frame"] for sample in samples]),
            class_count=class_count,
            truth=_table([sample["truth"] for sample in samples]),
            tracks=_table([sample["tracks"] for sample in samples]),
        )


def _table(samples: Sequence[Sequence[Sequence[Any]]]) -> BoxRows:
    """Join the boxes of all samples, each a list of [id, class, x, y, score]."""
    rows = list(chain.from_iterable(samples))
    ids = np.array([row[0] for row in rows], dtype=object)
    _, id_index = np.unique(ids, return_inverse=True)
    classes, *columns = np.array([row[1:] for row in rows], dtype=np.float64).reshape(-1, 4).T
    frames = np.repeat(np.arange(len(samples)), list(map(len, samples)))
    return boxes_in_order(np.rec.fromarrays([frames, classes, id_index, *columns], dtype=_BOX))


def boxes_in_order(boxes: BoxRows) -> BoxRows:
    """Sort boxes by sample, class and id."""
    return boxes[np.lexsort((boxes.id_index, boxes.class_index, boxes.frame))]


def matched(
    recording: TrackedRecording,
    pairs: BoxRows,
    scores: FloatArray,
    bonus: float = 0.0,
    position: IntArray | None = None,
) -> BoolArray:
    """Match boxes so that the sum of the scores of each group is highest.

    Args:
        recording: Recording with the boxes.
        pairs: P pairs that may match.
        scores: (P,) positive score of each pair.
        bonus: Further score of a pair whose ids were matched before.
        position: (N,) position of each true box in time; a pair gets the bonus only if it was
            matched at the preceding position. None if the last match of the actor counts.

    Returns:
        Which pairs match, (P,).
    """
    from scipy.optimize import linear_sum_assignment

    groups = recording.group(recording.truth)[pairs.truth]
    actors = recording.key(recording.truth)[pairs.truth].tolist()
    ids = recording.key(recording.tracks)[pairs.track].tolist()
    moments = [0] * len(pairs) if position is None else position[pairs.truth].tolist()
    shapes = np.column_stack([recording.sizes(recording.truth), recording.sizes(recording.tracks)])
    first_rows = np.cumsum(shapes, axis=0) - shapes
    cells = np.column_stack([pairs.truth, pairs.track]) - first_rows[groups]
    is_matched = np.ones(len(pairs), dtype=bool)
    last: dict[int, tuple[int, int]] = {}
    for start, end in pairwise(np.flatnonzero(np.diff(groups, prepend=-1, append=-1)).tolist()):
        some = slice(start, end)
        if len({*actors[some]}) + len({*ids[some]}) < 2 * (end - start):
            gains = scores[some].copy()
            claimed = set()
            for pair in range(start, end):
                before = (ids[pair], moments[pair] - (position is not None))
                if last.get(actors[pair]) == before and before not in claimed:
                    gains[pair - start] += bonus
                    claimed.add(before)
            # all boxes of the group, since the shape of the matrix decides ties
            matrix = np.zeros(shapes[groups[start]])
            rows, columns = cells[some].T
            matrix[rows, columns] = gains
            chosen = set(zip(*linear_sum_assignment(-matrix), strict=True))
            is_matched[some] = [cell in chosen for cell in zip(rows, columns, strict=True)]
        for pair in range(start, end):
            if is_matched[pair]:
                last[actors[pair]] = (ids[pair], moments[pair])
    return is_matched


def is_switch(recording: TrackedRecording, matches: BoxRows) -> BoolArray:
    """Return which matches (M,) give an actor another track than its match before, (M,)."""
    actors = recording.key(recording.truth)[matches.truth]
    order = np.lexsort((matches.truth, actors))
    is_new_track = np.diff(recording.tracks.id_index[matches.track[order]]) != 0
    switches = np.zeros(len(matches), dtype=bool)
    switches[order[1:]] = is_new_track & (np.diff(actors[order]) == 0)
    return switches


def match_sums(
    recording: TrackedRecording, matches: BoxRows, position: IntArray, mostly_tracked: float
) -> FloatArray:
    """Return `MATCH_SUMS` of each class, shape (C, 9).

    Args:
        recording: Recording with the boxes.
        matches: M matches.
        position: (N,) position of each true box in time; a step of more than 1 between two matches
            of an actor is a fragment.
        mostly_tracked: Smallest share of its boxes with which an actor is mostly tracked.
    """
    keys = recording.key(recording.truth)
    actors, actor = np.unique(keys, return_inverse=True)
    shares = np.bincount(actor[matches.truth], minlength=len(actors)) / np.bincount(actor)
    rows = matches.truth[np.lexsort((matches.truth, actor[matches.truth]))]
    is_fragment = (np.diff(position[rows]) > 1) & (np.diff(actor[rows]) == 0)
    actor_class = actors % recording.class_count
    match_class = recording.truth.class_index[matches.truth]
    columns: list[tuple[IntArray, Any]] = [
        (recording.truth.class_index, None),
        (recording.tracks.class_index, None),
        (match_class, None),
        (match_class, matches.distance),
        (match_class, is_switch(recording, matches)),
        (recording.truth.class_index[rows[1:]], is_fragment),
        (actor_class, None),
        (actor_class, shares >= mostly_tracked),
        (actor_class, shares < _MOSTLY_LOST),
    ]
    return np.column_stack(
        [np.bincount(classes, weights, recording.class_count) for classes, weights in columns]
    )


def exact_sum(values: FloatArray) -> FloatArray:
    """Round values to multiples of 2⁻³² (2e-10)."""
    return np.asarray(np.rint(values * _STEPS_PER_UNIT) / _STEPS_PER_UNIT)
