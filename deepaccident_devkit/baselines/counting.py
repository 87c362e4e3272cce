"""Counting the study's samples: the truth of a sample once, then every condition."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Final

from deepaccident_devkit.baselines.collisions import accidents_ahead
from deepaccident_devkit.baselines.conditions import Condition
from deepaccident_devkit.baselines.drawing import label_times, motion_of
from deepaccident_devkit.baselines.motion_models import MotionModel
from deepaccident_devkit.baselines.outlook import outlook
from deepaccident_devkit.baselines.predict import detections_of
from deepaccident_devkit.baselines.predict_results import Baseline
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.evaluation import (
    AccidentEvaluator,
    DetectedBoxes,
    DetectionEvaluator,
    MotionEvaluator,
    accident_context,
    detection_truth,
)
from deepaccident_devkit.motion import motion_labels
from deepaccident_devkit.parallel import Places, run_unordered
from deepaccident_devkit.taxonomy import LIDAR

if TYPE_CHECKING:
    from concurrent.futures import Executor

BATCH: Final = 4
"""Samples that a worker counts before it reports."""
_DETECTION: Final = "paper"
"""The protocol of detections: all that any agent sees must be found in every row, so that rows compare."""


def drawn(token: str, seed: int) -> str:
    """The name of a sample in the evaluators, where each seed's draw of it has its own counts."""
    return f"{token}#{seed}"


@dataclass(frozen=True, slots=True)
class Evaluators:
    """The evaluators of one condition, with samples called as `drawn` says.

    Attributes:
        motion: of the instance maps.
        maps: of the accidents in them, by the study's protocol.
        boxes: of the accidents named explicitly, by the protocol `boxes`.
        detection: of the boxes that are seen, by the protocol `paper`.
    """

    motion: MotionEvaluator
    maps: AccidentEvaluator
    boxes: AccidentEvaluator
    detection: DetectionEvaluator

    @classmethod
    def of(cls, protocol: str) -> Evaluators:
        """New ones; the released protocol's motion metrics go with its accident metrics, the paper's with all else."""
        motion = MotionEvaluator("released" if protocol == "released" else "paper", trajectories=False)
        return cls(motion, AccidentEvaluator(protocol), AccidentEvaluator("boxes"), DetectionEvaluator(_DETECTION))

    def merge(self, other: Evaluators) -> None:
        """Take all samples of others of the same condition."""
        for each in fields(self):
            getattr(self, each.name).merge(getattr(other, each.name))

    def as_dict(self) -> dict[str, Any]:
        """Name of an evaluator → token → counts, as JSON holds them."""
        return {each.name: dict(getattr(self, each.name).counts) for each in fields(self)}

    def add(self, counts: Mapping[str, Any]) -> None:
        """Take what `as_dict` gave of others of the same condition; KeyError if an evaluator is missing."""
        for each in fields(self):
            for token, found in counts[each.name].items():
                getattr(self, each.name).add(token, found)


@dataclass(frozen=True, slots=True, kw_only=True)
class Counting:
    """The settings of the counts; cheap to pickle.

    Attributes:
        dataset: the release.
        model: how actors go on.
        protocol: of the accidents in maps.
        seeds: of the links.
    """

    dataset: Dataset
    model: MotionModel
    protocol: str
    seeds: Sequence[int]


def counted(
    counting: Counting,
    samples: Mapping[str, Sequence[Condition]],
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: bool = False,
) -> dict[Condition, Evaluators]:
    """Evaluate samples under conditions; the numbers do not depend on the number of workers.

    Args:
        counting: how.
        samples: token → its conditions.
        workers: processes; None takes what the work is worth.
        executor: any executor of `concurrent.futures` to run on, in place of own workers.
        progress: whether to show a bar.
    """
    items = list(samples.items())
    jobs = [CountJob(counting, tuple(items[at : at + BATCH])) for at in range(0, len(items), BATCH)]
    sizes = [len(job.samples) for job in jobs]
    result: dict[Condition, Evaluators] = {}
    places = Places(reads=counting.dataset.places)
    done = run_unordered(
        count_samples,
        jobs,
        workers=workers,
        executor=executor,
        label="samples",
        progress=progress,
        sizes=sizes,
        places=places,
    )
    with closing(done):
        for _, part in done:
            for condition, evaluators in part.items():
                result.setdefault(condition, Evaluators.of(counting.protocol)).merge(evaluators)
    return result


@dataclass(frozen=True, slots=True)
class CountJob:
    """Samples to count.

    Attributes:
        counting: how.
        samples: each with its conditions.
    """

    counting: Counting
    samples: tuple[tuple[str, Sequence[Condition]], ...]


def count_samples(job: CountJob) -> dict[Condition, Evaluators]:
    """The evaluators of each condition with the samples of a job."""
    result: dict[Condition, Evaluators] = {}
    for token, conditions in job.samples:
        for horizon in sorted({condition.horizon for condition in conditions}):
            chosen = [condition for condition in conditions if condition.horizon == horizon]
            _count_sample(job.counting, token, horizon, chosen, result)
    return result


def _count_sample(
    counting: Counting,
    token: str,
    horizon: float,
    conditions: Sequence[Condition],
    result: dict[Condition, Evaluators],
) -> None:
    """Add a sample to the evaluators of conditions that look equally far ahead."""
    dataset, config = counting.dataset, Baseline(horizon=horizon).config
    label = motion_labels(dataset, token, config).to_present("bilinear")
    context, truth = accident_context(dataset, token, horizon), detection_truth(dataset, token, _DETECTION)
    ego_from_lidar = dataset.ego_from(token, LIDAR)
    for condition in conditions:
        evaluators = result.setdefault(condition, Evaluators.of(counting.protocol))
        for seed in condition.seeds(counting.seeds):
            link, name = condition.link(seed), drawn(token, seed)
            ahead = outlook(dataset, token, agents=condition.agents, model=counting.model, link=link)
            output = motion_of(ahead.seen, ahead.poses(label_times(config)), ego_from_lidar, config)
            found = detections_of(ahead.seen)
            boxes = found.boxes.transform(ego_from_lidar.inverse(), truth.frame)
            evaluators.motion.update(name, output, label)
            evaluators.maps.update(name, output, label, context)
            evaluators.boxes.update(name, accidents_ahead(ahead, horizon), context)
            evaluators.detection.update(name, DetectedBoxes(boxes=boxes, scores=found.scores), truth)
