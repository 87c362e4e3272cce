import numpy as np
import pytest
from numpy.testing import assert_array_equal
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import ChoiceError, ConfigError, FieldError, GeometryError
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.conventions import flip_six_vector
from deepaccident_devkit.motion import (
    FrameBoxes,
    MotionLabelConfig,
    MotionLabels,
    motion_labels_from_boxes,
)
from deepaccident_devkit.motion.batch_names import HEAD_NAMES, MAPS, config_from_names

NAMES = ("fiery", "beverse", "deepaccident")


def make_labels(**changes) -> MotionLabels:
    """Draw two cars, one of them turning, on a grid that is not square; the last frame is beyond
    the recording.
    """
    config = MotionLabelConfig(grid=BevGrid((-20, 30, 0.5), (-20, 20, 0.5)), **changes)
    frames = [
        FrameBoxes(
            center=[[5, 3, 0], [10 + t, -6, 0]],
            size=[[4, 2, 1.5]] * 2,
            yaw=[0.3 * t, 0],
            actor_id=[4, 8],
            category=[0, 1],
            visible=[True, True],
            ego_from_lidar=np.eye(4),
        )
        for t in range(config.future_frames)
    ]
    egomotion = np.random.default_rng(0).normal(0, 0.02, (config.frames, 6))
    return motion_labels_from_boxes([*frames, None], egomotion, config)


@pytest.mark.parametrize("orientation", ["devkit", "released", "fiery"])
@pytest.mark.parametrize("names", NAMES)
def test_a_batch_read_back_is_the_same_labels(names, orientation) -> None:
    labels = make_labels(orientation=orientation)
    batch = labels.as_batch(names)

    loaded = MotionLabels.from_batch(batch, labels.config, names)

    for field in (*MAPS, "future_egomotion"):
        assert_array_equal(getattr(loaded, field), getattr(labels, field))
        assert getattr(loaded, field).dtype == getattr(labels, field).dtype
    assert_array_equal(loaded.valid, labels.valid if names != "fiery" else np.ones(7))
    assert not loaded.at_present
    present = MotionLabels.from_batch(batch, labels.config, names, at_present=True)
    assert present.at_present


def test_fierys_batch() -> None:
    """Rows ahead, past frames in front (empty), segmentation with a channel."""
    labels = make_labels(orientation="fiery")

    batch = labels.as_batch("fiery")

    assert list(batch) == [*MAPS, "future_egomotion"]
    assert {name: batch[name].shape for name in MAPS} == {
        "segmentation": (7, 1, 100, 80),
        "instance": (7, 100, 80),
        "centerness": (7, 1, 100, 80),
        "offset": (7, 2, 100, 80),
        "flow": (7, 2, 100, 80),
    }
    assert batch["segmentation"].dtype == np.int64
    assert batch["instance"].dtype == np.int64
    assert not batch["instance"][:2].any()
    assert (batch["flow"][:2] == 255).all()
    assert_array_equal(batch["offset"][2:], labels.offset)
    assert_array_equal(batch["future_egomotion"], labels.future_egomotion)


def test_beverses_and_deepaccidents_batches() -> None:
    labels = make_labels(orientation="devkit")

    beverse = labels.as_batch("beverse")
    deepaccident = labels.as_batch("deepaccident")

    for batch in (beverse, deepaccident):
        assert list(batch) == [
            "motion_segmentation",
            "motion_instance",
            "instance_centerness",
            "instance_offset",
            "instance_flow",
            "future_egomotions",
            "img_is_valid",
            "has_invalid_frame",
        ]
        assert batch["has_invalid_frame"]
        assert batch["motion_segmentation"].shape == (5, 80, 100)
    assert_array_equal(beverse["instance_flow"], labels.flow)
    assert_array_equal(deepaccident["motion_instance"], labels.instance[:, ::-1])
    released = make_labels(orientation="released")
    assert_array_equal(deepaccident["instance_offset"], released.offset)
    flipped_egomotion = flip_six_vector(labels.future_egomotion).astype(np.float32)
    assert_array_equal(deepaccident["future_egomotions"], flipped_egomotion)


def test_labels_answer_to_the_names_of_the_heads() -> None:
    labels = make_labels()
    for ours, head in HEAD_NAMES.items():
        assert getattr(labels, head) is getattr(labels, ours)


def test_batches_that_do_not_fit_are_refused() -> None:
    labels = make_labels()
    batch = labels.as_batch("beverse")
    assert_raises(
        (
            lambda: labels.as_batch("stp3"),
            ChoiceError,
            "names: expected one of fiery, beverse, deepaccident, found 'stp3'",
        ),
        (
            lambda: MotionLabels.from_batch(batch, labels.config, "fiery"),
            FieldError,
            "batch: fiery labels have 'centerness'; there are future_egomotions",
        ),
        (
            lambda: MotionLabels.from_batch(
                {**batch, "motion_segmentation": batch["motion_instance"][None]},
                labels.config,
                "beverse",
            ),
            GeometryError,
            r"motion_segmentation: expected shape \(5, 80, 100\)",
        ),
    )


def test_settings_of_the_other_codes() -> None:
    fiery = {
        "TIME_RECEPTIVE_FIELD": 3,
        "N_FUTURE_FRAMES": 6,
        "LIFT": {
            "X_BOUND": [-40.0, 40.0, 0.5],
            "Y_BOUND": [-50.0, 50.0, 0.5],
            "D_BOUND": [2.0, 50.0, 1.0],
        },
        "DATASET": {"IGNORE_INDEX": 200, "FILTER_INVISIBLE_VEHICLES": False},
        "BATCHSIZE": 3,
    }
    config = config_from_names(fiery, "fiery")
    assert config == MotionLabelConfig.preset(
        "fiery",
        grid=BevGrid((-40, 40, 0.5), orientation="fiery"),
        future_frames=6,
        ignore_index=200,
        filter_invisible=False,
    )
    converter = {
        "grid_conf": {"xbound": [0, 30, 0.15], "ybound": [-15, 30, 0.15]},
        "only_vehicle": False,
    }
    assert config_from_names(converter, "beverse").grid == BevGrid((0, 30, 0.15), (-15, 30, 0.15))
    assert config_from_names(converter, "deepaccident").grid == BevGrid(
        (0, 30, 0.15), (-30, 15, 0.15)
    )
    assert config_from_names({}, "beverse") == MotionLabelConfig.preset("beverse")
    assert_raises(
        (
            lambda: config_from_names({"grid_conf": {"ybound": 3}}, "deepaccident"),
            ConfigError,
            "ybound: expected start, end and cell size in metres, found 3",
        ),
        (
            lambda: config_from_names({"future_frames": 0}, "beverse"),
            ConfigError,
            "future_frames: expected a whole number from 1",
        ),
    )
