from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import SE3, BevGrid
from deepaccident_devkit.motion import LABEL_PROTOCOLS, OWN_BOX_ID, Augmentation, MotionLabelConfig
from deepaccident_devkit.motion.drawing.box_polygons import box_polygons
from deepaccident_devkit.motion.drawing.from_boxes import FrameBoxes, motion_labels_from_boxes

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


def test_a_car_lies_where_it_is_and_so_does_its_centre() -> None:
    """Centre (10, −5): columns 120 ± 4, rows 90 ± 2, cell edges rounded up half a cell as the released code does."""
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
    """The ego drives 2 m ahead a step, and the car stands: it moves 4 cells to the rear only in the other's frame."""
    ahead = STILL.copy()
    ahead[:, 0] = -2
    standing = labels([frame((10 - 2 * t, 5, 7, 0, 1)) for t in range(5)], ahead, protocol="clean", draw_ego=False)
    assert_array_equal(np.unique(standing.flow[:4, :, standing.instance[0] > 0][0]), [0])
    moving = labels([frame((10 + t, 5 + 0.5 * t, 7, 0, 1)) for t in range(5)], protocol="clean", draw_ego=False)
    cell = np.argwhere(moving.instance[0])[0]
    assert_array_equal(moving.flow[0, :, cell[0], cell[1]], [1, 2])


def test_who_is_drawn_when() -> None:
    """Actor 1 is seen at first only, 2 later only, 3 always."""
    frames = [frame((0, 10, 1, 0, t == 0), (0, 20, 2, 0, t >= 2), (0, 30, 3, 0, 1)) for t in range(5)]
    for when, expected in {
        "present": [{1, 3}] * 5,
        "since": [{1, 3}, {1, 3}, {1, 2, 3}, {1, 2, 3}, {1, 2, 3}],
        "now": [{1, 3}, {3}, {2, 3}, {2, 3}, {2, 3}],
    }.items():
        config = MotionLabelConfig(protocol=replace(RELEASED, drawn_when=when), draw_ego=False)
        drawn = box_polygons(frames, config)
        assert [set(one.key.tolist()) for one in drawn] == expected
    everybody = box_polygons(frames, MotionLabelConfig(filter_invisible=False, draw_ego=False))
    assert [set(one.key.tolist()) for one in everybody] == [{1, 2, 3}] * 5


def test_nobody_is_drawn_where_the_present_is_missing_in_the_released_way() -> None:
    frames = [None, *[frame((0, 10, 1, 0, 1))] * 4]
    assert [len(one.key) for one in box_polygons(frames, MotionLabelConfig(draw_ego=False))[1:]] == [0] * 4
    assert len(box_polygons(frames, MotionLabelConfig(protocol="clean", draw_ego=False))[1].key) == 1


def test_vehicles_alone() -> None:
    frames = [frame(*((0, 5 * category, category + 1, category, 1) for category in range(6)))] * 5
    drawn = box_polygons(frames, MotionLabelConfig(only_vehicle=True, draw_ego=False))
    assert drawn[0].key.tolist() == [1, 2, 3, 4, 5]


def test_the_egos_own_box_and_its_slips() -> None:
    lidar = SE3.from_six([1, 0, 2, 0, 0, np.pi / 2])
    frames = [frame((-1, 0, -100, 0, 0), lidar=lidar)] * 5
    once = box_polygons(frames, MotionLabelConfig(protocol="clean"))[0]
    assert (once.key.tolist(), once.corners.mean(axis=1).round(5).tolist()) == ([OWN_BOX_ID], [[1, -1]])
    twice = box_polygons(frames, MotionLabelConfig())[0]
    assert_allclose(twice.corners.mean(axis=1), [[2, 1]], atol=1e-6)
    assert_allclose(np.ptp(once.corners, axis=1), [[2, 4]], atol=1e-6)
    assert_allclose(np.ptp(twice.corners, axis=1), [[4, 2]], atol=1e-6)
    for rows in ([], [OWN, OWN]):
        default = box_polygons([frame(*rows, lidar=lidar)] * 5, MotionLabelConfig())[0]
        assert_allclose(np.ptp(default.corners, axis=1), [[1.85, 3.99]], atol=1e-5)
        assert len(box_polygons([frame(*rows)] * 5, MotionLabelConfig(protocol="clean"))[0].key) == bool(rows)
    assert len(box_polygons(frames, MotionLabelConfig(), is_vehicle=False)[0].key) == 0
    assert len(box_polygons(frames, MotionLabelConfig(draw_ego=False))[0].key) == 0


def test_an_augmentation_moves_boxes_and_in_the_clean_way_the_egos_too() -> None:
    turned = Augmentation(rotation=np.pi / 2, scale=2, flip=True)
    frames = [frame((1, 0, -100, 0, 0), (10, 5, 7, 0, 1))] * 5
    released = box_polygons(frames, MotionLabelConfig(augmentation=turned))[0]
    clean = box_polygons(frames, MotionLabelConfig(augmentation=turned, protocol="clean"))[0]
    assert_allclose(released.corners.mean(axis=1), [[1, 0], [-10, -20]], atol=1e-5)
    assert_allclose(clean.corners.mean(axis=1), [[0, -2], [-10, -20]], atol=1e-5)
    assert_allclose(np.ptp(clean.corners, axis=1), [[4, 8], [4, 8]], atol=1e-5)


def test_half_a_cell_more_or_less() -> None:
    """A box from (0.1, 0.1) on lies in cells 100 and on; the released code draws it at the nearest edge instead."""
    frames = [frame((2.3, 1.3, 7, 0, 1))] * 5  # x 0.3 to 4.3, y 0.3 to 2.3
    clean = labels(frames, protocol="clean", draw_ego=False).instance[0]
    released = labels(frames, draw_ego=False).instance[0]
    for made, rows, columns in ((clean, (100, 104), (100, 108)), (released, (100, 104), (101, 109))):
        found = np.argwhere(made)
        assert (found[:, 1].min(), found[:, 1].max()) == columns
        assert (found[:, 0].min(), found[:, 0].max()) == rows


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
    made = labels([frame((0, 10, 9, 0, 1), (0, 20, 3, 0, 1))] * 5, draw_ego=False)
    assert made.id_map == {9: 1, 3: 2}
    continued = motion_labels_from_boxes(
        [frame((0, 10, 9, 0, 1), (0, 20, 3, 0, 1))] * 5, STILL, MotionLabelConfig(draw_ego=False), id_map=given
    )
    assert continued.id_map == {5: 1, 9: 2, 3: 3}
    assert given == {5: 1, 9: 2}
    assert set(np.unique(continued.instance)) == {0, 2, 3}


def test_missing_frames_are_empty_or_ignored() -> None:
    frames = [*[frame((0, 10, 1, 0, 1))] * 3, None, None]
    released = labels(frames)
    assert released.valid.tolist() == [True] * 5 + [False] * 2
    assert not released.segmentation[3:].any()
    assert not released.centerness[3:].any()
    clean = labels(frames, protocol="clean")
    for name in ("segmentation", "instance", "centerness", "offset", "flow"):
        assert (getattr(clean, name)[3:] == 255).all()
    for made in (released, clean):
        assert (made.flow[2] == 255).all()
        assert made.flow[1].min() == 0
    given = motion_labels_from_boxes(frames, STILL, MotionLabelConfig(), valid=[0, 1, 1, 1, 1, 0, 0])
    assert given.valid.tolist() == [False, *[True] * 4, False, False]


def test_nobody_at_all() -> None:
    for protocol in LABEL_PROTOCOLS:
        empty = labels([frame()] * 5, protocol=protocol, draw_ego=False)
        assert not empty.instance.any()
        assert (empty.flow == 255).all()
    nothing = labels([None] * 5)
    assert not nothing.label_valid.any()


def test_other_grids_sigmas_and_horizons() -> None:
    """A car at (50, −25) and the ego at (0, 0), on 200 × 100 cells of 0.4 m from (−20, −30)."""
    grid = BevGrid((-20, 60, 0.4), (-30, 10, 0.4))
    for protocol in LABEL_PROTOCOLS:
        config = MotionLabelConfig(
            grid=grid, receptive_field=2, future_frames=8, sigma=1.5, ignore_index=200, protocol=protocol
        )
        made = motion_labels_from_boxes([frame(OWN, (50, -25, 7, 0, 1))] * 9, np.zeros((10, 6)), config)
        assert made.offset.shape == (9, 2, 100, 200)
        rows, columns = np.nonzero(made.centerness[8, 0] == 1)
        assert_allclose(grid.centers()[rows, columns], [[50, -25], [0, 0]], atol=0.4)
        assert (made.offset[0, 0] == 200).sum() == (made.instance[0] == 0).sum()


def test_arrays_are_read_only_and_whole() -> None:
    made = labels([frame(OWN)] * 5)
    for name in ("segmentation", "instance", "centerness", "offset", "flow"):
        array = getattr(made, name)
        assert not array.flags.writeable
        assert array.flags.c_contiguous
    assert (made.segmentation.dtype, made.instance.dtype) == (np.uint8, np.int32)
    assert {getattr(made, name).dtype for name in ("centerness", "offset", "flow")} == {np.dtype(np.float32)}


def test_what_does_not_fit_is_refused_with_the_remedy() -> None:
    with pytest.raises(GeometryError, match=r"frames: expected 5.* found 4; give None for those beyond the recording"):
        labels([frame()] * 4)
    with pytest.raises(GeometryError, match=r"egomotion: expected shape \(7, 6\), found \(5, 6\)"):
        labels([frame()] * 5, np.zeros((5, 6)))
    with pytest.raises(GeometryError, match="egomotion: not all numbers are finite"):
        labels([frame()] * 5, np.full((7, 6), np.nan))
    with pytest.raises(GeometryError, match=r"FrameBoxes.yaw: expected shape \(0\), found \(1,\)"):
        replace(frame(), yaw=np.zeros(1))
    with pytest.raises(GeometryError, match=r"FrameBoxes.center: row 1 is not finite"):
        frame((0, 0, 1, 0, 1), (0, np.nan, 2, 0, 1))
