"""The protocol `clean`: HOTA, CLEAR MOT and identity numbers, equal to TrackEval's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.evaluation.tracking.recordings import (
    MATCH_SUMS,
    BoxRows,
    TrackedRecording,
    exact_sum,
    match_sums,
    matched,
)
from deepaccident_devkit.evaluation.tracking.truth import TrackingRules
from deepaccident_devkit.support.arrays import FloatArray, IntArray, as_floats

ALPHAS: Final = np.arange(0.05, 0.99, 0.05)
"""(19,) similarities from which a match counts for HOTA."""
_NUM_ALPHA_SUMS = 5
_TOLERANCE = np.finfo(np.float64).eps
# A pair of the preceding sample is preferred to all other pairs of a sample.
_CONTINUED_BONUS = 1000.0
# An actor is mostly tracked in more than this share of its samples.
_MOSTLY_TRACKED = np.nextafter(0.8, 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class CleanTracking(TrackingRules):
    """Rules of TrackEval with the similarity max(0, 1 − distance between centres / `distance`).

    Scores are not used, and nothing is interpolated.

    Attributes:
        threshold: Smallest similarity of a match for all numbers but HOTA and its parts.
    """

    threshold: float = 0.5

    def words(self) -> str:
        """Describe classes, truth, range and threshold for people."""
        limit = self.distance * (1 - self.threshold)
        hota = f"for HOTA within {self.distance:g} m"
        return f"{TrackingRules.words(self)}; match: within {limit:g} m, {hota}"

    def matches(self, recording: TrackedRecording) -> BoxRows:
        """Return the matches of the CLEAR numbers, preferably those of the preceding sample."""
        pairs = recording.near_pairs(self.distance)
        similarity = 1 - pairs.distance / self.distance
        is_near = similarity >= self.threshold - _TOLERANCE
        near = pairs[is_near]
        position = _paired_positions(recording)
        return near[matched(recording, near, similarity[is_near], _CONTINUED_BONUS, position)]

    def summed(self, recording: TrackedRecording) -> FloatArray:
        """Return the sums of each class, from which all numbers follow, (C, S)."""
        pairs = recording.near_pairs(self.distance)
        similarity = 1 - pairs.distance / self.distance
        position = _paired_positions(recording)
        sums = [
            match_sums(recording, self.matches(recording), position, _MOSTLY_TRACKED),
            _identity_sums(recording, pairs[similarity >= self.threshold]),
            _hota_sums(recording, pairs, similarity),
        ]
        return exact_sum(np.hstack(sums))

    def numbers(
        self, summaries: Sequence[FloatArray]
    ) -> tuple[dict[str, dict[str, float]], dict[str, float]]:
        """Compute the numbers of each class, and of all boxes, from the sums of recordings."""
        size = len(MATCH_SUMS) + 1 + _NUM_ALPHA_SUMS * len(ALPHAS)
        sums = sum(summaries, np.zeros((len(self.classes), size)))
        classes = {}
        for (name, _), class_sums in zip(self.classes, sums, strict=True):
            classes[name] = self._numbers(class_sums)
        return classes, self._numbers(sums.sum(axis=0))

    def _numbers(self, sums: FloatArray) -> dict[str, float]:
        """Compute the numbers of a class from its sums (S,); NaN without true and tracked boxes.

        As in TrackEval, shares of nothing are 0, and the nearness of no match is 1.
        """
        counts = dict(zip((*MATCH_SUMS, "idtp"), sums.tolist(), strict=False))
        truths = counts["true_boxes"]
        tracked = counts["tracked_boxes"]
        tp = counts.pop("matches")
        idtp = counts["idtp"]
        nearness = tp - counts.pop("distance") / self.distance
        tps, similarity, ass_a, ass_re, ass_pr = sums[len(counts) + 2 :].reshape(-1, len(ALPHAS))
        matches = np.maximum(tps, 1)
        det_a = tps / np.maximum(truths + tracked - tps, 1)
        curves = {
            "hota": np.sqrt(det_a * ass_a / matches),
            "det_a": det_a,
            "ass_a": ass_a / matches,
            "loc_a": np.where(tps > 0, similarity / matches, 1.0),
            "det_re": tps / max(truths, 1),
            "det_pr": tps / max(tracked, 1),
            "ass_re": ass_re / matches,
            "ass_pr": ass_pr / matches,
        }
        numbers = {name: float(curve.mean()) for name, curve in curves.items()} | {
            "mota": (2 * tp - tracked - counts["id_switches"]) / max(truths, 1),
            "moda": (2 * tp - tracked) / max(truths, 1),
            "motp_similarity": nearness / max(tp, 1),
            "idf1": 2 * idtp / max(truths + tracked, 1),
            "id_recall": idtp / max(truths, 1),
            "id_precision": idtp / max(tracked, 1),
        }
        if not truths + tracked:
            numbers = dict.fromkeys(numbers, np.nan)
        counts |= {"tp": tp, "fn": truths - tp, "fp": tracked - tp}
        counts |= {"idfn": truths - idtp, "idfp": tracked - idtp}
        counts["partly_tracked"] = (
            counts["actors"] - counts["mostly_tracked"] - counts["mostly_lost"]
        )
        return numbers | {name: int(value) for name, value in counts.items()}


def _paired_positions(recording: TrackedRecording) -> IntArray:
    """Return the position of each true box among the samples with truth and tracks of its class.

    As in TrackEval, samples without one of the two end no pair.
    """
    sizes = [recording.sizes(boxes) for boxes in (recording.truth, recording.tracks)]
    return recording.positions(np.minimum(*sizes) > 0)


def _identity_sums(recording: TrackedRecording, pairs: BoxRows) -> FloatArray:
    """Return the IDTP of each class, (C, 1): the most matches with one track for each actor."""
    from scipy.optimize import linear_sum_assignment

    truth_keys = recording.key(recording.truth)[pairs.truth]
    track_keys = recording.key(recording.tracks)[pairs.track]
    actors, rows = np.unique(truth_keys, return_inverse=True)
    tracks, columns = np.unique(track_keys, return_inverse=True)
    pair_counts = np.zeros((len(actors), len(tracks)))
    np.add.at(pair_counts, (rows, columns), 1)
    best = linear_sum_assignment(-pair_counts)
    classes = actors[best[0]] % recording.class_count
    matches = np.bincount(classes, pair_counts[best], recording.class_count)
    return as_floats(matches[:, None])


def _hota_sums(recording: TrackedRecording, pairs: BoxRows, similarity: FloatArray) -> FloatArray:
    """Return five sums for each α and class, (C, 95).

    The sums are the number of matches, their similarity, and the association, its recall and its
    precision.
    """
    truth_keys = recording.key(recording.truth)
    track_keys = recording.key(recording.tracks)
    num_keys = track_keys.max(initial=0) + 1
    pair_keys = truth_keys[pairs.truth] * num_keys + track_keys[pairs.track]
    keys, index = np.unique(pair_keys, return_inverse=True)
    truth_counts = np.bincount(truth_keys)[keys // num_keys]
    track_counts = np.bincount(track_keys)[keys % num_keys]
    truth_sums = np.bincount(pairs.truth, similarity)[pairs.truth]
    track_sums = np.bincount(pairs.track, similarity)[pairs.track]
    overlap = similarity / (truth_sums + track_sums - similarity)
    potential = np.bincount(index, overlap, len(keys))
    alignment = potential / (truth_counts + track_counts - potential)
    is_matched = matched(recording, pairs, alignment[index] * similarity)
    sums = []
    for alpha in ALPHAS:
        rows = is_matched & (similarity >= alpha - _TOLERANCE)
        counts = np.bincount(index[rows], minlength=len(keys))
        terms = [
            counts,
            np.bincount(index[rows], similarity[rows], len(keys)),
            counts**2 / np.maximum(truth_counts + track_counts - counts, 1),
            counts**2 / truth_counts,
            counts**2 / track_counts,
        ]
        classes = keys // num_keys % recording.class_count
        sums.append([np.bincount(classes, term, recording.class_count) for term in terms])
    return np.array(sums).T.reshape(recording.class_count, -1)
