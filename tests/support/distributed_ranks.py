"""Two processes of torch.distributed over `gloo`.

Spawned processes import this module by its name.
"""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
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
from support.spawned_evaluation import load_label_maps

RANKS = 2


def run_ranks(work: Callable[..., None], folder: Path, *arguments: Any) -> None:
    """Call `work(rank, folder, *arguments)` on all ranks, and raise the error of any rank."""
    torch.multiprocessing.spawn(_run_rank, (work, folder, *arguments), nprocs=RANKS)


def _run_rank(rank: int, work: Callable[..., None], folder: Path, *arguments: Any) -> None:
    if Path("/sys/class/net/lo").exists():  # saves looking up the name of this machine
        os.environ["GLOO_SOCKET_IFNAME"] = "lo"
    torch.set_num_threads(1)
    distributed.init_process_group("gloo", f"file://{folder}/meeting", rank=rank, world_size=RANKS)
    try:
        work(rank, folder, *arguments)
    finally:
        distributed.destroy_process_group()


def write_rank_outputs(
    rank: int, folder: Path, dataset: DeepAccident, tokens: list[str], root: Path
) -> None:
    """Write everything that the tests look at to files `NAME_RANK.json`."""
    write_rank_file(folder, "tables", rank, open_tables_together(root))

    rank_tokens = tokens[rank::RANKS]
    for evaluator in filled_evaluators(dataset, rank_tokens):
        merged_evaluator(evaluator).save(folder / f"{type(evaluator).__name__}_{rank}.json")
        assert evaluator.tokens == set(rank_tokens)

    data = V2XDataset(
        dataset, tokens, V2XConfig(points=False, boxes=None, augmentation=RandomAugmentation())
    )
    write_rank_file(folder, "augmentations", rank, augmentations_of_epochs(data))

    # both ranks evaluate the first token, as after the filling up of DistributedSampler
    motion_evaluator = filled_evaluators(dataset, tokens[:1])[0]
    assert merged_evaluator(motion_evaluator).repeated == {tokens[0]}

    write_rank_file(folder, "merge_error", rank, merge_error(rank))


def open_tables_together(root: Path) -> str:
    """Open the tables, or make them, at the same moment as the other rank; return their folder."""
    distributed.barrier()
    return str(DeepAccident("v1", root, workers=1, verbose=False).tables_folder)


def filled_evaluators(dataset: DeepAccident, tokens: list[str]) -> list[Evaluator[Any]]:
    motion = MotionEvaluator()
    accident = AccidentEvaluator("paper")
    detection = DetectionEvaluator()
    for token in tokens:
        prediction, label = load_label_maps(dataset, token)
        motion.update(token, prediction, label)
        accident.update(token, prediction, label)

        truth = detection_truth(dataset, token, detection.protocol)
        scores = torch.linspace(0.9, 0.1, len(truth)).double()
        detection.update(token, DetectedBoxes(boxes=truth, scores=scores), truth)
    return [motion, accident, detection]


def augmentations_of_epochs(data: V2XDataset) -> list[dict[str, Any]]:
    """Return the augmentation matrix of each of this rank's tokens in two epochs.

    One persistent worker loads both epochs.
    """
    sampler = DistributedSampler(data)
    loader = DataLoader(
        data, sampler=sampler, num_workers=1, persistent_workers=True, collate_fn=collate
    )
    epochs = []
    for epoch in range(2):
        data.set_epoch(epoch)
        sampler.set_epoch(epoch)
        matrices = {batch["token"][0]: batch["augmentation"][0].tolist() for batch in loader}
        epochs.append(matrices)
    return epochs


def merge_error(rank: int) -> str:
    protocols = ("paper", "released")
    try:
        merged_evaluator(MotionEvaluator(protocols[rank]))
    except EvaluationError as error:
        return str(error)
    return ""


def write_rank_file(folder: Path, name: str, rank: int, value: Any) -> None:
    path = folder / f"{name}_{rank}.json"
    path.write_text(json.dumps(value))
