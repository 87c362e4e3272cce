"""FIERY's golden labels (tests/data/golden, h_fiery), for the preset `fiery`, in each frame's own
ego frame.

FIERY made them (tests/data/golden/README.md). Every cell of instance, offset and flow is equal, and
centerness after rounding to float16, as it is stored. The ids are the objects' numbers, since FIERY
also counts ids over its past frames.
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

MAX_FLIPPED_CELLS = 1
"""The cells of centerness that may differ, since rounding to float16 may flip them."""


def make_fiery_labels(case) -> MotionLabels:
    """Draw labels from a case's polygons, with the case's ids."""
    config = MotionLabelConfig.preset("fiery")
    numbers = np.arange(case["corners"].shape[1])
    polygons = [
        FramePolygons(corners=corners[is_present], key=numbers[is_present])
        for corners, is_present in zip(case["corners"], case["present"] > 0, strict=True)
    ]
    egomotion = np.concatenate([np.zeros((config.receptive_field - 1, 6)), case["egomotion"]])
    id_map = {int(key): int(key) + 1 for key in numbers}
    return labels_from_polygons(polygons, egomotion, config, id_map=id_map)


@pytest.mark.golden_cases("h_fiery", "cases")
def test_labels_equal_fierys(golden) -> None:
    labels = make_fiery_labels(golden)
    for name in ("instance", "offset", "flow"):
        differing_cells = getattr(labels, name) != golden[name]
        assert differing_cells.sum() == 0, name
    assert_array_equal(labels.segmentation, golden["instance"] > 0)
    flipped_cells = labels.centerness.astype(np.float16) != golden["centerness"]
    assert flipped_cells.sum() <= MAX_FLIPPED_CELLS
