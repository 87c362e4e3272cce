"""Small models and their data."""

import functools
import importlib.util
from collections.abc import Callable
from typing import Any

import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.taxonomy import AGENTS

if importlib.util.find_spec("torch") is not None:
    import torch
    from torch_extra.model.small_model import small_config

    torch.set_num_threads(1)  # several tests run at the same time

    from deepaccident_devkit.plugins.model.inputs import Handedness, ModelInputs, model_inputs
    from deepaccident_devkit.plugins.model.network import ModelConfig, V2XFormer
    from deepaccident_devkit.training.torch import V2XConfig, V2XDataset, collate


@pytest.fixture(scope="session")
def config() -> "ModelConfig":
    return small_config()


@pytest.fixture(scope="session")
def moment(sample: str) -> list[str]:
    """The samples of all agents at one moment."""
    scenario, _, frame = sample.rsplit("/", 2)
    return [f"{scenario}/{agent}/{frame}" for agent in AGENTS]


@pytest.fixture(scope="session")
def make_model(da: DeepAccident, moment: list[str]) -> Callable[..., "V2XFormer"]:
    """A maker of models in evaluation mode with weights that depend only on a seed.

    A real moment sets the batch statistics, so that signals neither fade nor grow between layers.
    """

    @functools.cache
    def load_inputs(config: "V2XConfig", handedness: "Handedness") -> "ModelInputs":
        item = V2XDataset(da, moment[:1], config)[0]
        return model_inputs(collate([item]), handedness)

    def make(config: "ModelConfig", seed: int = 0) -> "V2XFormer":
        torch.manual_seed(seed)
        model = V2XFormer(config)
        for module in model.modules():
            if isinstance(module, torch.nn.modules.batchnorm._BatchNorm):
                module.momentum = 1.0
        with torch.no_grad():
            model(load_inputs(config.inputs("all"), config.handedness))
        return model.eval()

    return make


@pytest.fixture
def predict_maps() -> Callable[..., list[Any]]:
    """A predictor of the maps of both tasks for each ego, with the same draws for all egos."""

    def predict(model: "V2XFormer", inputs: "ModelInputs") -> list[Any]:
        noise = model.noise(1, torch.Generator().manual_seed(4))
        noise = noise.expand(-1, len(inputs.ego_rows), -1, -1, -1)
        with torch.inference_mode():
            outputs = model(inputs, noise=noise)

        maps = [values.movedim(1, 0) for values in outputs.motion.maps]
        for task in outputs.detection:
            maps += [task.heatmap, task.code]
        return maps

    return predict
