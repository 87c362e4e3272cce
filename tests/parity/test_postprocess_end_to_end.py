"""The golden scenes (tests/data/golden, a_labels) up to what the accident evaluation takes for
truth.

The released evaluation reads its labels as though a model had predicted them
(docs/released_code.md, Accidents): from boxes to labels to instances to boxes along their paths.
a_labels holds what comes out (`e2e_*`: the accident post-processing of the labels at the present,
with bilinear centres, cut to the frames that are recorded). Made by the released functions under
numpy 1.23.5, OpenCV 4.7.0 and torch 2.13 (tests/data/golden/README.md). The input is our own
labels from the boxes on: the stored float16 centres would make other plateaus. Every cell and
    number equal.
"""

from dataclasses import replace

import numpy as np
import pytest
from parity.test_labels import Scene, labels_of

from deepaccident_devkit.geometry.bev_grid import cells_in, to_orientation
from deepaccident_devkit.motion.grouping import MotionHeads
from deepaccident_devkit.motion.instances import predict_instances
from deepaccident_devkit.motion.labels import MotionLabels

pytestmark = pytest.mark.golden_cases("a_labels", "scenes")


def cut(labels: MotionLabels, frames: int) -> MotionLabels:
    """The first label frames alone, as the evaluation keeps them."""
    maps = ("segmentation", "instance", "centerness", "offset", "flow")
    return replace(labels, **{name: getattr(labels, name)[:frames] for name in maps})


@pytest.mark.parametrize("orientation", ["released", "devkit", "fiery"])
def test_boxes_drawn_from_labels_equal_the_released_codes(golden, orientation: str) -> None:
    scene = Scene(golden)
    expected = scene["e2e_rendered"]
    labels = labels_of(scene, orientation=orientation).to_present(centerness="bilinear")
    linked = predict_instances(MotionHeads.from_labels(cut(labels, len(expected))), "accident")
    drawn = to_orientation(linked.redrawn, vectors=False, source=orientation, target="released")
    assert drawn.shape == expected.shape
    assert int((drawn != expected).sum()) == 0
    shape = drawn.shape[1:]
    centers = {
        str(name): np.stack(
            cells_in(*points.T, shape, orientation, "released")[::-1], axis=-1
        ).tolist()
        for name, points in linked.centers.items()
    }
    assert centers == golden.entry["e2e_matched_centers"]
    counts = {str(name): path.cell_counts.tolist() for name, path in linked.paths.items()}
    assert counts == golden.entry["e2e_pixel_counts"]
