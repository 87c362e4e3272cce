"""Laws of motion labels: cells cover the box, flow leads to the next frame, orientations agree."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.testing import assert_allclose, assert_array_equal
from support.strategies import ANGLES, grids, numbers

from deepaccident_devkit.geometry import SE3, BevGrid, conventions
from deepaccident_devkit.geometry.bev_grid import ORIENTATIONS, cells_in, to_orientation, vectors_in
from deepaccident_devkit.motion import (
    LABEL_PROTOCOLS,
    FrameBoxes,
    MotionLabelConfig,
    motion_labels_from_boxes,
)

CELL_M = 0.5
orientations = st.sampled_from(ORIENTATIONS)
protocols = st.sampled_from(sorted(LABEL_PROTOCOLS))


@st.composite
def placed_boxes(draw: st.DrawFn, reach: float = 60.0) -> tuple[np.ndarray, np.ndarray, float]:
    """Centre (3,), size (3,) and yaw of a road user's box."""
    center = np.array([draw(numbers(reach)), draw(numbers(reach)), 0.0])
    size = np.array([draw(st.floats(0.4, 12)), draw(st.floats(0.4, 3)), 1.5])
    return center, size, draw(ANGLES)


def stack_boxes(boxes: list) -> FrameBoxes:
    centers, sizes, yaws = (np.array([box[column] for box in boxes]) for column in range(3))
    return make_frame(centers, sizes, yaws)


def make_frame(center, size, yaw) -> FrameBoxes:
    return FrameBoxes(
        center=np.reshape(center, (-1, 3)),
        size=np.reshape(size, (-1, 3)),
        yaw=np.reshape(yaw, -1),
        actor_id=np.arange(1, 1 + np.size(yaw)),
        category=np.zeros(np.size(yaw)),
        visible=np.ones(np.size(yaw)),
        ego_from_lidar=np.eye(4),
    )


def make_labels(frames, motion, orientation="devkit", protocol="clean"):
    config = MotionLabelConfig(
        receptive_field=1,
        future_frames=len(frames) - 1,
        orientation=orientation,
        protocol=protocol,
        draw_ego=False,
    )
    return motion_labels_from_boxes(frames, motion, config)


@given(placed_boxes(), orientations)
def test_the_cells_of_an_id_are_its_box(box, orientation) -> None:
    """All cells well inside it and none well outside it: each corner moves by less than a cell."""
    labels = make_labels([make_frame(*box)] * 2, np.zeros((2, 6)), orientation)
    center, size, yaw = box
    x, y = np.moveaxis(labels.config.grid.centers() - center[:2], -1, 0)
    ahead = x * np.cos(yaw) + y * np.sin(yaw)
    left = y * np.cos(yaw) - x * np.sin(yaw)
    distance = np.maximum(np.abs(ahead) - size[0] / 2, np.abs(left) - size[1] / 2)
    is_drawn = labels.instance[0] == 1
    max_error = np.sqrt(2) * CELL_M
    assert (distance[is_drawn] <= max_error).all()
    assert is_drawn[distance < -max_error].all()
    assert_array_equal(labels.segmentation[0] == 1, is_drawn)


@given(
    placed_boxes(30.0),
    numbers(8.0),
    numbers(8.0),
    ANGLES,
    numbers(5.0),
    numbers(5.0),
    numbers(0.3),
    orientations,
)
def test_flow_leads_to_where_the_box_is_at_the_next_frame(
    box, dx, dy, turned, ex, ey, eyaw, orientation
) -> None:
    """The flow is in metres, seen from this frame's ego, as accurate as cells allow.

    Each of two centres is off by less than a cell, because the corners are, and is rounded; the
    warp adds half a diagonal.
    """
    center, size, yaw = box
    next_center = center + np.array([dx, dy, 0])
    next_from_this = SE3.from_six([ex, ey, 0, 0, 0, eyaw])
    seen_center = next_from_this.apply(next_center[None])[0]
    frames = [make_frame(center, size, yaw), make_frame(seen_center, size, yaw + turned + eyaw)]
    motion = np.stack([next_from_this.to_six(), np.zeros(6)])
    labels = make_labels(frames, motion, orientation)

    is_drawn = labels.instance[0] == 1
    flow = labels.flow[0][:, is_drawn]
    assert (flow == flow[:, :1]).all()
    centers = labels.config.grid.centers()
    cell_steps = np.stack([centers[1, 0] - centers[0, 0], centers[0, 1] - centers[0, 0]])
    max_error = (2 * 1.5 + np.sqrt(0.5)) * CELL_M
    assert_allclose(flow[:, 0] @ cell_steps, [dx, dy], atol=max_error)
    assert (labels.flow[0][:, ~is_drawn] == 255).all()


@given(st.lists(placed_boxes(), max_size=4), numbers(3.0), numbers(0.3), orientations, protocols)
def test_offsets_lead_to_the_peak(boxes, ahead, turn, orientation, protocol) -> None:
    motion = np.tile([ahead, 0, 0, 0, 0, turn], (3, 1))
    labels = make_labels([stack_boxes(boxes)] * 3, motion, orientation, protocol)
    t, row, column = np.nonzero(labels.instance)
    down, along = labels.offset[t, :, row, column].T
    peak_row = (row + down).astype(int)
    peak_column = (column + along).astype(int)
    assert (labels.centerness[t, 0, peak_row, peak_column] == 1).all()
    assert ((labels.offset == 255).all(axis=1) == (labels.instance == 0)).all()
    num_peaks = (labels.centerness == 1).sum(axis=(1, 2, 3))
    assert (num_peaks <= labels.instance.max(axis=(1, 2))).all()


@given(st.lists(placed_boxes(), max_size=4), numbers(3.0), numbers(0.3), orientations, protocols)
def test_labels_of_every_orientation_are_the_same_cells(
    boxes, ahead, turn, orientation, protocol
) -> None:
    motion = np.tile([ahead, 0, 0, 0, 0, turn], (2, 1))
    frames = [stack_boxes(boxes)] * 2
    devkit = make_labels(frames, motion, "devkit", protocol)
    other = make_labels(frames, motion, orientation, protocol)
    for name in ("segmentation", "instance", "centerness", "offset", "flow"):
        turned = to_orientation(
            getattr(devkit, name),
            vectors=name in ("offset", "flow"),
            source="devkit",
            target=orientation,
            ignore=255,
        )
        assert_array_equal(getattr(other, name), turned)


@given(
    hnp.arrays(np.float32, (3, 2, 4, 5), elements=st.integers(-2, 3)),
    *[orientations] * 3,
    st.booleans(),
)
def test_orientations_compose(maps, first, second, third, vectors) -> None:
    def turn(array, source, target):
        return to_orientation(array, vectors=vectors, source=source, target=target, ignore=3)

    turned = turn(maps, first, second)
    assert_array_equal(turn(turned, second, first), maps)
    assert_array_equal(turn(turned, second, third), turn(maps, first, third))


@given(grids(), orientations, st.data())
def test_cells_and_vectors_change_with_the_maps(grid: BevGrid, target, data) -> None:
    rows, columns = grid.shape
    row, column = data.draw(st.integers(0, rows - 1)), data.draw(st.integers(0, columns - 1))
    down, along = data.draw(st.integers(-3, 3)), data.draw(st.integers(-3, 3))
    raster = np.zeros((2, rows, columns))
    raster[:, row, column] = down, along
    options = {"source": grid.orientation, "target": target}
    cell = cells_in(np.array(row), np.array(column), grid.shape, **options)
    vector = vectors_in(np.array(down), np.array(along), **options)
    turned = to_orientation(raster, vectors=True, **options)
    assert_array_equal(turned[:, cell[0], cell[1]], vector)
    assert_allclose(grid.with_orientation(target).centers()[cell], grid.centers()[row, column])


@given(placed_boxes(40.0), numbers(20.0), numbers(0.5))
def test_the_released_flow_of_what_stands_still_is_the_egos_motion(box, ahead, turn) -> None:
    """For any motion of the ego, a standing box has no flow beyond the accuracy of cells."""
    center, size, yaw = box
    motion = np.array([-ahead / 10, 0, 0, 0, 0, turn / 5])
    next_from_this = SE3(conventions.matrices_of_six(motion))
    seen_center = next_from_this.apply(center[None])[0]
    frames = [make_frame(center, size, yaw), make_frame(seen_center, size, yaw + turn / 5)]
    labels = make_labels(frames, np.stack([motion, np.zeros(6)]), "released", "released")
    flow = labels.flow[0][:, labels.instance[0] == 1]
    assert (np.abs(flow[flow != 255]) <= 2).all()
