"""The whole model: egos, partners, order, and gradients."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, get_args

import pytest
import torch
from torch.testing import assert_close
from torch_extra.model.small_model import (
    small_both_config,
    small_config,
    small_lidar_config,
    small_released_config,
)

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.plugins.model.fusion import ReleasedFusionConfig
from deepaccident_devkit.plugins.model.inputs import model_inputs
from deepaccident_devkit.plugins.model.network import ModelConfig, V2XFormer
from deepaccident_devkit.plugins.model.presets import fusion_config
from deepaccident_devkit.taxonomy import ModelFusion
from deepaccident_devkit.training.torch import AllEgosDataset, V2XDataset, collate, collate_all_egos

MakeModel = Callable[..., V2XFormer]
PredictMaps = Callable[..., list[torch.Tensor]]
MakeConfig = Callable[[], ModelConfig]
FUSIONS = get_args(ModelFusion)
BOTH = "cameras and LiDARs"


def assert_same_maps(
    maps: list[torch.Tensor], expected: list[torch.Tensor], tolerance: float = 1e-4
) -> None:
    for values, expected_values in zip(maps, expected, strict=True):
        assert_close(values, expected_values, atol=tolerance, rtol=tolerance)


def largest_difference(maps: list[torch.Tensor], expected: list[torch.Tensor]) -> float:
    pairs = zip(maps, expected, strict=True)
    return max(float((values - reference).abs().max()) for values, reference in pairs)


def make_fusion_config(name: str) -> ModelConfig:
    if name == BOTH:
        return small_both_config()
    if name == "released":
        fusion = ReleasedFusionConfig(channels=8, ego_channels=(1, 5))  # instead of 64 channels
    else:
        fusion = fusion_config(name, 8)
    return replace(small_config(), fusion=fusion)


def load_model_item(
    da: DeepAccident, token: str, config: ModelConfig, agents: Any
) -> dict[str, Any]:
    return V2XDataset(da, [token], config.inputs(agents))[0]


def check_egos(
    model: V2XFormer,
    predict_maps: PredictMaps,
    da: DeepAccident,
    tokens: list[str],
    agents: str,
    rows: slice = slice(None),
) -> list[str]:
    """Check that egos are predicted together as each by itself, and return all egos."""
    config = model.config
    [item] = AllEgosDataset(da, tokens, config.inputs(agents))
    batch_maps = predict_maps(model, model_inputs(collate_all_egos([item]), config.handedness))

    for row, token in list(enumerate(item["egos"]))[rows]:
        batch = collate([load_model_item(da, token, config, agents)])
        maps = predict_maps(model, model_inputs(batch, config.handedness))
        assert_same_maps([values[row : row + 1] for values in batch_maps], maps)
    return list(item["egos"])


@pytest.mark.parametrize("agents", ["all", "single", "+other"])
@pytest.mark.parametrize("make_config", [small_config, small_lidar_config, small_released_config])
def test_all_egos_at_once_are_predicted_as_each_by_itself(
    da: DeepAccident,
    moment: list[str],
    make_model: MakeModel,
    predict_maps: PredictMaps,
    agents: str,
    make_config: MakeConfig,
) -> None:
    rows = slice(3, 4) if make_config is small_released_config else slice(None)
    model = make_model(make_config())
    assert check_egos(model, predict_maps, da, moment, agents, rows) == moment


@pytest.mark.parametrize(("agents", "num_agents"), [("single", 2), ("+other", 3)])
@pytest.mark.parametrize("make_config", [small_config, small_lidar_config, small_both_config])
def test_agents_that_no_ego_hears_are_not_encoded(
    da: DeepAccident,
    moment: list[str],
    make_model: MakeModel,
    predict_maps: PredictMaps,
    agents: str,
    num_agents: int,
    make_config: MakeConfig,
) -> None:
    model = make_model(make_config())
    next_moment = [token[:-1] + "5" for token in moment]
    data = AllEgosDataset(da, [*moment, *next_moment], model.config.inputs(agents))
    inputs = model_inputs(collate_all_egos([data[0], data[1]]))

    egos = torch.tensor([7, 3])  # the second moment's ego first
    ego_inputs = inputs.of_egos(egos)

    assert inputs.frame_valid.shape[1] == 5
    assert ego_inputs.frame_valid.shape[1] == num_agents
    expected = [values[egos] for values in predict_maps(model, inputs)]
    assert_same_maps(predict_maps(model, ego_inputs), expected)


@pytest.mark.parametrize("make_config", [small_config, small_lidar_config, small_both_config])
def test_other_moments_of_a_batch_change_nothing(
    da: DeepAccident,
    moment: list[str],
    make_model: MakeModel,
    predict_maps: PredictMaps,
    make_config: MakeConfig,
) -> None:
    """Items of a batch may have different numbers of agents and different augmentations."""
    config = make_config()
    model = make_model(config)
    items = [
        load_model_item(da, moment[0], config, "all"),
        load_model_item(da, moment[1].replace("/004", "/001"), config, "single"),
        load_model_item(da, moment[4].replace("/004", "/006"), config, "+other"),
    ]

    batch_maps = predict_maps(model, model_inputs(collate(items)))

    maps_of_items = [predict_maps(model, model_inputs(collate([item]))) for item in items]
    expected = [torch.cat(values) for values in zip(*maps_of_items, strict=True)]
    assert_same_maps(batch_maps, expected)


@pytest.mark.parametrize("name", [*FUSIONS, BOTH])
def test_the_order_of_partners_does_not_matter(
    da: DeepAccident, moment: list[str], make_model: MakeModel, predict_maps: PredictMaps, name: str
) -> None:
    model = make_model(make_fusion_config(name))
    item = load_model_item(da, moment[0], model.config, "all")

    order = [0, 3, 1, 4, 2]
    reordered = dict(item)
    for key in (
        "agent_valid",
        "files_missing",
        "images",
        "ego_from_agent",
        "agent_from_past",
        "intrinsics",
        "ego_from_camera",
        "image_from_ego",
    ):
        reordered[key] = item[key][order]
    for key in {"agents", "points"} & item.keys():
        reordered[key] = type(item[key])(item[key][row] for row in order)

    maps, reordered_maps = (
        predict_maps(model, model_inputs(collate([choice]))) for choice in (item, reordered)
    )
    assert_same_maps(maps, reordered_maps)


@pytest.mark.parametrize("name", [*FUSIONS, BOTH])
def test_partners_that_are_not_heard_do_not_affect_the_ego(
    da: DeepAccident, moment: list[str], make_model: MakeModel, predict_maps: PredictMaps, name: str
) -> None:
    model = make_model(make_fusion_config(name))
    item, single = (
        load_model_item(da, moment[1], model.config, agents) for agents in ("all", "single")
    )

    inputs = model_inputs(collate([item]))
    masked = replace(inputs, partners=torch.tensor([[True, False, False, False, False]]))
    beside_partners = model_inputs(collate([single, item]))

    expected = predict_maps(model, model_inputs(collate([single])))
    assert_same_maps(predict_maps(model, masked), expected)
    assert_same_maps(
        [values[:1] for values in predict_maps(model, beside_partners)],
        expected,
    )
    assert largest_difference(predict_maps(model, inputs), expected) > 1e-2


def test_all_egos_of_a_partial_release_are_predicted_as_each_by_itself(
    da_partial: DeepAccident,
    moment: list[str],
    config: ModelConfig,
    make_model: MakeModel,
    predict_maps: PredictMaps,
) -> None:
    """The moment's first agent lacks a camera, so that it is neither an ego nor a partner."""
    tokens = [token for token in moment if "other_vehicle_behind" not in token]
    model = make_model(config)
    assert check_egos(model, predict_maps, da_partial, tokens, "available") == tokens[1:]


def test_only_fusions_that_use_kinds_and_delays_depend_on_them(
    da: DeepAccident, moment: list[str], make_model: MakeModel, predict_maps: PredictMaps
) -> None:
    batch = collate([load_model_item(da, moment[0], make_fusion_config("v2xvit"), "all")])
    inputs = model_inputs(batch)
    late = model_inputs(batch, delay=2)
    without_poles = replace(inputs, is_infrastructure=torch.zeros(1, 5).bool())

    for name, differs in (("mean", False), ("v2xvit", True)):
        model = make_model(make_fusion_config(name))
        maps = predict_maps(model, inputs)
        for changed in (late, without_poles):
            assert (largest_difference(maps, predict_maps(model, changed)) > 1e-3) == differs

    check_egos(model, predict_maps, da, moment, "all", slice(4, 5))
