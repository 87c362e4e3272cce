import numpy as np
import pytest
from numpy.testing import assert_array_equal

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.handedness import flip_six_vector
from deepaccident_devkit.motion import FrameBoxes, MotionLabelConfig, MotionLabels, motion_labels_from_boxes
from deepaccident_devkit.motion.batch_names import MAPS

NAMES = ("fiery", "beverse", "deepaccident")


def made(**changes) -> MotionLabels:
    """Two cars, one of which turns, on a grid that is not square; the last frame is beyond the recording."""
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
    motion = np.random.default_rng(0).normal(0, 0.02, (config.frames, 6))
    return motion_labels_from_boxes([*frames, None], motion, config)


@pytest.mark.parametrize("orientation", ["released", "fiery"])
@pytest.mark.parametrize("names", NAMES)
def test_a_batch_is_the_same_from_any_orientation(names, orientation) -> None:
    expected = made().as_batch(names)
    for name, array in made(orientation=orientation).as_batch(names).items():
        assert_array_equal(array, expected[name])


@pytest.mark.parametrize("orientation", ["devkit", "released", "fiery"])
@pytest.mark.parametrize("names", NAMES)
def test_a_batch_is_ones_own(names, orientation) -> None:
    labels = made(orientation=orientation)
    for array in labels.as_batch(names).values():
        array[...] = 7
    assert_array_equal(labels.instance, made(orientation=orientation).instance)
    assert_array_equal(labels.future_egomotion, made(orientation=orientation).future_egomotion)


def test_fierys_batch() -> None:
    """Rows ahead, past frames in front (empty), segmentation with a channel."""
    labels = made(orientation="fiery")
    batch = labels.as_batch("fiery")
    assert list(batch) == [*MAPS, "future_egomotion"]
    assert {name: batch[name].shape for name in MAPS} == {
        "segmentation": (7, 1, 100, 80),
        "instance": (7, 100, 80),
        "centerness": (7, 1, 100, 80),
        "offset": (7, 2, 100, 80),
        "flow": (7, 2, 100, 80),
    }
    assert (batch["segmentation"].dtype, batch["instance"].dtype) == (np.int64, np.int64)
    assert not batch["instance"][:2].any()
    assert (batch["flow"][:2] == 255).all()
    assert_array_equal(batch["offset"][2:], labels.offset)
    assert_array_equal(batch["future_egomotion"], labels.future_egomotion)


def test_beverses_and_deepaccidents_batches() -> None:
    labels = made(orientation="devkit")
    beverse, deepaccident = labels.as_batch("beverse"), labels.as_batch("deepaccident")
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
    assert_array_equal(deepaccident["instance_offset"], made(orientation="released").offset)
    assert_array_equal(deepaccident["future_egomotions"], flip_six_vector(labels.future_egomotion).astype(np.float32))


def test_other_codes_are_refused() -> None:
    labels = made()
    with pytest.raises(ChoiceError, match="names: expected one of fiery, beverse, deepaccident, found 'stp3'"):
        labels.as_batch("stp3")
