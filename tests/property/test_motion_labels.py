"""Laws of motion labels: an id's cells are its box, flow leads to the next frame, orientations hold
the same.
"""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.testing import assert_allclose, assert_array_equal
from strategies import ANGLES, grids, numbers

from deepaccident_devkit.geometry import SE3, BevGrid, conventions
from deepaccident_devkit.geometry.bev_grid import ORIENTATIONS, cells_in, to_orientation, vectors_in
from deepaccident_devkit.motion import (
    LABEL_PROTOCOLS,
    FrameBoxes,
    MotionLabelConfig,
    motion_labels_from_boxes,
)

CELL = 0.5
orientations = st.sampled_from(ORIENTATIONS)
protocols = st.sampled_from(sorted(LABEL_PROTOCOLS))


@st.composite
def placed_boxes(draw: st.DrawFn, reach: float = 60.0) -> tuple[np.ndarray, np.ndarray, float]:
    """Centre (3,), size (3,) and yaw of a road user's box."""
    center = np.array([draw(numbers(reach)), draw(numbers(reach)), 0.0])
    return center, np.array([draw(st.floats(0.4, 12)), draw(st.floats(0.4, 3)), 1.5]), draw(ANGLES)


def frame(center, size, yaw) -> FrameBoxes:
    return FrameBoxes(
        center=np.reshape(center, (-1, 3)),
        size=np.reshape(size, (-1, 3)),
        yaw=np.reshape(yaw, -1),
        actor_id=np.arange(1, 1 + np.size(yaw)),
        category=np.zeros(np.size(yaw)),
        visible=np.ones(np.size(yaw)),
        ego_from_lidar=np.eye(4),
    )


def labels(frames, motion, orientation="devkit", protocol="clean"):
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
    """All cells well inside it, none well beside it: the corners are moved to cells, by less than
    one each way.
    """
    made = labels([frame(*box)] * 2, np.zeros((2, 6)), orientation)
    center, size, yaw = box
    across, along = np.moveaxis(made.config.grid.centers() - center[:2], -1, 0)
    ahead = across * np.cos(yaw) + along * np.sin(yaw)
    left = along * np.cos(yaw) - across * np.sin(yaw)
    beyond = np.maximum(np.abs(ahead) - size[0] / 2, np.abs(left) - size[1] / 2)
    drawn = made.instance[0] == 1
    reach = np.sqrt(2) * CELL
    assert (beyond[drawn] <= reach).all()
    assert drawn[beyond < -reach].all()
    assert_array_equal(made.segmentation[0] == 1, drawn)


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
    """In metres, seen from this frame's ego, to the cells' accuracy.

    Each of two centres is off by less than a cell, for the corners are, and rounded; the warp adds
    half a diagonal.
    """
    center, size, yaw = box
    moved = center + np.array([dx, dy, 0])
    next_from_this = SE3.from_six([ex, ey, 0, 0, 0, eyaw])
    seen = next_from_this.apply(moved[None])[0]
    frames = [frame(center, size, yaw), frame(seen, size, yaw + turned + eyaw)]
    made = labels(frames, np.stack([next_from_this.to_six(), np.zeros(6)]), orientation)
    flow = made.flow[0][:, made.instance[0] == 1]
    assert (flow == flow[:, :1]).all()
    grid = made.config.grid
    step = np.stack(
        [grid.centers()[1, 0] - grid.centers()[0, 0], grid.centers()[0, 1] - grid.centers()[0, 0]]
    )
    assert_allclose(flow[:, 0] @ step, [dx, dy], atol=(2 * 1.5 + np.sqrt(0.5)) * CELL)
    assert (made.flow[0][:, made.instance[0] == 0] == 255).all()


@given(st.lists(placed_boxes(), max_size=4), numbers(3.0), numbers(0.3), orientations, protocols)
def test_offsets_lead_to_the_peak(boxes, ahead, turn, orientation, protocol) -> None:
    centers, sizes, yaws = (np.array([box[part] for box in boxes]) for part in range(3))
    motion = np.tile([ahead, 0, 0, 0, 0, turn], (3, 1))
    made = labels([frame(centers, sizes, yaws)] * 3, motion, orientation, protocol)
    t, row, column = np.nonzero(made.instance)
    down, along = made.offset[t, :, row, column].T
    assert (
        made.centerness[t, 0, (row + down).astype(int), (column + along).astype(int)] == 1
    ).all()
    assert ((made.offset == 255).all(axis=1) == (made.instance == 0)).all()
    assert (
        (made.centerness == 1).sum(axis=(1, 2, 3)) <= made.instance.reshape(3, -1).max(axis=1)
    ).all()


@given(st.lists(placed_boxes(), max_size=4), numbers(3.0), numbers(0.3), orientations, protocols)
def test_labels_of_every_orientation_are_the_same_cells(
    boxes, ahead, turn, orientation, protocol
) -> None:
    centers, sizes, yaws = (np.array([box[part] for box in boxes]) for part in range(3))
    motion = np.tile([ahead, 0, 0, 0, 0, turn], (2, 1))
    frames = [frame(centers, sizes, yaws)] * 2
    devkit, other = (labels(frames, motion, lying, protocol) for lying in ("devkit", orientation))
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
    def turned(array, source, target):
        return to_orientation(array, vectors=vectors, source=source, target=target, ignore=3)

    assert_array_equal(turned(turned(maps, first, second), second, first), maps)
    assert_array_equal(
        turned(turned(maps, first, second), second, third), turned(maps, first, third)
    )


@given(grids(), orientations, st.data())
def test_cells_and_vectors_change_with_the_maps(grid: BevGrid, target, data) -> None:
    rows, columns = grid.shape
    row, column = data.draw(st.integers(0, rows - 1)), data.draw(st.integers(0, columns - 1))
    down, along = data.draw(st.integers(-3, 3)), data.draw(st.integers(-3, 3))
    raster = np.zeros((2, rows, columns))
    raster[:, row, column] = down, along
    lying = {"source": grid.orientation, "target": target}
    there = cells_in(np.array(row), np.array(column), grid.shape, **lying)
    turned = to_orientation(raster, vectors=True, **lying)
    assert_array_equal(
        turned[:, there[0], there[1]], vectors_in(np.array(down), np.array(along), **lying)
    )
    assert_allclose(grid.with_orientation(target).centers()[there], grid.centers()[row, column])


@given(placed_boxes(40.0), numbers(20.0), numbers(0.5))
def test_the_released_flow_of_what_stands_still_is_the_egos_motion(box, ahead, turn) -> None:
    """Whatever the ego does, what stands still in the world has no flow, to the cells' accuracy."""
    center, size, yaw = box
    motion = np.array([-ahead / 10, 0, 0, 0, 0, turn / 5])
    next_from_this = SE3(conventions.matrices_of_six(motion))
    seen = next_from_this.apply(center[None])[0]
    frames = [frame(center, size, yaw), frame(seen, size, yaw + turn / 5)]
    made = labels(frames, np.stack([motion, np.zeros(6)]), "released", "released")
    flow = made.flow[0][:, made.instance[0] == 1]
    assert (np.abs(flow[flow != 255]) <= 2).all()
