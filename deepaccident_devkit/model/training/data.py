"""What a model is trained on, and its score on some samples, by the devkit's own evaluators."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

from torch.utils.data import DataLoader, Sampler
from torch.utils.data import Dataset as TorchDataset

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.evaluation import DetectionEvaluator, MotionEvaluator, detection_truth
from deepaccident_devkit.evaluation.detection import DETECTION_PROTOCOLS, DetectedBoxes
from deepaccident_devkit.evaluation.motion import MOTION_PROTOCOLS
from deepaccident_devkit.export.torch import AllEgosDataset, RandomAugmentation, collate_all_egos, merged_evaluator
from deepaccident_devkit.model.network import ModelConfig, V2XFormer
from deepaccident_devkit.model.results import PredictConfig, predictions
from deepaccident_devkit.model.training.config import TrainConfig
from deepaccident_devkit.motion import motion_labels, samples


class Moments(TorchDataset[dict[str, Any]]):
    """The moments of a split as `AllEgosDataset` has them, numbered on through the epochs."""

    def __init__(self, dataset: Dataset, model: ModelConfig, config: TrainConfig, *, images_cache: Any = None) -> None:
        """Find them.

        Args:
            dataset: the release.
            model: what it learns and sees.
            config: the split, who cooperates, and the augmentation.
            images_cache: of `V2XConfig`.

        Raises:
            NotAvailableError: the split has no labelled samples.
            DeepAccidentError: as of `AllEgosDataset`.
        """
        self.model = model
        tokens = samples(dataset, config.split, config.samples)
        if not tokens:
            raise NotAvailableError(f"{config.split}: has no samples to learn from; choose another split")
        self.data = AllEgosDataset(
            dataset,
            tokens,
            model.inputs(
                config.agents,
                boxes="sample",
                labels=model.labels,
                augmentation=RandomAugmentation() if config.augment else None,
                seed=config.seed,
                images_cache=images_cache,
            ),
        )

    def __len__(self) -> int:
        return len(self.data)

    def __getitem__(self, number: int) -> dict[str, Any]:
        """The moment of a number (epoch · moments + position)."""
        epoch, position = divmod(number, len(self.data))
        return self.data.item(position, epoch)


class _Given(Sampler[int]):
    """Numbers that an iterator gives."""

    def __init__(self, numbers: Iterable[int]) -> None:
        self._numbers = numbers

    def __iter__(self) -> Iterator[int]:
        return iter(self._numbers)


def batches(moments: Moments, numbers: Iterable[int], config: TrainConfig, *, workers: int = 0) -> DataLoader[Any]:
    """Batches of moments in the order of their numbers; worker processes change nothing.

    Args:
        moments: the moments.
        numbers: `step.positions`.
        config: how many a batch has.
        workers: processes that read; 0 for this one.
    """
    return DataLoader(
        moments,
        batch_size=config.moments,
        sampler=_Given(numbers),
        collate_fn=collate_all_egos,
        num_workers=workers,
        pin_memory=False,
    )


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
        DeepAccidentError: as of `results.predictions`.
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
