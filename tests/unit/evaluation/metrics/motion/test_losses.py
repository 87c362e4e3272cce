from dataclasses import replace

import numpy as np
import pytest
from accident_scenes import scene, standing

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.evaluation.metrics.alarms.reading import AccidentReading, accident_of
from deepaccident_devkit.evaluation.metrics.motion.overlaps import LostInstance, lost_instances, vpq_counts
from deepaccident_devkit.motion import MotionHeads, MotionLabels, predict_instances


def row(*ids: int) -> np.ndarray:
    return np.array(ids)[None]


def test_each_reason() -> None:
    """Ids that were found for the first time only are not renamed."""
    label = np.stack([row(1, 1, 1, 2, 0, 3, 3, 4, 4), row(1, 1, 1, 2, 0, 3, 3, 4, 4)])
    found = np.stack([row(5, 5, 5, 5, 0, 0, 0, 7, 7), row(6, 6, 6, 2, 0, 8, 8, 7, 7)])
    assert lost_instances(label, found) == [
        LostInstance(frame=0, identity=2, reason="merged", other=1),
        LostInstance(frame=0, identity=3, reason="missing"),
        LostInstance(frame=1, identity=1, reason="renamed"),
    ]
    assert lost_instances(label, label) == []
    assert lost_instances(row(1, 1, 0, 0)[None], row(5, 5, 5, 5)[None]) == [
        LostInstance(frame=0, identity=1, reason="cut")
    ]
    with pytest.raises(GeometryError, match="found"):
        lost_instances(label, found[:1])


def test_who_comes_back_has_a_new_id() -> None:
    """Linking looks one frame back; the labels know better."""
    label = scene({1: standing(20, 10), 2: [(30, 10), None, (30, 10), (30, 10), (30, 10)]})
    linked = predict_instances(MotionHeads.from_labels(label))
    assert lost_instances(label.instance, linked.instance) == [LostInstance(frame=2, identity=2, reason="renamed")]


@pytest.mark.slow
def test_each_lost_match_of_perfect_heads_is_explained(da_motion: DeepAccident) -> None:
    """What VPQ misses is in the list, and where nothing is lost the accident is the same but for the ids."""
    explained = 0
    for token in da_motion.samples("train", "evaluate"):
        whole = da_motion.motion_labels(token)
        frames = int(whole.label_valid.sum())
        for label in (whole.to_present("bilinear"), without_one_for_a_moment(whole.to_present("bilinear"))):
            linked = predict_instances(MotionHeads.from_labels(label))
            truth, found = label.instance[:frames], linked.instance[:frames]
            lost = lost_instances(truth, found)
            assert len(lost) == vpq_counts(found, truth).false_negative[:, 1].sum()
            explained += len(lost)
            by_maps, by_heads = (
                accident_of(each, label.config.grid, label.config.rules, AccidentReading()).contact
                for each in (truth, found)
            )
            if not lost:
                assert (by_maps is None) == (by_heads is None)
                assert by_maps is None or (by_maps.frame, by_maps.distance) == (by_heads.frame, by_heads.distance)
    assert explained


def without_one_for_a_moment(label: MotionLabels) -> MotionLabels:
    """The instance with the most cells is not there in the second frame."""
    largest = np.bincount(label.instance[label.instance > 0]).argmax()
    gone = label.instance == largest
    gone[[0, *range(2, len(gone))]] = False
    instance, segmentation = (np.where(gone, 0, each) for each in (label.instance, label.segmentation))
    return replace(label, instance=instance, segmentation=segmentation)
