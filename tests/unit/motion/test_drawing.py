"""Labels of boxes: which actors are drawn and where, missing frames, ids, centres and vectors."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import ConfigError, GeometryError
from deepaccident_devkit.geometry import SE3, BevGrid, conventions
from deepaccident_devkit.geometry.bev_grid import axes_of, to_orientation
from deepaccident_devkit.motion import (
    LABEL_PROTOCOLS,
    OWN_BOX_ID,
    Augmentation,
    FrameBoxes,
    MotionLabelConfig,
    drawing,
    motion_labels_from_boxes,
)
from deepaccident_devkit.motion.box_polygons import Footprints, box_polygons
from deepaccident_devkit.motion.drawing import following_centers
from deepaccident_devkit.motion.reference_arithmetic.polygon_fill import topmost
from deepaccident_devkit.motion.warping import sampling_matrix

STILL = np.zeros((7, 6))
RELEASED, CLEAN = LABEL_PROTOCOLS["released"], LABEL_PROTOCOLS["clean"]


def make_frame(*rows, lidar=None) -> FrameBoxes:
    """Make a frame of rows (x, y, id, category, visible): cars of 4 × 2 m that point ahead."""
    table = np.array(rows, dtype=float).reshape(-1, 5)
    return FrameBoxes(
        center=np.column_stack([table[:, :2], np.zeros(len(table))]),
        size=np.tile([4.0, 2.0, 1.5], (len(table), 1)),
        yaw=np.zeros(len(table)),
        actor_id=table[:, 2],
        category=table[:, 3],
        visible=table[:, 4] > 0,
        ego_from_lidar=np.eye(4) if lidar is None else lidar.matrix,
    )


OWN = (0, 0, -100, 0, 0)


def draw_labels(frames, motion=STILL, **changes):
    return motion_labels_from_boxes(frames, motion, MotionLabelConfig(**changes))


@pytest.mark.parametrize("augmentation", [None, Augmentation(rotation=0.2, scale=1.1, flip=True)])
def test_without_a_lean_both_rules_of_poses_give_the_same_corners(
    augmentation: Augmentation | None,
) -> None:
    boxes = make_frame(
        (10, -5, 7, 0, 1),
        (-3, 8, 8, 0, 1),
        (0, 30, 9, 0, 1),
        lidar=SE3.from_yaw(0.3, (1.0, -2.0, 0.5)),
    )
    size = boxes.size * ([1, 1, 1], [2, 1, 1], [-1, -1, 1])  # a release may have negative ones
    boxes = replace(boxes, yaw=np.array([0.4, -2.0, 3.0]), size=size)

    corners_by_pose = {}
    for pose in ("whole", "yaw"):
        config = MotionLabelConfig(
            augmentation=augmentation, draw_ego=False, protocol=replace(RELEASED, pose=pose)
        )
        (polygons,) = box_polygons([boxes], config)
        corners_by_pose[pose] = [np.array(sorted(corners.tolist())) for corners in polygons.corners]
    assert_allclose(corners_by_pose["yaw"], corners_by_pose["whole"], atol=1e-4)


def test_a_car_lies_where_it_is_and_so_does_its_centre() -> None:
    """Centre (10, −5): columns 120 ± 4, rows 90 ± 2, cell edges rounded up half a cell as the
    released code does.
    """
    labels = draw_labels([make_frame((10, -5, 7, 0, 1))] * 5, draw_ego=False)
    instance = labels.instance[0]
    peak = labels.centerness[0, 0]

    rows, columns = np.nonzero(instance)
    assert (rows.min(), rows.max()) == (87, 91)
    assert (columns.min(), columns.max()) == (116, 124)
    assert labels.id_map == {7: 1}
    assert_array_equal(labels.segmentation, labels.instance > 0)
    assert peak[89, 120] == 1
    assert_array_equal(np.argwhere(peak == 1), [[89, 120]])
    assert peak[92, 120] == pytest.approx(np.exp(-1))
    assert_array_equal(labels.offset[0, :, 91, 116], [-2, 4])
    assert_array_equal(labels.flow[0, :, 91, 116], [0, 0])
    assert (labels.offset[:, :, instance == 0] == 255).all()
    assert (labels.flow[4] == 255).all()


def test_flow_is_seen_from_this_frames_ego() -> None:
    """The ego drives 2 m ahead a step past a standing car, which therefore moves 4 cells to the
    rear only in the next frame's own axes.
    """
    ahead = STILL.copy()
    ahead[:, 0] = -2
    frames = [make_frame((10 - 2 * t, 5, 7, 0, 1)) for t in range(5)]
    standing = draw_labels(frames, ahead, protocol="clean", draw_ego=False)
    car_flow = standing.flow[:4, :, standing.instance[0] > 0][0]
    assert_array_equal(np.unique(car_flow), [0])

    frames = [make_frame((10 + t, 5 + 0.5 * t, 7, 0, 1)) for t in range(5)]
    moving = draw_labels(frames, protocol="clean", draw_ego=False)
    row, column = np.argwhere(moving.instance[0])[0]
    assert_array_equal(moving.flow[0, :, row, column], [1, 2])


def test_a_protocol_chooses_when_an_actor_is_drawn() -> None:
    """Actor 1 is seen only at first, 2 only later, 3 always."""
    frames = [
        make_frame((0, 10, 1, 0, t == 0), (0, 20, 2, 0, t >= 2), (0, 30, 3, 0, 1)) for t in range(5)
    ]
    for when, expected in {
        "present": [{1, 3}] * 5,
        "since": [{1, 3}, {1, 3}, {1, 2, 3}, {1, 2, 3}, {1, 2, 3}],
        "now": [{1, 3}, {3}, {2, 3}, {2, 3}, {2, 3}],
    }.items():
        config = MotionLabelConfig(protocol=replace(RELEASED, drawn_when=when), draw_ego=False)
        drawn = box_polygons(frames, config)
        assert [set(polygons.key.tolist()) for polygons in drawn] == expected

    unfiltered = box_polygons(frames, MotionLabelConfig(filter_invisible=False, draw_ego=False))
    assert [set(polygons.key.tolist()) for polygons in unfiltered] == [{1, 2, 3}] * 5


def test_the_released_protocol_draws_no_actor_if_the_present_is_missing() -> None:
    frames = [None, *[make_frame((0, 10, 1, 0, 1))] * 4]

    released = box_polygons(frames, MotionLabelConfig(draw_ego=False))
    clean = box_polygons(frames, MotionLabelConfig(protocol="clean", draw_ego=False))

    assert [len(polygons.key) for polygons in released[1:]] == [0] * 4
    assert len(clean[1].key) == 1


def test_only_vehicles_are_drawn_if_asked() -> None:
    rows = [(0, 5 * category, category + 1, category, 1) for category in range(6)]
    config = MotionLabelConfig(only_vehicle=True, draw_ego=False)

    present = box_polygons([make_frame(*rows)] * 5, config)[0]

    assert present.key.tolist() == [1, 2, 3, 4, 5]


def test_the_egos_own_box_and_its_slips() -> None:
    released = MotionLabelConfig()
    clean = MotionLabelConfig(protocol="clean")
    lidar = SE3.from_six([1, 0, 2, 0, 0, np.pi / 2])
    frames = [make_frame((-1, 0, -100, 0, 0), lidar=lidar)] * 5

    once = box_polygons(frames, clean)[0]
    assert once.key.tolist() == [OWN_BOX_ID]
    assert once.corners.mean(axis=1).round(5).tolist() == [[1, -1]]
    assert_allclose(np.ptp(once.corners, axis=1), [[2, 4]], atol=1e-6)

    twice = box_polygons(frames, released)[0]
    assert_allclose(twice.corners.mean(axis=1), [[2, 1]], atol=1e-6)
    assert_allclose(np.ptp(twice.corners, axis=1), [[4, 2]], atol=1e-6)

    for rows in ([], [OWN, OWN]):
        default = box_polygons([make_frame(*rows, lidar=lidar)] * 5, released)[0]
        assert_allclose(np.ptp(default.corners, axis=1), [[1.85, 3.99]], atol=1e-5)
        own = box_polygons([make_frame(*rows)] * 5, clean)[0]
        assert len(own.key) == bool(rows)

    assert len(box_polygons(frames, released, is_vehicle=False)[0].key) == 0
    assert len(box_polygons(frames, MotionLabelConfig(draw_ego=False))[0].key) == 0


@pytest.mark.parametrize("protocol", ["released", "clean"])
def test_where_the_agent_leans_the_middle_of_a_boxs_bottom_counts(protocol: str) -> None:
    """The released code takes half a height off the own box twice, and moves it twice."""
    config = MotionLabelConfig(protocol=protocol)
    lidar = SE3.from_six([1.0, 2.0, 3.0, 0.4, -0.3, 0.2])
    boxes = make_frame((10, 5, 7, 0, 1), (3, 1, -100, 0, 0), lidar=lidar)
    own, other = lidar.apply(np.array([[3, 1, -0.75], [10, 5, -0.75]]))
    if protocol == "released":
        own = lidar.apply((own - [0, 0, 0.75])[None])[0]

    low_polygons = box_polygons([boxes] * 5, config)[0]
    assert_allclose(low_polygons.corners.mean(axis=1), [own[:2], other[:2]], atol=1e-5)

    high = make_frame((10, 5, 7, 0, 1), (9, 9, 8, 0, 1), lidar=lidar)
    high = replace(high, center=[[10, 5, 2.0], [9, 9, 4]])
    high_polygons = box_polygons([high] * 5, config)[0]
    if protocol == "clean":
        assert high_polygons.key.tolist() == [7, 8]
    else:  # a default box at the height of the first row's middle
        assert high_polygons.key.tolist() == [OWN_BOX_ID, 7, 8]
        default = lidar.apply(np.array([[0, 0, 2.0 - 1.62 / 2]]))[0]
        assert_allclose(high_polygons.corners[0].mean(axis=0), default[:2], atol=1e-5)


def test_an_augmentation_moves_boxes_and_in_the_clean_way_the_egos_too() -> None:
    turned = Augmentation(rotation=np.pi / 2, scale=2, flip=True)
    frames = [make_frame((1, 0, -100, 0, 0), (10, 5, 7, 0, 1))] * 5

    released = box_polygons(frames, MotionLabelConfig(augmentation=turned))[0]
    assert_allclose(released.corners.mean(axis=1), [[1, 0], [-10, -20]], atol=1e-5)

    config = MotionLabelConfig(augmentation=turned, protocol="clean")
    clean = box_polygons(frames, config)[0]
    assert_allclose(clean.corners.mean(axis=1), [[0, -2], [-10, -20]], atol=1e-5)
    assert_allclose(np.ptp(clean.corners, axis=1), [[4, 8], [4, 8]], atol=1e-5)


def test_the_released_code_draws_half_a_cell_off() -> None:
    """A box that begins at (0.1, 0.1) lies in cells 100 and on; the released code draws it at the
    nearest edge instead.
    """
    frames = [make_frame((2.3, 1.3, 7, 0, 1))] * 5  # x 0.3 to 4.3, y 0.3 to 2.3
    for protocol, expected_rows, expected_columns in (
        ("clean", (100, 104), (100, 108)),
        ("released", (100, 104), (101, 109)),
    ):
        instance = draw_labels(frames, protocol=protocol, draw_ego=False).instance[0]
        rows, columns = np.nonzero(instance)
        assert (rows.min(), rows.max()) == expected_rows
        assert (columns.min(), columns.max()) == expected_columns


def test_beverse_rounds_in_its_own_right_handed_frame() -> None:
    """BEVerse draws corners at round((x + 50) / 0.5), round((y + 50) / 0.5); its y points left."""
    for y in (0.3, 0.2, -0.3, 5.4):
        frames = [make_frame((2.2, y, 7, 0, 1))] * 5
        labels = draw_labels(frames, protocol="beverse", draw_ego=False)
        cells = np.argwhere(labels.instance[0])
        expected_edges = np.round((np.array([[y - 1, 0.2], [y + 1, 4.2]]) + 50) / 0.5)
        assert_array_equal([cells.min(axis=0), cells.max(axis=0)], expected_edges)

    released = draw_labels([make_frame((2.2, 0.3, 7, 0, 1))] * 5, draw_ego=False)
    rows, _ = np.nonzero(released.instance[0])
    assert rows.min() == 199 - round((0.7 + 50) / 0.5)


def test_untracked_rows_share_an_instance_or_have_one_each() -> None:
    frames = [make_frame((0, 10, -1, 0, 1), (0, 20, -1, 0, 1), (0, 30, 5, 0, 1))] * 5

    shared = draw_labels(frames, draw_ego=False)
    assert shared.id_map == {-1: 1, 5: 2}
    assert shared.instance.max() == 2

    own = draw_labels(frames, protocol="clean", draw_ego=False)
    assert own.id_map == {5: 3}
    instances_by_frame = [np.unique(frame[frame > 0]).tolist() for frame in own.instance]
    assert instances_by_frame == [[1, 2, 3], [3, 4, 5], [3, 6, 7], [3, 8, 9], [3, 10, 11]]
    untracked = (own.instance[0] > 0) & (own.instance[0] < 3)
    assert (own.flow[:, :, untracked] == 255).all()


def test_ids_go_on_where_another_sample_left_off() -> None:
    frames = [make_frame((0, 10, 9, 0, 1), (0, 20, 3, 0, 1))] * 5
    first = draw_labels(frames, draw_ego=False)
    assert first.id_map == {9: 1, 3: 2}

    previous_ids = {5: 1, 9: 2}
    continued = motion_labels_from_boxes(
        frames, STILL, MotionLabelConfig(draw_ego=False), id_map=previous_ids
    )
    assert continued.id_map == {5: 1, 9: 2, 3: 3}
    assert previous_ids == {5: 1, 9: 2}
    assert set(np.unique(continued.instance)) == {0, 2, 3}


def test_ids_go_on_only_where_the_protocol_keeps_them() -> None:
    frames = [make_frame((0, 10, 9, 0, 1))] * 5
    for protocol in ("clean", "beverse"):
        config = MotionLabelConfig(protocol=protocol)
        assert_raises(
            (
                partial(motion_labels_from_boxes, frames, STILL, config, id_map={9: 4}),
                ConfigError,
                "count from 1 in every sample; leave it out, or choose a protocol with",
            ),
        )

    config = MotionLabelConfig(protocol=replace(CLEAN, ids_kept_between_samples=True))
    labels = motion_labels_from_boxes(frames, STILL, config, id_map={np.int64(9): np.int32(4)})
    assert labels.id_map == {9: 4}

    config = MotionLabelConfig(draw_ego=False)
    labels = motion_labels_from_boxes([make_frame()] * 5, STILL, config, id_map={3: 2**24})
    assert labels.id_map == {3: 2**24}

    for wrong_ids in ({"a": 2}, {3: -4}, {7: 0}, {3: 1.5}, {3: 2**24 + 1}, [3]):
        assert_raises(
            (
                partial(motion_labels_from_boxes, frames, STILL, id_map=wrong_ids),
                ConfigError,
                "id_map: expected",
            ),
        )


@pytest.mark.parametrize("protocol", sorted(LABEL_PROTOCOLS))
def test_missing_frames_are_empty_or_ignored_before_and_after_warps(protocol: str) -> None:
    """Frames 3 and 4 are beyond the recording, and the ego turns until then."""
    turning = STILL.copy()
    turning[2:4] = (-6, 0, 0, 0, 0, -0.2)
    present = make_frame((5, 5, 1, 0, 1))

    labels = draw_labels([present, present, present, None, None], turning, protocol=protocol)

    assert labels.valid.tolist() == [True] * 5 + [False] * 2
    assert labels.instance[2].any()
    assert (labels.flow[2] == 255).all()
    assert labels.flow[1].min() < 255
    map_mark = 0 if protocol == "released" else 255
    for warped in (labels, labels.to_present("nearest"), labels.to_present("bilinear")):
        for name in ("segmentation", "instance", "centerness"):
            assert (getattr(warped, name)[3:] == map_mark).all(), name
        if protocol != "released" or warped is labels:
            assert (warped.offset[3:] == 255).all()
            assert (warped.flow[3:] == 255).all()


def test_a_frame_that_is_not_valid_is_missing() -> None:
    present = make_frame((5, 5, 1, 0, 1))
    labels = motion_labels_from_boxes([present] * 5, STILL, "beverse", valid=[True] * 6 + [False])
    assert labels.label_valid.tolist() == [True] * 4 + [False]
    assert (labels.instance[4] == 255).all()

    labels = motion_labels_from_boxes([*[present] * 4, None], STILL, valid=[True] * 7)
    assert labels.label_valid.tolist() == [True] * 4 + [False]


def test_a_small_mark_is_no_vector() -> None:
    """On a grid of 8 cells the mark may be 8. A step of 7 and a single component of 8 are still
    vectors.
    """
    vectors = np.array([[8, 8, 7], [8, 3, 8]], dtype=np.float32)

    turned = to_orientation(
        vectors.reshape(1, 2, 1, 3), vectors=True, source="released", target="devkit", ignore=8
    )

    assert turned.reshape(2, 3).tolist() == [[8, -8, -7], [8, 3, 8]]


def test_huge_peaks_and_far_boxes() -> None:
    centred = make_frame((0, 0, 1, 0, 1))
    huge = draw_labels([centred] * 5, sigma=10_000, draw_ego=False)
    assert huge.centerness.min() > 0.999

    far = make_frame((1e30, 0, 1, 0, 1), (0, 0, 2, 0, 1))
    for protocol in LABEL_PROTOCOLS:
        labels = draw_labels([far] * 5, protocol=protocol, draw_ego=False)
        assert np.unique(labels.instance).tolist() == [0, 2]


def test_nobody_at_all() -> None:
    for protocol in LABEL_PROTOCOLS:
        empty = draw_labels([make_frame()] * 5, protocol=protocol, draw_ego=False)
        assert not empty.instance.any()
        assert (empty.flow == 255).all()
    assert not draw_labels([None] * 5).label_valid.any()


def test_other_grids_sigmas_and_horizons() -> None:
    """A car at (50, −25) and the ego at (0, 0), on 200 × 100 cells of 0.4 m from (−20, −30)."""
    grid = BevGrid((-20, 60, 0.4), (-30, 10, 0.4))
    frames = [make_frame(OWN, (50, -25, 7, 0, 1))] * 9
    for protocol in LABEL_PROTOCOLS:
        config = MotionLabelConfig(
            grid=grid,
            receptive_field=2,
            future_frames=8,
            sigma=1.5,
            ignore_index=200,
            protocol=protocol,
        )
        labels = motion_labels_from_boxes(frames, np.zeros((10, 6)), config)
        assert labels.offset.shape == (9, 2, 100, 200)
        peaks = np.nonzero(labels.centerness[8, 0] == 1)
        assert_allclose(grid.centers()[peaks], [[50, -25], [0, 0]], atol=0.4)
        assert (labels.offset[0, 0] == 200).sum() == (labels.instance[0] == 0).sum()


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (
            lambda: draw_labels([make_frame()] * 4),
            r"frames: expected 5.* found 4; give None for frames beyond the recording",
        ),
        (
            lambda: draw_labels([make_frame()] * 5, np.zeros((5, 6))),
            r"egomotion: expected shape \(7, 6\), found \(5, 6\)",
        ),
        (
            lambda: draw_labels([make_frame()] * 5, np.full((7, 6), np.nan)),
            "egomotion: not all numbers are finite",
        ),
        (
            lambda: replace(make_frame(), yaw=np.zeros(1)),
            r"FrameBoxes.yaw: expected shape \(0\), found \(1,\)",
        ),
        (
            lambda: make_frame((0, 0, 1, 0, 1), (0, np.nan, 2, 0, 1)),
            r"FrameBoxes.center: row 1 is not finite",
        ),
        (
            lambda: replace(make_frame(), center=5),
            r"FrameBoxes.center: expected shape \(N, 3\), found \(\)",
        ),
        (
            lambda: replace(make_frame(), ego_from_lidar=np.full((4, 4), np.nan)),
            r"FrameBoxes.ego_from_lidar: row 0 is not finite; give None for",
        ),
        (
            lambda: draw_labels(["a"] * 5),
            "frames: expected FrameBoxes, or None beyond the recording, found 'a'",
        ),
    ],
)
def test_what_does_not_fit_is_refused_with_the_remedy(
    make: Callable[[], object], sentence: str
) -> None:
    assert_raises(
        (make, GeometryError, sentence),
    )


def test_vectors_have_two_channels_of_cells() -> None:
    for wrong in (np.zeros((2, 5)), np.zeros((3, 4, 5))):
        assert_raises(
            (
                partial(to_orientation, wrong, vectors=True, source="devkit", target="fiery"),
                GeometryError,
                r"vectors: expected shape \(…, 2, H, W\), found",
            ),
        )


def test_axes_as_rows_and_columns_count_them() -> None:
    x = (-20, 60, 0.5)
    y = (-30, 10, 0.25)
    grid = BevGrid(x, y)
    assert axes_of(grid.with_orientation("devkit")) == (y, x)
    assert axes_of(grid.with_orientation("released")) == ((-10, 30, 0.25), x)
    assert axes_of(grid.with_orientation("fiery")) == (x, y)


CONFIG = MotionLabelConfig(
    grid=BevGrid((-20, 20, 0.5), (-15, 15, 0.5)), receptive_field=1, future_frames=1
)
CORNERS = st.lists(
    st.lists(st.tuples(st.integers(-20, 100), st.integers(-20, 100)), min_size=4, max_size=4),
    min_size=1,
    max_size=6,
)
MOTIONS = st.tuples(
    st.floats(-30, 30),
    st.floats(-30, 30),
    st.floats(-0.2, 0.2),
    st.floats(-0.2, 0.2),
    st.floats(-0.2, 0.2),
    st.floats(-4, 4),
)


def make_footprints(corners: list, config: MotionLabelConfig) -> Footprints:
    """Put all polygons into the second of two frames."""
    shape = config.grid.with_orientation(config.rules.native).shape
    polygons = np.array(corners, dtype=np.int64)
    image = np.ones(len(corners), dtype=np.int64)
    instance = 1 + np.arange(len(polygons)) // 2
    return Footprints(polygons, image, instance, topmost(polygons, shape, image, 2))


@given(CORNERS, MOTIONS, st.sampled_from(list(LABEL_PROTOCOLS)))
def test_near_cells_are_enough(corners: list, motion: tuple[float, ...], protocol: str) -> None:
    config = replace(CONFIG, protocol=protocol)
    footprints = make_footprints(corners, config)
    matrices = sampling_matrix(conventions.matrices_of_six([motion]), config.rules)

    centers = following_centers(footprints, matrices, config, 3)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drawing, "even_spread", lambda *_: None)  # as for points that are far away
        expected = following_centers(footprints, matrices, config, 3)
    assert_array_equal(centers, expected)


@pytest.mark.parametrize(
    "motion", [(1e7, 0, 0, 0, 0, 0), (0, 0, 0, np.pi / 2, 0, 0)], ids=["far away", "upright"]
)
def test_points_that_do_not_lie_evenly_are_looked_at_one_by_one(motion: tuple[float, ...]) -> None:
    config = replace(CONFIG, protocol="clean")
    grid = config.grid.with_orientation("released")
    footprints = make_footprints([[(0, 0), (79, 0), (79, 59), (0, 59)]], config)
    matrices = sampling_matrix(conventions.matrices_of_six([motion]), config.rules)

    lines = drawing.sampling_lines(matrices, grid, config.rules)
    assert drawing.even_spread(lines, grid) is None

    center = following_centers(footprints, matrices, config, 1)[0, 1]
    far_away = motion[0] > 0
    assert np.isnan(center).all() == far_away


def test_one_frame_that_does_not_lie_evenly_is_enough_to_look_at_every_cell() -> None:
    grid = CONFIG.grid.with_orientation("released")
    turned = conventions.matrices_of_six([(0, 0, 0, np.pi / 2, 0, 0)])[0]
    shrunk = np.diag([0.45, 0.45, 1, 1])
    enlarged = np.diag([2.1, 2.1, 1, 1])
    for matrix in (turned, shrunk, enlarged):
        lines = drawing.sampling_lines(np.stack([np.eye(4), matrix]), grid, CLEAN)
        assert drawing.even_spread(lines, grid) is None

    slightly_shrunk = np.diag([0.55, 0.55, 1, 1])
    slightly_enlarged = np.diag([1.9, 1.9, 1, 1])
    matrices = np.stack([np.eye(4), slightly_shrunk, slightly_enlarged])
    lines = drawing.sampling_lines(matrices, grid, CLEAN)
    assert drawing.even_spread(lines, grid) is not None
