"""BEV segmentation targets: the camera's pixels in the cells of a grid."""

import math

import numpy as np
import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import BEV_CLASSES, Augmentation, bev_segmentation, segmentation_of
from deepaccident_devkit.motion.bev_segmentation import COVERAGE
from deepaccident_devkit.release import BevImage
from deepaccident_devkit.taxonomy import BEV_SHAPE

ROAD = 7
LANE_LINE = 6
VEHICLE = 10


def _image(*painted: tuple[int, slice, slice]) -> BevImage:
    semantic = np.zeros(BEV_SHAPE, dtype=np.uint8)
    for tag, rows, columns in painted:
        semantic[rows, columns] = tag
    return BevImage(semantic, np.zeros(BEV_SHAPE, dtype=np.uint16))


def _pixels_around(x: float, y: float) -> tuple[slice, slice]:
    """Return the camera's pixels of a square of 1 m around a point x forward, y left."""
    row = round(599.5 - x / 0.1)
    column = round(599.5 - y / 0.1)
    return slice(row - 5, row + 5), slice(column - 5, column + 5)


@pytest.mark.parametrize("orientation", ["devkit", "released", "fiery"])
def test_a_vehicle_ahead_on_the_left_is_found_in_every_orientation(orientation: str) -> None:
    grid = BevGrid(orientation=orientation)  # type: ignore[arg-type]
    image = _image((VEHICLE, *_pixels_around(20.25, 10.25)))

    mask = segmentation_of(image, grid).mask("vehicle")

    (cell,), _ = grid.index_of([[20.25, 10.25]])
    assert mask[tuple(cell)]
    assert 1 <= mask.sum() <= 9
    np.testing.assert_allclose(grid.centers()[mask].mean(axis=0), [20.25, 10.25], atol=0.3)


def test_wide_classes_need_half_a_cell_and_thin_ones_a_pixel() -> None:
    # the cell of x 0…0.5, y 0…0.5 covers rows 595…599 and columns 595…599
    ten_pixels = (ROAD, slice(595, 600), slice(595, 597))
    two_pixels = (ROAD, slice(595, 597), slice(597, 598))
    three_pixels = (ROAD, slice(595, 598), slice(597, 598))
    line = (LANE_LINE, slice(599, 600), slice(599, 600))
    grid = BevGrid()
    (cell,), _ = grid.index_of([[0.25, 0.25]])

    few = segmentation_of(_image(ten_pixels, two_pixels, line), grid)  # 12 of 25 pixels
    assert not few.mask("road")[tuple(cell)]
    assert few.mask("lane_line")[tuple(cell)]
    assert few.mask("lane_line").sum() == 1

    enough = segmentation_of(_image(ten_pixels, three_pixels), grid)
    assert enough.mask("road")[tuple(cell)]


def test_cells_beyond_the_camera_are_unknown_and_empty() -> None:
    image = _image((ROAD, slice(None), slice(None)))
    grid = BevGrid((-80, 80, 0.5), (-70, 70, 0.5))

    targets = segmentation_of(image, grid)

    assert targets.known.sum() == 240 * 240
    np.testing.assert_array_equal(targets.mask("road"), targets.known)


def test_cells_finer_than_pixels_take_the_nearest() -> None:
    image = _image((ROAD, slice(0, 600), slice(None)))
    grid = BevGrid((-1, 1, 0.05), (-1, 1, 0.05))

    targets = segmentation_of(image, grid)

    expected = np.broadcast_to(np.arange(40) >= 20, (40, 40))
    np.testing.assert_array_equal(targets.mask("road"), expected)


def test_an_augmentation_moves_the_ground_as_it_moves_points() -> None:
    augmentation = Augmentation(rotation=math.radians(90), scale=1.1, flip=True)
    moved_point = augmentation.matrix @ np.array([20.25, 10.25, 0.0, 1.0])
    image = _image((VEHICLE, *_pixels_around(20.25, 10.25)))
    grid = BevGrid()

    mask = segmentation_of(image, grid, augmentation=augmentation).mask("vehicle")

    centre = grid.centers()[mask].mean(axis=0)
    np.testing.assert_allclose(centre, moved_point[:2], atol=0.3)


def test_boxes_of_a_sample_lie_on_vehicle_cells(da: DeepAccident) -> None:
    sample = da.sample[3]
    boxes = da.boxes(sample, "ego")
    vehicles = boxes.select(np.flatnonzero(boxes.category < 3))

    targets = bev_segmentation(da, sample)

    cells, inside = targets.grid.index_of(vehicles.center)
    painted = targets.mask("vehicle")[tuple(cells[inside].T)]
    assert len(painted) >= 3
    # the rest are hidden under others or parked beyond the drawn ground
    assert painted.mean() > 0.6
    assert targets.mask("road").any()


def test_unknown_classes_are_refused() -> None:
    targets = segmentation_of(_image(), BevGrid())
    assert_raises(
        (lambda: targets.mask("tram"), ChoiceError, "expected one of"),
    )


def test_the_ground_of_a_sample_is_augmented_too(da: DeepAccident) -> None:
    sample = da.sample[3]
    augmentation = Augmentation(rotation=math.radians(90), flip=True)

    road = bev_segmentation(da, sample, augmentation=augmentation).mask("road")

    expected = segmentation_of(da.load_bev(sample), BevGrid(), augmentation=augmentation)
    np.testing.assert_array_equal(road, expected.mask("road"))
    plain = bev_segmentation(da, sample)
    assert (road != plain.mask("road")).any()


@pytest.mark.parametrize("augmentation", [None, Augmentation(rotation=0.3, scale=1.1, flip=True)])
def test_cells_count_the_pixels_at_their_points(augmentation: Augmentation | None) -> None:
    """Each cell has 5 × 4 points, looked at one by one; half of a cell is 10 of them."""
    tags = {"road": 7, "lane_line": 6, "sidewalk": 8, "vehicle": 10, "pedestrian": 4}
    needs_half = {"road", "sidewalk", "vehicle"}
    assert dict(COVERAGE) == {name: 0.5 * (name in needs_half) for name in tags}
    assert tuple(tags) == BEV_CLASSES

    semantic = np.random.default_rng(3).choice(
        [0, *tags.values()], BEV_SHAPE, p=[0.02, 0.48, 0.04, 0.42, 0.02, 0.02]
    )
    image = BevImage(semantic.astype(np.uint8), _image().instance)
    grid = BevGrid((-3, 3, 0.5), (-2, 2, 0.4))
    targets = segmentation_of(image, grid, augmentation=augmentation)

    back = np.linalg.inv(np.eye(4) if augmentation is None else augmentation.matrix)
    half_road_cells = 0
    for row, column in np.ndindex(10, 12):  # y to the left by rows, x ahead by columns
        counts = dict.fromkeys((0, *tags.values()), 0)
        for along, across in np.ndindex(5, 4):
            x = -3 + column / 2 + 0.1 * (along + 0.5)
            y = -2 + row / 2.5 + 0.1 * (across + 0.5)
            x, y, _, _ = back @ (x, y, 0, 1)
            pixel = semantic.item(round(599.5 - x / 0.1), round(599.5 - y / 0.1))
            counts[pixel] += 1
        half_road_cells += counts[7] == 10
        assert targets.masks[:, row, column].tolist() == [
            counts[tag] >= (10 if name in needs_half else 1) for name, tag in tags.items()
        ]
    assert half_road_cells > 3
