"""The golden scenes (tests/data/golden, a_labels) up to the truth of the accident evaluation.

The released evaluation reads its labels as though a model had predicted them
(docs/released_code.md, Accidents): from boxes to labels to instances to boxes along their paths.
a_labels holds the results (`e2e_*`: the accident post-processing of the labels at the present,
with bilinear centres, cut to the recorded frames). The released functions made them under
numpy 1.23.5, OpenCV 4.7.0 and torch 2.13 (tests/data/golden/README.md). The input is our own
labels, drawn from the boxes, since the stored float16 centres would have other plateaus. Every cell
and number is equal.
"""

from dataclasses import replace

import pytest
from parity.test_labels import Scene, make_labels
from support.golden_motion import column_row_centers

from deepaccident_devkit.geometry.bev_grid import to_orientation
from deepaccident_devkit.motion.grouping import MotionHeads
from deepaccident_devkit.motion.instances import predict_instances
from deepaccident_devkit.motion.labels import MotionLabels

pytestmark = pytest.mark.golden_cases("a_labels", "scenes")


def cut_labels(labels: MotionLabels, num_frames: int) -> MotionLabels:
    """Keep only the first label frames, as the evaluation does."""
    names = ("segmentation", "instance", "centerness", "offset", "flow")
    maps = {name: getattr(labels, name)[:num_frames] for name in names}
    return replace(labels, **maps)


@pytest.mark.parametrize("orientation", ["released", "devkit", "fiery"])
def test_boxes_drawn_from_labels_equal_the_released_codes(golden, orientation: str) -> None:
    scene = Scene(golden)
    expected = scene["e2e_rendered"]
    labels = make_labels(scene, orientation=orientation).to_present(centerness="bilinear")
    heads = MotionHeads.from_labels(cut_labels(labels, len(expected)))

    linked = predict_instances(heads, "accident")

    drawn = to_orientation(linked.redrawn, vectors=False, source=orientation, target="released")
    assert drawn.shape == expected.shape
    assert int((drawn != expected).sum()) == 0
    assert column_row_centers(linked) == golden.entry["e2e_matched_centers"]
    counts = {str(name): path.cell_counts.tolist() for name, path in linked.paths.items()}
    assert counts == golden.entry["e2e_pixel_counts"]
