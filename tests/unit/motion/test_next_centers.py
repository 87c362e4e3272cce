"""Looking only at the cells around footprints finds the same centres as looking at all cells."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from deepaccident_devkit.exact.polygon_fill import topmost
from deepaccident_devkit.geometry import BevGrid, conventions
from deepaccident_devkit.motion import LABEL_PROTOCOLS, MotionLabelConfig, drawing
from deepaccident_devkit.motion.box_polygons import Footprints
from deepaccident_devkit.motion.drawing import following_centers
from deepaccident_devkit.motion.warping import sampling_matrix

CONFIG = MotionLabelConfig(grid=BevGrid((-20, 20, 0.5), (-15, 15, 0.5)), receptive_field=1, future_frames=1)
CORNERS = st.lists(
    st.lists(st.tuples(st.integers(-20, 100), st.integers(-20, 100)), min_size=4, max_size=4), min_size=1, max_size=6
)
MOTIONS = st.tuples(
    *(st.floats(-30, 30) for _ in range(2)), *(st.floats(-0.2, 0.2) for _ in range(3)), st.floats(-4, 4)
)


def footprints(corners: list, config: MotionLabelConfig) -> Footprints:
    """All in the second of two frames."""
    shape = config.grid.with_orientation(config.rules.native).shape
    image, given = np.ones(len(corners), dtype=np.int64), np.array(corners, dtype=np.int64)
    return Footprints(given, image, 1 + np.arange(len(given)) // 2, topmost(given, shape, image, 2))


@given(CORNERS, MOTIONS, st.sampled_from(list(LABEL_PROTOCOLS)))
def test_near_cells_are_enough(corners: list, motion: tuple[float, ...], protocol: str) -> None:
    config = replace(CONFIG, protocol=protocol)
    shown, matrices = footprints(corners, config), sampling_matrix(conventions.matrices_of_six([motion]), config.rules)
    found = following_centers(shown, matrices, config, 3)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drawing, "_spread", lambda *_: None)  # as for points that are far away
        assert_array_equal(found, following_centers(shown, matrices, config, 3))


def test_few_cells_are_looked_at() -> None:
    """Else the shortcut could be lost without any other test failing."""
    shown = footprints([[(30, 20), (38, 20), (38, 24), (30, 24)]], CONFIG)
    lines = drawing.sampling_lines(np.eye(4)[None], CONFIG.grid, CONFIG.rules)
    runs = drawing._runs_near(shown, *drawing._spread(lines, CONFIG.grid), CONFIG.grid)
    assert 9 * 5 <= runs.length.sum() <= 12 * 8


@pytest.mark.parametrize("motion", [(1e7, 0, 0, 0, 0, 0), (0, 0, 0, np.pi / 2, 0, 0)], ids=["far away", "upright"])
def test_points_that_do_not_lie_evenly_are_looked_at_one_by_one(motion: tuple[float, ...]) -> None:
    config = replace(CONFIG, protocol="clean")
    shown = footprints([[(0, 0), (79, 0), (79, 59), (0, 59)]], config)
    matrices = sampling_matrix(conventions.matrices_of_six([motion]), config.rules)
    lines = drawing.sampling_lines(matrices, config.grid.with_orientation("released"), config.rules)
    assert drawing._spread(lines, config.grid.with_orientation("released")) is None
    assert np.isnan(following_centers(shown, matrices, config, 1)[0, 1]).all() == (motion[0] > 0)


def test_one_frame_that_does_not_lie_evenly_is_enough_to_look_at_every_cell() -> None:
    grid = CONFIG.grid.with_orientation("released")
    turned = conventions.matrices_of_six([(0, 0, 0, np.pi / 2, 0, 0)])[0]
    for other in (turned, np.diag([0.45, 0.45, 1, 1]), np.diag([2.1, 2.1, 1, 1])):
        lines = drawing.sampling_lines(np.stack([np.eye(4), other]), grid, LABEL_PROTOCOLS["clean"])
        assert drawing._spread(lines, grid) is None
    near = np.stack([np.eye(4), np.diag([0.55, 0.55, 1, 1]), np.diag([1.9, 1.9, 1, 1])])
    lines = drawing.sampling_lines(near, grid, LABEL_PROTOCOLS["clean"])
    assert drawing._spread(lines, grid) is not None
