"""Presets, their options, and configurations with parts that do not fit together."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.expected_errors import assert_raises
from torch_extra.compared import are_identical
from torch_extra.model.small_model import small_config

from deepaccident_devkit.errors import ChoiceError, ConfigError
from deepaccident_devkit.export.images import ImageConfig
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.plugins.model import presets
from deepaccident_devkit.plugins.model.bev import BevUNetConfig
from deepaccident_devkit.plugins.model.checkpoint import FINAL_FILE, write_weights
from deepaccident_devkit.plugins.model.fusion import (
    CobevtConfig,
    DiscoNetConfig,
    PoolFusionConfig,
    V2XViTConfig,
)
from deepaccident_devkit.plugins.model.network import CameraConfig, ModelConfig, V2XFormer
from deepaccident_devkit.plugins.model.pillars import PillarConfig
from deepaccident_devkit.plugins.model.presets import (
    MODEL_PRESETS,
    ModelChoice,
    load_model,
    released,
    tiny,
    tiny_both,
    tiny_lidar,
)
from deepaccident_devkit.taxonomy import ModelFusion

PARAMETER_COUNTS = [
    (tiny, 0.4e6, 0.6e6),
    (tiny_lidar, 0.2e6, 1e6),
    (tiny_both, 0.4e6, 1e6),
    (released, 82.5e6, 83.5e6),
]


@pytest.mark.parametrize(("preset", "minimum", "maximum"), PARAMETER_COUNTS)
def test_presets_have_their_sizes(
    preset: Callable[[], ModelConfig], minimum: float, maximum: float
) -> None:
    """The released model has 83.0 million parameters without its frustum."""
    with torch.device("meta"):
        model = V2XFormer(preset())
    assert minimum < sum(weight.numel() for weight in model.parameters()) < maximum


@pytest.mark.parametrize(
    ("fusion", "kind"),
    [
        ("mean", PoolFusionConfig),
        ("disconet", DiscoNetConfig),
        ("cobevt", CobevtConfig),
        ("v2xvit", V2XViTConfig),
    ],
)
@pytest.mark.parametrize("preset", MODEL_PRESETS)
def test_a_fusion_fits_its_preset(fusion: ModelFusion, kind: type, preset: Any) -> None:
    config = ModelChoice(preset=preset, fusion=fusion).config
    assert isinstance(config.fusion, kind)
    assert config == replace(MODEL_PRESETS[preset](), fusion=config.fusion)
    with torch.device("meta"):
        V2XFormer(config)


@pytest.mark.parametrize(("horizon", "frames"), [(0.5, 1), (2.0, 4), (4, 8)])
def test_a_horizon_is_a_number_of_frames(horizon: float, frames: int) -> None:
    config = ModelChoice(horizon=horizon).config
    assert config.motion.future_frames == config.labels.future_frames == frames


@pytest.mark.parametrize(
    ("choice", "error", "facts"),
    [
        *(
            ({"horizon": horizon}, ConfigError, ("horizon", "0.5 s", "choose"))
            for horizon in (0.0, -1.0, 0.7, 1e3, np.nan)
        ),
        ({"preset": "large"}, ChoiceError, ("preset", "released, tiny")),
        ({"preset": "tiny_lidar", "focal": 100.0}, ConfigError, ("focal", "no cameras")),
        ({"fusion": "sum"}, ChoiceError, ("fusion",)),
        ({"preset": "tiny", "fusion": "released"}, ConfigError, ("ego_channels", "from 0 to 31")),
    ],
)
def test_other_choices_are_refused(
    choice: dict[str, Any], error: type[Exception], facts: tuple[str, ...]
) -> None:
    """The released fusion, for example, has channels that a small model lacks."""
    assert_raises((lambda: ModelChoice(**choice), error, facts))


def test_a_choice_can_be_noted_and_made_again() -> None:
    choice = ModelChoice(preset="released", fusion="cobevt", horizon=3)
    notes, path = choice.as_dict(), Path("weights.safetensors")
    assert ModelChoice.from_dict({**notes, "step": 7}, path) == choice

    facts = ("weights.safetensors: does not say which model its weights are for",)
    assert_raises(
        (lambda: ModelChoice.from_dict({}, path), ConfigError, facts),
        (lambda: ModelChoice.from_dict({"preset": "tiny"}, path), ConfigError, facts),
        (
            lambda: ModelChoice.from_dict({**notes, "preset": "large"}, path),
            ConfigError,
            facts,
        ),
        (
            lambda: ModelChoice.from_dict(
                {"preset": "tiny", "fusion": None, "horizon": "long"}, path
            ),
            ConfigError,
            "deepaccident train --from",
        ),
    )


def test_a_model_is_loaded_by_its_notes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(presets, "MODEL_PRESETS", {"tiny": small_config})
    choice = ModelChoice(fusion="cobevt")
    model = V2XFormer(choice.config)

    def load_with_notes(notes: dict[str, Any]) -> V2XFormer:
        write_weights(tmp_path / FINAL_FILE, model.state_dict(), notes)
        return load_model(tmp_path)

    notes = {**choice.as_dict(), "step": 7}
    loaded = load_with_notes(notes)
    assert (loaded.config, loaded.notes) == (model.config, notes)
    assert are_identical(dict(loaded.state_dict()), dict(model.state_dict()))

    mean_model = load_with_notes({**notes, "fusion": "mean"})
    assert mean_model.config.fusion == PoolFusionConfig()
    assert_raises(
        (
            lambda: load_with_notes({**notes, "fusion": "disconet"}),
            ConfigError,
            (" tensors missing (v2x_fusion.score",),
        ),
        (lambda: load_with_notes({}), ConfigError, "does not say which model"),
    )


def cameras_with_lift(**lift: Any) -> CameraConfig:
    cameras = small_config().cameras
    assert cameras is not None
    return replace(cameras, lift=replace(cameras.lift, **lift))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cameras": None}, "cameras, pillars: expected cameras, pillars or both"),
        (
            {"cameras": replace(small_config().cameras, images=ImageConfig(resize=(36, 64)))},
            "images.dtype: expected 'uint8'",
        ),
        (
            {"cameras": cameras_with_lift(channels=9)},
            "lift.channels: expected 8, as temporal.channels, found 9",
        ),
        (
            {"pillars": PillarConfig(channels=9, grid=small_config().grid)},
            "pillars.channels: expected 8, as temporal.channels",
        ),
        ({"pillars": PillarConfig(channels=8, grid=BevGrid())}, "pillars.grid: expected BevGrid"),
        ({"bev": BevUNetConfig(in_channels=9, out_channels=16)}, "bev.in_channels: expected 8"),
        (
            {"motion": replace(small_config().motion, in_channels=9)},
            "motion.in_channels: expected 16, as bev.out_channels",
        ),
        (
            {"detection": replace(small_config().detection, in_channels=9)},
            "detection.in_channels: expected 16",
        ),
        (
            {"motion": replace(small_config().motion, future_frames=9)},
            "motion.future_frames: expected 2, as labels.future",
        ),
        (
            {"temporal": replace(small_config().temporal, frames=3)},
            "temporal.frames: expected 2, as labels.receptive_field",
        ),
    ],
)
def test_parts_that_do_not_fit_are_named(changes: dict[str, Any], message: str) -> None:
    assert_raises((lambda: replace(small_config(), **changes), ConfigError, message))


def test_a_virtual_camera_and_fierys_labels_are_noted_where_they_are_chosen(tmp_path: Path) -> None:
    # runs before these options noted only three entries
    assert ModelChoice().as_dict() == {
        "preset": "tiny",
        "fusion": None,
        "horizon": None,
    }

    choice = ModelChoice(focal=100.0, labels="fiery", horizon=1.0)
    assert ModelChoice.from_dict(choice.as_dict(), tmp_path) == choice
    assert choice.config.cameras.images == ImageConfig(
        virtual_camera=(100.0, 90, 160), dtype="uint8", decode="scaled"
    )
    labels = choice.config.labels
    assert (labels.protocol, labels.future_frames, labels.only_vehicle) == ("fiery", 2, True)
