"""Check each rule of reading instances off maps by itself; the parity tests compare all of them
together with the released code.
"""

from dataclasses import astuple, replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from support.expected_errors import assert_raises

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


def draw_squares(
    *frames: dict[tuple[int, int], tuple[float, float]], orientation="released"
) -> MotionHeads:
    """Make perfect heads of 5 × 5 squares; each frame maps their middles to their flow."""
    logit = np.full((len(frames), 2, *SHAPE), [[[1]], [[-1]]], dtype=np.float32)
    centerness = np.zeros((len(frames), 1, *SHAPE), dtype=np.float32)
    offset = np.zeros((len(frames), 2, *SHAPE), dtype=np.float32)
    flow = np.zeros_like(offset)
    rows, columns = np.indices(SHAPE)
    for t, squares in enumerate(frames):
        for (row, column), move in squares.items():
            to_row = row - rows
            to_column = column - columns
            inside = (abs(to_row) <= 2) & (abs(to_column) <= 2)
            logit[t, :, inside] = -1, 1
            centerness[t, 0, row, column] = 1
            offset[t, 0][inside] = to_row[inside]
            offset[t, 1][inside] = to_column[inside]
            flow[t, :, inside] = move
    return MotionHeads(
        segmentation=logit,
        centerness=centerness,
        offset=offset,
        flow=flow,
        orientation=orientation,
    )


def ids_at(maps: np.ndarray, *cells: tuple[int, int]) -> list[int]:
    return [int(maps[cell]) for cell in cells]


def test_a_square_that_moves_keeps_its_id_and_has_a_path() -> None:
    heads = draw_squares(
        {(5, 5): (0, 4), (20, 30): (0, 0)},
        {(20, 31): (0, 0), (5, 9): (0, 0)},
    )

    linked = predict_instances(heads)

    assert ids_at(linked.instance[1], (5, 9), (20, 31), (0, 0)) == [1, 2, 0]
    assert_array_equal(linked.centers[1], [[5, 5], [5, 9]])
    assert_array_equal(linked.paths[2].cell_counts, [25, 25])
    assert linked.instance.dtype == np.int32
    assert linked.redrawn is None


def test_a_pair_must_be_nearer_than_the_link_distance() -> None:
    heads = draw_squares({(5, 5): (0, 0)}, {(5, 13): (0, 0)})
    for settings, instance in (
        (PostProcessing(link_distance=8.0), 2),
        (PostProcessing(link_distance=8.01), 1),
        ("fiery", 2),
    ):
        linked = predict_instances(heads, settings)
        assert ids_at(linked.instance[1], (5, 13)) == [instance]


def test_after_an_empty_frame_ids_are_counted_anew_and_may_come_twice() -> None:
    heads = draw_squares({}, {(5, 5): (0, 0)}, {(5, 5): (0, 0), (25, 30): (0, 0)})

    linked = predict_instances(heads)

    assert not linked.paths
    assert ids_at(linked.frame_instance[2], (5, 5), (25, 30)) == [1, 2]
    assert ids_at(linked.instance[2], (5, 5), (25, 30)) == [1, 1]


def test_new_ids_follow_the_order_of_a_python_set() -> None:
    """{0, 7, 8} lies as 0, 8, 7 in a set's eight slots: instance 8 gets the lower one of the new
    ids.
    """
    still = (0.0, 0.0)
    known = {(row, column): still for row in (2, 14) for column in (2, 14, 26)}
    heads = draw_squares(known, {**known, (26, 2): still, (26, 30): still})

    linked = predict_instances(heads)

    assert ids_at(linked.frame_instance[1], (26, 2), (26, 30)) == [7, 8]
    assert ids_at(linked.instance[1], (26, 2), (26, 30)) == [8, 7]


def test_without_any_background_the_lowest_instance_becomes_it() -> None:
    heads = draw_squares({(5, 5): (0, 0), (20, 30): (0, 0)})
    actors_only = np.full_like(heads.segmentation, [[[-1]], [[1]]])
    heads = replace(heads, segmentation=actors_only)

    linked = predict_instances(heads)
    assert ids_at(linked.instance[0], (5, 5), (20, 30)) == [0, 1]
    assert list(linked.paths) == [1]

    accident = predict_instances(heads, "accident")
    assert accident.redrawn is not None
    assert set(np.unique(accident.redrawn)) == {0, 1}


def test_the_first_centres_are_kept_up_to_the_limit_and_all_of_a_plateau() -> None:
    heads = draw_squares({(5, 5): (0, 0), (20, 30): (0, 0)})
    centerness = np.zeros_like(heads.centerness)
    centerness[0, 0, 3, 3:6] = 0.2
    centerness[0, 0, 20, 20] = 0.9
    heads = replace(heads, centerness=centerness)

    for settings, centers in (
        (PostProcessing(), [[3, 3], [3, 4], [3, 5], [20, 20]]),
        (PostProcessing(max_centers=2), [[3, 3], [3, 4]]),
        (PostProcessing(center_threshold=0.2), [[20, 20]]),
        (PostProcessing(max_centers=1, scan="devkit"), [[20, 20]]),
    ):
        assert_array_equal(predict_instances(heads, settings).frame_centers[0], centers)


@pytest.mark.parametrize("orientation", ["released", "devkit"])
def test_labels_are_not_taken_for_logits(orientation) -> None:
    heads = draw_squares({(5, 5): (0, 0)}, orientation=orientation)
    actor = heads.segmentation[:, 1] > 0
    labels = np.stack([~actor, actor], axis=1) * np.float32(10)
    heads = replace(heads, segmentation=labels)

    for rules in (POST_PROCESSING["accident"], PostProcessing(foreground="sigmoid")):
        as_labels = predict_instances(heads, rules)
        assert (as_labels.instance > 0).sum() == 25

        as_logits = predict_instances(heads, replace(rules, labels_bypass_sigmoid=False))
        assert (as_logits.frame_instance == 0).all()


def test_the_sigmoid_is_above_its_threshold_where_its_logit_is() -> None:
    heads = draw_squares({(5, 5): (0, 0)})
    margins = np.array([-1e-6, 1e-6, 1], dtype=np.float32)
    logit = np.full_like(heads.segmentation, -5)
    logit[0, 1, 5, 4:7] = np.log(0.4 / 0.6) + margins
    heads = replace(heads, segmentation=logit)

    linked = predict_instances(heads, PostProcessing(foreground="sigmoid"))

    assert ids_at(linked.instance[0], (5, 4), (5, 5), (5, 6)) == [0, 1, 1]


def test_redrawn_boxes_follow_the_path_but_not_across_a_gap() -> None:
    heads = draw_squares({(5, 5): (0, 8)}, {(5, 13): (0, 8)}, {(5, 21): (0, 0)})
    linked = predict_instances(heads, "accident")
    assert linked.redrawn is not None
    for frame, column in zip(linked.redrawn, (5, 13, 21), strict=True):
        rows, columns = np.nonzero(frame)
        assert (rows.min(), rows.max()) == (3, 7)
        assert (columns.min(), columns.max()) == (column - 2, column + 2)

    heads = draw_squares({(5, 5): (0, 8)}, {}, {(5, 5): (0, 0)})
    with_gap = predict_instances(heads, "accident")
    assert_array_equal(with_gap.paths[1].frames, [0, 2])
    assert with_gap.redrawn is not None
    assert with_gap.redrawn[1].any()
    assert not with_gap.redrawn[2].any()


def test_redrawn_boxes_are_cut_to_a_cars_size_and_later_ids_lie_on_top() -> None:
    heads = draw_squares({(4, 10): (0, 0), (5, 13): (0, 0)})
    logit = heads.segmentation.copy()
    logit[0, :, 18:21, 12:29] = [[[-1]], [[1]]]
    centerness = heads.centerness.copy()
    centerness[0, 0, 19, 20] = 1
    heads = replace(heads, segmentation=logit, centerness=centerness)

    linked = predict_instances(heads, "accident")

    assert linked.redrawn is not None
    rows, columns = np.nonzero(linked.redrawn[0] == 3)
    assert np.ptp(rows) == 2
    assert np.ptp(columns) == 10
    assert ids_at(linked.redrawn[0], (4, 12), (4, 9)) == [2, 1]


def test_trajectories_undo_the_half_cell() -> None:
    grid = BevGrid(x=(-10, 10, 0.5), y=(-5, 10, 0.5))
    heads = draw_squares({(5, 8): (0, 0)})
    released = predict_instances(heads)
    assert_allclose(trajectories(released, grid)[1], [[-6.0, 7.5]])
    assert_allclose(trajectories(released, grid, half_cell_shift=False)[1], [[-5.75, 7.25]])

    turned = predict_instances(heads.in_orientation("devkit"))
    assert_array_equal(turned.centers[1], [[24, 8]])
    assert_allclose(trajectories(turned, grid)[1], [[-6.0, 7.5]])

    fiery = predict_instances(heads.in_orientation("fiery"), "fiery")
    for protocol, point in {
        "released": [-6.0, 7.5],
        "clean": [-5.75, 7.25],
        "beverse": [-6.0, 7.0],
        "fiery": [-6.0, 7.0],
    }.items():
        for linked in (turned, fiery):
            shifted = trajectories(linked, grid, protocol)
            assert_allclose(shifted[1], [point])
            unshifted = trajectories(linked, grid, protocol, half_cell_shift=False)
            assert_allclose(unshifted[1], [[-5.75, 7.25]])

    assert_raises(
        (
            lambda: trajectories(turned, BevGrid(x=(0, 10, 0.5), y=(-5, 10, 0.5))),
            GeometryError,
            r"grid: has \(30, 20\) cells, but the instances have \(30, 40\)",
        ),
    )


def test_impossible_settings_are_refused() -> None:
    assert post_processing("motion") == PostProcessing()
    assert_raises(
        (
            lambda: predict_instances(draw_squares({}), "vpq"),
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
            lambda: predict_instances(draw_squares({}), None),
            ConfigError,
            "expected PostProcessing or the name of one, found None",
        ),
        (
            lambda: predict_instances({}),
            ConfigError,
            (
                r"heads: expected MotionHeads, found dict; make them from labels with "
                r"MotionHeads\.from_labels, or"
            ),
        ),
    )
    assert PostProcessing(max_centers=np.int64(100), link_distance=10) == PostProcessing()
    lowest = PostProcessing(max_centers=1, link_distance=0, center_threshold=0)
    assert astuple(lowest) == ("argmax", True, 0.0, 1, "released", 0.0, False)
    assert PostProcessing(max_centers=2**24).max_centers == 2**24


def test_the_named_settings_written_out() -> None:
    fields_by_name = {name: astuple(rules) for name, rules in POST_PROCESSING.items()}
    assert fields_by_name == {
        "motion": ("argmax", True, 0.1, 100, "released", 10.0, False),
        "accident": ("sigmoid", True, 0.1, 100, "released", 8.0, True),
        "fiery": ("argmax", True, 0.1, 100, "fiery", 3.0, False),
    }
    assert FOREGROUND_THRESHOLD == 0.4
    assert LABEL_LOGIT == 10.0


@pytest.mark.parametrize(("move", "turns"), [(3, False), (4, True)])
def test_a_redrawn_box_turns_after_a_move_of_four_cells_and_is_10_by_4_at_most(
    move: int, turns: bool
) -> None:
    hull = [(28, 8), (28, 16), (12, 16), (12, 8)]  # 16 × 8, along a row
    centers = np.array([[12.0, 20.0], [12.0 + move, 20.0], [13.0 + move, 20.0]])

    positions, ids = redrawn_cells([hull], centers[None], np.ones((1, 3), dtype=bool), (40, 40))

    extents = [np.ptp(position, axis=1).tolist() for position in positions]
    later_extent = [10, 4] if turns else [4, 10]
    assert extents == [[4, 10], later_extent, later_extent]
    assert [position.mean(axis=1).tolist() for position in positions] == centers.tolist()
    assert all((frame_ids == 1).all() for frame_ids in ids)


def test_the_smallest_redrawn_box_has_three_cells_a_side_and_stays_in_the_grid() -> None:
    shape = (8, 7)
    hulls = [[(0, 0)], [(5, 6)]]
    centers = np.array([[[0.0, 0.0]], [[6.0, 5.0]]])
    expected = np.zeros(shape, dtype=int)
    expected[:2, :2] = 1
    expected[5:8, 4:7] = 2

    positions, ids = redrawn_cells(hulls, centers, np.ones((2, 1)) > 0, shape)

    image = np.zeros(shape, dtype=int)
    image[tuple(positions[0])] = ids[0]
    assert_array_equal(image, expected)


def test_heads_come_from_anything_that_holds_an_array() -> None:
    heads = draw_squares({(5, 5): (0, 0)}, {(5, 6): (0, 0)}, orientation="devkit")
    expected = predict_instances(heads).instance
    maps = {
        "segmentation": np.array(heads.segmentation),
        "centerness": np.array(heads.centerness[:, 0]),
        "offset": np.array(heads.offset),
        "flow": np.array(heads.flow),
    }

    for wrap in (np.asarray, np.ndarray.tolist, lambda array: array.astype(np.float16)):
        wrapped = {name: wrap(array) for name, array in maps.items()}
        by_position = MotionHeads.from_arrays(*wrapped.values())
        assert_array_equal(predict_instances(by_position).instance, expected)
        by_name = MotionHeads(**wrapped)
        assert_array_equal(predict_instances(by_name).instance, expected)

    heads = MotionHeads.from_arrays(*maps.values())
    assert np.shares_memory(heads.offset, maps["offset"])
    assert MotionHeads.from_arrays(*maps.values(), ignore_index=255).ignore_index == 255


def test_impossible_heads_are_refused() -> None:
    good = np.zeros((2, 2, 3, 4), dtype=np.float32)
    heat = good[:, :1]
    assert_raises(
        (
            lambda: MotionHeads.from_arrays(good, heat, good.astype("U1"), good),
            GeometryError,
            r"offset: expected numbers, found ndarray \(not numeric: <U1\)",
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
            r"found \(2, 1, 3, 4\); if the model has a single logit x for actors, stack -x and x",
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
    certain[1, :, 2, 3] = -np.inf, np.inf
    heads = MotionHeads.from_arrays(certain, heat, good, good)
    assert heads.segmentation[1, 0, 2, 3] == -np.inf

    broken = good.copy()
    broken[1, 0, 2, 3] = np.nan
    assert_raises(
        (
            lambda: MotionHeads.from_arrays(broken, heat, good, good),
            GeometryError,
            r"segmentation: nan at \(1, 0, 2, 3\) is NaN or too large",
        ),
        (
            lambda: MotionHeads.from_arrays(
                np.where(np.isnan(broken), np.nan, np.inf), heat, good, good
            ),
            GeometryError,
            r"segmentation: nan at \(1, 0, 2, 3\) is NaN or too large",
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
    heads = draw_squares({(5, 5): (0, 0)}, {(5, 6): (0, 0)}, orientation="devkit")
    actor = heads.segmentation[:, 1] > 0
    background = np.broadcast_to(~actor[:, None], heads.offset.shape)
    labels = MotionLabels(
        config=config,
        segmentation=actor.astype(np.uint8),
        instance=actor.astype(np.int32),
        centerness=heads.centerness,
        offset=np.where(background, np.float32(255), heads.offset),
        flow=np.where(background, np.float32(255), heads.flow),
        future_egomotion=np.zeros((2, 6)),
        valid=np.ones(2, dtype=bool),
        id_map={-101: 1},
    )
    as_heads = MotionHeads.from_labels(labels)
    assert set(np.unique(as_heads.segmentation)) == {0, 10}
    released = as_heads.in_orientation("released")
    assert (released.offset == 255).sum() == 2 * 2 * (30 * 40 - 25)
    for name in ("motion", "accident"):
        assert_array_equal(predict_instances(as_heads, name).instance, labels.instance)
