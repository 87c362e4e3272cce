"""BEV segmentation targets: the camera's pixels in the cells of a grid."""

import math

import numpy as np
import pytest
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import BEV_CLASSES, Augmentation, bev_segmentation, segmentation_of
from deepaccident_devkit.motion.bev_segmentation import COVERAGE
from deepaccident_devkit.release import BevImage
from deepaccident_devkit.taxonomy import BEV_SHAPE

ROAD, LANE_LINE, VEHICLE = 7, 6, 10


def _image(*painted: tuple[int, slice, slice]) -> BevImage:
    semantic = np.zeros(BEV_SHAPE, dtype=np.uint8)
    for tag, rows, columns in painted:
        semantic[rows, columns] = tag
    return BevImage(semantic, np.zeros(BEV_SHAPE, dtype=np.uint16))


def _pixel(x: float, y: float) -> tuple[slice, slice]:
    """A square of 1 m about a point x forward, y left, in the camera's pixels."""
    row, column = round(599.5 - x / 0.1), round(599.5 - y / 0.1)
    return slice(row - 5, row + 5), slice(column - 5, column + 5)


@pytest.mark.parametrize("orientation", ["devkit", "released", "fiery"])
def test_what_lies_ahead_on_the_left_is_there_in_every_orientation(orientation: str) -> None:
    grid = BevGrid(orientation=orientation)  # type: ignore[arg-type]
    targets = segmentation_of(_image((VEHICLE, *_pixel(20.25, 10.25))), grid)
    (cell,), _ = grid.index_of([[20.25, 10.25]])
    mask = targets.mask("vehicle")
    assert mask[tuple(cell)]
    assert 1 <= mask.sum() <= 9
    np.testing.assert_allclose(grid.centers()[mask].mean(axis=0), [20.25, 10.25], atol=0.3)


def test_wide_classes_need_half_a_cell_and_thin_ones_a_pixel() -> None:
    # the cell of x 0…0.5, y 0…0.5 covers rows 595…599 and columns 595…599
    columns, line = (
        (ROAD, slice(595, 600), slice(595, 597)),
        (LANE_LINE, slice(599, 600), slice(599, 600)),
    )
    few = _image(columns, (ROAD, slice(595, 597), slice(597, 598)), line)  # 12 of 25 pixels
    grid = BevGrid()
    (cell,), _ = grid.index_of([[0.25, 0.25]])
    targets = segmentation_of(few, grid)
    assert not targets.mask("road")[tuple(cell)]
    assert targets.mask("lane_line")[tuple(cell)]
    assert targets.mask("lane_line").sum() == 1
    assert segmentation_of(_image(columns, (ROAD, slice(595, 598), slice(597, 598))), grid).mask(
        "road"
    )[tuple(cell)]


def test_cells_beyond_the_camera_are_unknown_and_empty() -> None:
    targets = segmentation_of(
        _image((ROAD, slice(None), slice(None))), BevGrid((-80, 80, 0.5), (-70, 70, 0.5))
    )
    assert targets.known.sum() == 240 * 240
    np.testing.assert_array_equal(targets.mask("road"), targets.known)


def test_cells_finer_than_pixels_take_the_nearest() -> None:
    targets = segmentation_of(
        _image((ROAD, slice(0, 600), slice(None))), BevGrid((-1, 1, 0.05), (-1, 1, 0.05))
    )
    np.testing.assert_array_equal(
        targets.mask("road"), np.broadcast_to(np.arange(40) >= 20, (40, 40))
    )


def test_an_augmentation_moves_the_ground_as_it_moves_points() -> None:
    augmentation = Augmentation(rotation=math.radians(90), scale=1.1, flip=True)
    moved = augmentation.matrix @ np.array([20.25, 10.25, 0.0, 1.0])
    targets = segmentation_of(
        _image((VEHICLE, *_pixel(20.25, 10.25))), BevGrid(), augmentation=augmentation
    )
    np.testing.assert_allclose(
        BevGrid().centers()[targets.mask("vehicle")].mean(axis=0), moved[:2], atol=0.3
    )


def test_boxes_of_a_sample_lie_on_vehicle_cells(da: DeepAccident) -> None:
    sample = da.sample[3]
    targets, boxes = bev_segmentation(da, sample), da.boxes(sample, "ego")
    index, inside = targets.grid.index_of(boxes.select(np.flatnonzero(boxes.category < 3)).center)
    painted = targets.mask("vehicle")[index[inside, 0], index[inside, 1]]
    assert len(painted) >= 3
    assert (
        painted.mean() > 0.6
    )  # the rest are hidden under others or parked beyond the drawn ground
    assert targets.mask("road").any()


def test_unknown_classes_are_refused() -> None:
    assert_refused(
        (lambda: segmentation_of(_image(), BevGrid()).mask("tram"), ChoiceError, "expected one of"),
    )


def test_of_a_sample_the_ground_is_augmented_too(da: DeepAccident) -> None:
    sample, augmentation = da.sample[3], Augmentation(rotation=math.radians(90), flip=True)
    mine = bev_segmentation(da, sample, augmentation=augmentation)
    np.testing.assert_array_equal(
        mine.mask("road"),
        segmentation_of(da.load_bev(sample), BevGrid(), augmentation=augmentation).mask("road"),
    )
    assert (mine.mask("road") != bev_segmentation(da, sample).mask("road")).any()


@pytest.mark.parametrize("augmentation", [None, Augmentation(rotation=0.3, scale=1.1, flip=True)])
def test_cells_count_the_pixels_at_their_points(augmentation: Augmentation | None) -> None:
    """Cells of 5 × 4 points, each looked at by itself; where half of a cell is enough, 10 of 20
    are.
    """
    tags = {"road": 7, "lane_line": 6, "sidewalk": 8, "vehicle": 10, "pedestrian": 4}
    assert (dict(COVERAGE), BEV_CLASSES) == (
        {name: 0.5 * (name[0] in "rsv") for name in tags},
        tuple(tags),
    )
    generator, image, halves = np.random.default_rng(3), _image(), 0
    semantic = generator.choice(
        [0, *tags.values()], BEV_SHAPE, p=[0.02, 0.48, 0.04, 0.42, 0.02, 0.02]
    ).astype(np.uint8)
    grid = BevGrid((-3, 3, 0.5), (-2, 2, 0.4))
    targets = segmentation_of(BevImage(semantic, image.instance), grid, augmentation=augmentation)
    back = np.linalg.inv(np.eye(4) if augmentation is None else augmentation.matrix)
    for row, column in np.ndindex(10, 12):  # y to the left by rows, x ahead by columns
        counts = dict.fromkeys((0, *tags.values()), 0)
        for along, across in np.ndindex(5, 4):
            x, y, *_ = back @ (
                -3 + column / 2 + 0.1 * (along + 0.5),
                -2 + row / 2.5 + 0.1 * (across + 0.5),
                0,
                1,
            )
            counts[semantic.item(round(599.5 - x / 0.1), round(599.5 - y / 0.1))] += 1
        halves += counts[7] == 10
        assert targets.masks[:, row, column].tolist() == [
            counts[tag] >= (10 if COVERAGE[name] else 1) for name, tag in tags.items()
        ]
    assert halves > 3
