import pickle
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusals import assert_refused

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import SE3, Box, Boxes, box_arrays
from deepaccident_devkit.geometry.box_arrays import BOX_COLUMNS
from deepaccident_devkit.geometry.boxes import concatenate, trusted_boxes


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
    assert_allclose(
        two.corners()[0], [*ahead, [8, 1, 1.75], [8, -1, 1.75], [8, -1, 0.25], [8, 1, 0.25]]
    )
    # front right, front left, rear left, rear right of a box that heads to y
    assert_allclose(
        two.bottom_corners()[1],
        [[0.25, 5.5, 0.1], [-0.25, 5.5, 0.1], [-0.25, 4.5, 0.1], [0.25, 4.5, 0.1]],
    )


def test_columns_and_defaults(two: Boxes) -> None:
    assert two.category_names == ["car", "pedestrian"]
    assert_array_equal(two.category, [0, 5])
    assert_allclose(two.yaw, [0, np.pi / 2])
    plain = Boxes.from_arrays(np.zeros((1, 3)), np.ones((1, 3)), [0.0])
    assert (plain.frame, plain.actor_id[0], plain.num_lidar_pts[0], plain.camera_visible[0]) == (
        "world",
        -1,
        0,
        False,
    )
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


def test_a_number_picks_a_box_and_all_else_picks_boxes(two: Boxes) -> None:
    for number in (1, -1, np.int64(1), np.array(1)):
        box = two[number]
        assert isinstance(box, Box)
        assert (box.actor_id, box.category, box.frame, box.token) == (
            7,
            "pedestrian",
            "lidar",
            None,
        )
    assert repr(list(two)) == repr([two[0], two[1]])
    for which in (slice(1, None), [False, True], [1], np.array([-1]), two.actor_id == 7):
        some = two[which]
        assert isinstance(some, Boxes)
        assert (some.actor_id.tolist(), some.row.tolist()) == ([7], [1])
    assert (two[::-1].actor_id.tolist(), len(two[:0]), len(two[[]]), list(two[:0])) == (
        [7, -100],
        0,
        0,
        [],
    )
    for part in (two[1:], two[[1]], two[0], two.transform(SE3.identity(), "ego"), two.select([0])):
        for name in ("center", "size", "velocity"):
            assert not getattr(part, name).flags.writeable, name


def test_an_index_says_what_it_cannot_pick(two: Boxes) -> None:
    nothing, wrong = (
        r"does not pick from 2 boxes|expected a mask \(2,\)",
        ([2], [True], [0.5], ["0"], [[0], [1]]),
    )
    assert_refused(
        *[
            (partial(two.__getitem__, at), IndexError, ("2 boxes", f"box {at}"))
            for at in (2, -3, np.int64(2))
        ],
        *[(partial(two.select, at), GeometryError, nothing) for at in (0, *wrong)],
        *[
            (partial(two.__getitem__, at), GeometryError, nothing)
            for at in (True, 1.0, "car", None, (0, slice(None)), *wrong)
        ],
        *[
            (
                partial(call, boxes),
                GeometryError,
                r"several arrays; give one of them, such as boxes\.center\)?$",
            )
            for boxes in (two, two[:0])
            for call in (np.asarray, np.array, two.contains, two.select)
        ],
    )


def test_tokens_follow_the_sample(two: Boxes) -> None:
    columns = {name: getattr(two, name) for name in BOX_COLUMNS}
    known = Boxes(frame="lidar", sample="type/name/ego_vehicle/003", **columns)
    tokens = ["type/name/ego_vehicle/003/0", "type/name/ego_vehicle/003/1"]
    moved = known.transform(SE3.identity(), "ego")
    for boxes in (
        known,
        moved,
        pickle.loads(pickle.dumps(known)),
        concatenate([moved[:1], moved[1:]], "ego"),
    ):
        assert (boxes.token, [box.token for box in boxes], boxes[::-1].token) == (
            tokens,
            tokens,
            tokens[::-1],
        )
    for boxes in (
        two,
        concatenate([known, two], "lidar"),
        concatenate([known, two][::-1], "lidar"),
    ):
        assert boxes.token is None
    with pytest.raises(GeometryError, match=r"Boxes\.sample: expected a token or None, found 3"):
        Boxes(frame="lidar", sample=3, **columns)  # type: ignore[arg-type]


def test_contains_takes_faces_in(two: Boxes) -> None:
    points = [
        [12, 1, 1.75],
        [12.001, 0, 1],
        [10, 1.001, 1],
        [10, 0, 0.2],
        [0, 5.5, 1],
        [0.26, 5, 1],
    ]
    inside = [[True, False, False, False, False, False], [False, False, False, False, True, False]]
    assert_array_equal(two.contains(points), inside)
    assert two.contains(np.zeros((0, 3))).shape == (2, 0)


def test_no_boxes_at_all() -> None:
    none = Boxes.from_arrays(np.zeros((0, 3)), np.zeros((0, 3)), [])
    assert (len(none.transform(SE3.identity(), "ego")), none.corners().shape) == (0, (0, 8, 3))
    assert (none.contains([[0, 0, 0]]).shape, none.category_names) == ((0, 1), [])


def test_concatenate_joins_boxes_of_one_frame(two: Boxes) -> None:
    assert_array_equal(concatenate([two, two.select([1])], "lidar").actor_id, [-100, 7, 7])
    assert_refused(
        (
            lambda: concatenate([two], "world"),
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
        ({"category": ["car", "tank"]}, r"unknown category \['tank'\]; known are car, truck"),
        ({"colour": ["red", "blue"]}, r"no column \['colour'\]; it has \['center'"),
        ({"center": "nowhere"}, "Boxes.center: expected an array"),
    ],
)
def test_wrong_columns_are_refused_by_name(columns: dict[str, object], message: str) -> None:
    good = {"center": np.zeros((2, 3)), "size": np.ones((2, 3)), "yaw": np.zeros(2)}
    assert_refused(
        (lambda: Boxes.from_arrays(**{**good, **columns}), GeometryError, message),
    )


@pytest.fixture
def square() -> Boxes:
    """2 × 2 × 2 around the origin."""
    return Boxes.from_arrays([[0, 0, 0]], [[2, 2, 2]], [0], frame="lidar")


def test_iou_by_hand(square: Boxes) -> None:
    centers = [[0, 0, 0], [1, 0, 0], [1, 1, 1], [2, 0, 0], [0, 0, 3], [5, 5, 0], [0, 0, 0]]
    others = Boxes.from_arrays(
        centers, [[2, 2, 2]] * 6 + [[1, 1, 1]], [0, np.pi / 2, np.pi, 0, 0, 0, 0], frame="lidar"
    )
    assert_allclose(square.iou_bev(others), [[1, 1 / 3, 1 / 7, 0, 1, 0, 1 / 4]], atol=1e-15)
    assert_allclose(square.iou_3d(others), [[1, 1 / 3, 1 / 15, 0, 0, 0, 1 / 8]], atol=1e-15)
    star = Boxes.from_arrays(
        [[0, 0, 0]], [[2, 2, 2]], [np.pi / 4], frame="lidar"
    )  # a regular octagon in common
    octagon = 8 * np.tan(np.pi / 8)
    assert square.iou_bev(star)[0, 0] == pytest.approx(octagon / (8 - octagon), abs=1e-12)


def test_gap_by_hand(square: Boxes) -> None:
    """Side by side, corner to corner, corner to edge, edges crossing with no corner inside,
    touching, above.
    """
    centers = [[4, 0, 0], [4, 5, 0], [3, 0, 0], [0, 0, 0], [2, 0, 0], [0, 0, 9]]
    sizes = [[2, 2, 2], [2, 2, 2], [2, 2, 2], [9, 0.5, 1], [2, 1, 1], [1, 1, 1]]
    others = Boxes.from_arrays(centers, sizes, [0, np.pi, np.pi / 4, 0.1, 0, 0], frame="lidar")
    assert_allclose(
        square.distance_bev(others), [[2, np.hypot(2, 3), 2 - np.sqrt(2), 0, 0, 0]], atol=1e-12
    )


def test_tilted_boxes_count_as_if_upright(square: Boxes) -> None:
    nod = SE3.from_six([0, 0, 0, 0, 0.3, 0])
    assert_allclose(square.transform(nod, "lidar").iou_bev(square), [[1]])
    assert_allclose(square.transform(nod, "lidar").iou_3d(square), [[1]])


def test_boxes_without_area_overlap_nothing(square: Boxes) -> None:
    flat = Boxes.from_arrays([[0, 0, 0]] * 2, [[0, 2, 1], [0, 0, 0]], [0, 0], frame="lidar")
    for iou in (flat.iou_bev(flat), flat.iou_3d(flat)):
        assert_array_equal(iou, np.zeros((2, 2)))
    assert_array_equal(flat.iou_bev(square), np.zeros((2, 1)))
    assert_array_equal(flat.distance_bev(square), np.zeros((2, 1)))
    assert_array_equal(square.contains([[np.nan, 0, 0], [0, np.inf, 0]]), [[False, False]])


@pytest.mark.parametrize("column", ["center", "size", "rotation"])
def test_boxes_that_are_nowhere_have_no_gap_and_hold_nothing(square: Boxes, column: str) -> None:
    columns = {name: getattr(square, name).copy() for name in BOX_COLUMNS}
    columns[column][0, 0] = np.nan
    nowhere = trusted_boxes("lidar", columns)  # the constructor takes none
    assert_array_equal(nowhere.distance_bev(square), [[np.nan]])
    assert_array_equal(square.distance_bev(nowhere), [[np.nan]])
    assert_array_equal(nowhere.contains([[0, 0, 0]]), [[False]])
    if column != "rotation":
        assert_array_equal(nowhere.iou_bev(square), [[0]])


@pytest.mark.parametrize("compare", ["iou_bev", "iou_3d", "distance_bev"])
def test_comparing_needs_one_frame_with_a_ground(two: Boxes, compare: str) -> None:
    none = two.select([])
    assert (getattr(two, compare)(none).shape, getattr(none, compare)(two).shape) == (
        (2, 0),
        (0, 2),
    )
    elsewhere = two.transform(SE3.identity(), "ego")
    assert_refused(
        (
            lambda: getattr(two, compare)(elsewhere),
            GeometryError,
            "'lidar' cannot be compared with those of 'ego'; transform them first",
        ),
    )
    in_camera = two.transform(SE3.identity(), "Camera_Back")
    assert_refused(
        (
            lambda: getattr(in_camera, compare)(in_camera),
            GeometryError,
            r"Camera_Back have no ground plane, .*; transform them to ego or lidar",
        ),
    )


def test_counts_are_those_of_contains(two: Boxes) -> None:
    points = np.array([[10, 0, 1], [11, 0.5, 1], [0, 5, 1], [50, 50, 1]])
    assert_array_equal(two.count_points(points), [2, 1])
    assert two.count_points(points).dtype == np.int64
    assert_array_equal(two.count_points(np.zeros((0, 3))), [0, 0])
    assert two.select([]).count_points(points).shape == (0,)
    assert_refused(
        (lambda: two.count_points([1, 2, 3]), GeometryError, r"points: expected shape \(N, 3\)"),
    )


def test_many_pairs_are_worked_off_in_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    some = Boxes.from_arrays(
        rng.normal(size=(40, 3)) * 5, rng.uniform(1, 5, (40, 3)), rng.uniform(-3, 3, 40)
    )
    points = rng.normal(size=(300, 3)) * 5
    whole = some.iou_bev(some), some.distance_bev(some), some.contains(points)
    monkeypatch.setattr(box_arrays, "PAIRS_AT_ONCE", 7)
    monkeypatch.setattr(box_arrays, "POINTS_AT_ONCE", 7)
    for have, want in zip(
        (some.iou_bev(some), some.distance_bev(some), some.contains(points)), whole, strict=True
    ):
        assert_array_equal(have, want)


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
    two: Boxes, columns: dict[str, object], message: str
) -> None:
    good = {name: getattr(two, name) for name in ("frame", *BOX_COLUMNS)}
    assert_refused(
        (lambda: Boxes(**{**good, **columns}), GeometryError, message),
    )


def test_names_and_nearly_unit_quaternions_are_taken(two: Boxes) -> None:
    good = {name: getattr(two, name) for name in ("frame", *BOX_COLUMNS)}
    made = Boxes(**{**good, "category": ["van", "car"], "rotation": two.rotation * 1.0005})
    assert_array_equal(made.category, [2, 0])
    assert_allclose(made.rotation, two.rotation, atol=1e-15)
    assert_array_equal(Boxes(**good).rotation, two.rotation)


def test_other_things_than_boxes_and_transforms_are_refused(two: Boxes) -> None:
    assert_refused(
        *[
            (partial(compare, None), GeometryError, "other: expected Boxes, found NoneType")
            for compare in (two.iou_bev, two.iou_3d, two.distance_bev)
        ],
        (
            lambda: Box([]),
            GeometryError,
            r"a Box is one row of Boxes, found list; boxes\[0\] picks one",
        ),
        (
            lambda: two.transform(np.eye(4), "ego"),
            GeometryError,
            "target_from_source: expected an SE3, found ndarray; of a matrix",
        ),
        (
            lambda: two.transform(SE3.identity(), 5),
            GeometryError,
            r"frame: expected the name of a frame, .* found 5",
        ),
    )
