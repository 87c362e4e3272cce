"""What a model is trained on: moments of a release, each with all its agents."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from torch.utils.data import DataLoader, Sampler
from torch.utils.data import Dataset as TorchDataset

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.export.torch import AllEgosDataset, RandomAugmentation, collate_all_egos
from deepaccident_devkit.model.config import ModelConfig
from deepaccident_devkit.model.training.config import TrainConfig
from deepaccident_devkit.motion import samples


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
        numbers: `schedule.positions`.
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
