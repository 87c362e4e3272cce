"""The golden post-processing (tests/data/golden, c_postprocess): instances, ids, paths and boxes of
noisy predictions.

The released functions made them under numpy 1.23.5, OpenCV 4.7.0, scipy 1.10.1 and torch 2.13 on
the CPU (tests/data/golden/README.md); the rules are in docs/released_code.md, Post-processing.
Every cell and number is equal. The golden maps have the released orientation; each case also runs
turned to the devkit's orientation and to FIERY's, and must give the same result, turned.
"""

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from support.golden_motion import column_row_centers, read_heads

from deepaccident_devkit.geometry.bev_grid import cells_in, to_orientation
from deepaccident_devkit.motion.instances import LinkedInstances, predict_instances

pytestmark = [
    pytest.mark.golden_cases("c_postprocess", "cases"),
    pytest.mark.parametrize("orientation", ["released", "devkit", "fiery"]),
]


def count_differing_cells(maps: np.ndarray, orientation: str, expected: np.ndarray) -> int:
    """Count the cells that differ from the golden ones."""
    released_maps = to_orientation(maps, vectors=False, source=orientation, target="released")
    assert released_maps.shape == expected.shape
    return int((released_maps != expected).sum())


def released_points(points: np.ndarray, linked: LinkedInstances) -> np.ndarray:
    """Return rows and columns (n, 2) in the released orientation."""
    shape = linked.instance.shape[1:]
    cells = cells_in(*points.T, shape, linked.orientation, "released")
    return np.stack(cells, axis=-1)


def assert_paths_equal(linked: LinkedInstances, expected: dict) -> None:
    """Compare the points of each instance, column before row, and its cells in each frame."""
    assert column_row_centers(linked) == expected["matched_centers"]
    cell_counts = {str(name): path.cell_counts.tolist() for name, path in linked.paths.items()}
    assert cell_counts == expected["pixel_counts"]
    for path in linked.paths.values():
        assert_array_equal(path.frames, np.flatnonzero(path.cell_counts))


def test_instances_of_the_motion_evaluation(golden, orientation: str) -> None:
    linked = predict_instances(read_heads(golden, orientation), "motion")
    assert count_differing_cells(linked.frame_instance, orientation, golden["frame_instances"]) == 0
    assert count_differing_cells(linked.instance, orientation, golden["traj_consistent"]) == 0
    assert count_differing_cells(linked.instance, orientation, golden["traj_seg"]) == 0
    assert linked.redrawn is None
    assert_paths_equal(linked, golden.entry["traj"])


def test_instances_of_the_accident_evaluation(golden, orientation: str) -> None:
    linked = predict_instances(read_heads(golden, orientation), "accident")
    assert count_differing_cells(linked.instance, orientation, golden["accident_consistent"]) == 0
    assert count_differing_cells(linked.redrawn, orientation, golden["accident_seg"]) == 0
    assert_paths_equal(linked, golden.entry["accident"])


def test_centers_in_the_order_found(golden, orientation: str) -> None:
    linked = predict_instances(read_heads(golden, orientation), "motion")
    centers = [released_points(frame, linked).tolist() for frame in linked.frame_centers]
    assert centers == golden.entry["centers_per_frame"]
