"""Files of weights in three formats, and a training run; all of it needs PyTorch."""

from pathlib import Path

import torch
from torch_extra.model.small_model import RUN, small_config, train_small_model

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.plugins.model.checkpoint import write_weights
from deepaccident_devkit.plugins.model.network import V2XFormer
from deepaccident_devkit.plugins.model.training_run import TrainConfig

TRAINING = TrainConfig(
    steps=1,
    egos=1,
    samples="every",
    agents="available",
    validation=None,
    save_every=1,
    seed=RUN.seed,
)


def small_network() -> V2XFormer:
    """Return the network that the files' weights belong to."""
    torch.manual_seed(0)
    return V2XFormer(small_config())


def write_weight_files(folder: Path) -> None:
    """Write weights in the devkit's own format and in both formats of PyTorch."""
    folder.mkdir()
    state = small_network().state_dict()
    notes = {"preset": "tiny", "fusion": None, "horizon": None, "step": 7}
    write_weights(folder / "own.safetensors", state, notes)
    torch.save(state, folder / "new.pt")
    torch.save(state, folder / "old.pth", _use_new_zipfile_serialization=False)


def write_run(dataset: DeepAccident, folder: Path) -> None:
    """Write a training run of one step, which is complete but for its final weights."""
    train_small_model(dataset, folder, TRAINING)
    for path in folder.glob("final.*"):
        path.unlink()  # resuming the run writes them from the training state


__all__ = ["TRAINING", "small_network", "train_small_model", "write_run", "write_weight_files"]
