"""The whole model: egos, partners, order, and gradients."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, get_args

import pytest
import torch
from torch.testing import assert_close
from torch_extra.model.small_model import small, small_both, small_lidar, small_released

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.plugins.model.fusion import ReleasedFusionConfig
from deepaccident_devkit.plugins.model.inputs import model_inputs
from deepaccident_devkit.plugins.model.network import ModelConfig, V2XFormer
from deepaccident_devkit.plugins.model.presets import fusion_config
from deepaccident_devkit.taxonomy import ModelFusion
from deepaccident_devkit.training.torch import AllEgosDataset, V2XDataset, collate, collate_all_egos

Seeded = Callable[..., V2XFormer]
Predicted = Callable[..., list[torch.Tensor]]
FUSIONS = get_args(ModelFusion)
BOTH = "cameras and LiDARs"


def assert_same(
    found: list[torch.Tensor], expected: list[torch.Tensor], tolerance: float = 1e-4
) -> None:
    for one, other in zip(found, expected, strict=True):
        assert_close(one, other, atol=tolerance, rtol=tolerance)


def apart(one: list[torch.Tensor], other: list[torch.Tensor]) -> float:
    return max(float((a - b).abs().max()) for a, b in zip(one, other, strict=True))


def of_fusion(name: str) -> ModelConfig:
    if name == BOTH:
        return small_both()
    own = ReleasedFusionConfig(
        channels=8, ego_channels=(1, 5)
    )  # the released numbers are of 64 channels
    return replace(small(), fusion=own if name == "released" else fusion_config(name, 8))


def alone(
    da: DeepAccident, token: str, config: ModelConfig, agents: Any, **options: Any
) -> dict[str, Any]:
    return V2XDataset(da, [token], config.inputs(agents, **options))[0]


def egos_by_themselves(
    model: V2XFormer,
    predicted: Predicted,
    da: DeepAccident,
    tokens: list[str],
    agents: str,
    rows: slice = slice(None),
) -> list[str]:
    """A moment's egos; what is predicted for some of them at once is what is predicted for each by
    itself.
    """
    [item] = AllEgosDataset(da, tokens, model.config.inputs(agents))
    together = predicted(model, model_inputs(collate_all_egos([item]), model.config.handedness))
    for row, token in list(enumerate(item["egos"]))[rows]:
        inputs = model_inputs(
            collate([alone(da, token, model.config, agents)]), model.config.handedness
        )
        assert_same([each[row : row + 1] for each in together], predicted(model, inputs))
    return list(item["egos"])


@pytest.mark.parametrize("agents", ["all", "single", "+other"])
@pytest.mark.parametrize("make", [small, small_lidar, small_released])
def test_all_egos_at_once_are_each_by_itself(
    da: DeepAccident,
    moment: list[str],
    seeded: Seeded,
    predicted: Predicted,
    agents: str,
    make: Callable[[], ModelConfig],
) -> None:
    """With the devkit's own items of each ego."""
    rows = slice(3, 4) if make is small_released else slice(None)
    assert egos_by_themselves(seeded(make()), predicted, da, moment, agents, rows) == moment


@pytest.mark.parametrize(("agents", "left"), [("single", 2), ("+other", 3)])
@pytest.mark.parametrize("make", [small, small_lidar, small_both])
def test_agents_that_no_ego_hears_are_not_encoded(
    da: DeepAccident,
    moment: list[str],
    seeded: Seeded,
    predicted: Predicted,
    agents: str,
    left: int,
    make: Callable[[], ModelConfig],
) -> None:
    """Of two moments; what is predicted for the egos that are left is what it was."""
    model = seeded(make())
    data = AllEgosDataset(
        da, [*moment, *(token[:-1] + "5" for token in moment)], model.config.inputs(agents)
    )
    inputs = model_inputs(collate_all_egos([data[0], data[1]]))
    rows = torch.tensor([7, 3])  # the second moment's ego first
    some = inputs.of_egos(rows)
    assert inputs.frame_valid.shape[1] == 5
    assert some.frame_valid.shape[1] == left
    assert_same(predicted(model, some), [each[rows] for each in predicted(model, inputs)])


@pytest.mark.parametrize("make", [small, small_lidar, small_both])
def test_other_moments_of_a_batch_change_nothing(
    da: DeepAccident,
    moment: list[str],
    seeded: Seeded,
    predicted: Predicted,
    make: Callable[[], ModelConfig],
) -> None:
    """Nor does it matter that an item has fewer agents, or another augmentation."""
    config = make()
    model = seeded(config)
    items = [
        alone(da, moment[0], config, "all"),
        alone(da, moment[1].replace("/004", "/001"), config, "single"),
        alone(da, moment[4].replace("/004", "/006"), config, "+other"),
    ]
    together = predicted(model, model_inputs(collate(items)))
    by_itself = [predicted(model, model_inputs(collate([item]))) for item in items]
    assert_same(together, [torch.cat(each) for each in zip(*by_itself, strict=True)])


@pytest.mark.parametrize("name", [*FUSIONS, BOTH])
def test_the_order_of_partners_does_not_matter(
    da: DeepAccident, moment: list[str], seeded: Seeded, predicted: Predicted, name: str
) -> None:
    model, order = seeded(of_fusion(name)), [0, 3, 1, 4, 2]
    item = alone(da, moment[0], model.config, "all")
    tensors = (
        "agent_valid",
        "files_missing",
        "images",
        "ego_from_agent",
        "agent_from_past",
        "intrinsics",
    )
    shuffled = item | {
        key: item[key][order] for key in (*tensors, "ego_from_camera", "image_from_ego")
    }
    for key in {"agents", "points"} & item.keys():
        shuffled[key] = type(item[key])(item[key][row] for row in order)
    assert_same(*[predicted(model, model_inputs(collate([each]))) for each in (item, shuffled)])


@pytest.mark.parametrize("name", [*FUSIONS, BOTH])
def test_partners_that_are_not_heard_leave_the_ego_alone(
    da: DeepAccident, moment: list[str], seeded: Seeded, predicted: Predicted, name: str
) -> None:
    """Exactly the single agent's prediction, whether masked or beside another item's partners."""
    model = seeded(of_fusion(name))
    item, single = (alone(da, moment[1], model.config, agents) for agents in ("all", "single"))
    inputs, beside = model_inputs(collate([item])), model_inputs(collate([single, item]))
    masked = replace(inputs, partners=torch.tensor([[True, False, False, False, False]]))
    expected = predicted(model, model_inputs(collate([single])))
    assert_same(predicted(model, masked), expected)
    assert_same([each[:1] for each in predicted(model, beside)], expected)
    assert apart(predicted(model, inputs), expected) > 1e-2


def test_all_egos_of_a_partial_release_are_each_by_itself(
    da_partial: DeepAccident,
    moment: list[str],
    config: ModelConfig,
    seeded: Seeded,
    predicted: Predicted,
) -> None:
    """The moment's first agent lacks a camera: it is no ego and no partner, and the others' places
    stay right.
    """
    there = [token for token in moment if "other_vehicle_behind" not in token]
    assert (
        egos_by_themselves(seeded(config), predicted, da_partial, there, "available") == there[1:]
    )


def test_fusions_that_ask_know_kinds_and_delays(
    da: DeepAccident, moment: list[str], seeded: Seeded, predicted: Predicted
) -> None:
    """Of the right agents, in whichever order they stand."""
    batch = collate([alone(da, moment[0], of_fusion("v2xvit"), "all")])
    inputs = model_inputs(batch)
    late, parked = (
        model_inputs(batch, delay=2),
        replace(inputs, is_infrastructure=torch.zeros(1, 5).bool()),
    )
    for name, differs in (("mean", False), ("v2xvit", True)):
        model = seeded(of_fusion(name))
        for changed in (late, parked):
            assert (apart(predicted(model, inputs), predicted(model, changed)) > 1e-3) == differs
    egos_by_themselves(model, predicted, da, moment, "all", slice(4, 5))
