"""`tiny` in an even smaller size, and runs with it: in a module that other processes can import by
name.
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

ALONG = (-50.0, 50.0, 2.5)
"""40 cells: 20 after the encoder, 5 of the latent."""
RUN = TrainConfig(
    steps=6,
    egos=2,
    samples="every",
    validate_every=4,
    validation_samples=1,
    save_every=2,
    warm_up=0.2,
)
"""A run of seconds, whose steps are saved two by two."""


def small() -> ModelConfig:
    """The wiring of `tiny` with 40 × 40 cells, images of 64 × 36 pixels, and labels of three
    frames, 0.1 s apart.
    """
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
                x=ALONG,
                y=ALONG,
                image_size=(48, 64),
            ),
        ),
        temporal=replace(tiny.temporal, channels=8, grid=BevGrid(x=ALONG, y=ALONG)),
        bev=BevUNetConfig(in_channels=8, out_channels=16, widths=(16, 16)),
        motion=replace(
            tiny.motion, in_channels=16, latent=4, future_frames=2, hidden=8, upsample=2, samples=2
        ),
        detection=replace(tiny.detection, in_channels=16, shared_channels=8, x=ALONG, y=ALONG),
        labels=replace(tiny.labels, grid=BevGrid(x=ALONG, y=ALONG), step=1, future_frames=2),
    )


def small_both() -> ModelConfig:
    """`small`, which also sees with LiDARs."""
    config = small()
    return replace(config, pillars=PillarConfig(channels=8, grid=config.grid, width=8))


def small_lidar() -> ModelConfig:
    """`small`, which sees with LiDARs alone."""
    return replace(small_both(), cameras=None)


def small_released() -> ModelConfig:
    """The wiring of `released` with all its quirks, two frames and a narrow encoder; the released
    kinds of layers.
    """
    released = presets.released()
    along = (-48.0, 48.0, 3.0)
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
                x=along,
                y=along,
                image_size=(32, 64),
            ),
        ),
        temporal=replace(released.temporal, channels=8, grid=BevGrid(x=along, y=along)),
        fusion=replace(released.fusion, channels=8, ego_channels=(1, 5)),
        bev=BevEncodeConfig(in_channels=8, out_channels=16, widths=(8, 8, 16)),
        motion=replace(released.motion, in_channels=16, latent=4, future_frames=2, samples=2),
        detection=replace(released.detection, in_channels=16, shared_channels=8, x=along, y=along),
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


def trained(
    dataset: DeepAccident,
    folder: Path,
    config: TrainConfig = RUN,
    *,
    curves: bool = False,
    **options: Any,
) -> Path:
    """A run with `small` in the place of `tiny`, on one thread; curves, which take seconds, are
    left out.
    """
    torch.set_num_threads(1)
    drawn = training.save_training if curves else lambda *_: None
    with (
        patch.object(presets, "MODEL_PRESETS", {"tiny": small}),
        patch.object(training, "save_training", drawn),
    ):
        return training.train(
            dataset, folder, presets.ModelChoice(), config, device="cpu", **options
        )


def killed_run(root: str, folder: str, step: int) -> None:
    """A run that is killed as soon as it has logged a step, before it saves anything."""
    add = training.add_to_log

    def add_and_die(run: Path, row: dict[str, Any]) -> None:
        add(run, row)
        if row["step"] == step:
            os.kill(os.getpid(), signal.SIGKILL)

    with patch.object(training, "add_to_log", add_and_die):
        trained(DeepAccident("v1", root, verbose=False), Path(folder))


def one_of_several(root: str, folder: Path) -> None:
    """A run of two steps on one of several processes; leaves its parameters, as it has them at the
    end.
    """
    made: list[torch.nn.Module] = []
    model_of = training.new_model

    def watched(*arguments: Any) -> Any:
        made.append(model_of(*arguments))
        return made[-1]

    with patch.object(training, "new_model", watched):
        trained(
            DeepAccident("v1", root, verbose=False), folder, replace(RUN, steps=2, validation=None)
        )
    torch.save(dict(made[0].named_parameters()), folder / f"rank_{os.environ['RANK']}.pth")


if __name__ == "__main__":  # under `torchrun`
    one_of_several(sys.argv[1], Path(sys.argv[2]))
