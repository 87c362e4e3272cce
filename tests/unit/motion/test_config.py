import json
import pickle
from dataclasses import replace

import numpy as np
import pytest

from deepaccident_devkit.errors import ChoiceError, ConfigError
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import LABEL_PROTOCOLS, PRESETS, Augmentation, MotionLabelConfig


def test_the_default_is_the_released_labels_in_the_devkits_orientation() -> None:
    config = MotionLabelConfig()
    assert (config.label_frames, config.frames, config.orientation) == (5, 7, "devkit")
    assert list(config.offsets) == [-10, -5, 0, 5, 10, 15, 20]
    assert config.rules == LABEL_PROTOCOLS["released"]
    assert config == MotionLabelConfig.preset("deepaccident")


def test_presets() -> None:
    for seconds in (3, 4, 5):
        assert MotionLabelConfig.preset(f"deepaccident-{seconds}s").label_frames == 1 + 2 * seconds
    fiery = MotionLabelConfig.preset("fiery", future_frames=2)
    assert (fiery.orientation, fiery.grid.orientation, fiery.draw_ego, fiery.label_frames) == (
        "fiery",
        "fiery",
        False,
        3,
    )
    assert MotionLabelConfig.preset("beverse").only_vehicle
    assert {name: MotionLabelConfig.preset(name) for name in PRESETS} == dict(PRESETS)


def test_orientation_is_the_grids_unless_it_is_given() -> None:
    grid = BevGrid(orientation="fiery")
    assert MotionLabelConfig(grid=grid).orientation == "fiery"
    assert MotionLabelConfig(grid=grid, orientation="released").grid.orientation == "released"


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"future_frames": 0}, "future_frames: expected a whole number from 1, found 0; labels of motion need"),
        ({"receptive_field": 0}, "receptive_field: expected a whole number from 1"),
        ({"step": 2.5}, "step: expected a whole number from 1, found 2.5; recorded frames between label frames"),
        ({"ignore_index": 0}, "ignore_index: expected a whole number from 1, found 0; a mark"),
        ({"sigma": 0}, "sigma: 0 is no radius; choose"),
    ],
)
def test_what_cannot_be_is_refused_with_the_remedy(changes, sentence) -> None:
    with pytest.raises(ConfigError, match=sentence):
        MotionLabelConfig(**changes)


def test_unknown_words_are_refused() -> None:
    with pytest.raises(ChoiceError, match=r"preset: expected one of deepaccident, .*, found 'nuscenes'"):
        MotionLabelConfig.preset("nuscenes")
    with pytest.raises(ConfigError, match="preset: there is no field 'futureframes'; there are grid, "):
        MotionLabelConfig.preset("fiery", futureframes=3)
    with pytest.raises(ChoiceError, match="protocol: expected one of released, clean, beverse, fiery, found 'paper'"):
        MotionLabelConfig(protocol="paper")
    with pytest.raises(ChoiceError, match=r"drawn_when is one of .*, found 'later'"):
        replace(LABEL_PROTOCOLS["clean"], drawn_when="later")
    with pytest.raises(ConfigError, match="is not a whole number of cells"):
        MotionLabelConfig(grid=BevGrid((-50, 50, 0.3)))


def test_a_digest_tells_configurations_apart_by_what_they_draw() -> None:
    config = MotionLabelConfig()
    assert config.digest == MotionLabelConfig(protocol=LABEL_PROTOCOLS["released"]).digest
    others = [
        replace(config, future_frames=5),
        replace(config, orientation="released"),
        replace(config, protocol="clean"),
        replace(config, augmentation=Augmentation(flip=True)),
        replace(config, agents="single"),
        replace(config, grid=BevGrid((-40, 40, 0.5))),
    ]
    assert len({config.digest, *(other.digest for other in others)}) == 1 + len(others)
    json.dumps(config.as_dict())
    assert pickle.loads(pickle.dumps(config)) == config


def test_an_augmentation_turns_then_scales_then_mirrors() -> None:
    moved = Augmentation(rotation=np.pi / 2, scale=2, flip=True).matrix @ [1, 0, 3, 1]
    np.testing.assert_allclose(moved, [0, -2, 6, 1], atol=1e-12)
    with pytest.raises(ConfigError, match="augmentation: scale is 0; choose a factor above 0"):
        Augmentation(scale=0)
    with pytest.raises(ConfigError, match="augmentation: rotation is nan; choose finite radians"):
        Augmentation(rotation=np.nan)
