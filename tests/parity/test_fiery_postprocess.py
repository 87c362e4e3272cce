"""FIERY's golden ids and paths (tests/data/golden, h_fiery), for noisy predictions, with the preset
`fiery`.

Made by wayveai/fiery @ fd03f16 under numpy 1.26.4 and torch 2.13 on the CPU
(tests/data/golden/README.md); rasters there are FIERY's, rows along x. Every cell and number equal.
Each case also runs turned to the devkit's orientation.
"""

import numpy as np
import pytest

from deepaccident_devkit.geometry.bev_grid import cells_in, to_orientation
from deepaccident_devkit.motion.grouping import MotionHeads
from deepaccident_devkit.motion.instances import predict_instances

pytestmark = pytest.mark.golden_cases("h_fiery", "cases")


@pytest.mark.parametrize("orientation", ["fiery", "devkit"])
def test_linked_instances_equal_fierys(golden, orientation: str) -> None:
    logit = golden["seg_q"].astype(np.float32) / 16
    heads = MotionHeads(
        segmentation=np.stack([-logit, logit], axis=1),
        centerness=golden["center_q"].astype(np.float32) / 255,
        offset=golden["off_q"].astype(np.float32) / 4,
        flow=golden["flow_q"].astype(np.float32) / 4,
        orientation="fiery",
    ).in_orientation(orientation)
    linked = predict_instances(heads, "fiery")
    expected, shape = golden["consistent"], linked.instance.shape[1:]
    found = to_orientation(linked.instance, vectors=False, source=orientation, target="fiery")
    assert found.shape == expected.shape
    assert int((found != expected).sum()) == 0
    centers = {
        str(name): np.stack(cells_in(*points.T, shape, orientation, "fiery"), axis=-1)[
            :, ::-1
        ].tolist()
        for name, points in linked.centers.items()
    }
    assert centers == golden.entry["matched_centers"]
