import json
import pickle
from dataclasses import astuple, replace
from functools import partial

import numpy as np
import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import ChoiceError, ConfigError
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import LABEL_PROTOCOLS, PRESETS, Augmentation, MotionLabelConfig
from deepaccident_devkit.motion.config import resolved_label_config, slip_names
from deepaccident_devkit.v2x import AgentConfig


def test_the_default_is_the_released_labels_in_the_devkits_orientation() -> None:
    config = MotionLabelConfig()
    assert config.label_frames == 5
    assert config.frames == 7
    assert config.grid.orientation == "devkit"
    assert list(config.offsets) == [-10, -5, 0, 5, 10, 15, 20]
    assert config.rules == LABEL_PROTOCOLS["released"]
    assert config == MotionLabelConfig.preset("deepaccident")


def test_the_orientation_is_the_grids_and_a_new_grid_brings_its_own() -> None:
    fiery = BevGrid(orientation="fiery")
    released = BevGrid(orientation="released")
    assert MotionLabelConfig(grid=fiery).grid is fiery

    config = MotionLabelConfig(grid=fiery, orientation="released")
    assert config.grid == released
    assert config.orientation is None
    assert replace(config, grid=fiery).grid == fiery
    assert replace(config, grid=BevGrid()).grid == BevGrid()
    assert replace(config, orientation="fiery").grid == fiery
    assert replace(config, future_frames=2).grid == released


def test_a_presets_orientation_is_kept_unless_the_grid_or_the_caller_gives_another() -> None:
    devkit = BevGrid((-20, 20, 0.5))
    released = devkit.with_orientation("released")
    fiery = devkit.with_orientation("fiery")
    preset = MotionLabelConfig.preset
    assert preset("fiery", grid=devkit).grid == fiery
    assert preset("fiery", grid=released).grid == released
    assert preset("fiery", grid=released, orientation="devkit").grid == devkit
    assert preset("fiery", grid=devkit, orientation="devkit").grid == devkit
    assert preset("deepaccident", grid=released).grid == released


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        (
            {"future_frames": 0},
            (
                r"future_frames: expected a whole number from 1 to 1,000 \(frames "
                r"after the present.*found 0"
            ),
        ),
        ({"future_frames": 10**9}, "found 1000000000"),
        ({"future_frames": 1001}, "found 1001"),
        (
            {"receptive_field": True},
            "receptive_field: expected a whole number from 1 .* found True",
        ),
        (
            {"step": 2.5},
            r"step: expected a whole number from 1 to 1,000 \(recorded frames .* found 2.5",
        ),
        ({"ignore_index": 0}, "ignore_index: expected a whole number from 1 to 255 .*, found 0"),
        ({"ignore_index": 256}, "ignore_index: .* found 256"),
        (
            {"ignore_index": 199},
            "199 may also be a number of cells in offset and flow; choose 200 to 255",
        ),
        ({"sigma": 0}, "sigma: expected cells from 0.01 to 10,000, such as 3, found 0"),
        ({"sigma": 0.009}, "sigma: .* found 0.009"),
        ({"sigma": 10_001}, "sigma: .* found 10001"),
        ({"sigma": "3"}, "sigma: .* found '3'"),
        ({"sigma": np.nan}, "sigma: .* found nan"),
        ({"draw_ego": "no"}, "draw_ego: expected True or False, found 'no'"),
        ({"only_vehicle": 1}, "only_vehicle: expected True or False, found 1"),
        ({"grid": None}, "grid: expected a BevGrid, found None"),
        ({"grid": (-50, 50, 0.5)}, r"grid: expected a BevGrid, found \(-50"),
        ({"augmentation": "flip"}, "augmentation: expected an Augmentation or None, found 'flip'"),
    ],
)
def test_what_cannot_be_is_refused_with_the_remedy(changes, sentence) -> None:
    assert_raises(
        (lambda: MotionLabelConfig(**changes), ConfigError, sentence),
    )


def test_unknown_words_are_refused() -> None:
    assert_raises(
        (
            lambda: MotionLabelConfig.preset("nuscenes"),
            ChoiceError,
            r"preset: expected one of deepaccident, .*, found 'nuscenes'",
        ),
        (
            lambda: MotionLabelConfig.preset("fiery", futureframes=3),
            ConfigError,
            "preset: no field 'futureframes'; the fields are grid, ",
        ),
        (
            lambda: MotionLabelConfig(protocol="paper"),
            ChoiceError,
            "protocol: expected one of released, clean, beverse, fiery, found 'paper'",
        ),
        (
            lambda: replace(LABEL_PROTOCOLS["clean"], drawn_when="later"),
            ChoiceError,
            r"drawn_when: expected one of present, .*, found 'later'",
        ),
        *[
            (
                partial(MotionLabelConfig, protocol=protocol),
                ChoiceError,
                "protocol: expected one of released",
            )
            for protocol in (3, ["clean"], None)
        ],
        (
            lambda: replace(LABEL_PROTOCOLS["clean"], half_cell_shift=1),
            ConfigError,
            "half_cell_shift: expected True or False, found 1",
        ),
        (
            lambda: replace(LABEL_PROTOCOLS["released"], warp="fiery"),
            ConfigError,
            "warp 'fiery' needs native 'fiery', found 'released'",
        ),
        *[
            (partial(MotionLabelConfig, agents=agents), ChoiceError, "agents: expected")
            for agents in ("nobody", ["pole"], [], 5)
        ],
        (
            lambda: MotionLabelConfig(grid=BevGrid((-50, 50, 0.3))),
            ConfigError,
            "is not a whole number of cells",
        ),
    )


def test_a_digest_tells_configurations_apart_by_what_they_draw() -> None:
    config = MotionLabelConfig()
    assert config.digest == MotionLabelConfig(protocol=LABEL_PROTOCOLS["released"]).digest

    configs = [
        config,
        replace(config, future_frames=5),
        replace(config, orientation="released"),
        replace(config, protocol="clean"),
        replace(config, augmentation=Augmentation(flip=True)),
        replace(config, agents="single"),
        replace(config, grid=BevGrid((-40, 40, 0.5))),
    ]
    digests = {config.digest for config in configs}
    assert len(digests) == len(configs)

    json.dumps(config.as_dict())
    assert pickle.loads(pickle.dumps(config)) == config


@pytest.mark.parametrize(
    ("arguments", "equal_arguments"),
    [
        ({"sigma": 3}, {"sigma": np.float32(3)}),
        ({"ignore_index": np.uint8(255)}, {}),
        ({"draw_ego": np.True_}, {}),
        ({"protocol": "clean"}, {"protocol": LABEL_PROTOCOLS["clean"]}),
        ({"protocol": replace(LABEL_PROTOCOLS["clean"], warp="exact")}, {"protocol": "clean"}),
        ({"agents": ["ego_vehicle"]}, {"agents": ("ego_vehicle",)}),
        ({"orientation": "fiery"}, {"grid": BevGrid(orientation="fiery")}),
        ({"grid": BevGrid((-50, 50, 0.5))}, {}),
        (
            {"augmentation": Augmentation(scale=1)},
            {"augmentation": Augmentation(scale=np.float64(1))},
        ),
    ],
)
def test_the_same_configuration_in_other_words_is_equal_and_has_the_same_digest(
    arguments, equal_arguments
) -> None:
    config = MotionLabelConfig(**arguments)
    equal_config = MotionLabelConfig(**equal_arguments)
    assert config == equal_config
    assert hash(config) == hash(equal_config)
    assert config.digest == equal_config.digest

    text = json.dumps(config.as_dict())
    assert MotionLabelConfig.from_dict(json.loads(text)) == config


def test_a_configuration_may_be_named() -> None:
    assert resolved_label_config("fiery") == PRESETS["fiery"]
    assert resolved_label_config(None) == MotionLabelConfig()
    assert resolved_label_config(PRESETS["beverse"]) is PRESETS["beverse"]
    assert_raises(
        (
            lambda: resolved_label_config(3),
            ConfigError,
            "config: expected a MotionLabelConfig or the name of a preset, found 3",
        ),
    )


def test_on_grids_of_more_than_255_cells_the_mark_is_255() -> None:
    grid = BevGrid((-100, 100, 0.5))
    assert MotionLabelConfig(grid=grid).ignore_index == 255
    assert_raises(
        (lambda: MotionLabelConfig(grid=grid, ignore_index=254), ConfigError, "choose 255 to 255"),
    )


def test_an_augmentation_turns_then_scales_then_mirrors() -> None:
    moved = Augmentation(rotation=np.pi / 2, scale=2, flip=True).matrix @ [1, 0, 3, 1]
    np.testing.assert_allclose(moved, [0, -2, 6, 1], atol=1e-12)
    assert_raises(
        (
            lambda: Augmentation(scale=0),
            ConfigError,
            r"augmentation: scale: expected a factor above 0 \(1 does not scale\), found 0",
        ),
        (
            lambda: Augmentation(rotation=np.nan),
            ConfigError,
            "augmentation: rotation: expected finite radians, found nan",
        ),
        (
            lambda: Augmentation(flip="no"),
            ConfigError,
            "augmentation: flip: expected True or False, found 'no'",
        ),
        (
            lambda: Augmentation(rotation="x"),
            ConfigError,
            "augmentation: rotation: expected finite radians, found 'x'",
        ),
    )


def test_the_narrowest_and_the_widest_centre() -> None:
    assert MotionLabelConfig(sigma=0.01).sigma == 0.01
    assert MotionLabelConfig(sigma=10_000).sigma == 10_000
    config = MotionLabelConfig(ignore_index=200, future_frames=1000, step=1, receptive_field=1)
    assert config.frames == 1001


def test_agents_of_a_configuration_are_described_by_name_and_partners() -> None:
    agents = AgentConfig("mine", ("behind", "infrastructure"))
    assert MotionLabelConfig(agents=agents).as_dict()["agents"] == {
        "name": "mine",
        "partners": list(agents.partners),
    }


def test_every_preset_written_out() -> None:
    """The digests count too: label files of earlier versions have them."""
    default_fields = {
        "grid": {"x": [-50.0, 50.0, 0.5], "y": [-50.0, 50.0, 0.5]},
        "receptive_field": 3,
        "future_frames": 4,
        "step": 5,
        "only_vehicle": False,
        "filter_invisible": True,
        "agents": None,
        "draw_ego": True,
        "ignore_index": 255,
        "orientation": "devkit",
        "sigma": 3.0,
        "augmentation": None,
    }
    vehicles = {"only_vehicle": True, "draw_ego": False}
    fiery = {**vehicles, "agents": "single", "orientation": "fiery"}
    expected = {
        "deepaccident": ("released", {}, "aa6bab7c91a6df2a"),
        "deepaccident-3s": ("released", {"future_frames": 6}, "aefaeedb784d8aeb"),
        "deepaccident-4s": ("released", {"future_frames": 8}, "20daa06506a4a130"),
        "deepaccident-5s": ("released", {"future_frames": 10}, "adb29110af8447f4"),
        "beverse": ("beverse", vehicles, "3d559a2d563f3af4"),
        "fiery": ("fiery", fiery, "e880ac3b47b82b25"),
    }

    assert list(PRESETS) == list(expected)
    for name, (protocol, changes, digest) in expected.items():
        preset = PRESETS[name]
        fields = preset.as_dict()
        assert fields.pop("protocol")["native"] == LABEL_PROTOCOLS[protocol].native
        assert fields == {**default_fields, **changes}
        assert preset.protocol == protocol
        assert preset.digest == digest


def test_every_protocol_written_out() -> None:
    yes, no = True, False
    assert {name: astuple(rules) for name, rules in LABEL_PROTOCOLS.items()} == {
        "released": (
            *[yes] * 4,
            "present",
            *[yes] * 5,
            "stretched",
            "released",
            "released",
            "whole",
        ),
        "clean": (*[no] * 4, "since", *[no] * 5, "exact", "released", "released", "whole"),
        "beverse": (
            *[yes] * 4,
            "now",
            yes,
            no,
            yes,
            yes,
            no,
            "stretched",
            "devkit",
            "released",
            "whole",
        ),
        "fiery": (*[yes] * 4, "now", no, no, yes, yes, yes, "fiery", "fiery", "camera", "yaw"),
    }
    assert [(rules.right_handed, rules.place_in_cell) for rules in LABEL_PROTOCOLS.values()] == [
        (False, (0.0, 1.0)),
        (False, (0.5, 0.5)),
        (True, (0.0, 0.0)),
        (True, (0.0, 0.0)),
    ]
    assert slip_names() == [
        "own_box_moved_twice",
        "own_box_default",
        "own_box_not_augmented",
        "half_cell_shift",
        "untracked_share_an_id",
        "missing_frames_are_empty",
        "outside_is_zero",
        "vectors_not_rotated",
        "ids_kept_between_samples",
    ]


def test_no_augmentation_changes_nothing() -> None:
    augmentation = Augmentation()
    assert astuple(augmentation) == (0.0, 1.0, False)
    np.testing.assert_array_equal(augmentation.matrix, np.eye(4))
    assert_raises(
        (
            lambda: Augmentation(scale=-1),
            ConfigError,
            r"scale: expected a factor above 0 \(1 does not scale\), found -1",
        ),
    )


@pytest.mark.parametrize(
    "described", [{}, [], None, {**MotionLabelConfig().as_dict(), "colour": "red"}]
)
def test_what_describes_no_configuration_is_refused(described: object) -> None:
    assert_raises(
        (
            lambda: MotionLabelConfig.from_dict(described),
            ConfigError,
            r"label configuration: cannot be read \(.+\)",
        ),
    )
