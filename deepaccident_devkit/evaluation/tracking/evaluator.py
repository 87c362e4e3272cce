"""`TrackingEvaluator`: how well the tracks of a recording follow its actors."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, ClassVar, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import EvaluationError, GeometryError
from deepaccident_devkit.evaluation.drawing import Drawing, Role, drawn_paths
from deepaccident_devkit.evaluation.evaluator import Counts, Evaluator
from deepaccident_devkit.evaluation.predicted_boxes import Tracks, drawn_matches
from deepaccident_devkit.evaluation.task import switched
from deepaccident_devkit.evaluation.tracking.clean import CleanTracking
from deepaccident_devkit.evaluation.tracking.nuscenes import NuScenesTracking
from deepaccident_devkit.evaluation.tracking.recordings import tracked_recordings
from deepaccident_devkit.evaluation.tracking.result import TrackingResult, mean_of_classes
from deepaccident_devkit.evaluation.tracking.truth import TrackingTruth, tracking_truth
from deepaccident_devkit.evaluation.truth import recorded_past
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.support.arrays import AnyArray
from deepaccident_devkit.taxonomy import FRAME_PERIOD

_Protocol = CleanTracking | NuScenesTracking
TRACKING_PROTOCOLS: Final[Mapping[str, _Protocol]] = MappingProxyType(
    {"clean": CleanTracking(), "nuscenes": NuScenesTracking()}
)
"""`clean` equals TrackEval, `nuscenes` the nuScenes devkit."""
# Key of counts that hold the summaries of whole recordings.
_SUMMARIES = "summaries"
# Recorded frames before a sample in which pictures show its tracks.
_PAST_FRAMES = 20


class TrackingEvaluator(Evaluator[TrackingResult]):
    """Evaluator of tracks; it counts boxes by sample, and computes numbers by recording.

    Pass all samples of a recording: a missing one looks like a gap in all tracks.

    >>> TrackingEvaluator().compute().samples
    0
    """

    task = "tracking"
    description = "Evaluate tracks: HOTA, MOTA, IDF1, identity switches, AMOTA."
    result_kinds: ClassVar[tuple[str, ...]] = ("tracking",)
    protocols = TRACKING_PROTOCOLS
    result_class = TrackingResult
    main_numbers: ClassVar[tuple[str, ...]] = ("class_mean/hota", "class_mean/amota")
    needs_whole_recordings = True
    needs_complete_recordings = True
    has_horizon = False

    protocol: _Protocol

    def __init__(self, protocol: str | _Protocol = "clean", **switches: Any) -> None:
        """Create an evaluator without samples.

        Args:
            protocol: `clean`, `nuscenes`, or your own rules.
            **switches: Fields of the protocol to change, such as `truth="own"`.

        Raises:
            ChoiceError: If the protocol, a switch or a choice does not exist.
            ConfigError: If a number is invalid.
        """
        super().__init__(protocol)
        self.protocol = switched(self.protocol, switches)

    def truth(self, dataset: Dataset, token: str, /, *_unused: Any) -> tuple[TrackingTruth]:
        """Return the true boxes."""
        return (tracking_truth(dataset, token, self.protocol),)

    def read(self, results: Any, dataset: Dataset, token: str) -> Tracks:  # noqa: ARG002
        """Read a sample's tracks, and where they were in the last two seconds."""
        tracks: Tracks = results.prediction(token)
        recording, _, number = token.rpartition("/")
        row_by_id = {name: row for row, name in enumerate(tracks.ids)}
        times = []
        past = []
        for step in range(-_PAST_FRAMES, 0):
            earlier = f"{recording}/{int(number) + step:03d}"
            if earlier in results:
                before = results.prediction(earlier)
                centers = np.full((len(tracks) + 1, 3), np.nan)  # the last row: other tracks
                centers[[row_by_id.get(name, -1) for name in before.ids]] = before.boxes.center
                times.append(step * FRAME_PERIOD)
                past.append(centers[:-1])
        if not past:
            return tracks
        return replace(tracks, past_times=np.array(times), past=np.stack(past, axis=1))

    def update(self, token: str, prediction: Tracks, truth: TrackingTruth) -> None:
        """Count one sample.

        Args:
            token: Token of the sample: recording, slash, number of the frame.
            prediction: Tracks in the world; may be empty.
            truth: True boxes from `tracking_truth`. The range and the classes are applied here.

        Raises:
            EvaluationError: If an argument has the wrong type, or the sample was counted before
                with other counts.
            GeometryError: If the tracks are in another frame.
        """
        self.add(token, self._count_sample(token, prediction, truth))

    def _count_sample(self, token: str, prediction: Tracks, truth: TrackingTruth) -> Counts:
        """Count one sample; the arguments and errors are as in `update`."""
        recording, _, frame = str(token).rpartition("/")
        if not recording or not frame.isdecimal():
            raise EvaluationError(
                f"token: expected a recording, a slash and a frame number, found {token!r}"
            )
        if not isinstance(prediction, Tracks):
            raise EvaluationError(
                f"{token}: expected Tracks, found {type(prediction).__name__}; make them with "
                "Tracks.from_arrays(center, size, yaw, scores, ids=ids, frame='world')"
            )
        tracks = prediction.boxes
        if tracks.frame != "world" or truth.boxes.frame != "world":
            raise GeometryError(
                f"{token}: tracks in frame {tracks.frame!r}, truth in {truth.boxes.frame!r}; "
                "transform both to 'world'"
            )
        is_true = self.protocol.counts(truth.boxes, truth)
        is_tracked = self.protocol.counts(tracks, truth)
        return {
            "recording": recording,
            "frame": int(frame),
            "truth": self._rows(truth.boxes.select(is_true), truth.boxes.actor_id[is_true]),
            "tracks": self._rows(
                tracks.select(is_tracked), prediction.ids[is_tracked], prediction.scores[is_tracked]
            ),
        }

    def _rows(self, boxes: Boxes, ids: AnyArray, scores: AnyArray | None = None) -> list[list[Any]]:
        """Return [id, class, x, y, score] of each box; a true box has the score 0."""
        if scores is None:
            scores = np.zeros(len(boxes))
        columns = [ids, self.protocol.class_index(boxes.category), *boxes.center[:, :2].T, scores]
        return list(map(list, zip(*(column.tolist() for column in columns), strict=True)))

    def drawing(self, dataset: Dataset, token: str, prediction: Any, /, *truth: Any) -> Drawing:
        """Describe matched, false and missed boxes, and the paths of tracks and actors.

        The prediction may be in any frame of the sample.
        """
        (true,) = truth
        world_from_prediction = dataset.world_from(token, prediction.boxes.frame)
        tracks = prediction.transform(world_from_prediction, "world")
        counts = self._count_sample(token, tracks, true)
        (recording,) = tracked_recordings([counts], len(self.protocol.classes))
        matches = self.protocol.matches(recording)
        true_rows = np.flatnonzero(self.protocol.counts(true.boxes, true))
        track_rows = np.flatnonzero(self.protocol.counts(tracks.boxes, true))
        # the index of an id is its position among the ids that count
        found_ids = recording.truth.id_index[matches.truth]
        found = true_rows[np.argsort(true.boxes.actor_id[true_rows])][found_ids]
        right_ids = recording.tracks.id_index[matches.track]
        right = track_rows[np.argsort(tracks.ids[track_rows])][right_ids]
        outcomes: dict[Role, AnyArray] = {"right": right, "false": np.setdiff1d(track_rows, right)}
        missed = np.setdiff1d(true_rows, found)
        true_outcomes: dict[Role, AnyArray] = {"truth": found, "missed": missed}
        drawn = drawn_matches(tracks, true.boxes, true_outcomes, outcomes, "tracked")
        past = recorded_past(dataset, token, true.boxes.actor_id)
        past_times = np.arange(1 - past.shape[1], 1) * FRAME_PERIOD
        paths = drawn_paths(past, past_times, "past", "last second")
        ego_from_world = dataset.world_from(token, "ego").inverse()
        times = np.append(tracks.past_times, 0.0)
        for role, rows in outcomes.items():
            centers = np.concatenate([tracks.past[rows], tracks.boxes.center[rows, None]], axis=1)
            xyz = ego_from_world.apply(centers.reshape(-1, 3)).reshape(centers.shape)
            paths += drawn_paths(xyz[..., :2], times, role, "")
        return replace(drawn, paths=tuple(paths))

    def result_of(self, counts: Collection[Counts]) -> TrackingResult:
        """Compute the metrics from the counts of samples, in any order; they can be `pooled`."""
        parts = [part for part in counts if _SUMMARIES in part]
        parts += self.pooled([sample for sample in counts if _SUMMARIES not in sample])
        summaries = [summary for part in parts for summary in part[_SUMMARIES]]
        classes, pooled = self.protocol.numbers(summaries)
        return TrackingResult(
            class_mean=mean_of_classes(classes),
            pooled=pooled,
            classes=classes,
            samples=sum(part["samples"] for part in parts),
            recordings=len(summaries),
            notes=(self.protocol.words(),),
        )

    def pooled(self, counts: Collection[Counts]) -> Sequence[Counts]:
        """Summarize whole recordings; the list has a single entry."""
        recordings = tracked_recordings(counts, len(self.protocol.classes))
        summaries = [self.protocol.summed(recording) for recording in recordings]
        return [{_SUMMARIES: summaries, "samples": len(counts)}]
