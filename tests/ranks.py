"""Two processes of torch.distributed over `gloo`: in a module that spawned processes can import by
name.
"""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from evaluating import labels_as_maps
from torch import distributed
from torch.utils.data import DataLoader, DistributedSampler

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation import (
    AccidentEvaluator,
    DetectionEvaluator,
    MotionEvaluator,
    detection_truth,
)
from deepaccident_devkit.evaluation.detection import DetectedBoxes
from deepaccident_devkit.evaluation.evaluator import Evaluator
from deepaccident_devkit.training.torch import (
    RandomAugmentation,
    V2XConfig,
    V2XDataset,
    collate,
    merged_evaluator,
)

RANKS = 2


def run_ranks(work: Callable[..., None], folder: Path, *arguments: Any) -> None:
    """`work(rank, folder, *arguments)` on all ranks; an error of one is raised here."""
    torch.multiprocessing.spawn(_rank, (work, folder, *arguments), nprocs=RANKS)


def _rank(rank: int, work: Callable[..., None], folder: Path, *arguments: Any) -> None:
    if Path("/sys/class/net/lo").exists():  # no name of this machine has to be looked up
        os.environ["GLOO_SOCKET_IFNAME"] = "lo"
    torch.set_num_threads(1)
    distributed.init_process_group("gloo", f"file://{folder}/meeting", rank=rank, world_size=RANKS)
    try:
        work(rank, folder, *arguments)
    finally:
        distributed.destroy_process_group()


def everything(
    rank: int, folder: Path, dataset: DeepAccident, tokens: list[str], root: Path
) -> None:
    """Leaves `<what>_<rank>.json` of all that the tests look at."""
    write(folder, "opened", rank, tables_of(root))
    data = V2XDataset(
        dataset, tokens, V2XConfig(points=False, boxes=None, augmentation=RandomAugmentation())
    )
    seen = tokens[rank::RANKS]
    for evaluator in counted(dataset, seen):
        merged_evaluator(evaluator).save(folder / f"{type(evaluator).__name__}_{rank}.json")
        assert evaluator.tokens == set(seen)
    write(folder, "trained", rank, trained(data))
    twice = counted(dataset, tokens[:1])[0]  # by both, as after DistributedSampler
    assert merged_evaluator(twice).repeated == {tokens[0]}
    write(folder, "refused", rank, refusal(rank))


def tables_of(root: Path) -> str:
    """The tables that a process opens, or makes, at the same moment as the other."""
    distributed.barrier()
    return str(DeepAccident("v1", root, workers=1, verbose=False).tables_folder)


def counted(dataset: DeepAccident, tokens: list[str]) -> list[Evaluator[Any]]:
    motion, accident, detection = (
        MotionEvaluator(),
        AccidentEvaluator("paper"),
        DetectionEvaluator(),
    )
    for token in tokens:
        prediction, label = labels_as_maps(dataset, token)
        motion.update(token, prediction, label)
        accident.update(token, prediction, label)
        truth = detection_truth(dataset, token, detection.protocol)
        scores = torch.linspace(0.9, 0.1, len(truth)).double()
        detection.update(token, DetectedBoxes(boxes=truth, scores=scores), truth)
    return [motion, accident, detection]


def trained(data: V2XDataset) -> list[dict[str, Any]]:
    """Token → augmentation matrix of this rank's items, for two epochs of a worker that stays."""
    sampler = DistributedSampler(data)
    loader = DataLoader(
        data, sampler=sampler, num_workers=1, persistent_workers=True, collate_fn=collate
    )
    epochs = []
    for epoch in range(2):
        data.set_epoch(epoch)
        sampler.set_epoch(epoch)
        epochs.append({batch["token"][0]: batch["augmentation"][0].tolist() for batch in loader})
    return epochs


def refusal(rank: int) -> str:
    """Of evaluators with other settings on each rank."""
    try:
        merged_evaluator(MotionEvaluator("released" if rank else "paper"))
    except EvaluationError as error:
        return str(error)
    return ""


def write(folder: Path, what: str, rank: int, value: Any) -> None:
    (folder / f"{what}_{rank}.json").write_text(json.dumps(value))
