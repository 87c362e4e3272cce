import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import PinholeCamera


@pytest.mark.parametrize(("degrees", "focal"), [(70, 1142.5184), (110, 560.166)])
def test_field_of_view_gives_the_releases_focal_lengths(degrees: float, focal: float) -> None:
    camera = PinholeCamera.from_field_of_view(1600, 900, np.radians(degrees))
    assert_allclose(camera.intrinsic, [[focal, 0, 800], [0, focal, 450], [0, 0, 1]], atol=1e-3)


def test_right_is_larger_u_and_down_is_larger_v() -> None:
    camera = PinholeCamera(np.array([[500.0, 0, 800], [0, 400, 450], [0, 0, 1]]), 1600, 900)
    pixels, depth = camera.project([[0, 0, 5], [1, 0, 5], [0, 1, 5], [2, 2, 10]])
    assert_array_equal(pixels, [[800, 450], [900, 450], [800, 530], [900, 530]])
    assert_array_equal(depth, [5, 5, 5, 10])


def test_what_is_not_in_front_has_no_pixel() -> None:
    camera = PinholeCamera.from_field_of_view(1600, 900, 1.2)
    pixels, depth = camera.project([[0, 0, 0], [1, 1, -3], [0, 0, 1]])
    assert_array_equal(np.isnan(pixels), [[True, True], [True, True], [False, False]])
    assert_array_equal(depth, [0, -3, 1])
    assert_array_equal(camera.in_image(pixels), [False, False, True])
    assert camera.project(np.zeros((0, 3)))[0].shape == (0, 2)


def test_the_image_starts_at_zero_and_ends_before_its_size() -> None:
    camera = PinholeCamera.from_field_of_view(1600, 900, 1.2)
    pixels = [[0, 0], [1599.9, 899.9], [1600, 450], [800, 900], [-0.1, 450], [800, -0.1]]
    assert_array_equal(camera.in_image(pixels), [True, True, False, False, False, False])


def test_wrong_shapes_are_refused_and_the_intrinsic_is_a_copy() -> None:
    with pytest.raises(GeometryError, match=r"PinholeCamera.intrinsic: expected shape \(3, 3\)"):
        PinholeCamera(np.eye(4), 10, 10)
    mine = np.eye(3)
    camera = PinholeCamera(mine, 10, 10)
    mine[0, 0] = 5
    assert camera.intrinsic[0, 0] == 1
    with pytest.raises(ValueError, match="read-only"):
        camera.intrinsic[0, 0] = 2
    with pytest.raises(GeometryError, match=r"points: expected shape \(N, 3\)"):
        camera.project([1, 2, 3])
    with pytest.raises(GeometryError, match=r"pixels: expected shape \(N, 2\)"):
        camera.in_image([[1, 2, 3]])
