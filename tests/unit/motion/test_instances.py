"""Each rule of reading instances off maps by itself; that all of them together are the released
code's, parity says.
"""

from dataclasses import astuple, replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusals import assert_refused

from deepaccident_devkit.errors import ChoiceError, ConfigError, GeometryError
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion.config import MotionLabelConfig
from deepaccident_devkit.motion.grouping import LABEL_LOGIT, MotionHeads
from deepaccident_devkit.motion.instances import (
    FOREGROUND_THRESHOLD,
    POST_PROCESSING,
    PostProcessing,
    post_processing,
    predict_instances,
    trajectories,
)
from deepaccident_devkit.motion.labels import MotionLabels
from deepaccident_devkit.motion.reference_arithmetic.contours import redrawn_cells

SHAPE = (30, 40)


def drawn(
    *frames: dict[tuple[int, int], tuple[float, float]], orientation="released"
) -> MotionHeads:
    """Perfect heads of 5 × 5 squares: per frame, where their middles are and their flow."""
    logit = np.full((len(frames), 2, *SHAPE), [[[1]], [[-1]]], dtype=np.float32)
    centerness = np.zeros((len(frames), 1, *SHAPE), dtype=np.float32)
    offset, flow = np.zeros((2, len(frames), 2, *SHAPE), dtype=np.float32)
    down, across = np.indices(SHAPE)
    for t, squares in enumerate(frames):
        for (row, column), move in squares.items():
            here = (abs(down - row) <= 2) & (abs(across - column) <= 2)
            logit[t, :, here] = -1, 1
            centerness[t, 0, row, column] = 1
            offset[t, 0][here], offset[t, 1][here] = (row - down)[here], (column - across)[here]
            flow[t, :, here] = move
    return MotionHeads(
        segmentation=logit, centerness=centerness, offset=offset, flow=flow, orientation=orientation
    )


def ids_at(maps: np.ndarray, *cells: tuple[int, int]) -> list[int]:
    return [int(maps[cell]) for cell in cells]


def test_a_square_that_moves_keeps_its_id_and_has_a_path() -> None:
    linked = predict_instances(
        drawn({(5, 5): (0, 4), (20, 30): (0, 0)}, {(20, 31): (0, 0), (5, 9): (0, 0)})
    )
    assert ids_at(linked.instance[1], (5, 9), (20, 31), (0, 0)) == [1, 2, 0]
    assert_array_equal(linked.centers[1], [[5, 5], [5, 9]])
    assert_array_equal(linked.paths[2].cell_counts, [25, 25])
    assert (linked.instance.dtype, linked.redrawn) == (np.int32, None)


def test_a_pair_must_be_nearer_than_the_link_distance() -> None:
    heads = drawn({(5, 5): (0, 0)}, {(5, 13): (0, 0)})
    assert ids_at(
        predict_instances(heads, PostProcessing(link_distance=8.0)).instance[1], (5, 13)
    ) == [2]
    assert ids_at(
        predict_instances(heads, PostProcessing(link_distance=8.01)).instance[1], (5, 13)
    ) == [1]
    assert ids_at(predict_instances(heads, "fiery").instance[1], (5, 13)) == [2]


def test_after_an_empty_frame_ids_are_counted_anew_and_may_come_twice() -> None:
    nobody: dict[tuple[int, int], tuple[float, float]] = {}
    linked = predict_instances(drawn(nobody, {(5, 5): (0, 0)}, {(5, 5): (0, 0), (25, 30): (0, 0)}))
    assert not linked.paths
    assert ids_at(linked.frame_instance[2], (5, 5), (25, 30)) == [1, 2]
    assert ids_at(linked.instance[2], (5, 5), (25, 30)) == [1, 1]


def test_new_ids_follow_the_order_of_a_python_set() -> None:
    """{0, 7, 8} lies as 0, 8, 7 in a set's eight slots: instance 8 gets the lower one of the new
    ids.
    """
    still = (0.0, 0.0)
    known = {(row, column): still for row in (2, 14) for column in (2, 14, 26)}
    linked = predict_instances(drawn(known, {**known, (26, 2): still, (26, 30): still}))
    assert ids_at(linked.frame_instance[1], (26, 2), (26, 30)) == [7, 8]
    assert ids_at(linked.instance[1], (26, 2), (26, 30)) == [8, 7]


def test_without_any_background_the_lowest_instance_becomes_it() -> None:
    heads = drawn({(5, 5): (0, 0), (20, 30): (0, 0)})
    full = replace(
        heads, segmentation=np.broadcast_to(np.float32([[[-1]], [[1]]]), heads.segmentation.shape)
    )
    linked = predict_instances(full)
    assert (ids_at(linked.instance[0], (5, 5), (20, 30)), list(linked.paths)) == ([0, 1], [1])
    accident = predict_instances(full, "accident")
    assert accident.redrawn is not None
    assert set(np.unique(accident.redrawn)) == {0, 1}


def test_the_first_of_too_many_centres_are_kept_and_all_of_a_plateau() -> None:
    heads = drawn({(5, 5): (0, 0), (20, 30): (0, 0)})
    flat = np.zeros_like(heads.centerness)
    flat[0, 0, 3, 3:6], flat[0, 0, 20, 20] = 0.2, 0.9
    assert_array_equal(
        predict_instances(replace(heads, centerness=flat)).frame_centers[0],
        [[3, 3], [3, 4], [3, 5], [20, 20]],
    )
    first = predict_instances(replace(heads, centerness=flat), PostProcessing(max_centers=2))
    assert_array_equal(first.frame_centers[0], [[3, 3], [3, 4]])
    threshold = predict_instances(
        replace(heads, centerness=flat), PostProcessing(center_threshold=0.2)
    )
    assert_array_equal(threshold.frame_centers[0], [[20, 20]])
    from_below = predict_instances(
        replace(heads, centerness=flat), PostProcessing(max_centers=1, scan="devkit")
    )
    assert_array_equal(from_below.frame_centers[0], [[20, 20]])


@pytest.mark.parametrize("orientation", ["released", "devkit"])
def test_labels_are_not_taken_for_logits(orientation) -> None:
    heads = drawn({(5, 5): (0, 0)}, orientation=orientation)
    actor = heads.segmentation[:, 1] > 0
    encoded = replace(heads, segmentation=np.stack([~actor, actor], axis=1) * np.float32(10))
    for rules in (POST_PROCESSING["accident"], PostProcessing(foreground="sigmoid")):
        assert (predict_instances(encoded, rules).instance > 0).sum() == 25
        assert (
            predict_instances(encoded, replace(rules, labels_bypass_sigmoid=False)).frame_instance
            == 0
        ).all()


def test_the_sigmoid_is_above_its_threshold_where_its_logit_is() -> None:
    heads = drawn({(5, 5): (0, 0)})
    logit = np.full_like(heads.segmentation, -5)
    logit[0, 1, 5, 4:7] = np.log(0.4 / 0.6) + np.array([-1e-6, 1e-6, 1], dtype=np.float32)
    found = predict_instances(
        replace(heads, segmentation=logit), PostProcessing(foreground="sigmoid")
    )
    assert ids_at(found.instance[0], (5, 4), (5, 5), (5, 6)) == [0, 1, 1]


def test_redrawn_boxes_follow_the_path_but_not_across_a_gap() -> None:
    redrawn = predict_instances(
        drawn({(5, 5): (0, 8)}, {(5, 13): (0, 8)}, {(5, 21): (0, 0)}), "accident"
    ).redrawn
    assert redrawn is not None
    for frame, column in zip(redrawn, (5, 13, 21), strict=True):
        rows, columns = np.nonzero(frame)
        assert (rows.min(), rows.max(), columns.min(), columns.max()) == (
            3,
            7,
            column - 2,
            column + 2,
        )
    missing = predict_instances(drawn({(5, 5): (0, 8)}, {}, {(5, 5): (0, 0)}), "accident")
    assert_array_equal(missing.paths[1].frames, [0, 2])
    assert missing.redrawn is not None
    assert missing.redrawn[1].any()
    assert not missing.redrawn[2].any()


def test_redrawn_boxes_are_cut_to_a_cars_size_and_later_ids_lie_on_top() -> None:
    heads = drawn({(4, 10): (0, 0), (5, 13): (0, 0)})
    long = heads.segmentation.copy()
    long[0, :, 18:21, 12:29] = [[[-1]], [[1]]]
    centerness = heads.centerness.copy()
    centerness[0, 0, 19, 20] = 1
    linked = predict_instances(replace(heads, segmentation=long, centerness=centerness), "accident")
    assert linked.redrawn is not None
    rows, columns = np.nonzero(linked.redrawn[0] == 3)
    assert (np.ptp(rows), np.ptp(columns), ids_at(linked.redrawn[0], (4, 12), (4, 9))) == (
        2,
        10,
        [2, 1],
    )


def test_trajectories_undo_the_half_cell() -> None:
    grid, heads = BevGrid(x=(-10, 10, 0.5), y=(-5, 10, 0.5)), drawn({(5, 8): (0, 0)})
    assert_allclose(trajectories(predict_instances(heads), grid)[1], [[-6.0, 7.5]])
    assert_allclose(
        trajectories(predict_instances(heads), grid, half_cell_shift=False)[1], [[-5.75, 7.25]]
    )
    turned = predict_instances(heads.in_orientation("devkit"))
    assert_array_equal(turned.centers[1], [[24, 8]])
    assert_allclose(trajectories(turned, grid)[1], [[-6.0, 7.5]])
    native = predict_instances(heads.in_orientation("fiery"), "fiery")
    for protocol, place in {
        "released": [-6.0, 7.5],
        "clean": [-5.75, 7.25],
        "beverse": [-6.0, 7.0],
        "fiery": [-6.0, 7.0],
    }.items():
        for linked in (turned, native):
            assert_allclose(trajectories(linked, grid, protocol)[1], [place])
            assert_allclose(
                trajectories(linked, grid, protocol, half_cell_shift=False)[1], [[-5.75, 7.25]]
            )
    assert_refused(
        (
            lambda: trajectories(turned, BevGrid(x=(0, 10, 0.5), y=(-5, 10, 0.5))),
            GeometryError,
            r"grid: has \(30, 20\) cells, but the instances have \(30, 40\)",
        ),
    )


def test_settings_that_cannot_be() -> None:
    assert post_processing("motion") == PostProcessing()
    assert_refused(
        (
            lambda: predict_instances(drawn({}), "vpq"),
            ChoiceError,
            "post-processing: expected one of motion, accident, fiery, found 'vpq'",
        ),
        (
            lambda: PostProcessing(foreground="softmax"),
            ChoiceError,
            "foreground: expected one of argmax, sigmoid, found 'softmax'",
        ),
        (
            lambda: PostProcessing(scan="left"),
            ChoiceError,
            "scan: expected one of devkit, released, fiery, found 'left'",
        ),
        (
            lambda: PostProcessing(link_distance=float("nan")),
            ConfigError,
            "link_distance: expected a number of cells from 0, found nan",
        ),
        (
            lambda: PostProcessing(max_centers=True),
            ConfigError,
            r"max_centers: expected a whole number from 1 .*, found True",
        ),
        (
            lambda: PostProcessing(max_centers=2**24 + 1),
            ConfigError,
            "from 1 to 16,777,216 .* found 16777217",
        ),
        (
            lambda: PostProcessing(max_centers=0),
            ConfigError,
            "max_centers: expected a whole number from 1 .* found 0",
        ),
        (
            lambda: PostProcessing(link_distance=-0.1),
            ConfigError,
            "a number of cells from 0, found -0.1",
        ),
        (
            lambda: PostProcessing(center_threshold=-0.1),
            ConfigError,
            "center_threshold: expected a number from 0, found",
        ),
        (lambda: PostProcessing(redraw=1), ConfigError, "redraw: expected True or False, found 1"),
        (
            lambda: predict_instances(drawn({}), None),
            ConfigError,
            "expected PostProcessing or the name of one, found None",
        ),
        (
            lambda: predict_instances({}),
            ConfigError,
            r"heads: expected MotionHeads, found dict; MotionHeads.from_labels",
        ),
    )
    assert PostProcessing(max_centers=np.int64(100), link_distance=10) == PostProcessing()
    least = PostProcessing(max_centers=1, link_distance=0, center_threshold=0)
    assert astuple(least) == ("argmax", True, 0.0, 1, "released", 0.0, False)
    assert PostProcessing(max_centers=2**24).max_centers == 2**24


def test_the_named_settings_written_out() -> None:
    assert {name: astuple(rules) for name, rules in POST_PROCESSING.items()} == {
        "motion": ("argmax", True, 0.1, 100, "released", 10.0, False),
        "accident": ("sigmoid", True, 0.1, 100, "released", 8.0, True),
        "fiery": ("argmax", True, 0.1, 100, "fiery", 3.0, False),
    }
    assert (FOREGROUND_THRESHOLD, LABEL_LOGIT) == (0.4, 10.0)


@pytest.mark.parametrize(("move", "turns"), [(3, False), (4, True)])
def test_a_redrawn_box_turns_after_a_move_of_four_cells_and_is_10_by_4_at_most(
    move: int, turns: bool
) -> None:
    hull = [(28, 8), (28, 16), (12, 16), (12, 8)]  # 16 × 8, along a row
    centers = np.array([[[12.0, 20.0], [12.0 + move, 20.0], [13.0 + move, 20.0]]])
    positions, ids = redrawn_cells([hull], centers, np.ones((1, 3), dtype=bool), (40, 40))
    assert [tuple(np.ptp(position, axis=1).tolist()) for position in positions] == [
        (4, 10),
        *[(10, 4) if turns else (4, 10)] * 2,
    ]
    assert [position.mean(axis=1).tolist() for position in positions] == centers[0].tolist()
    assert all((one == 1).all() for one in ids)


def test_the_smallest_redrawn_box_has_three_cells_a_side_and_stays_in_the_grid() -> None:
    positions, ids = redrawn_cells(
        [[(0, 0)], [(5, 6)]], np.array([[[0.0, 0.0]], [[6.0, 5.0]]]), np.ones((2, 1)) > 0, (8, 7)
    )
    expected = np.zeros((8, 7), dtype=int)
    expected[:2, :2], expected[5:8, 4:7] = 1, 2
    found = np.zeros((8, 7), dtype=int)
    found[tuple(positions[0])] = ids[0]
    assert_array_equal(found, expected)


def test_heads_come_from_anything_that_holds_an_array() -> None:
    heads = drawn({(5, 5): (0, 0)}, {(5, 6): (0, 0)}, orientation="devkit")
    maps = [
        np.array(array)
        for array in (heads.segmentation, heads.centerness, heads.offset, heads.flow)
    ]
    maps[1] = maps[1][:, 0]
    expected = predict_instances(heads).instance
    for wrap in (np.asarray, np.ndarray.tolist, lambda array: array.astype(np.float16)):
        assert_array_equal(
            predict_instances(MotionHeads.from_arrays(*map(wrap, maps))).instance, expected
        )
        names = ("segmentation", "centerness", "offset", "flow")
        by_name = MotionHeads(
            **{name: wrap(values) for name, values in zip(names, maps, strict=True)}
        )
        assert_array_equal(predict_instances(by_name).instance, expected)
    assert np.shares_memory(MotionHeads.from_arrays(*maps).offset, maps[2])
    assert MotionHeads.from_arrays(*maps, ignore_index=255).ignore_index == 255


def test_heads_that_cannot_be() -> None:
    good = np.zeros((2, 2, 3, 4), dtype=np.float32)
    heat = good[:, :1]
    assert_refused(
        (
            lambda: MotionHeads.from_arrays(good, heat, good.astype("U1"), good),
            GeometryError,
            r"offset: expected numbers, found ndarray \(no numbers: <U1\)",
        ),
        (
            lambda: MotionHeads.from_arrays(np.zeros((2, 3, 3, 4)), heat, good, good),
            GeometryError,
            r"segmentation: expected \(T, 2, H, W\), .*, found \(2, 3, 3, 4\)$",
        ),
        (
            lambda: MotionHeads.from_arrays(np.moveaxis(good, 1, -1), heat, good, good),
            GeometryError,
            r"found \(2, 3, 4, 2\); move the channels to the second axis",
        ),
        (
            lambda: MotionHeads.from_arrays(heat, heat, good, good),
            GeometryError,
            r"found \(2, 1, 3, 4\); of a single logit x for actors, stack -x and x",
        ),
        (
            lambda: MotionHeads.from_arrays(good, good, good, good),
            GeometryError,
            r"centerness: expected shape \(2, 1, 3, 4\), found \(2, 2, 3, 4\)",
        ),
        (
            lambda: MotionHeads.from_arrays(good, heat, good, good[:1]),
            GeometryError,
            r"flow: expected shape \(2, 2, 3, 4\), found \(1, 2, 3, 4\)",
        ),
        (
            lambda: MotionHeads.from_arrays(good[:0], heat[:0], good[:0], good[:0]),
            GeometryError,
            r"at least one frame of one cell, found \(0, 2, 3, 4\)",
        ),
    )
    certain = good.copy()
    certain[1, 0, 2, 3], certain[1, 1, 2, 3] = -np.inf, np.inf
    assert MotionHeads.from_arrays(certain, heat, good, good).segmentation[1, 0, 2, 3] == -np.inf
    broken = good.copy()
    broken[1, 0, 2, 3] = np.nan
    assert_refused(
        (
            lambda: MotionHeads.from_arrays(broken, heat, good, good),
            GeometryError,
            r"segmentation: nan at \(1, 0, 2, 3\) cannot be used",
        ),
        (
            lambda: MotionHeads.from_arrays(
                np.where(np.isnan(broken), np.nan, np.inf), heat, good, good
            ),
            GeometryError,
            r"segmentation: nan at \(1, 0, 2, 3\) cannot be used",
        ),
        (
            lambda: MotionHeads.from_arrays(good, heat, good, good - 1.1e15),
            GeometryError,
            r"flow: -1099999978979328.0 at \(0, 0, 0, 0",
        ),
        (
            lambda: MotionHeads.from_arrays(good, heat, good + np.inf, good),
            GeometryError,
            r"offset: inf at \(0, 0, 0, 0\)",
        ),
        (
            lambda: MotionHeads.from_arrays(good, heat, good, good, orientation="up"),
            ChoiceError,
            "orientation: expected one of devkit, released, fiery, found 'up'",
        ),
    )


def test_labels_are_a_prediction_that_is_right_and_255_is_no_vector() -> None:
    config = MotionLabelConfig(
        grid=BevGrid(x=(0, 20, 0.5), y=(0, 15, 0.5)), receptive_field=1, future_frames=1
    )
    heads = drawn({(5, 5): (0, 0)}, {(5, 6): (0, 0)}, orientation="devkit")
    actor = heads.segmentation[:, 1] > 0
    background = np.broadcast_to(~actor[:, None], heads.offset.shape)
    labels = MotionLabels(
        config=config,
        segmentation=actor.astype(np.uint8),
        instance=actor.astype(np.int32),
        centerness=heads.centerness,
        offset=np.where(background, 255, heads.offset).astype(np.float32),
        flow=np.where(background, 255, heads.flow).astype(np.float32),
        future_egomotion=np.zeros((2, 6)),
        valid=np.ones(2, dtype=bool),
        id_map={-101: 1},
    )
    as_heads = MotionHeads.from_labels(labels)
    assert set(np.unique(as_heads.segmentation)) == {0, 10}
    assert (as_heads.in_orientation("released").offset == 255).sum() == 2 * 2 * (30 * 40 - 25)
    for name in ("motion", "accident"):
        assert_array_equal(predict_instances(as_heads, name).instance, labels.instance)
