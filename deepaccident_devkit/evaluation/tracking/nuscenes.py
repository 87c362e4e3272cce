"""The protocol `nuscenes`: AMOTA, AMOTP and further numbers, equal to the nuScenes devkit's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from operator import itemgetter
from typing import Final, Literal, get_args

import numpy as np

from deepaccident_devkit.evaluation.evaluator import ratio
from deepaccident_devkit.evaluation.tracking.recordings import (
    MATCH_SUMS,
    Recording,
    Table,
    exact_sum,
    in_order,
    is_switch,
    match_sums,
    matched,
)
from deepaccident_devkit.evaluation.tracking.truth import Shape, TrackingRules, TruthSource
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, check_minima
from deepaccident_devkit.support.text import settle_choices
from deepaccident_devkit.taxonomy import CATEGORIES

Interpolation = Literal["mirrored", "straight", "none"]
_SUMS: Final = (*MATCH_SUMS, "frames", "tid", "lgd", "tracked")
_CLASSES = (
    ("car", ("car", "van")),
    ("truck", ("truck",)),
    ("bicycle", ("cyclist",)),
    *((name, (name,)) for name in CATEGORIES[4:]),
)
_MOSTLY_TRACKED = 0.8
# Seconds between samples, as in nuScenes.
_SAMPLE_PERIOD = 0.5
# Larger than any sum of distances in a sample: as many pairs as possible match.
_PAIR_SCORE = 1e3
_CONTINUED_BONUS = 1e6
_COUNTS = ("true_boxes", "id_switches", "fragments", "mostly_tracked", "mostly_lost")
# What the nuScenes devkit reports for a class whose tracks have no match.
_WORST = {"faf": 500.0, "tid": 20.0, "lgd": 20.0} | dict.fromkeys(
    ("fp", "id_switches", "fragments"), np.nan
)


@dataclass(frozen=True, slots=True, kw_only=True)
class NuScenesTracking(TrackingRules):
    """Rules of nuScenes' tracking challenge.

    A track has the mean score of its boxes. Thresholds of the score are chosen at levels of recall.

    Attributes:
        interpolation: How gaps of true and tracked boxes are filled. `mirrored`: as in the nuScenes
            devkit, whose weights are swapped, so that a box in a longer gap moves backwards;
            `straight`: at constant velocity; `none`: not at all.
        recalls: Number of levels of recall, up to 1.
        min_recall: Lowest level of recall.
    """

    truth: TruthSource = "label"
    classes: tuple[tuple[str, tuple[str, ...]], ...] = _CLASSES
    class_of_instance: bool = True
    frame: Literal["lidar", "ego"] = "ego"
    shape: Shape = "circle"
    ranges: tuple[float, ...] = (50.0, 50.0, 40.0, 40.0, 40.0)
    interpolation: Interpolation = "mirrored"
    recalls: int = 40
    min_recall: float = 0.1

    def __post_init__(self) -> None:
        """Check the fields; raise ChoiceError or ConfigError if one is invalid."""
        TrackingRules.__post_init__(self)
        settle_choices(self, {"interpolation": get_args(Interpolation)})
        check_minima(self, recalls=1, min_recall=0)

    def words(self) -> str:
        """Describe classes, truth, range, threshold and interpolation for people."""
        gaps = f"gaps: {self.interpolation} interpolation"
        return f"{TrackingRules.words(self)}; match: below {self.distance:g} m; {gaps}"

    def matches(self, recording: Recording) -> Table:
        """Return the matches of all tracks; a match continues while the two are near."""
        pairs = recording.near_pairs(self.distance)
        scores = _PAIR_SCORE - pairs.distance
        return pairs[matched(recording, pairs, scores, _CONTINUED_BONUS)]

    def summed(self, recording: Recording) -> ScoredTracks:
        """Return the recording without gaps, from which all numbers follow."""
        truth = _filled(recording.truth, recording, self.interpolation)
        tracks = _filled(recording.tracks, recording, self.interpolation)
        return ScoredTracks(replace(recording, truth=truth, tracks=tracks), self)

    def numbers(
        self, summaries: Sequence[ScoredTracks]
    ) -> tuple[dict[str, dict[str, float]], dict[str, float]]:
        """Compute the numbers of each class from the tracks of recordings."""
        classes = {}
        for index, (name, _) in enumerate(self.classes):
            classes[name] = self._numbers(summaries, index)
        return classes, {}

    def _numbers(self, summaries: Sequence[ScoredTracks], index: int) -> dict[str, float]:
        """Compute the numbers of a class; most are those at the score with the best MOTA."""

        def numbers_at(threshold: float) -> dict[str, float]:
            sums = np.zeros(len(_SUMS))
            for tracks in summaries:
                sums += tracks.sums(index, threshold)
            return _numbers_of(dict(zip(_SUMS, sums.tolist(), strict=True)))

        best = numbers_at(np.inf) | _WORST | {"motp": float(self.distance)}
        truths = int(best["true_boxes"])
        scores = np.concatenate([[], *(tracks.match_scores(index) for tracks in summaries)])
        levels = [numbers_at(threshold) for threshold in self._thresholds(scores, truths)]
        if levels:
            best = max(levels, key=itemgetter("mota"))  # the first one, with the highest recall
        unreached = self.recalls - len(levels)
        motp = sum(numbers["motp"] for numbers in levels) + unreached * self.distance
        amota = sum(numbers["motar"] for numbers in levels) / self.recalls
        best |= {"amota": amota, "amotp": motp / self.recalls}
        if not truths:
            best = dict.fromkeys(best, np.nan) | {"true_boxes": 0}
        return best

    def _thresholds(self, scores: FloatArray, truths: int) -> list[float]:
        """Return the ascending scores at which matches with scores (M,) reach levels of recall."""
        if not len(scores):
            return []
        recalls = np.arange(1, len(scores) + 1) / truths
        levels = np.linspace(self.min_recall, 1, self.recalls).round(12)
        thresholds = np.interp(levels, recalls, np.sort(scores)[::-1])
        reached: list[float] = thresholds[levels <= recalls[-1]][::-1].tolist()
        return reached


@dataclass(frozen=True, slots=True, eq=False)
class ScoredTracks:
    """A recording without gaps; sums at a score are computed once.

    Attributes:
        recording: Recording whose tracked boxes have the score of their track.
        rules: Rules of the matches.
        known: Class and number of its boxes with at least a score → sums.
    """

    recording: Recording
    rules: NuScenesTracking
    known: dict[tuple[int, int], FloatArray] = field(default_factory=dict)

    def match_scores(self, class_index: int) -> FloatArray:
        """Return the scores of a class's matches without a change of identity, if all count."""
        tracks = self.recording.tracks
        recording = replace(self.recording, tracks=tracks[tracks.class_index == class_index])
        matches = self.rules.matches(recording)
        is_same = ~is_switch(recording, matches)
        return np.asarray(recording.tracks.score[matches.track[is_same]])

    def sums(self, class_index: int, threshold: float) -> FloatArray:
        """Return `_SUMS` of a class's tracks with at least this score, shape (13,)."""
        tracks = self.recording.tracks
        counts = (tracks.score >= threshold) & (tracks.class_index == class_index)
        key = (class_index, int(counts.sum()))
        if key not in self.known:
            self.known[key] = exact_sum(self._compute_sums(class_index, counts))
        return self.known[key]

    def _compute_sums(self, class_index: int, counts: BoolArray) -> FloatArray:
        """Compute `_SUMS` of the tracked boxes of a class that count, a mask (N,)."""
        recording = replace(self.recording, tracks=self.recording.tracks[counts])
        matches = self.rules.matches(recording)
        has_box = recording.sizes(recording.truth) + recording.sizes(recording.tracks) > 0
        frames = recording.positions(has_box)  # samples without any box do not count
        keys = recording.key(recording.truth)
        order = np.zeros(len(keys), dtype=np.int64)
        delays = []
        gaps = []
        for actor in np.unique(keys[recording.truth.class_index == class_index]):
            rows = np.flatnonzero(keys == actor)
            order[rows] = np.arange(len(rows))
            matched_rows = rows[np.isin(rows, matches.truth)]
            if len(matched_rows):
                ends = frames[rows[0]] - 1, frames[rows[-1]] + 1
                unmatched = np.diff([ends[0], *frames[matched_rows], ends[1]]) - 1
                delays.append(unmatched[0])
                gaps.append(unmatched.max())
        sums = match_sums(recording, matches, order, _MOSTLY_TRACKED)[class_index]
        frame_count = has_box.reshape(-1, recording.class_count)[:, class_index].sum()
        times = [_SAMPLE_PERIOD * sum(delays), _SAMPLE_PERIOD * sum(gaps)]
        return np.array([*sums, frame_count, *times, len(delays)])


def _numbers_of(sums: dict[str, float]) -> dict[str, float]:
    """Compute the numbers at one level of recall from `_SUMS`."""
    truths = sums["true_boxes"]
    matches = sums["matches"]
    fp = sums["tracked_boxes"] - matches
    counts = {
        "tp": matches - sums["id_switches"],
        "fp": fp,
        "fn": truths - matches,
        **{name: sums[name] for name in _COUNTS},
    }
    return {
        "recall": ratio(matches, truths),
        "motar": max(0.0, 1 - ratio(fp, counts["tp"])),
        "mota": max(0.0, ratio(counts["tp"] - fp, truths)),
        "motp": ratio(sums["distance"], matches),
        "faf": 100 * ratio(fp, sums["frames"]),
        "tid": ratio(sums["tid"], sums["tracked"]),
        "lgd": ratio(sums["lgd"], sums["tracked"]),
        **{name: int(value) for name, value in counts.items()},
    }


def _filled(boxes: Table, recording: Recording, interpolation: Interpolation) -> Table:
    """Give each box the mean score of its track, and fill the gaps of tracks.

    A box in a gap has the class of the next box.
    """
    parts = [boxes[:0]]
    for track in range(boxes.id_index.max(initial=-1) + 1):
        known = boxes[boxes.id_index == track]
        frames = known.frame
        filled = frames if interpolation == "none" else np.arange(frames[0], frames[-1] + 1)
        right = np.searchsorted(frames, filled)
        is_gap = frames[right] != filled
        left = right - is_gap
        start, now, end = recording.frame_number[[frames[left], filled, frames[right]]]
        part = end - now if interpolation == "mirrored" else now - start
        weight = np.where(is_gap, part / np.maximum(end - start, 1), 1.0)
        known.score = np.mean(known.score)
        result = known[right]
        result.frame = filled
        for name in ("x", "y", "score"):
            values = known[name]
            result[name] = (1 - weight) * values[left] + weight * values[right]
        parts.append(result)
    return in_order(np.concatenate(parts).view(np.recarray))
