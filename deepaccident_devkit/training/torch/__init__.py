"""Training with PyTorch: cooperative samples as tensors, and batches of them (the extra `torch`).

    from torch.utils.data import DataLoader
    from deepaccident_devkit import DeepAccident
    from deepaccident_devkit.training.torch import ImageConfig, V2XConfig, V2XDataset, collate

    da = DeepAccident(dataroot="data/DeepAccident")
    config = V2XConfig(agents="all", images=ImageConfig(resize=(224, 400)), labels="deepaccident")
    data = V2XDataset(da, da.training_samples("train"), config)
    loader = DataLoader(data, batch_size=2, shuffle=True, num_workers=4, collate_fn=collate)

`V2XDataset` describes an item, `collate` and `collate_fusion` describe a batch; without
`collate_fn` a loader uses `collate`. `AllEgosDataset` and `collate_all_egos` have the targets of
all agents for one reading of their sensors. docs/training.md has a training loop.
`merged_evaluator` is for several GPUs. Only this package imports torch; importing it without torch
raises MissingExtraError.
"""

from deepaccident_devkit.errors import MissingExtraError

try:
    import torch  # noqa: F401 - nothing here works without it
except ModuleNotFoundError as error:
    raise MissingExtraError(
        "the torch adapter needs PyTorch; run pip install '.[torch]' in a checkout (for PyTorch's "
        "CPU build, first pip install torch --index-url https://download.pytorch.org/whl/cpu)"
    ) from error

from deepaccident_devkit.export.images import ImageConfig
from deepaccident_devkit.training.torch.collate import (
    collate,
    collate_all_egos,
    collate_fusion,
    merged_evaluator,
)
from deepaccident_devkit.training.torch.config import RandomAugmentation, V2XConfig
from deepaccident_devkit.training.torch.dataset import AllEgosDataset, V2XDataset

__all__ = [
    "AllEgosDataset",
    "ImageConfig",
    "RandomAugmentation",
    "V2XConfig",
    "V2XDataset",
    "collate",
    "collate_all_egos",
    "collate_fusion",
    "merged_evaluator",
]
