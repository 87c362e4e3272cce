"""Items and batches with the targets of all egos equal the separate items of each ego."""

from dataclasses import replace

import pytest
import torch
from support.expected_errors import assert_raises
from torch.testing import assert_close
from torch_extra.compared import are_identical

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ConfigError, MissingFileError, NotAvailableError
from deepaccident_devkit.taxonomy import AGENTS
from deepaccident_devkit.training.torch import (
    AllEgosDataset,
    ImageConfig,
    RandomAugmentation,
    V2XConfig,
    V2XDataset,
    collate_all_egos,
)
from deepaccident_devkit.v2x import Link

CONFIG = {"past": 2, "step": 1, "images": ImageConfig(dtype="uint8"), "labels": "deepaccident"}
SENSOR_KEYS = ("images", "intrinsics", "ego_from_camera", "agent_from_past")


@pytest.fixture(scope="module")
def moment(sample: str) -> list[str]:
    """The samples of all agents at one moment, not in the usual order."""
    scenario, _, frame = sample.rsplit("/", 2)
    return [f"{scenario}/{agent}/{frame}" for agent in reversed(AGENTS)]


@pytest.mark.parametrize("agents", ["single", "+other", "all", None])
def test_each_ego_has_its_own_targets_and_its_partners(
    da: DeepAccident, moment: list[str], agents: str | None
) -> None:
    config = V2XConfig(agents=agents, augmentation=RandomAugmentation(), **CONFIG)
    [item] = AllEgosDataset(da, moment, config)
    names = item["agents"]
    assert (item["egos"], names[0]) == (tuple(moment), AGENTS[-1])

    for row, ego in enumerate(moment):
        # both items are the first of their dataset, so that they have the same augmentation
        ego_item = V2XDataset(da, [ego], config)[0]
        targets = item["targets"][row]
        assert are_identical(targets, {key: ego_item[key] for key in targets})

        pairs = zip(names, item["partners"][row], strict=True)
        partners = {name for name, is_partner in pairs if is_partner}
        assert partners == set(ego_item["agents"])

        columns = [names.index(name) for name in ego_item["agents"]]
        sensors = [item[key][columns] for key in SENSOR_KEYS]
        assert are_identical(sensors, [ego_item[key] for key in SENSOR_KEYS])

        ego_from_first = torch.linalg.inv(item["ego_from_agent"][columns[0], -1].double())
        ego_from_agent = ego_from_first @ item["ego_from_agent"][columns].double()
        assert_close(ego_from_agent.float(), ego_item["ego_from_agent"])


def test_a_batch_lists_the_egos_of_all_moments(da: DeepAccident, moment: list[str]) -> None:
    later = [token.replace("/004", "/005") for token in moment[2:]]
    data = AllEgosDataset(da, [*moment, *later], V2XConfig(agents="all", **CONFIG))

    batch = collate_all_egos([data[1], data[0]])

    assert batch["egos"] == [*later, *moment]
    ego_names = [token.split("/")[-2] for token in batch["egos"]]
    rows = batch["ego_rows"].tolist()
    assert ego_names == [batch["agents"][sample][agent] for sample, agent in rows]
    assert batch["partners"].shape == (8, 5)
    assert batch["instance"].shape == (8, 5, 200, 200)
    assert len(batch["boxes"]) == 8


def test_absent_agents_are_neither_egos_nor_partners(
    da_partial: DeepAccident, moment: list[str]
) -> None:
    """The release has no other_vehicle_behind, and the ego vehicle's front camera is missing.

    Files of agents other than the ego may be skipped.
    """
    tokens = [token for token in moment if "other_vehicle_behind" not in token]
    config = V2XConfig(agents="available", points=False, on_missing="skip", **CONFIG)

    item = AllEgosDataset(da_partial, tokens, config)[0]
    reversed_item = AllEgosDataset(da_partial, tokens[::-1], config)[0]  # begins with the ego

    assert item["agent_valid"].all(dim=1).tolist() == [
        name != "ego_vehicle" for name in item["agents"]
    ]
    assert item["egos"] == tuple(tokens[:-1])
    assert reversed_item["egos"] == tuple(tokens[-2::-1])
    assert are_identical(reversed_item["targets"][0], item["targets"][-1])

    all_agents = replace(config, agents="all")
    late = replace(config, link=Link(latency=0.1))
    assert_raises(
        (
            lambda: AllEgosDataset(da_partial, tokens, all_agents),
            NotAvailableError,
            "other_vehicle_behind is not in this",
        ),
        (
            lambda: AllEgosDataset(da_partial, tokens[-1:], config)[0],
            MissingFileError,
            "no agent has all its sensor",
        ),
        (
            lambda: AllEgosDataset(da_partial, tokens, late),
            ConfigError,
            ("its own messages", "use V2XDataset"),
        ),
    )
