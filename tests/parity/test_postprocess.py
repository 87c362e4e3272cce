"""The golden post-processing (tests/data/golden, c_postprocess): instances, ids, paths and boxes of
noisy predictions.

Made by the released functions under numpy 1.23.5, OpenCV 4.7.0, scipy 1.10.1 and torch 2.13 on the
CPU (tests/data/golden/README.md); the rules are docs/released_code.md, Post-processing. Every cell
and number equal. The golden's maps lie as the released code has them; each case also runs turned to
the devkit's orientation and to FIERY's, and must give the same, turned.
"""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from deepaccident_devkit.geometry.bev_grid import cells_in, to_orientation
from deepaccident_devkit.motion.grouping import MotionHeads
from deepaccident_devkit.motion.instances import LinkedInstances, predict_instances

pytestmark = [
    pytest.mark.golden_cases("c_postprocess", "cases"),
    pytest.mark.parametrize("orientation", ["released", "devkit", "fiery"]),
]


def heads_of(golden, orientation: str) -> MotionHeads:
    """The stored prediction, as golden/README.md says that it is quantised."""
    logit = golden["seg_q"].astype(np.float32) / 16
    return MotionHeads(
        segmentation=np.stack([-logit, logit], axis=1),
        centerness=golden["center_q"].astype(np.float32) / 255,
        offset=golden["off_q"].astype(np.float32) / 4,
        flow=golden["flow_q"].astype(np.float32) / 4,
        orientation="released",
    ).in_orientation(orientation)


def differing_cells(maps: np.ndarray, orientation: str, expected: np.ndarray) -> int:
    """How many cells are others than the golden's."""
    back = to_orientation(maps, vectors=False, source=orientation, target="released")
    assert back.shape == expected.shape
    return int((back != expected).sum())


def released_points(points: np.ndarray, linked: LinkedInstances) -> np.ndarray:
    """Rows and columns (n, 2) as the released code counts them."""
    shape = linked.instance.shape[1:]
    return np.stack(
        cells_in(points[:, 0], points[:, 1], shape, linked.orientation, "released"), axis=-1
    )


def assert_paths_equal(linked: LinkedInstances, expected: dict) -> None:
    """Points column before row, one for each frame that the instance is in; cells of each frame."""
    centers = {
        str(name): released_points(points, linked)[:, ::-1].tolist()
        for name, points in linked.centers.items()
    }
    assert centers == expected["matched_centers"]
    assert {
        str(name): path.cell_counts.tolist() for name, path in linked.paths.items()
    } == expected["pixel_counts"]
    for path in linked.paths.values():
        assert_array_equal(path.frames, np.flatnonzero(path.cell_counts))


def test_instances_of_the_motion_evaluation(golden, orientation: str) -> None:
    linked = predict_instances(heads_of(golden, orientation), "motion")
    assert differing_cells(linked.frame_instance, orientation, golden["frame_instances"]) == 0
    assert differing_cells(linked.instance, orientation, golden["traj_consistent"]) == 0
    assert differing_cells(linked.instance, orientation, golden["traj_seg"]) == 0
    assert linked.redrawn is None
    assert_paths_equal(linked, golden.entry["traj"])


def test_instances_of_the_accident_evaluation(golden, orientation: str) -> None:
    linked = predict_instances(heads_of(golden, orientation), "accident")
    assert differing_cells(linked.instance, orientation, golden["accident_consistent"]) == 0
    assert differing_cells(linked.redrawn, orientation, golden["accident_seg"]) == 0
    assert_paths_equal(linked, golden.entry["accident"])


def test_centers_in_the_order_found(golden, orientation: str) -> None:
    linked = predict_instances(heads_of(golden, orientation), "motion")
    centers = [released_points(frame, linked).tolist() for frame in linked.frame_centers]
    assert centers == golden.entry["centers_per_frame"]
