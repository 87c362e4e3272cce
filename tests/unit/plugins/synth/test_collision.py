import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from shapely import affinity, box

from deepaccident_devkit.plugins.synth.traffic.simulate import gap, separation

coordinates = st.floats(-8, 8)
poses = st.tuples(coordinates, coordinates, st.floats(-4, 4)).map(np.array)
sizes = st.tuples(st.floats(0.3, 6), st.floats(0.3, 6)).map(np.array)


def make_polygon(pose, size):
    length, width = size / 2
    rectangle = box(-length, -width, length, width)
    turned = affinity.rotate(rectangle, pose[2], origin=(0, 0), use_radians=True)
    return affinity.translate(turned, *pose[:2])


@given(poses, sizes, poses, sizes)
def test_gap_and_overlap_equal_shapely(pose_a, size_a, pose_b, size_b):
    polygon_a = make_polygon(pose_a, size_a)
    polygon_b = make_polygon(pose_b, size_b)
    distance = polygon_a.distance(polygon_b)
    assert gap(pose_a, size_a, pose_b, size_b) == pytest.approx(distance, abs=1e-7)

    signed_gap = separation(pose_a, size_a, pose_b, size_b)
    overlaps = polygon_a.intersection(polygon_b).area > 1e-9
    assert overlaps == (signed_gap < 0) or abs(signed_gap) < 1e-6


def test_arrays_broadcast():
    size = np.array([4.0, 2.0])
    poses = np.zeros((5, 7, 3))
    poses[..., 0] = np.arange(5)[:, None] * 10

    gaps = gap(np.zeros(3), size, poses, size)

    assert gaps.shape == (5, 7)
    np.testing.assert_allclose(gaps[:, 0], [0, 6, 16, 26, 36])
