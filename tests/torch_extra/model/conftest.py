"""Models in a small size, their data, and runs that several tests look at."""

import functools
import importlib.util
from collections.abc import Callable
from typing import Any

import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.taxonomy import AGENTS

if importlib.util.find_spec("torch") is not None:
    import torch
    from torch_extra.model.small_model import small

    torch.set_num_threads(1)  # several tests run side by side

    from deepaccident_devkit.plugins.model.inputs import Handedness, ModelInputs, model_inputs
    from deepaccident_devkit.plugins.model.network import ModelConfig, V2XFormer
    from deepaccident_devkit.training.torch import V2XConfig, V2XDataset, collate


@pytest.fixture(scope="session")
def config() -> "ModelConfig":
    """The small one."""
    return small()


@pytest.fixture(scope="session")
def moment(sample: str) -> list[str]:
    """The samples of all agents at one moment."""
    scenario, _, frame = sample.rsplit("/", 2)
    return [f"{scenario}/{agent}/{frame}" for agent in AGENTS]


@pytest.fixture(scope="session")
def seeded(da: DeepAccident, moment: list[str]) -> Callable[..., "V2XFormer"]:
    """A model whose weights depend on a seed alone, in evaluation mode.

    Its batch statistics are those of a moment, so that signals neither fade nor grow on their way.
    """

    @functools.cache
    def inputs(given: "V2XConfig", handedness: "Handedness") -> "ModelInputs":
        return model_inputs(collate([V2XDataset(da, moment[:1], given)[0]]), handedness)

    def made(config: "ModelConfig", seed: int = 0) -> "V2XFormer":
        torch.manual_seed(seed)
        model = V2XFormer(config)
        for module in model.modules():
            if isinstance(module, torch.nn.modules.batchnorm._BatchNorm):
                module.momentum = 1.0
        with torch.no_grad():
            model(inputs(config.inputs("all"), config.handedness))
        return model.eval()

    return made


@pytest.fixture
def predicted() -> Callable[..., list[Any]]:
    """A model's maps of both tasks for each ego, with the same draws for all of them."""

    def of(model: "V2XFormer", inputs: "ModelInputs") -> list[Any]:
        noise = model.noise(1, torch.Generator().manual_seed(4)).expand(
            -1, len(inputs.ego_rows), -1, -1, -1
        )
        with torch.inference_mode():
            found = model(inputs, noise=noise)
        maps = [each.movedim(1, 0) for each in found.motion.maps]
        return [*maps, *(each for task in found.detection for each in (task.heatmap, task.code))]

    return of


@pytest.fixture(scope="session")
def root(da: DeepAccident) -> str:
    """Where the release is, for other processes."""
    return str(da.dataroot)
