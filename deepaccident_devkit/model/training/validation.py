"""A model's score on some samples, by the devkit's own evaluators."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.evaluation import DetectionEvaluator, MotionEvaluator, detection_truth
from deepaccident_devkit.evaluation.metrics.detection import DETECTION_PROTOCOLS, DetectedBoxes
from deepaccident_devkit.evaluation.metrics.motion.evaluator import MOTION_PROTOCOLS
from deepaccident_devkit.export.torch import merged_evaluator
from deepaccident_devkit.model.network import V2XFormer
from deepaccident_devkit.model.predicting import PredictConfig, predictions
from deepaccident_devkit.model.training.config import TrainConfig
from deepaccident_devkit.motion import motion_labels, samples

SCORE = "score"
"""The mean of the IoU and the VPQ at all distances: what the best checkpoint has most of."""
_WIDE = "100x100"


def validation_samples(dataset: Dataset, config: TrainConfig) -> list[str]:
    """Those that a run is validated with: two a second of the whole split, or evenly chosen ones of them."""
    if config.validation is None:
        return []
    listed = samples(dataset, config.validation, "all")
    wanted = config.validation_samples
    if not wanted or wanted >= len(listed):
        return listed
    return [listed[index * len(listed) // wanted] for index in range(wanted)]


def validated(model: V2XFormer, dataset: Dataset, tokens: Sequence[str], config: PredictConfig) -> dict[str, float]:
    """IoU, VPQ and distance mAP of a model at some samples, in [0, 1], and the `score`; NaN becomes 0.

    Args:
        model: on the configuration's device.
        dataset: the release.
        tokens: of the samples; where several processes train, this one's, and the scores are of all of them.
        config: who cooperates.

    Raises:
        DeepAccidentError: as of `predicting.predictions`.
    """
    labels, rules = model.config.labels, DETECTION_PROTOCOLS["paper"]
    counted = replace(MOTION_PROTOCOLS["paper"], labels=model.config.labels_protocol)
    motion, detection = MotionEvaluator(counted, trajectories=False), DetectionEvaluator(rules)
    for found in predictions(model, dataset, tokens, config):
        motion.update(found.token, found.motion, motion_labels(dataset, found.token, labels))
        pose = dataset.world_from(found.token, rules.frame).inverse()
        boxes = DetectedBoxes(boxes=found.boxes.boxes.transform(pose, rules.frame), scores=found.boxes.scores)
        detection.update(found.token, boxes, detection_truth(dataset, found.token, rules))
    wide = merged_evaluator(motion).compute().ranges[_WIDE]
    percent = {"iou": wide.iou, "vpq": wide.pq, "map": merged_evaluator(detection).compute().mean_average_precision}
    known = {name: 0.0 if math.isnan(value) else value / 100 for name, value in percent.items()}
    return {**known, SCORE: (known["iou"] + known["vpq"]) / 2}
