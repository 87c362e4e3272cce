"""The preset `tiny` in an even smaller size, and runs with it.

Other processes import this module by its name.
"""

import os
import signal
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.export.images import ImageConfig
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.plugins.model import presets
from deepaccident_devkit.plugins.model import training_loop as training
from deepaccident_devkit.plugins.model.bev import BevEncodeConfig, BevUNetConfig
from deepaccident_devkit.plugins.model.images import SmallConvConfig, SwinConfig
from deepaccident_devkit.plugins.model.network import CameraConfig, ModelConfig
from deepaccident_devkit.plugins.model.pillars import PillarConfig
from deepaccident_devkit.plugins.model.training_run import TrainConfig

AXIS = (-50.0, 50.0, 2.5)
"""Start, end and step in metres: 40 cells, which are 20 after the encoder and 5 in the latent."""
RUN = TrainConfig(
    steps=6,
    egos=2,
    samples="every",
    validate_every=4,
    validation_samples=1,
    save_every=2,
    warm_up=0.2,
)
"""A run that takes seconds and saves every second step."""


def small_config() -> ModelConfig:
    """Return `tiny` with 40 × 40 cells, 64 × 36 pixels and three label frames 0.1 s apart."""
    tiny = presets.tiny()
    return replace(
        tiny,
        cameras=CameraConfig(
            images=ImageConfig(resize=(36, 64), dtype="uint8"),
            rows=48,
            encoder=SmallConvConfig(widths=(8, 8, 8), branch=8, neck_channels=8),
            lift=replace(
                tiny.cameras.lift,
                in_channels=8,
                channels=8,
                depth=(2.0, 50.0, 4.0),
                x=AXIS,
                y=AXIS,
                image_size=(48, 64),
            ),
        ),
        temporal=replace(tiny.temporal, channels=8, grid=BevGrid(x=AXIS, y=AXIS)),
        bev=BevUNetConfig(in_channels=8, out_channels=16, widths=(16, 16)),
        motion=replace(
            tiny.motion, in_channels=16, latent=4, future_frames=2, hidden=8, upsample=2, samples=2
        ),
        detection=replace(tiny.detection, in_channels=16, shared_channels=8, x=AXIS, y=AXIS),
        labels=replace(tiny.labels, grid=BevGrid(x=AXIS, y=AXIS), step=1, future_frames=2),
    )


def small_both_config() -> ModelConfig:
    config = small_config()
    return replace(config, pillars=PillarConfig(channels=8, grid=config.grid, width=8))


def small_lidar_config() -> ModelConfig:
    return replace(small_both_config(), cameras=None)


def small_released_config() -> ModelConfig:
    """Return `released` with its layers and quirks, but two frames and a narrow encoder."""
    released = presets.released()
    axis = (-48.0, 48.0, 3.0)
    return replace(
        released,
        cameras=CameraConfig(
            images=ImageConfig(resize=(36, 64), crop=(4, 0, 32, 64), dtype="uint8"),
            encoder=SwinConfig(
                embed_dims=8,
                depths=(1, 1, 1, 1),
                num_heads=(1, 2, 2, 4),
                window_size=4,
                neck_channels=16,
            ),
            lift=replace(
                released.cameras.lift,
                in_channels=16,
                channels=8,
                depth=(1.0, 41.0, 5.0),
                x=axis,
                y=axis,
                image_size=(32, 64),
            ),
        ),
        temporal=replace(released.temporal, channels=8, grid=BevGrid(x=axis, y=axis)),
        fusion=replace(released.fusion, channels=8, ego_channels=(1, 5)),
        bev=BevEncodeConfig(in_channels=8, out_channels=16, widths=(8, 8, 16)),
        motion=replace(released.motion, in_channels=16, latent=4, future_frames=2, samples=2),
        detection=replace(released.detection, in_channels=16, shared_channels=8, x=axis, y=axis),
        labels=replace(
            released.labels,
            grid=BevGrid(
                x=(-48.0, 48.0, 2.0),
                y=(-48.0, 48.0, 2.0),
                orientation=released.labels.grid.orientation,
            ),
            step=1,
            future_frames=2,
        ),
    )


def train_small_model(
    dataset: DeepAccident,
    folder: Path,
    config: TrainConfig = RUN,
    *,
    curves: bool = False,
    **options: Any,
) -> Path:
    """Train the small model instead of `tiny` on one thread, and return the weights' path.

    Curves take seconds to draw, so that they are left out by default.
    """
    torch.set_num_threads(1)
    save_training = training.save_training if curves else lambda *_: None
    with (
        patch.object(presets, "MODEL_PRESETS", {"tiny": small_config}),
        patch.object(training, "save_training", save_training),
    ):
        return training.train(
            dataset, folder, presets.ModelChoice(), config, device="cpu", **options
        )


def train_and_die(root: str, folder: str, step: int) -> None:
    """Train until a step is logged, and die before anything of it is saved."""
    add_to_log = training.add_to_log

    def add_and_die(run: Path, row: dict[str, Any]) -> None:
        add_to_log(run, row)
        if row["step"] == step:
            os.kill(os.getpid(), signal.SIGKILL)

    with patch.object(training, "add_to_log", add_and_die):
        train_small_model(DeepAccident("v1", root, verbose=False), Path(folder))


def train_one_rank(root: str, folder: Path) -> None:
    """Train for two steps as one of several processes, and save this rank's final parameters."""
    models: list[torch.nn.Module] = []
    new_model = training.new_model

    def record_model(*arguments: Any) -> Any:
        models.append(new_model(*arguments))
        return models[-1]

    with patch.object(training, "new_model", record_model):
        train_small_model(
            DeepAccident("v1", root, verbose=False), folder, replace(RUN, steps=2, validation=None)
        )
    torch.save(dict(models[0].named_parameters()), folder / f"rank_{os.environ['RANK']}.pth")


if __name__ == "__main__":  # under `torchrun`
    train_one_rank(sys.argv[1], Path(sys.argv[2]))
