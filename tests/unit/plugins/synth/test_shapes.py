import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.actors import MEDIAN_SIZES
from deepaccident_devkit.plugins.synth.shapes import BOX_CLEARANCE, INSET, MODELS, make_shape
from deepaccident_devkit.plugins.synth.solids import face_corners, face_planes

ALL_MODELS = [
    (category, model) for category, models in MODELS.items() for model in range(len(models))
]


@pytest.fixture(params=ALL_MODELS, ids=[f"{category}-{model}" for category, model in ALL_MODELS])
def shape(request):
    category, model = request.param
    solids = make_shape(category, MEDIAN_SIZES[category], (200, 30, 30), (30, 60, 200), model)
    return category, model, solids


def test_shapes_fill_their_boxes_and_keep_within(shape):
    """The smallest and largest drawn sizes, too: all solids stay `INSET` away from the box's
    faces.
    """
    category, model, _ = shape
    for factor in (0.95, 1.0, 1.05):
        size = np.array(MEDIAN_SIZES[category]) * factor
        solids = make_shape(category, tuple(size.tolist()), (0, 0, 0), (0, 0, 0), model)
        corners = solids.corners.reshape(-1, 3)

        x, y = np.abs(corners[:, :2]).max(axis=0)
        half_length, half_width = size[:2] / 2 - INSET + 1e-9
        least_length = (0.35 if category == "pedestrian" else 0.49) * size[0]
        assert least_length < x <= half_length
        assert 0.4 * size[1] < y <= half_width

        z = corners[:, 2]
        assert BOX_CLEARANCE <= z.min() < 0.05
        assert 0.98 * size[2] < z.max() <= BOX_CLEARANCE + size[2] - INSET + 1e-9


def test_solids_are_convex_and_turned_outwards(shape):
    _, _, solids = shape
    normals, offsets = face_planes(face_corners(solids.corners))
    centers = np.repeat(solids.corners.mean(axis=1), 6, axis=0)
    assert (np.einsum("fk,fk->f", normals, centers) < offsets).all()
