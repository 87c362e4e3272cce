"""Compare every default and constant of reference_arithmetic with the values written out here."""

import numpy as np
from support.default_values import package_values

from deepaccident_devkit.motion.reference_arithmetic.contours import first_contour
from deepaccident_devkit.motion.reference_arithmetic.outlines import pair_gaps
from deepaccident_devkit.motion.reference_arithmetic.polygon_fill import filled_cells
from deepaccident_devkit.motion.reference_arithmetic.single_precision import pose_matrices

WRITTEN = {
    "contours.LARGEST_BOX_CELLS": "(10, 4)",
    "contours.TURNING_MOVE": "4",
    "contours.first_contour": "one_part=False",
    "outlines.LEVEL": "0.1",
    "outlines.TOLERANCE": "0.5",
    "outlines.LENGTH_TIE": "1e-09",
    "outlines.NO_OUTLINE": "100000000000.0",
    "outlines.pair_gaps": "below=inf",
    "polygon_fill.filled_cells": "image=None, images=1",
    "polygon_fill.topmost": "image=None, images=1",
    "single_precision.OUTSIDE": "-1",
    "single_precision.take_cells": "fill=0",
    "single_precision.blend_cells": "fill=0",
}


def test_every_default_and_constant_written_out() -> None:
    assert package_values("deepaccident_devkit.motion.reference_arithmetic") == WRITTEN

    cell = np.zeros(1, dtype=int)
    assert first_contour(cell, cell) == [(0, 0)]

    pairs, _ = pair_gaps(np.zeros((3, 3), dtype=np.int32), np.zeros(0, dtype=np.int64))
    assert len(pairs) == 0

    cells, _ = filled_cells(np.zeros((0, 4, 2)), (3, 3))
    assert len(cells) == 0
    assert len(pose_matrices(np.zeros((0, 6)))) == 0
