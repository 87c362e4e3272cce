"""The protocol `nuscenes`: AMOTA, AMOTP and further numbers, equal to the nuScenes devkit's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import Final, Literal, get_args

import numpy as np

from deepaccident_devkit.evaluation.evaluator import ratio
from deepaccident_devkit.evaluation.tracking.recordings import (
    MATCH_SUMS,
    BoxRows,
    TrackedRecording,
    boxes_in_order,
    exact_sum,
    is_switch,
    match_sums,
    matched,
)
from deepaccident_devkit.evaluation.tracking.truth import Shape, TrackedActors, TrackingRules
from deepaccident_devkit.support.arrays import FloatArray, check_minima
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

    truth: TrackedActors = "label"
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

    def matches(self, recording: TrackedRecording) -> BoxRows:
        """Return the matches of all tracks; a match continues while the two are near."""
        pairs = recording.near_pairs(self.distance)
        scores = _PAIR_SCORE - pairs.distance
        return pairs[matched(recording, pairs, scores, _CONTINUED_BONUS)]

    def summed(self, recording: TrackedRecording) -> tuple[ScoredTracks, ...]:
        """Return the tracks of each class, without gaps, from which all numbers follow."""
        truth = _filled(recording.truth, recording, self.interpolation)
        tracks = _filled(recording.tracks, recording, self.interpolation)
        filled = replace(recording, truth=truth, tracks=tracks)
        return tuple(ScoredTracks(filled, index, self) for index in range(len(self.classes)))

    def numbers(
        self, summaries: Sequence[Sequence[ScoredTracks]]
    ) -> tuple[dict[str, dict[str, float]], dict[str, float]]:
        """Compute the numbers of each class from the tracks of recordings."""
        classes = {}
        for index, (name, _) in enumerate(self.classes):
            classes[name] = self._numbers([tracks[index] for tracks in summaries])
        return classes, {}

    def _numbers(self, recordings: Sequence[ScoredTracks]) -> dict[str, float]:
        """Compute the numbers of a class; most are those at the score with the best MOTA."""
        truths = sum(tracks.true_boxes for tracks in recordings)
        scores = np.concatenate([[], *(tracks.match_scores for tracks in recordings)])
        thresholds = np.append(self._thresholds(scores, truths), np.inf)
        sums = np.zeros((len(thresholds), len(_SUMS)))
        for tracks in recordings:
            sums += tracks.sums(thresholds)
        rows = [dict(zip(_SUMS, row, strict=True)) for row in sums.tolist()]
        *levels, nothing = map(_numbers_of, rows)
        best = nothing
        if levels:
            best = max(levels, key=itemgetter("mota"))  # the first one, with the highest recall
        elif truths:
            best = nothing | _WORST | {"motp": float(self.distance)}
        unreached = self.recalls - len(levels)
        motp = sum(numbers["motp"] for numbers in levels) + unreached * self.distance
        amota = sum(numbers["motar"] for numbers in levels) / self.recalls
        best |= {"amota": amota, "amotp": motp / self.recalls}
        if not truths:
            best |= {name: np.nan for name, value in best.items() if not isinstance(value, int)}
        return best

    def _thresholds(self, scores: FloatArray, truths: int) -> FloatArray:
        """Return the ascending scores at which matches with scores (M,) reach levels of recall."""
        if not len(scores):
            return scores
        recalls = np.arange(1, len(scores) + 1) / truths
        levels = np.linspace(self.min_recall, 1, self.recalls).round(12)
        thresholds = np.interp(levels, recalls, np.sort(scores)[::-1])
        return np.asarray(thresholds[levels <= recalls[-1]][::-1])


class ScoredTracks:
    """The tracks of one class in a recording without gaps; sums at a score are computed once.

    Attributes:
        true_boxes: Number of true boxes of the class.
        match_scores: (M,) scores of the matches without a change of identity, if all tracks count.
    """

    def __init__(
        self, recording: TrackedRecording, class_index: int, rules: NuScenesTracking
    ) -> None:
        """Select the class, and match all of its tracks."""
        tracks = recording.tracks[recording.tracks.class_index == class_index]
        truth = recording.truth[recording.truth.class_index == class_index]
        self._recording = replace(recording, truth=truth, tracks=tracks)
        self._class_index = class_index
        self._rules = rules
        self._scores = np.sort(tracks.score)
        self._sums = np.full((len(tracks) + 1, len(_SUMS)), np.nan)
        matches = rules.matches(self._recording)
        self.true_boxes = len(truth)
        self.match_scores = tracks.score[matches.track[~is_switch(self._recording, matches)]]

    def sums(self, thresholds: FloatArray) -> FloatArray:
        """Return `_SUMS` of the tracks with at least each score (R,), shape (R, 13)."""
        counts = len(self._scores) - np.searchsorted(self._scores, thresholds)
        for count in np.unique(counts[np.isnan(self._sums[counts, 0])]).tolist():
            lowest = np.append(self._scores, np.inf)[-1 - count]
            self._sums[count] = exact_sum(self._compute_sums(lowest))
        return np.asarray(self._sums[counts])

    def _compute_sums(self, threshold: float) -> FloatArray:
        """Compute `_SUMS` of the tracks with at least a score."""
        tracks = self._recording.tracks
        recording = replace(self._recording, tracks=tracks[tracks.score >= threshold])
        matches = self._rules.matches(recording)
        has_box = recording.sizes(recording.truth) + recording.sizes(recording.tracks) > 0
        frames = recording.positions(has_box)  # samples without any box do not count
        actors = recording.truth.id_index
        order = np.zeros(len(actors), dtype=np.int64)
        delays = []
        gaps = []
        for actor in np.unique(actors):
            rows = np.flatnonzero(actors == actor)
            order[rows] = np.arange(len(rows))
            matched_rows = rows[np.isin(rows, matches.truth)]
            if len(matched_rows):
                ends = frames[rows[0]] - 1, frames[rows[-1]] + 1
                unmatched = np.diff([ends[0], *frames[matched_rows], ends[1]]) - 1
                delays.append(unmatched[0])
                gaps.append(unmatched.max())
        sums = match_sums(recording, matches, order, _MOSTLY_TRACKED)[self._class_index]
        times = [_SAMPLE_PERIOD * sum(delays), _SAMPLE_PERIOD * sum(gaps)]
        return np.array([*sums, has_box.sum(), *times, len(delays)])


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


def _filled(boxes: BoxRows, recording: TrackedRecording, interpolation: Interpolation) -> BoxRows:
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
    return boxes_in_order(np.concatenate(parts).view(np.recarray))
