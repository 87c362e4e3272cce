"""Evaluation on several processes of `torch.distributed`: each sample once, and all processes' counts together.

Training needs nothing of the devkit's: `V2XDataset` draws augmentations by position and epoch, so ranks that take
different positions from torch's `DistributedSampler` draw different ones.
"""

from __future__ import annotations

from collections.abc import Iterator, Sized
from typing import TYPE_CHECKING, Any

from deepaccident_devkit.arrays import checked_whole
from deepaccident_devkit.errors import ConfigError, EvaluationError
from deepaccident_devkit.evaluation.metrics.evaluator import Evaluator, EvaluatorT

if TYPE_CHECKING:
    from torch.distributed import ProcessGroup

    # as in `dataset`: mypy would see an Any here
    TorchSampler = object
else:
    from torch.utils.data import Sampler as TorchSampler


class EvaluationSampler(TorchSampler):
    """The positions of one rank's samples: every `num_replicas`-th from `rank` on, in order; nothing is padded.

    All ranks together have each sample exactly once, and their numbers of samples differ by at most one. torch's
    `DistributedSampler` repeats samples until all ranks have equally many. Ranks without that take different numbers of
    steps, so the loop must not wait for the others in each step: use the model itself, not its
    `DistributedDataParallel`.

    Attributes:
        num_replicas: number of ranks.
        rank: this one, from 0.
    """

    def __init__(self, dataset: Sized, num_replicas: int | None = None, rank: int | None = None) -> None:
        """Choose the samples of a rank.

        Args:
            dataset: a `V2XDataset`, or whatever has a length.
            num_replicas: number of ranks; None for that of `torch.distributed`, 1 where it was not set up.
            rank: which rank; None for that of this process.

        Raises:
            ConfigError: `dataset` has no length, only one of the numbers is given, or there is no such rank.
        """
        if not isinstance(dataset, Sized):
            raise ConfigError(f"dataset: expected a V2XDataset, or what has a length, found {dataset!r}")
        if (num_replicas is None) != (rank is None):
            raise ConfigError("num_replicas, rank: give both, or none of them for those of torch.distributed")
        given = _place() if num_replicas is None else (num_replicas, rank)
        self.num_replicas = checked_whole("num_replicas", given[0], "a whole number from 1", ConfigError)
        self.rank = checked_whole("rank", given[1], "a whole number from 0", ConfigError)
        if not 0 <= self.rank < self.num_replicas:
            raise ConfigError(f"rank: expected 0 to num_replicas - 1, found {self.rank} of {self.num_replicas}")
        self._dataset = dataset

    def __len__(self) -> int:
        """Number of this rank's samples; 0 if there are more ranks than samples."""
        return len(self._positions())

    def __iter__(self) -> Iterator[int]:
        """Positions in the dataset, ascending."""
        return iter(self._positions())

    def __repr__(self) -> str:
        return f"EvaluationSampler({len(self):,} of {len(self._dataset):,} samples, rank {self.rank})"

    def _positions(self) -> range:
        return range(self.rank, len(self._dataset), self.num_replicas)


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


def _place() -> tuple[int, int]:
    """The number of ranks and this process's; one and the first without torch.distributed."""
    from torch import distributed

    return (distributed.get_world_size(), distributed.get_rank()) if _is_initialized() else (1, 0)


def _is_initialized() -> bool:
    from torch import distributed

    return bool(distributed.is_available() and distributed.is_initialized())
