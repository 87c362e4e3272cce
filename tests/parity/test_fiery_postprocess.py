"""FIERY's golden ids and paths (tests/data/golden, h_fiery), for noisy predictions, with the preset
`fiery`.

wayveai/fiery @ fd03f16 made them under numpy 1.26.4 and torch 2.13 on the CPU
(tests/data/golden/README.md); the rasters have FIERY's orientation, rows along x. Every cell and
number is equal. Each case also runs turned to the devkit's orientation.
"""

import pytest
from support.golden_motion import column_row_centers, read_heads

from deepaccident_devkit.geometry.bev_grid import to_orientation
from deepaccident_devkit.motion.instances import predict_instances

pytestmark = pytest.mark.golden_cases("h_fiery", "cases")


@pytest.mark.parametrize("orientation", ["fiery", "devkit"])
def test_linked_instances_equal_fierys(golden, orientation: str) -> None:
    heads = read_heads(golden, orientation, source="fiery")

    linked = predict_instances(heads, "fiery")

    expected = golden["consistent"]
    instance = to_orientation(linked.instance, vectors=False, source=orientation, target="fiery")
    assert instance.shape == expected.shape
    assert int((instance != expected).sum()) == 0
    assert column_row_centers(linked, "fiery") == golden.entry["matched_centers"]
