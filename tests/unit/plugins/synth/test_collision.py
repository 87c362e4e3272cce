import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from shapely import affinity, box

from deepaccident_devkit.plugins.synth.traffic.simulate import gap, separation

coordinates = st.floats(-8, 8)
poses = st.tuples(coordinates, coordinates, st.floats(-4, 4)).map(np.array)
sizes = st.tuples(st.floats(0.3, 6), st.floats(0.3, 6)).map(np.array)


def _polygon(pose, size):
    length, width = size / 2
    turned = affinity.rotate(
        box(-length, -width, length, width), pose[2], origin=(0, 0), use_radians=True
    )
    return affinity.translate(turned, *pose[:2])


@given(poses, sizes, poses, sizes)
def test_gap_and_overlap_equal_shapely(pose_a, size_a, pose_b, size_b):
    a, b, apart = (
        _polygon(pose_a, size_a),
        _polygon(pose_b, size_b),
        separation(pose_a, size_a, pose_b, size_b),
    )
    assert gap(pose_a, size_a, pose_b, size_b) == pytest.approx(a.distance(b), abs=1e-7)
    assert (a.intersection(b).area > 1e-9) == (apart < 0) or abs(apart) < 1e-6


def test_arrays_broadcast():
    size = np.array([4.0, 2.0])
    many = np.zeros((5, 7, 3))
    many[..., 0] = np.arange(5)[:, None] * 10
    result = gap(np.zeros(3), size, many, size)
    assert result.shape == (5, 7)
    np.testing.assert_allclose(result[:, 0], [0, 6, 16, 26, 36])
