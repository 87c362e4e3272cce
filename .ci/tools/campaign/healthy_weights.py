"""Files of weights in three formats, and a run of training; all of it needs PyTorch."""

from pathlib import Path

import torch
from torch_extra.model.small_model import RUN, small, trained

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
    """The network whose weights the files have."""
    torch.manual_seed(0)
    return V2XFormer(small())


def write_weight_files(folder: Path) -> None:
    """Our own format, and both of PyTorch."""
    folder.mkdir()
    state = small_network().state_dict()
    write_weights(
        folder / "own.safetensors",
        state,
        {"preset": "tiny", "fusion": None, "horizon": None, "step": 7},
    )
    torch.save(state, folder / "new.pt")
    torch.save(state, folder / "old.pth", _use_new_zipfile_serialization=False)


def write_run(dataset: DeepAccident, folder: Path) -> None:
    """A run of one step, which is done."""
    trained(dataset, folder, TRAINING)
    for path in folder.glob("final.*"):
        path.unlink()  # so that it is written from the state


__all__ = ["TRAINING", "small_network", "trained", "write_run", "write_weight_files"]
