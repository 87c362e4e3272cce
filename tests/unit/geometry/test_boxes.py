import pickle
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import SE3, Box, Boxes, box_arrays
from deepaccident_devkit.geometry.box_arrays import BOX_COLUMNS
from deepaccident_devkit.geometry.boxes import concatenate, trusted_boxes


@pytest.fixture
def two_boxes() -> Boxes:
    return Boxes.from_arrays(
        [[10, 0, 1], [0, 5, 1]],
        [[4, 2, 1.5], [1, 0.5, 1.8]],
        [0, np.pi / 2],
        frame="lidar",
        category=["car", "pedestrian"],
        velocity=[[3, 0, 0], [np.nan] * 3],
        actor_id=[-100, 7],
    )


def test_corners_in_the_nuscenes_order(two_boxes: Boxes) -> None:
    front = [[12, 1, 1.75], [12, -1, 1.75], [12, -1, 0.25], [12, 1, 0.25]]
    rear = [[8, 1, 1.75], [8, -1, 1.75], [8, -1, 0.25], [8, 1, 0.25]]

    assert_allclose(two_boxes.corners()[0], front + rear)
    # front right, front left, rear left, rear right of a box that heads to y
    assert_allclose(
        two_boxes.bottom_corners()[1],
        [[0.25, 5.5, 0.1], [-0.25, 5.5, 0.1], [-0.25, 4.5, 0.1], [0.25, 4.5, 0.1]],
    )


def test_columns_and_defaults(two_boxes: Boxes) -> None:
    assert two_boxes.category_names == ["car", "pedestrian"]
    assert_array_equal(two_boxes.category, [0, 5])
    assert_allclose(two_boxes.yaw, [0, np.pi / 2])
    plain_boxes = Boxes.from_arrays(np.zeros((1, 3)), np.ones((1, 3)), [0.0])
    assert plain_boxes.frame == "world"
    assert plain_boxes.actor_id[0] == -1
    assert plain_boxes.num_lidar_pts[0] == 0
    assert not plain_boxes.camera_visible[0]
    assert np.isnan(plain_boxes.velocity).all()
    assert plain_boxes.category_names == ["car"]


def test_a_turn_to_the_left_turns_center_yaw_and_velocity(two_boxes: Boxes) -> None:
    moved_boxes = two_boxes.transform(SE3.from_yaw(np.pi / 2, (0, 0, 2)), "ego")
    assert moved_boxes.frame == "ego"
    assert_allclose(moved_boxes.center, [[0, 10, 3], [-5, 0, 3]], atol=1e-12)
    assert_allclose(moved_boxes.yaw, [np.pi / 2, np.pi])
    assert_allclose(moved_boxes.velocity, [[0, 3, 0], [np.nan] * 3], atol=1e-12)
    assert_array_equal(moved_boxes.size, two_boxes.size)


def test_select_by_mask_and_by_index(two_boxes: Boxes) -> None:
    for index in ([False, True], [1], np.array([1]), [-1]):
        selected_boxes = two_boxes.select(index)
        assert selected_boxes.actor_id.tolist() == [7]
        assert selected_boxes.row.tolist() == [1]
    for empty_index in ([], np.zeros(0, dtype=int), [False, False]):
        assert len(two_boxes.select(empty_index)) == 0


def test_a_number_picks_a_box_and_any_other_index_picks_boxes(two_boxes: Boxes) -> None:
    for number in (1, -1, np.int64(1), np.array(1)):
        box = two_boxes[number]
        assert isinstance(box, Box)
        assert (box.actor_id, box.category, box.frame) == (7, "pedestrian", "lidar")
        assert box.token is None
    assert repr(list(two_boxes)) == repr([two_boxes[0], two_boxes[1]])
    for index in (slice(1, None), [False, True], [1], np.array([-1]), two_boxes.actor_id == 7):
        picked_boxes = two_boxes[index]
        assert isinstance(picked_boxes, Boxes)
        assert picked_boxes.actor_id.tolist() == [7]
        assert picked_boxes.row.tolist() == [1]

    assert two_boxes[::-1].actor_id.tolist() == [7, -100]
    assert len(two_boxes[:0]) == 0
    assert len(two_boxes[[]]) == 0
    assert list(two_boxes[:0]) == []

    in_ego = two_boxes.transform(SE3.identity(), "ego")
    for part in (two_boxes[1:], two_boxes[[1]], two_boxes[0], in_ego, two_boxes.select([0])):
        for name in ("center", "size", "velocity"):
            assert not getattr(part, name).flags.writeable, name


def test_an_index_says_what_it_cannot_pick(two_boxes: Boxes) -> None:
    no_pick = r"does not pick from 2 boxes|expected a mask \(2,\)"
    wrong_indices = ([2], [True], [0.5], ["0"], [[0], [1]])

    assert_raises(
        *[
            (partial(two_boxes.__getitem__, number), IndexError, ("2 boxes", f"box {number}"))
            for number in (2, -3, np.int64(2))
        ],
        *[
            (partial(two_boxes.select, index), GeometryError, no_pick)
            for index in (0, *wrong_indices)
        ],
        *[
            (partial(two_boxes.__getitem__, index), GeometryError, no_pick)
            for index in (True, 1.0, "car", None, (0, slice(None)), *wrong_indices)
        ],
        *[
            (
                partial(call, boxes),
                GeometryError,
                r"several arrays; give one array, such as boxes\.center\)?$",
            )
            for boxes in (two_boxes, two_boxes[:0])
            for call in (np.asarray, np.array, two_boxes.contains, two_boxes.select)
        ],
    )


def test_tokens_follow_the_sample(two_boxes: Boxes) -> None:
    columns = {name: getattr(two_boxes, name) for name in BOX_COLUMNS}
    known_boxes = Boxes(frame="lidar", sample="type/name/ego_vehicle/003", **columns)
    moved_boxes = known_boxes.transform(SE3.identity(), "ego")
    copied_boxes = pickle.loads(pickle.dumps(known_boxes))
    tokens = ["type/name/ego_vehicle/003/0", "type/name/ego_vehicle/003/1"]
    for boxes in (
        known_boxes,
        moved_boxes,
        copied_boxes,
        concatenate([moved_boxes[:1], moved_boxes[1:]], "ego"),
    ):
        assert boxes.token == tokens
        assert [box.token for box in boxes] == tokens
        assert boxes[::-1].token == tokens[::-1]

    assert two_boxes.token is None
    assert concatenate([known_boxes, two_boxes], "lidar").token is None
    assert concatenate([two_boxes, known_boxes], "lidar").token is None
    with pytest.raises(GeometryError, match=r"Boxes\.sample: expected a token or None, found 3"):
        Boxes(frame="lidar", sample=3, **columns)  # type: ignore[arg-type]


def test_points_on_a_face_are_inside(two_boxes: Boxes) -> None:
    points = [
        [12, 1, 1.75],
        [12.001, 0, 1],
        [10, 1.001, 1],
        [10, 0, 0.2],
        [0, 5.5, 1],
        [0.26, 5, 1],
    ]
    inside = [[True, False, False, False, False, False], [False, False, False, False, True, False]]

    assert_array_equal(two_boxes.contains(points), inside)
    assert two_boxes.contains(np.zeros((0, 3))).shape == (2, 0)


def test_no_boxes_at_all() -> None:
    no_boxes = Boxes.from_arrays(np.zeros((0, 3)), np.zeros((0, 3)), [])
    assert len(no_boxes.transform(SE3.identity(), "ego")) == 0
    assert no_boxes.corners().shape == (0, 8, 3)
    assert no_boxes.contains([[0, 0, 0]]).shape == (0, 1)
    assert no_boxes.category_names == []


def test_concatenate_joins_boxes_of_one_frame(two_boxes: Boxes) -> None:
    assert_array_equal(
        concatenate([two_boxes, two_boxes.select([1])], "lidar").actor_id, [-100, 7, 7]
    )
    assert_raises(
        (
            lambda: concatenate([two_boxes], "world"),
            GeometryError,
            "'lidar' cannot join those of 'world'; transform them first",
        ),
    )


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"size": np.ones((3, 3))}, r"Boxes.size: expected shape \(2, 3\), found \(3, 3\)"),
        ({"center": np.ones((2, 2))}, r"Boxes.center: expected shape \(N, 3\)"),
        ({"yaw": [[0.0], [0.0]]}, r"Boxes.yaw: expected shape \(N\)"),
        ({"velocity": np.ones((2, 2))}, r"Boxes.velocity: expected shape \(2, 3\)"),
        ({"actor_id": [1]}, r"Boxes.actor_id: expected shape \(2\)"),
        ({"category": [0, 6]}, r"category codes are 0 to 5 \(car, .*\), found \[0 6\]"),
        ({"category": [-1, 0]}, r"category codes are 0 to 5"),
        ({"category": [0.5, 0]}, r"category codes are 0 to 5"),
        ({"category": ["car", "tank"]}, r"unknown category \['tank'\]; expected car, truck"),
        ({"colour": ["red", "blue"]}, r"no column \['colour'\]; it has \['center'"),
        ({"center": "nowhere"}, "Boxes.center: expected an array"),
    ],
)
def test_wrong_columns_are_refused_by_name(columns: dict[str, object], message: str) -> None:
    good_columns = {"center": np.zeros((2, 3)), "size": np.ones((2, 3)), "yaw": np.zeros(2)}
    assert_raises(
        (lambda: Boxes.from_arrays(**{**good_columns, **columns}), GeometryError, message),
    )


@pytest.fixture
def square() -> Boxes:
    """Return a cube of 2 m around the origin."""
    return Boxes.from_arrays([[0, 0, 0]], [[2, 2, 2]], [0], frame="lidar")


def test_iou_by_hand(square: Boxes) -> None:
    centers = [[0, 0, 0], [1, 0, 0], [1, 1, 1], [2, 0, 0], [0, 0, 3], [5, 5, 0], [0, 0, 0]]
    sizes = [[2, 2, 2]] * 6 + [[1, 1, 1]]
    yaws = [0, np.pi / 2, np.pi, 0, 0, 0, 0]
    boxes = Boxes.from_arrays(centers, sizes, yaws, frame="lidar")
    assert_allclose(square.iou_bev(boxes), [[1, 1 / 3, 1 / 7, 0, 1, 0, 1 / 4]], atol=1e-15)
    assert_allclose(square.iou_3d(boxes), [[1, 1 / 3, 1 / 15, 0, 0, 0, 1 / 8]], atol=1e-15)

    # both cover a regular octagon
    diamond = Boxes.from_arrays([[0, 0, 0]], [[2, 2, 2]], [np.pi / 4], frame="lidar")
    octagon_area = 8 * np.tan(np.pi / 8)
    expected = octagon_area / (8 - octagon_area)
    assert square.iou_bev(diamond)[0, 0] == pytest.approx(expected, abs=1e-12)


def test_gap_by_hand(square: Boxes) -> None:
    """The boxes stand side by side, corner to corner and corner to edge; then one crosses without a
    corner inside, one touches and one is above.
    """
    centers = [[4, 0, 0], [4, 5, 0], [3, 0, 0], [0, 0, 0], [2, 0, 0], [0, 0, 9]]
    sizes = [[2, 2, 2], [2, 2, 2], [2, 2, 2], [9, 0.5, 1], [2, 1, 1], [1, 1, 1]]
    yaws = [0, np.pi, np.pi / 4, 0.1, 0, 0]
    boxes = Boxes.from_arrays(centers, sizes, yaws, frame="lidar")
    expected = [[2, np.hypot(2, 3), 2 - np.sqrt(2), 0, 0, 0]]
    assert_allclose(square.distance_bev(boxes), expected, atol=1e-12)


def test_tilted_boxes_count_as_if_upright(square: Boxes) -> None:
    tilted_boxes = square.transform(SE3.from_six([0, 0, 0, 0, 0.3, 0]), "lidar")
    assert_allclose(tilted_boxes.iou_bev(square), [[1]])
    assert_allclose(tilted_boxes.iou_3d(square), [[1]])


def test_boxes_without_area_overlap_nothing(square: Boxes) -> None:
    flat_boxes = Boxes.from_arrays([[0, 0, 0]] * 2, [[0, 2, 1], [0, 0, 0]], [0, 0], frame="lidar")
    for iou in (flat_boxes.iou_bev(flat_boxes), flat_boxes.iou_3d(flat_boxes)):
        assert_array_equal(iou, np.zeros((2, 2)))
    assert_array_equal(flat_boxes.iou_bev(square), np.zeros((2, 1)))
    assert_array_equal(flat_boxes.distance_bev(square), np.zeros((2, 1)))
    assert_array_equal(square.contains([[np.nan, 0, 0], [0, np.inf, 0]]), [[False, False]])


@pytest.mark.parametrize("column", ["center", "size", "rotation"])
def test_boxes_at_nan_have_no_gap_and_contain_nothing(square: Boxes, column: str) -> None:
    columns = {name: getattr(square, name).copy() for name in BOX_COLUMNS}
    columns[column][0, 0] = np.nan
    nan_boxes = trusted_boxes("lidar", columns)  # the constructor takes none

    assert_array_equal(nan_boxes.distance_bev(square), [[np.nan]])
    assert_array_equal(square.distance_bev(nan_boxes), [[np.nan]])
    assert_array_equal(nan_boxes.contains([[0, 0, 0]]), [[False]])
    if column != "rotation":
        assert_array_equal(nan_boxes.iou_bev(square), [[0]])


@pytest.mark.parametrize("method", ["iou_bev", "iou_3d", "distance_bev"])
def test_comparing_needs_one_frame_with_a_ground(two_boxes: Boxes, method: str) -> None:
    no_boxes = two_boxes.select([])
    assert getattr(two_boxes, method)(no_boxes).shape == (2, 0)
    assert getattr(no_boxes, method)(two_boxes).shape == (0, 2)
    in_ego = two_boxes.transform(SE3.identity(), "ego")
    assert_raises(
        (
            lambda: getattr(two_boxes, method)(in_ego),
            GeometryError,
            "'lidar' cannot be compared with those of 'ego'; transform them first",
        ),
    )
    in_camera = two_boxes.transform(SE3.identity(), "Camera_Back")
    assert_raises(
        (
            lambda: getattr(in_camera, method)(in_camera),
            GeometryError,
            r"Camera_Back have no ground plane, .*; transform the boxes to ego or lidar",
        ),
    )


def test_point_counts_agree_with_contains(two_boxes: Boxes) -> None:
    points = np.array([[10, 0, 1], [11, 0.5, 1], [0, 5, 1], [50, 50, 1]])
    assert_array_equal(two_boxes.count_points(points), [2, 1])
    assert two_boxes.count_points(points).dtype == np.int64
    assert_array_equal(two_boxes.count_points(np.zeros((0, 3))), [0, 0])
    assert two_boxes.select([]).count_points(points).shape == (0,)
    assert_raises(
        (
            lambda: two_boxes.count_points([1, 2, 3]),
            GeometryError,
            r"points: expected shape \(N, 3\)",
        ),
    )


def test_many_pairs_are_worked_off_in_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    boxes = Boxes.from_arrays(
        rng.normal(size=(40, 3)) * 5, rng.uniform(1, 5, (40, 3)), rng.uniform(-3, 3, 40)
    )
    points = rng.normal(size=(300, 3)) * 5
    overlaps = boxes.iou_bev(boxes)
    distances = boxes.distance_bev(boxes)
    inside = boxes.contains(points)

    monkeypatch.setattr(box_arrays, "PAIRS_AT_ONCE", 7)
    monkeypatch.setattr(box_arrays, "POINTS_AT_ONCE", 7)
    assert_array_equal(boxes.iou_bev(boxes), overlaps)
    assert_array_equal(boxes.distance_bev(boxes), distances)
    assert_array_equal(boxes.contains(points), inside)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        (
            {"center": [[0, 0, 0], [np.nan, 0, 0]]},
            r"Boxes.center: expected finite numbers, found \[nan, .* in row 1",
        ),
        (
            {"size": [[1, 1, np.inf], [1, 1, 1]]},
            r"Boxes.size: expected finite numbers, found .* in row 0",
        ),
        (
            {"size": [[1, 1, 1], [1, -1, 1]]},
            r"Boxes.size: expected lengths, widths and heights from 0, .* in row 1",
        ),
        (
            {"rotation": [[1, 0, 0, 0], [0, 0, 0, 0]]},
            r"Boxes.rotation: expected unit quaternions .* in row 1",
        ),
        (
            {"rotation": [[2, 0, 0, 2], [1, 0, 0, 0]]},
            r"Boxes.rotation: expected unit quaternions .* in row 0",
        ),
        (
            {"rotation": [[np.nan, 0, 0, 1], [1, 0, 0, 0]]},
            "Boxes.rotation: expected finite numbers",
        ),
        ({"category": [0, 77]}, r"category codes are 0 to 5 \(car, .* found \[ 0 77\]"),
        ({"category": [0, 300]}, "category codes are 0 to 5"),
        ({"actor_id": [1.7, 2]}, "Boxes.actor_id: expected whole numbers of int64"),
        (
            {"frame": 7},
            "Boxes.frame: expected the name of a frame, such as 'world', 'ego' or 'lidar', found 7",
        ),
        ({"frame": ""}, "Boxes.frame: expected the name of a frame"),
        ({"center": [[1, 2], [1, 2, 3]]}, "Boxes.center: expected an array"),
    ],
)
def test_numbers_that_are_no_boxes_are_refused(
    two_boxes: Boxes, columns: dict[str, object], message: str
) -> None:
    good_columns = {name: getattr(two_boxes, name) for name in ("frame", *BOX_COLUMNS)}
    assert_raises(
        (lambda: Boxes(**{**good_columns, **columns}), GeometryError, message),
    )


def test_names_and_nearly_unit_quaternions_are_taken(two_boxes: Boxes) -> None:
    good_columns = {name: getattr(two_boxes, name) for name in ("frame", *BOX_COLUMNS)}
    boxes = Boxes(
        **{**good_columns, "category": ["van", "car"], "rotation": two_boxes.rotation * 1.0005}
    )

    assert_array_equal(boxes.category, [2, 0])
    assert_allclose(boxes.rotation, two_boxes.rotation, atol=1e-15)
    assert_array_equal(Boxes(**good_columns).rotation, two_boxes.rotation)


def test_values_that_are_no_boxes_or_transforms_are_refused(two_boxes: Boxes) -> None:
    assert_raises(
        *[
            (partial(compare, None), GeometryError, "other: expected Boxes, found NoneType")
            for compare in (two_boxes.iou_bev, two_boxes.iou_3d, two_boxes.distance_bev)
        ],
        (
            lambda: Box([]),
            GeometryError,
            r"a Box is one row of Boxes, found list; boxes\[0\] picks one",
        ),
        (
            lambda: two_boxes.transform(np.eye(4), "ego"),
            GeometryError,
            "target_from_source: expected an SE3, found ndarray; make an SE3 from a matrix",
        ),
        (
            lambda: two_boxes.transform(SE3.identity(), 5),
            GeometryError,
            r"frame: expected the name of a frame, .* found 5",
        ),
    )
