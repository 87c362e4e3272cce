"""Presets, what is changed in them, and configurations whose parts do not fit."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from refusals import assert_refused
from torch_extra.model.small_model import small

from deepaccident_devkit.errors import ChoiceError, ConfigError
from deepaccident_devkit.export.images import ImageConfig
from deepaccident_devkit.model import presets
from deepaccident_devkit.model.bev import BevUNetConfig
from deepaccident_devkit.model.checkpoint import FINAL, write_weights
from deepaccident_devkit.model.fusion import CobevtConfig, DiscoNetConfig, PoolFusionConfig, V2XViTConfig
from deepaccident_devkit.model.network import V2XFormer
from deepaccident_devkit.model.presets import PRESETS, ModelChoice, load_model, released, tiny
from deepaccident_devkit.taxonomy import ModelFusion


def parameters(model: torch.nn.Module) -> int:
    return sum(each.numel() for each in model.parameters())


def test_tiny_has_half_a_million_parameters() -> None:
    assert 0.4e6 < parameters(V2XFormer(tiny())) < 0.6e6


def test_released_has_the_sizes_of_the_release() -> None:
    """83.0 million, less the frustum; and its quirks, each in its field (model.md section 9)."""
    config = released()
    with torch.device("meta"):
        assert 82.5e6 < parameters(V2XFormer(config)) < 83.5e6
    assert (config.lift.frustum, config.lift.voxel_rounding) == ("corners", "trunc")
    assert (config.temporal.warp, config.temporal.chain, config.temporal.egomotion_input) == (
        "stretched",
        "released",
        "raw",
    )
    assert (config.motion.posterior_ignore, config.motion.hidden_warp) == ("keep", "none")
    assert (config.handedness, config.labels.grid.orientation) == ("left", "released")
    assert config.labels_protocol == "released"
    assert len(config.detection.class_slots) == 6


@pytest.mark.parametrize(
    ("fusion", "kind"),
    [("mean", PoolFusionConfig), ("disconet", DiscoNetConfig), ("cobevt", CobevtConfig), ("v2xvit", V2XViTConfig)],
)
@pytest.mark.parametrize("preset", PRESETS)
def test_a_fusion_fits_its_preset(fusion: ModelFusion, kind: type, preset: Any) -> None:
    config = ModelChoice(preset=preset, fusion=fusion).config
    assert isinstance(config.fusion, kind)
    assert replace(config, fusion=PRESETS[preset]().fusion) == PRESETS[preset]()
    with torch.device("meta"):
        V2XFormer(config)


def test_the_released_fusion_has_channels_that_a_small_model_lacks() -> None:
    with pytest.raises(ConfigError, match="ego_channels: expected numbers from 0 to 31"):
        ModelChoice(preset="tiny", fusion="released")


@pytest.mark.parametrize(("horizon", "frames"), [(0.5, 1), (2.0, 4), (4, 8)])
def test_a_horizon_is_a_number_of_frames(horizon: float, frames: int) -> None:
    config = ModelChoice(horizon=horizon).config
    assert config.motion.future_frames == config.labels.future_frames == frames


@pytest.mark.parametrize("horizon", [0.0, -1.0, 0.7, 1000.0, float("nan")])
def test_other_horizons_are_refused(horizon: float) -> None:
    with pytest.raises(ConfigError, match=r"horizon: .* s is no number of steps of 0\.5 s; choose 0\.5, 1"):
        ModelChoice(horizon=horizon)


def test_unknown_words_are_refused() -> None:
    assert_refused(
        (lambda: ModelChoice(preset="large"), ChoiceError, "preset: expected one of released, tiny"),
        (lambda: ModelChoice(fusion="sum"), ChoiceError, "fusion"),
    )


def test_a_choice_can_be_noted_and_made_again() -> None:
    choice = ModelChoice(preset="released", fusion="cobevt", horizon=3)
    path = Path("weights.safetensors")
    assert ModelChoice.from_dict({**choice.as_dict(), "step": 7}, path) == choice
    for described in ({}, {"preset": "tiny"}, {"preset": "large", "fusion": None, "horizon": None}):
        with pytest.raises(ConfigError, match=r"^weights\.safetensors: does not say which model its weights are of"):
            ModelChoice.from_dict(described, path)
    with pytest.raises(ConfigError, match="deepaccident train --from"):
        ModelChoice.from_dict({"preset": "tiny", "fusion": None, "horizon": "long"}, path)


def test_a_model_is_loaded_by_its_notes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(presets, "PRESETS", {"tiny": small})
    choice = ModelChoice(fusion="cobevt")
    torch.manual_seed(3)
    model = V2XFormer(choice.config)
    notes = {**choice.as_dict(), "step": 7}
    write_weights(tmp_path / FINAL, model.state_dict(), notes)
    loaded = load_model(tmp_path)
    assert loaded.config == model.config
    assert loaded.notes == notes
    assert all(torch.equal(each, loaded.state_dict()[name]) for name, each in model.state_dict().items())
    write_weights(tmp_path / FINAL, model.state_dict(), {**notes, "fusion": "mean"})
    assert load_model(tmp_path).config.fusion == PoolFusionConfig()
    write_weights(tmp_path / FINAL, model.state_dict(), {**notes, "fusion": "disconet"})
    with pytest.raises(ConfigError, match=r"of the model are missing \(v2x_fusion\.score"):
        load_model(tmp_path)
    write_weights(tmp_path / FINAL, model.state_dict(), {})
    with pytest.raises(ConfigError, match="does not say which model"):
        load_model(tmp_path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"images": ImageConfig(resize=(36, 64))}, "images.dtype: expected 'uint8'"),
        (
            {"temporal": replace(small().temporal, channels=9)},
            "temporal.channels: expected 8, as lift.channels, found 9",
        ),
        ({"bev": BevUNetConfig(in_channels=9, out_channels=16)}, "bev.in_channels: expected 8"),
        ({"motion": replace(small().motion, in_channels=9)}, "motion.in_channels: expected 16, as bev.out_channels"),
        ({"detection": replace(small().detection, in_channels=9)}, "detection.in_channels: expected 16"),
        ({"motion": replace(small().motion, future_frames=9)}, "motion.future_frames: expected 2, as labels.future"),
        ({"temporal": replace(small().temporal, frames=3)}, "temporal.frames: expected 2, as labels.receptive_field"),
    ],
)
def test_parts_that_do_not_fit_are_named(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        replace(small(), **changes)
