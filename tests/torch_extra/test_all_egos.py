"""Items and batches with the targets of all egos equal those of each ego by itself."""

from dataclasses import replace

import pytest
import torch
from refusals import assert_refused
from torch.testing import assert_close
from torch_extra.compared import same

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
SENSORS = ("images", "intrinsics", "ego_from_camera", "agent_from_past")


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
    assert (item["egos"], item["agents"][0]) == (tuple(moment), AGENTS[-1])
    for row, ego in enumerate(moment):
        alone = V2XDataset(da, [ego], config)[0]  # the first item in both: the same augmentation
        assert same(item["targets"][row], {key: alone[key] for key in item["targets"][row]})
        partners = {
            name
            for name, is_one in zip(item["agents"], item["partners"][row], strict=True)
            if is_one
        }
        assert partners == set(alone["agents"])
        places = [item["agents"].index(name) for name in alone["agents"]]
        assert same([item[key][places] for key in SENSORS], [alone[key] for key in SENSORS])
        ego_from_first = torch.linalg.inv(item["ego_from_agent"][places[0], -1].double())
        assert_close(
            (ego_from_first @ item["ego_from_agent"][places].double()).float(),
            alone["ego_from_agent"],
        )


def test_a_batch_lists_the_egos_of_all_moments(da: DeepAccident, moment: list[str]) -> None:
    later = [token.replace("/004", "/005") for token in moment[2:]]
    data = AllEgosDataset(da, [*moment, *later], V2XConfig(agents="all", **CONFIG))
    batch = collate_all_egos([data[1], data[0]])
    assert batch["egos"] == [*later, *moment]
    assert [token.split("/")[-2] for token in batch["egos"]] == [
        batch["agents"][b][a] for b, a in batch["ego_rows"].tolist()
    ]
    shapes = (batch["partners"].shape, batch["instance"].shape, len(batch["boxes"]))
    assert shapes == ((8, 5), (8, 5, 200, 200), 8)


def test_absent_agents_are_neither_egos_nor_partners(
    da_partial: DeepAccident, moment: list[str]
) -> None:
    """The release has no other_vehicle_behind, and lacks the ego's front camera, which may be
    skipped for others.
    """
    there = [token for token in moment if "other_vehicle_behind" not in token]
    config = V2XConfig(agents="available", points=False, on_missing="skip", **CONFIG)
    whole, first = (
        AllEgosDataset(da_partial, tokens, config)[0] for tokens in (there, there[::-1])
    )
    assert whole["agent_valid"].all(dim=1).tolist() == [
        name != "ego_vehicle" for name in whole["agents"]
    ]
    assert (whole["egos"], first["egos"]) == (tuple(there[:-1]), tuple(there[-2::-1]))
    assert same(
        first["targets"][0], whole["targets"][-1]
    )  # though the one without its files is the first
    absent, late = replace(config, agents="all"), replace(config, link=Link(latency=0.1))
    assert_refused(
        (
            lambda: AllEgosDataset(da_partial, there, absent),
            NotAvailableError,
            "other_vehicle_behind is not in this",
        ),
        (
            lambda: AllEgosDataset(da_partial, there[-1:], config)[0],
            MissingFileError,
            "no agent has all its sensor",
        ),
        (
            lambda: AllEgosDataset(da_partial, there, late),
            ConfigError,
            ("its own messages", "use V2XDataset"),
        ),
    )
