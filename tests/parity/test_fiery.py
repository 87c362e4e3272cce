"""FIERY's golden labels (tests/data/golden, h_fiery), for the preset `fiery`, in each frame's own
ego frame.

Made by FIERY (tests/data/golden/README.md). Every cell of instance, offset and flow is equal, and
centerness after rounding to float16, as it is stored. The ids are the objects' numbers: FIERY
counts them over its past frames too.
"""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from deepaccident_devkit.motion import (
    FramePolygons,
    MotionLabelConfig,
    MotionLabels,
    labels_from_polygons,
)

FLIPS = 1


def fiery_labels(case) -> MotionLabels:
    """The labels of a case's polygons with the ids that it has."""
    config = MotionLabelConfig.preset("fiery")
    number = np.arange(case["corners"].shape[1])
    polygons = [
        FramePolygons(corners=corners[there], key=number[there])
        for corners, there in zip(case["corners"], case["present"] > 0, strict=True)
    ]
    past = np.zeros((config.receptive_field - 1, 6))
    id_map = {int(key): int(key) + 1 for key in number}
    return labels_from_polygons(
        polygons, np.concatenate([past, case["egomotion"]]), config, id_map=id_map
    )


@pytest.mark.golden_cases("h_fiery", "cases")
def test_labels_equal_fierys(golden) -> None:
    labels = fiery_labels(golden)
    differing = {
        name: int((getattr(labels, name) != golden[name]).sum())
        for name in ("instance", "offset", "flow")
    }
    assert differing == {"instance": 0, "offset": 0, "flow": 0}
    assert_array_equal(labels.segmentation, golden["instance"] > 0)
    assert (labels.centerness.astype(np.float16) != golden["centerness"]).sum() <= FLIPS
