"""Evaluation on several processes of `torch.distributed`: all processes' counts together.

Training needs nothing of the devkit's: `V2XDataset` draws augmentations by position and epoch, so ranks that take
different positions from torch's `DistributedSampler` draw different ones.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.evaluator import Evaluator, EvaluatorT

if TYPE_CHECKING:
    from torch.distributed import ProcessGroup


def merged_evaluator(evaluator: EvaluatorT, group: ProcessGroup | None = None) -> EvaluatorT:
    """All ranks' counts in one new evaluator, on every rank; to be called by all of them.

    Counts are small and go by token, and are summed exactly: the result has the bits of one process that counted all
    samples. A sample that ranks counted alike, as after `DistributedSampler`, counts once (`Evaluator.repeated`).

    Args:
        evaluator: this rank's, which stays as it is.
        group: whose processes take part; None for all. With NCCL, objects go over the GPUs, so each process first needs
            `torch.cuda.set_device`; a group with `gloo` needs no GPU.

    Returns:
        An evaluator with all samples; a copy of this one's where `torch.distributed` was not set up.

    Raises:
        EvaluationError: on all ranks, if one gave no evaluator, or one of other settings, or two counted the same
            sample differently.
    """
    from torch import distributed

    gathered: list[Any] = [evaluator]
    if _is_initialized():
        gathered = [None] * distributed.get_world_size(group)
        distributed.all_gather_object(gathered, evaluator, group)
    for rank, each in enumerate(gathered):
        if not isinstance(each, Evaluator):
            raise EvaluationError(
                f"evaluator: expected an Evaluator, such as MotionEvaluator(), rank {rank} has {each!r}"
            )
    merged: EvaluatorT = gathered[0].fresh()
    for each in gathered:
        merged.merge(each)
    return merged


def _is_initialized() -> bool:
    from torch import distributed

    return bool(distributed.is_available() and distributed.is_initialized())
