"""Recordings of true and tracked boxes as rows, for tracking evaluators."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from deepaccident_devkit.evaluation.tracking import (
    TrackingEvaluator,
    TrackingResult,
    TrackingTruth,
    Tracks,
)
from deepaccident_devkit.geometry import Boxes

Row = Sequence[Any]
EVERYWHERE = (1e6,)


def track_samples(
    recordings: Mapping[str, Mapping[str, Any]],
) -> Iterator[tuple[str, Tracks, TrackingTruth]]:
    """Yield token, tracks and truth of each sample.

    Args:
        recordings: Name → `frames` (numbers), `truth` rows [frame, id, class, x, y, z] and `tracks`
            rows [frame, id, class, x, y, z, score], metres in the world.
    """
    for name, recording in recordings.items():
        for frame in recording["frames"]:
            truth = [row for row in recording["truth"] if row[0] == frame]
            tracks = [row for row in recording["tracks"] if row[0] == frame]
            boxes = make_boxes(truth, actor_id=[row[1] for row in truth])
            ids = np.array([str(row[1]) for row in tracks], dtype=object)
            scores = np.array([row[6] for row in tracks], dtype=np.float64)
            yield (
                f"{name}/{frame:03d}",
                Tracks(boxes=make_boxes(tracks), scores=scores, ids=ids),
                TrackingTruth(boxes=boxes),
            )


def make_boxes(rows: Sequence[Row], **columns: Sequence[Any]) -> Boxes:
    """Make boxes of one cubic metre in the world from rows [frame, id, class, x, y, z, …]."""
    return Boxes.from_arrays(
        np.array([row[3:6] for row in rows], dtype=np.float64).reshape(-1, 3),
        np.ones((len(rows), 3)),
        np.zeros(len(rows)),
        category=[row[2] for row in rows] or None,
        **{name: np.array(values, dtype=np.int64) for name, values in columns.items()},
    )


def evaluate_rows(
    recordings: Mapping[str, Mapping[str, Any]], protocol: str = "clean", **switches: Any
) -> TrackingResult:
    """Evaluate rows under a protocol, without a limit of range."""
    evaluator = TrackingEvaluator(protocol, ranges=EVERYWHERE, **switches)
    for sample in track_samples(recordings):
        evaluator.update(*sample)
    return evaluator.compute()
