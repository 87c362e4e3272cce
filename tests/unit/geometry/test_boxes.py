import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import SE3, Boxes
from deepaccident_devkit.geometry.boxes import concatenate


@pytest.fixture
def two() -> Boxes:
    return Boxes.from_arrays(
        [[10, 0, 1], [0, 5, 1]],
        [[4, 2, 1.5], [1, 0.5, 1.8]],
        [0, np.pi / 2],
        frame="lidar",
        category=["car", "pedestrian"],
        velocity=[[3, 0, 0], [np.nan] * 3],
        actor_id=[-100, 7],
    )


def test_corners_in_the_nuscenes_order(two: Boxes) -> None:
    ahead = [[12, 1, 1.75], [12, -1, 1.75], [12, -1, 0.25], [12, 1, 0.25]]
    behind = [[8, 1, 1.75], [8, -1, 1.75], [8, -1, 0.25], [8, 1, 0.25]]
    assert_allclose(two.corners()[0], ahead + behind)
    # front right, front left, rear left, rear right of a box that heads to y
    assert_allclose(two.bottom_corners()[1], [[0.25, 5.5, 0.1], [-0.25, 5.5, 0.1], [-0.25, 4.5, 0.1], [0.25, 4.5, 0.1]])


def test_columns_and_defaults(two: Boxes) -> None:
    assert two.category_names == ["car", "pedestrian"]
    assert_array_equal(two.category, [0, 5])
    assert_allclose(two.yaw, [0, np.pi / 2])
    plain = Boxes.from_arrays(np.zeros((1, 3)), np.ones((1, 3)), [0.0])
    assert (plain.frame, plain.actor_id[0], plain.num_lidar_pts[0], plain.camera_visible[0]) == ("world", -1, 0, False)
    assert np.isnan(plain.velocity).all()
    assert plain.category_names == ["car"]


def test_a_turn_to_the_left_turns_all_of_it(two: Boxes) -> None:
    moved = two.transform(SE3.from_yaw(np.pi / 2, (0, 0, 2)), "ego")
    assert moved.frame == "ego"
    assert_allclose(moved.center, [[0, 10, 3], [-5, 0, 3]], atol=1e-12)
    assert_allclose(moved.yaw, [np.pi / 2, np.pi])
    assert_allclose(moved.velocity, [[0, 3, 0], [np.nan] * 3], atol=1e-12)
    assert_array_equal(moved.size, two.size)


def test_select_by_mask_and_by_index(two: Boxes) -> None:
    for which in ([False, True], [1], np.array([1]), [-1]):
        one = two.select(which)
        assert (len(one), one.actor_id[0], one.row[0]) == (1, 7, 1)
    for nothing in ([], np.zeros(0, dtype=int), [False, False]):
        assert len(two.select(nothing)) == 0


@pytest.mark.parametrize("which", [0, [2], [True], [0.5], ["0"], [[0], [1]]])
def test_select_says_what_it_cannot_pick(two: Boxes, which: object) -> None:
    with pytest.raises(GeometryError, match=r"does not pick from 2 boxes|expected a mask \(2,\)"):
        two.select(which)  # type: ignore[arg-type]


def test_contains_takes_faces_in(two: Boxes) -> None:
    points = [[12, 1, 1.75], [12.001, 0, 1], [10, 1.001, 1], [10, 0, 0.2], [0, 5.5, 1], [0.26, 5, 1]]
    inside = [[True, False, False, False, False, False], [False, False, False, False, True, False]]
    assert_array_equal(two.contains(points), inside)
    assert two.contains(np.zeros((0, 3))).shape == (2, 0)


def test_no_boxes_at_all() -> None:
    none = Boxes.from_arrays(np.zeros((0, 3)), np.zeros((0, 3)), [])
    assert len(none.transform(SE3.identity(), "ego")) == 0
    assert none.corners().shape == (0, 8, 3)
    assert none.contains([[0, 0, 0]]).shape == (0, 1)
    assert none.category_names == []


def test_concatenate_joins_boxes_of_one_frame(two: Boxes) -> None:
    joined = concatenate([two, two.select([1])], "lidar")
    assert_array_equal(joined.actor_id, [-100, 7, 7])
    with pytest.raises(GeometryError, match="'lidar' cannot join those of 'world'; transform them first"):
        concatenate([two], "world")


def test_arrays_are_read_only_and_the_callers_are_not(two: Boxes) -> None:
    center = np.zeros((1, 3))
    made = Boxes.from_arrays(center, np.ones((1, 3)), [0.0])
    for boxes in (made, two.transform(SE3.identity(), "ego"), two.select([0])):
        for array in (boxes.center, boxes.size, boxes.rotation, boxes.velocity, boxes.category, boxes.camera_visible):
            with pytest.raises(ValueError, match="read-only"):
                array[0] = 1
    center[0] = 1  # must not raise


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"size": np.ones((3, 3))}, r"Boxes.size: expected shape \(2, 3\), found \(3, 3\)"),
        ({"center": np.ones((2, 2))}, r"Boxes.center: expected shape \(2, 3\)"),
        ({"yaw": [[0.0], [0.0]]}, r"Boxes.yaw: expected shape \(N\)"),
        ({"velocity": np.ones((2, 2))}, r"Boxes.velocity: expected shape \(2, 3\)"),
        ({"actor_id": [1]}, r"Boxes.actor_id: expected shape \(2\)"),
        ({"category": [0, 6]}, r"category codes are 0 to 5 \(car, .*\), found \[0 6\]"),
        ({"category": [-1, 0]}, r"category codes are 0 to 5"),
        ({"category": [0.5, 0]}, r"category codes are 0 to 5"),
        ({"category": ["car", "tank"]}, r"unknown category \['tank'\]; known are car, truck"),
        ({"colour": ["red", "blue"]}, r"no column \['colour'\]; it has \['center'"),
        ({"center": "nowhere"}, "Boxes.center: expected an array"),
    ],
)
def test_wrong_columns_are_refused_by_name(columns: dict[str, object], message: str) -> None:
    good = {"center": np.zeros((2, 3)), "size": np.ones((2, 3)), "yaw": np.zeros(2)}
    with pytest.raises(GeometryError, match=message):
        Boxes.from_arrays(**{**good, **columns})
