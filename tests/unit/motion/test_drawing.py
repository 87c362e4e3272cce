"""Labels of boxes: who is drawn where, missing frames, ids, centres and vectors."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from refusals import assert_refused

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


def frame(*rows, lidar=None) -> FrameBoxes:
    """Rows of (x, y, id, category, visible), cars of 4 × 2 m that point ahead."""
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


def labels(frames, motion=STILL, **changes):
    return motion_labels_from_boxes(frames, motion, MotionLabelConfig(**changes))


@pytest.mark.parametrize("augmentation", [None, Augmentation(rotation=0.2, scale=1.1, flip=True)])
def test_without_a_lean_both_rules_of_poses_give_the_same_corners(
    augmentation: Augmentation | None,
) -> None:
    boxes = frame(
        *((10, -5, 7, 0, 1), (-3, 8, 8, 0, 1), (0, 30, 9, 0, 1)),
        lidar=SE3.from_yaw(0.3, (1.0, -2.0, 0.5)),
    )
    size = boxes.size * ([1, 1, 1], [2, 1, 1], [-1, -1, 1])  # a release may have negative ones
    boxes, found = replace(boxes, yaw=np.array([0.4, -2.0, 3.0]), size=size), []
    for pose in ("whole", "yaw"):
        config = MotionLabelConfig(
            augmentation=augmentation, draw_ego=False, protocol=replace(RELEASED, pose=pose)
        )
        (polygons,) = box_polygons([boxes], config)
        found.append([np.array(sorted(each.tolist())) for each in polygons.corners])
    assert_allclose(found[1], found[0], atol=1e-4)


def test_a_car_lies_where_it_is_and_so_does_its_centre() -> None:
    """Centre (10, −5): columns 120 ± 4, rows 90 ± 2, cell edges rounded up half a cell as the
    released code does.
    """
    made = labels([frame((10, -5, 7, 0, 1))] * 5, draw_ego=False)
    rows, columns = np.nonzero(made.instance[0])
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (87, 91, 116, 124)
    assert made.id_map == {7: 1}
    assert_array_equal(made.segmentation, made.instance > 0)
    assert made.centerness[0, 0, 89, 120] == 1
    assert_array_equal(np.argwhere(made.centerness[0, 0] == 1), [[89, 120]])
    assert made.centerness[0, 0, 92, 120] == pytest.approx(np.exp(-1))
    assert_array_equal(made.offset[0, :, 91, 116], [-2, 4])
    assert_array_equal(made.flow[0, :, 91, 116], [0, 0])
    assert (made.offset[:, :, made.instance[0] == 0] == 255).all()
    assert (made.flow[4] == 255).all()


def test_flow_is_seen_from_this_frames_ego() -> None:
    """The ego drives 2 m ahead a step, and the car stands: it moves 4 cells to the rear only in the
    other's frame.
    """
    ahead = STILL.copy()
    ahead[:, 0] = -2
    standing = labels(
        [frame((10 - 2 * t, 5, 7, 0, 1)) for t in range(5)], ahead, protocol="clean", draw_ego=False
    )
    assert_array_equal(np.unique(standing.flow[:4, :, standing.instance[0] > 0][0]), [0])
    moving = labels(
        [frame((10 + t, 5 + 0.5 * t, 7, 0, 1)) for t in range(5)], protocol="clean", draw_ego=False
    )
    cell = np.argwhere(moving.instance[0])[0]
    assert_array_equal(moving.flow[0, :, cell[0], cell[1]], [1, 2])


def test_who_is_drawn_when() -> None:
    """Actor 1 is seen at first only, 2 later only, 3 always."""
    frames = [
        frame((0, 10, 1, 0, t == 0), (0, 20, 2, 0, t >= 2), (0, 30, 3, 0, 1)) for t in range(5)
    ]
    for when, expected in {
        "present": [{1, 3}] * 5,
        "since": [{1, 3}, {1, 3}, {1, 2, 3}, {1, 2, 3}, {1, 2, 3}],
        "now": [{1, 3}, {3}, {2, 3}, {2, 3}, {2, 3}],
    }.items():
        config = MotionLabelConfig(protocol=replace(RELEASED, drawn_when=when), draw_ego=False)
        assert [set(one.key.tolist()) for one in box_polygons(frames, config)] == expected
    everybody = box_polygons(frames, MotionLabelConfig(filter_invisible=False, draw_ego=False))
    assert [set(one.key.tolist()) for one in everybody] == [{1, 2, 3}] * 5


def test_nobody_is_drawn_where_the_present_is_missing_in_the_released_way() -> None:
    frames = [None, *[frame((0, 10, 1, 0, 1))] * 4]
    assert [
        len(one.key) for one in box_polygons(frames, MotionLabelConfig(draw_ego=False))[1:]
    ] == [0] * 4
    assert (
        len(box_polygons(frames, MotionLabelConfig(protocol="clean", draw_ego=False))[1].key) == 1
    )


def test_vehicles_alone() -> None:
    frames = [frame(*((0, 5 * category, category + 1, category, 1) for category in range(6)))] * 5
    assert box_polygons(frames, MotionLabelConfig(only_vehicle=True, draw_ego=False))[
        0
    ].key.tolist() == [1, 2, 3, 4, 5]


def test_the_egos_own_box_and_its_slips() -> None:
    lidar = SE3.from_six([1, 0, 2, 0, 0, np.pi / 2])
    frames = [frame((-1, 0, -100, 0, 0), lidar=lidar)] * 5
    once = box_polygons(frames, MotionLabelConfig(protocol="clean"))[0]
    assert (once.key.tolist(), once.corners.mean(axis=1).round(5).tolist()) == (
        [OWN_BOX_ID],
        [[1, -1]],
    )
    twice = box_polygons(frames, MotionLabelConfig())[0]
    assert_allclose(twice.corners.mean(axis=1), [[2, 1]], atol=1e-6)
    assert_allclose(np.ptp(once.corners, axis=1), [[2, 4]], atol=1e-6)
    assert_allclose(np.ptp(twice.corners, axis=1), [[4, 2]], atol=1e-6)
    for rows in ([], [OWN, OWN]):
        default = box_polygons([frame(*rows, lidar=lidar)] * 5, MotionLabelConfig())[0]
        assert_allclose(np.ptp(default.corners, axis=1), [[1.85, 3.99]], atol=1e-5)
        assert len(
            box_polygons([frame(*rows)] * 5, MotionLabelConfig(protocol="clean"))[0].key
        ) == bool(rows)
    assert len(box_polygons(frames, MotionLabelConfig(), is_vehicle=False)[0].key) == 0
    assert len(box_polygons(frames, MotionLabelConfig(draw_ego=False))[0].key) == 0


@pytest.mark.parametrize("protocol", ["released", "clean"])
def test_where_the_agent_leans_the_middle_of_a_boxs_bottom_counts(protocol: str) -> None:
    """The released code takes half a height off the own box twice, and moves it twice."""
    lidar = SE3.from_six([1.0, 2.0, 3.0, 0.4, -0.3, 0.2])
    boxes = frame((10, 5, 7, 0, 1), (3, 1, -100, 0, 0), lidar=lidar)
    own, other = (lidar.apply(np.array([[*place, -0.75]]))[0] for place in ((3, 1), (10, 5)))
    if protocol == "released":
        own = lidar.apply((own - [0, 0, 0.75])[None])[0]
    config = MotionLabelConfig(protocol=protocol)
    assert_allclose(
        box_polygons([boxes] * 5, config)[0].corners.mean(axis=1), [own[:2], other[:2]], atol=1e-5
    )
    high = replace(
        frame((10, 5, 7, 0, 1), (9, 9, 8, 0, 1), lidar=lidar), center=[[10, 5, 2.0], [9, 9, 4]]
    )
    assert box_polygons([high] * 5, config)[0].key.tolist() == (
        [OWN_BOX_ID, 7, 8] if protocol == "released" else [7, 8]
    )
    if protocol == "released":  # a default box at the height of the first row's middle
        default = lidar.apply(np.array([[0, 0, 2.0 - 1.62 / 2]]))[0]
        assert_allclose(
            box_polygons([high] * 5, config)[0].corners[0].mean(axis=0), default[:2], atol=1e-5
        )


def test_an_augmentation_moves_boxes_and_in_the_clean_way_the_egos_too() -> None:
    turned = Augmentation(rotation=np.pi / 2, scale=2, flip=True)
    frames = [frame((1, 0, -100, 0, 0), (10, 5, 7, 0, 1))] * 5
    released = box_polygons(frames, MotionLabelConfig(augmentation=turned))[0]
    clean = box_polygons(frames, MotionLabelConfig(augmentation=turned, protocol="clean"))[0]
    assert_allclose(released.corners.mean(axis=1), [[1, 0], [-10, -20]], atol=1e-5)
    assert_allclose(clean.corners.mean(axis=1), [[0, -2], [-10, -20]], atol=1e-5)
    assert_allclose(np.ptp(clean.corners, axis=1), [[4, 8], [4, 8]], atol=1e-5)


def test_half_a_cell_more_or_less() -> None:
    """A box from (0.1, 0.1) on lies in cells 100 and on; the released code draws it at the nearest
    edge instead.
    """
    frames = [frame((2.3, 1.3, 7, 0, 1))] * 5  # x 0.3 to 4.3, y 0.3 to 2.3
    clean = labels(frames, protocol="clean", draw_ego=False).instance[0]
    released = labels(frames, draw_ego=False).instance[0]
    for made, rows, columns in (
        (clean, (100, 104), (100, 108)),
        (released, (100, 104), (101, 109)),
    ):
        found = np.argwhere(made)
        assert ((found[:, 1].min(), found[:, 1].max()), (found[:, 0].min(), found[:, 0].max())) == (
            columns,
            rows,
        )


def test_beverse_rounds_in_its_own_right_handed_frame() -> None:
    """BEVerse draws corners at round((x + 50) / 0.5), round((y + 50) / 0.5); its y points left."""
    for y in (0.3, 0.2, -0.3, 5.4):
        found = np.argwhere(
            labels([frame((2.2, y, 7, 0, 1))] * 5, protocol="beverse", draw_ego=False).instance[0]
        )
        for axis, (low, high) in enumerate(((y - 1, y + 1), (0.2, 4.2))):
            assert [found[:, axis].min(), found[:, axis].max()] == [
                round((edge + 50) / 0.5) for edge in (low, high)
            ]
    released = labels([frame((2.2, 0.3, 7, 0, 1))] * 5, draw_ego=False).instance[0]
    assert np.argwhere(released)[:, 0].min() == 199 - round((0.7 + 50) / 0.5)


def test_untracked_rows_are_one_or_each_its_own() -> None:
    frames = [frame((0, 10, -1, 0, 1), (0, 20, -1, 0, 1), (0, 30, 5, 0, 1))] * 5
    shared = labels(frames, draw_ego=False)
    assert (shared.id_map, shared.instance.max()) == ({-1: 1, 5: 2}, 2)
    own = labels(frames, protocol="clean", draw_ego=False)
    assert own.id_map == {5: 3}
    assert [np.unique(one[one > 0]).tolist() for one in own.instance] == [
        [1, 2, 3], [3, 4, 5], [3, 6, 7], [3, 8, 9], [3, 10, 11],
    ]  # fmt: skip
    assert (own.flow[:, :, (own.instance[0] > 0) & (own.instance[0] < 3)] == 255).all()


def test_ids_go_on_where_another_sample_left_off() -> None:
    given = {5: 1, 9: 2}
    assert labels([frame((0, 10, 9, 0, 1), (0, 20, 3, 0, 1))] * 5, draw_ego=False).id_map == {
        9: 1,
        3: 2,
    }
    continued = motion_labels_from_boxes(
        [frame((0, 10, 9, 0, 1), (0, 20, 3, 0, 1))] * 5,
        STILL,
        MotionLabelConfig(draw_ego=False),
        id_map=given,
    )
    assert (continued.id_map, given) == ({5: 1, 9: 2, 3: 3}, {5: 1, 9: 2})
    assert set(np.unique(continued.instance)) == {0, 2, 3}


def test_ids_go_on_only_where_the_protocol_keeps_them() -> None:
    frames = [frame((0, 10, 9, 0, 1))] * 5
    assert_refused(
        *[
            (
                partial(
                    motion_labels_from_boxes,
                    frames,
                    STILL,
                    MotionLabelConfig(protocol=protocol),
                    id_map={9: 4},
                ),
                ConfigError,
                "count from 1 in every sample; leave it out, or choose a protocol with",
            )
            for protocol in ("clean", "beverse")
        ],
    )
    kept = replace(CLEAN, ids_kept_between_samples=True)
    made = motion_labels_from_boxes(
        frames, STILL, MotionLabelConfig(protocol=kept), id_map={np.int64(9): np.int32(4)}
    )
    assert made.id_map == {9: 4}
    nobody = MotionLabelConfig(draw_ego=False)
    assert motion_labels_from_boxes([frame()] * 5, STILL, nobody, id_map={3: 2**24}).id_map == {
        3: 2**24
    }
    assert_refused(
        *[
            (
                partial(motion_labels_from_boxes, frames, STILL, id_map=wrong),
                ConfigError,
                "id_map: expected",
            )
            for wrong in ({"a": 2}, {3: -4}, {7: 0}, {3: 1.5}, {3: 2**24 + 1}, [3])
        ],
    )


@pytest.mark.parametrize("protocol", sorted(LABEL_PROTOCOLS))
def test_missing_frames_are_empty_or_ignored_before_and_after_warps(protocol: str) -> None:
    """Frames 3 and 4 are beyond the recording, and the ego turns up to there."""
    turning = STILL.copy()
    turning[2:4] = (-6, 0, 0, 0, 0, -0.2)
    made = labels([*[frame((5, 5, 1, 0, 1))] * 3, None, None], turning, protocol=protocol)
    assert (made.valid.tolist(), made.instance[2].any()) == ([True] * 5 + [False] * 2, True)
    assert ((made.flow[2] == 255).all(), made.flow[1].min() < 255) == (True, True)
    for one in (made, made.to_present("nearest"), made.to_present("bilinear")):
        for name in ("segmentation", "instance", "centerness", "offset", "flow"):
            if name not in ("offset", "flow") or protocol != "released" or one is made:
                mark = 0 if protocol == "released" and name not in ("offset", "flow") else 255
                assert (getattr(one, name)[3:] == mark).all(), name


def test_a_frame_that_is_not_valid_is_missing() -> None:
    frames = [frame((5, 5, 1, 0, 1))] * 5
    made = motion_labels_from_boxes(frames, STILL, "beverse", valid=[True] * 6 + [False])
    assert made.label_valid.tolist() == [True] * 4 + [False]
    assert (made.instance[4] == 255).all()
    assert motion_labels_from_boxes(
        [*frames[:4], None], STILL, valid=[True] * 7
    ).label_valid.tolist() == [True] * 4 + [False]


def test_a_small_mark_is_no_vector() -> None:
    """On a grid of 8 cells the mark may be 8; a row's step of 7 and one component that is 8 beside
    another are kept.
    """
    vectors = np.array([[[[8, 8, 7]]], [[[8, 3, 8]]]], dtype=np.float32).reshape(1, 2, 1, 3)
    turned = to_orientation(vectors, vectors=True, source="released", target="devkit", ignore=8)
    assert turned.reshape(2, 3).tolist() == [[8, -8, -7], [8, 3, 8]]


def test_huge_peaks_and_far_boxes() -> None:
    assert (
        labels([frame((0, 0, 1, 0, 1))] * 5, sigma=10_000, draw_ego=False).centerness.min() > 0.999
    )
    for protocol in LABEL_PROTOCOLS:
        far = labels(
            [frame((1e30, 0, 1, 0, 1), (0, 0, 2, 0, 1))] * 5, protocol=protocol, draw_ego=False
        )
        assert np.unique(far.instance).tolist() == [0, 2]


def test_nobody_at_all() -> None:
    for protocol in LABEL_PROTOCOLS:
        empty = labels([frame()] * 5, protocol=protocol, draw_ego=False)
        assert not empty.instance.any()
        assert (empty.flow == 255).all()
    assert not labels([None] * 5).label_valid.any()


def test_other_grids_sigmas_and_horizons() -> None:
    """A car at (50, −25) and the ego at (0, 0), on 200 × 100 cells of 0.4 m from (−20, −30)."""
    grid = BevGrid((-20, 60, 0.4), (-30, 10, 0.4))
    for protocol in LABEL_PROTOCOLS:
        config = MotionLabelConfig(
            grid=grid,
            receptive_field=2,
            future_frames=8,
            sigma=1.5,
            ignore_index=200,
            protocol=protocol,
        )
        made = motion_labels_from_boxes(
            [frame(OWN, (50, -25, 7, 0, 1))] * 9, np.zeros((10, 6)), config
        )
        assert made.offset.shape == (9, 2, 100, 200)
        rows, columns = np.nonzero(made.centerness[8, 0] == 1)
        assert_allclose(grid.centers()[rows, columns], [[50, -25], [0, 0]], atol=0.4)
        assert (made.offset[0, 0] == 200).sum() == (made.instance[0] == 0).sum()


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (
            lambda: labels([frame()] * 4),
            r"frames: expected 5.* found 4; give None for frames beyond the recording",
        ),
        (
            lambda: labels([frame()] * 5, np.zeros((5, 6))),
            r"egomotion: expected shape \(7, 6\), found \(5, 6\)",
        ),
        (
            lambda: labels([frame()] * 5, np.full((7, 6), np.nan)),
            "egomotion: not all numbers are finite",
        ),
        (
            lambda: replace(frame(), yaw=np.zeros(1)),
            r"FrameBoxes.yaw: expected shape \(0\), found \(1,\)",
        ),
        (
            lambda: frame((0, 0, 1, 0, 1), (0, np.nan, 2, 0, 1)),
            r"FrameBoxes.center: row 1 is not finite",
        ),
        (
            lambda: replace(frame(), center=5),
            r"FrameBoxes.center: expected shape \(N, 3\), found \(\)",
        ),
        (
            lambda: replace(frame(), ego_from_lidar=np.full((4, 4), np.nan)),
            r"FrameBoxes.ego_from_lidar: row 0 is not finite; give None for",
        ),
        (
            lambda: labels(["a"] * 5),
            "frames: expected FrameBoxes, or None beyond the recording, found 'a'",
        ),
    ],
)
def test_what_does_not_fit_is_refused_with_the_remedy(
    make: Callable[[], object], sentence: str
) -> None:
    assert_refused(
        (make, GeometryError, sentence),
    )


def test_vectors_have_two_channels_of_cells() -> None:
    assert_refused(
        *[
            (
                partial(to_orientation, wrong, vectors=True, source="devkit", target="fiery"),
                GeometryError,
                r"vectors: expected shape \(…, 2, H, W\), found",
            )
            for wrong in (np.zeros((2, 5)), np.zeros((3, 4, 5)))
        ],
    )


def test_axes_as_rows_and_columns_count_them() -> None:
    grid = BevGrid((-20, 60, 0.5), (-30, 10, 0.25))
    x, y = (-20, 60, 0.5), (-30, 10, 0.25)
    for orientation, expected in (
        ("devkit", (y, x)),
        ("released", ((-10, 30, 0.25), x)),
        ("fiery", (x, y)),
    ):
        assert axes_of(grid.with_orientation(orientation)) == expected


CONFIG = MotionLabelConfig(
    grid=BevGrid((-20, 20, 0.5), (-15, 15, 0.5)), receptive_field=1, future_frames=1
)
CORNERS = st.lists(
    st.lists(st.tuples(st.integers(-20, 100), st.integers(-20, 100)), min_size=4, max_size=4),
    min_size=1,
    max_size=6,
)
MOTIONS = st.tuples(
    *(st.floats(-30, 30) for _ in range(2)),
    *(st.floats(-0.2, 0.2) for _ in range(3)),
    st.floats(-4, 4),
)


def footprints(corners: list, config: MotionLabelConfig) -> Footprints:
    """All in the second of two frames."""
    shape = config.grid.with_orientation(config.rules.native).shape
    image, given = np.ones(len(corners), dtype=np.int64), np.array(corners, dtype=np.int64)
    return Footprints(given, image, 1 + np.arange(len(given)) // 2, topmost(given, shape, image, 2))


@given(CORNERS, MOTIONS, st.sampled_from(list(LABEL_PROTOCOLS)))
def test_near_cells_are_enough(corners: list, motion: tuple[float, ...], protocol: str) -> None:
    config = replace(CONFIG, protocol=protocol)
    shown, matrices = (
        footprints(corners, config),
        sampling_matrix(conventions.matrices_of_six([motion]), config.rules),
    )
    found = following_centers(shown, matrices, config, 3)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drawing, "even_spread", lambda *_: None)  # as for points that are far away
        assert_array_equal(found, following_centers(shown, matrices, config, 3))


@pytest.mark.parametrize(
    "motion", [(1e7, 0, 0, 0, 0, 0), (0, 0, 0, np.pi / 2, 0, 0)], ids=["far away", "upright"]
)
def test_points_that_do_not_lie_evenly_are_looked_at_one_by_one(motion: tuple[float, ...]) -> None:
    config = replace(CONFIG, protocol="clean")
    shown = footprints([[(0, 0), (79, 0), (79, 59), (0, 59)]], config)
    matrices = sampling_matrix(conventions.matrices_of_six([motion]), config.rules)
    lines = drawing.sampling_lines(matrices, config.grid.with_orientation("released"), config.rules)
    assert drawing.even_spread(lines, config.grid.with_orientation("released")) is None
    assert np.isnan(following_centers(shown, matrices, config, 1)[0, 1]).all() == (motion[0] > 0)


def test_one_frame_that_does_not_lie_evenly_is_enough_to_look_at_every_cell() -> None:
    grid = CONFIG.grid.with_orientation("released")
    turned = conventions.matrices_of_six([(0, 0, 0, np.pi / 2, 0, 0)])[0]
    for other in (turned, np.diag([0.45, 0.45, 1, 1]), np.diag([2.1, 2.1, 1, 1])):
        lines = drawing.sampling_lines(np.stack([np.eye(4), other]), grid, LABEL_PROTOCOLS["clean"])
        assert drawing.even_spread(lines, grid) is None
    near = np.stack([np.eye(4), np.diag([0.55, 0.55, 1, 1]), np.diag([1.9, 1.9, 1, 1])])
    lines = drawing.sampling_lines(near, grid, LABEL_PROTOCOLS["clean"])
    assert drawing.even_spread(lines, grid) is not None
