import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.actors import MEDIAN_SIZES
from deepaccident_devkit.plugins.synth.shapes import BOX_CLEARANCE, INSET, MODELS, shape_of
from deepaccident_devkit.plugins.synth.solids import face_corners, face_planes

ALL = [(category, model) for category, models in MODELS.items() for model in range(len(models))]


@pytest.fixture(params=ALL, ids=[f"{category}-{model}" for category, model in ALL])
def shape(request):
    category, model = request.param
    return (
        category,
        model,
        shape_of(category, MEDIAN_SIZES[category], (200, 30, 30), (30, 60, 200), model),
    )


def test_shapes_fill_their_boxes_and_keep_within(shape):
    """Also the smallest and the largest that are drawn: all solids keep `INSET` from the box's
    faces.
    """
    category, model, _ = shape
    for factor in (0.95, 1.0, 1.05):
        size = np.array(MEDIAN_SIZES[category]) * factor
        corners = shape_of(
            category, tuple(size.tolist()), (0, 0, 0), (0, 0, 0), model
        ).corners.reshape(-1, 3)
        half = size[:2] / 2 - INSET + 1e-9
        (x, y), (low, high) = (
            np.abs(corners[:, :2]).max(axis=0),
            (corners[:, 2].min(), corners[:, 2].max()),
        )
        assert (0.35 if category == "pedestrian" else 0.49) * size[0] < x <= half[0]
        assert 0.4 * size[1] < y <= half[1]
        assert BOX_CLEARANCE <= low < 0.05
        assert 0.98 * size[2] < high <= BOX_CLEARANCE + size[2] - INSET + 1e-9


def test_solids_are_convex_and_turned_outwards(shape):
    _, _, solids = shape
    normals, offsets = face_planes(face_corners(solids.corners))
    assert (
        np.einsum("fk,fk->f", normals, np.repeat(solids.corners.mean(axis=1), 6, axis=0)) < offsets
    ).all()
