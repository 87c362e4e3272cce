"""Batches, workers and a training loop."""

import math
import pickle
import re
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from numpy.testing import assert_allclose, assert_array_equal
from support.expected_errors import assert_raises
from torch.utils.data import DataLoader
from torch_extra.compared import are_identical
from torch_extra.items import load_item

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import ConfigError, MissingFileError
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import MotionLabelConfig
from deepaccident_devkit.training.torch import (
    ImageConfig,
    RandomAugmentation,
    V2XConfig,
    V2XDataset,
    collate,
    collate_fusion,
)
from deepaccident_devkit.v2x import Link

FULL_CONFIG = V2XConfig(
    agents="all",
    link=Link(latency=0.1, pose_noise=0.3, packet_loss=0.3),
    past=2,
    images=ImageConfig(resize=(18, 32)),
    labels=MotionLabelConfig(
        grid=BevGrid(x=(-50, 50, 1), y=(-50, 50, 1)), receptive_field=2, future_frames=2, step=1
    ),
    bev_segmentation=BevGrid(x=(-30, 30, 1), y=(-30, 30, 1)),
    augmentation=RandomAugmentation(),
)


def test_collate_places_agents_side_by_side(da: DeepAccident, tokens: list[str]) -> None:
    single = load_item(da, tokens[0], agents="single", images=ImageConfig())
    cooperative = load_item(da, tokens[1], agents="all", images=ImageConfig())

    batch = collate([single, cooperative])

    first, second = ({key: values[row] for key, values in batch.items()} for row in range(2))
    assert are_identical(second, cooperative)
    padding = {
        "agent_valid": torch.zeros(4, 1, dtype=torch.bool),
        "images": torch.zeros(4, 1, 6, 3, 36, 64),
        "intrinsics": torch.eye(3).expand(4, 1, 6, 3, 3),
    }
    expected = {key: torch.cat([single[key], blank]) for key, blank in padding.items()}
    assert are_identical({key: first[key] for key in padding}, expected)


def test_collate_fusion_places_agents_one_after_another(
    da: DeepAccident, tokens: list[str]
) -> None:
    items = [load_item(da, tokens[0], agents=agents) for agents in ("+other", "single", "all")]

    batch = collate_fusion(items)

    assert (batch["record_len"].tolist(), batch["record_len"].dtype) == (
        [2, 1, 5],
        torch.int64,
    )
    assert (batch["ego_from_agent"].shape, len(batch["points"])) == (
        (8, 1, 4, 4),
        8,
    )
    pairwise = batch["pairwise_t_matrix"]
    assert_array_equal(
        torch.cat([pairwise[1], pairwise[0, 2:]]),
        np.broadcast_to(np.eye(4), (8, 5, 4, 4)),
    )

    frames = [da.get_sample(da.scenario[0], name, 4) for name in items[2]["agents"]]
    expected = [[da.transform(target, source).matrix for target in frames] for source in frames]
    assert_allclose(pairwise[2], expected, atol=1e-3)


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_agents_that_a_partial_release_lacks_are_left_out(own_release: Path) -> None:
    scenario = min(path.name for path in own_release.glob("*/*/other_vehicle/calib/*"))
    for folder in own_release.glob(f"*/*/other_vehicle/*/{scenario}"):
        shutil.rmtree(folder)

    da = DeepAccident("v1", own_release, verbose=False)
    tokens = [f"{record['token']}/ego_vehicle/004" for record in da.scenario]
    data = V2XDataset(
        da,
        tokens,
        V2XConfig(agents=None, points=False, past=2, step=1, labels="deepaccident"),
    )
    num_agents = [4 if scenario in token else 5 for token in tokens]
    assert set(num_agents) == {4, 5}
    options = {
        "batch_size": len(tokens),
        "num_workers": 1,
        "multiprocessing_context": "fork",
    }

    [side_by_side] = DataLoader(data, collate_fn=collate, **options)
    assert side_by_side["agent_valid"].sum(dim=(1, 2)).tolist() == [
        2 * count for count in num_agents
    ]

    [one_after_another] = DataLoader(data, collate_fn=collate_fusion, **options)
    num_names = [len(names) for names in one_after_another["agents"]]
    assert one_after_another["record_len"].tolist() == num_names == num_agents


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
@pytest.mark.parametrize("start", [None, "spawn"])
def test_a_loader_without_collate_fn_batches_as_collate_does(
    da: DeepAccident, sample: str, start: str | None
) -> None:
    """torch's own collation finds ours in its registry; by itself it could not stack the items."""
    partner = sample.replace("ego_vehicle", "infrastructure")
    data = V2XDataset(da, [sample, partner], V2XConfig(agents="all"))
    assert len(data[0]["boxes"]) != len(data[1]["boxes"])

    workers = {} if start is None else {"num_workers": 1, "multiprocessing_context": start}
    [batch] = DataLoader(data, batch_size=2, **workers)

    assert are_identical(batch, collate([data[0], data[1]]))
    assert type(batch) is dict


def test_skipped_files_are_as_if_they_had_not_arrived(
    da: DeepAccident, da_partial: DeepAccident, sample: str
) -> None:
    """The pole of this release has no LiDAR, and the ego vehicle no front camera."""
    fields = {"agents": ["ego_vehicle", "other_vehicle", "infrastructure"], "past": 2, "step": 1}
    images = {"points": False, "images": ImageConfig()}
    pole_message = "infrastructure.*no such file; .* with on_missing='skip'"
    ego_message = (
        f"Camera_Front.*no such file; {sample} lacks 1 of the 6 .*cannot be "
        f"skipped.*sensors=.'Camera_Front'"
    )
    assert_raises(
        (lambda: load_item(da_partial, sample, **fields), MissingFileError, pole_message),
        (
            lambda: load_item(da_partial, sample, **fields, **images, on_missing="skip"),
            MissingFileError,
            ego_message,
        ),
        (
            lambda: load_item(da_partial, sample, **fields, **images, on_missing="raise"),
            MissingFileError,
            ego_message,
        ),
    )

    item = load_item(da_partial, sample, **fields, on_missing="skip")
    complete = load_item(da, sample, **fields, on_missing="skip")
    missing = [[0, 0], [0, 0], [1, 1]]
    assert (~item["agent_valid"]).long().tolist() == item["files_missing"].tolist() == missing
    empty_clouds = [cloud[:0] for cloud in complete["points"][0]]
    assert are_identical(item["points"], [*complete["points"][:2], empty_clouds])
    assert_array_equal(item["ego_from_agent"][2], np.broadcast_to(np.eye(4), (2, 4, 4)))
    assert collate([item, complete])["files_missing"].tolist() == [missing, [[0, 0]] * 3]


@pytest.mark.parametrize("collate_items", [collate, collate_fusion])
def test_items_of_other_kinds_make_no_batch(
    da: DeepAccident, tokens: list[str], collate_items: Callable[..., Any]
) -> None:
    plain, small, large, longer = (
        load_item(da, tokens[0], points=False, boxes=None, **fields)
        for fields in (
            {},
            {"images": ImageConfig(resize=(9, 16))},
            {"images": ImageConfig(resize=(18, 32))},
            {"past": 2},
        )
    )
    assert_raises(
        (lambda: collate_items([]), ConfigError, "batch: expected at least one item, found none"),
        (
            lambda: collate_items([plain, small]),
            ConfigError,
            r"only some of the items have 'ego_from_camera'; .* of one V2XConfig",
        ),
        (
            lambda: collate_items([large, small]),
            ConfigError,
            r"images: items of shapes .*9, 16\) and .*18, 32\) cannot form a batch; .*resize=",
        ),
        (
            lambda: collate_items([plain, longer]),
            ConfigError,
            r"agent_valid: items of shapes .* cannot form a batch",
        ),
    )


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
@pytest.mark.parametrize("start", ["fork", "spawn"])
def test_workers_give_what_one_process_gives(
    da: DeepAccident, tokens: list[str], start: str
) -> None:
    make_loader = partial(
        DataLoader, V2XDataset(da, tokens[:4], FULL_CONFIG), batch_size=2, collate_fn=collate_fusion
    )
    assert are_identical(
        list(make_loader()), list(make_loader(num_workers=2, multiprocessing_context=start))
    )


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_persistent_workers_use_the_new_epoch(da: DeepAccident, tokens: list[str]) -> None:
    data = V2XDataset(
        da, tokens[:3], V2XConfig(points=False, boxes=None, augmentation=RandomAugmentation())
    )
    loader = DataLoader(
        data,
        collate_fn=collate,
        num_workers=1,
        persistent_workers=True,
        multiprocessing_context="fork",
    )
    epochs = []
    for epoch in range(2):
        data.set_epoch(epoch)
        epochs.append(torch.cat([batch["augmentation"] for batch in loader]))
        assert are_identical(epochs[-1], torch.stack([item["augmentation"] for item in data]))
    assert not torch.equal(*epochs)


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_errors_come_out_of_workers_as_they_are(da_b: DeepAccident) -> None:
    loader = DataLoader(
        V2XDataset(da_b, [da_b.sample[0]["token"]]),
        num_workers=1,
        collate_fn=collate,
    )
    assert_raises((lambda: next(iter(loader)), MissingFileError, "no such file"))


def test_a_dataset_pickles_cheaply(da: DeepAccident) -> None:
    data = V2XDataset(da, [record["token"] for record in da.sample], V2XConfig(points=False))
    data.set_epoch(7)
    pickled = pickle.dumps(data)
    assert len(pickled) < 8 * len(data) + 10_000
    assert are_identical(pickle.loads(pickled)[5], data[5])


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_the_documented_training_loop_learns(
    da: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All code of docs/training.md runs, on the session's release instead of the page's own."""
    page = Path(__file__).parents[2] / "docs" / "training.md"
    blocks = re.findall(r"```(python|bash)\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    (tmp_path / "training_release").symlink_to(da.dataroot)
    monkeypatch.chdir(tmp_path)
    torchrun_variables = {
        "RANK": "0",
        "WORLD_SIZE": "1",
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": "0",
    }
    for name, value in torchrun_variables.items():
        monkeypatch.setenv(name, value)

    names: dict[str, Any] = {}
    for language, code in blocks:
        if language == "bash":
            CliRunner().invoke(
                deepaccident, code.split()[1:], catch_exceptions=False, standalone_mode=False
            )
        else:
            exec(compile(code, str(page), "exec"), names)  # noqa: S102

    assert names["item"]["images"].shape == (5, 1, 6, 3, 12, 32)
    assert names["fiery_batch"]["image"].shape == (2, 3, 6, 3, 224, 480)
    assert names["fiery_batch"]["flow"].shape == (2, 7, 2, 200, 200)
    assert names["losses"][4] < 0.8 * names["losses"][0]
    assert names["evaluator"].tokens == set(da.evaluation_samples("val"))
    assert math.isfinite(names["loss"].item())
