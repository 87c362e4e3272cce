import numpy as np
from numpy.testing import assert_array_equal

from deepaccident_devkit.motion.reference_arithmetic.peaks import nearest_peaks

PEAKS = np.array([[0, 0], [0, 2]], dtype=np.float32)


def test_the_first_of_equally_near_peaks() -> None:
    points = np.array([[0, 0, 0, 5], [0.5, 1, 1.5, 1]], dtype=np.float32)
    assert_array_equal(nearest_peaks(points, PEAKS), [0, 0, 1, 0])


def test_distances_are_equal_where_their_float32_roots_are() -> None:
    """The second peak is nearer by one step of the squares, but equally near by their roots."""
    point = np.array([[232.31808471679688], [1.0009762048721313]], dtype=np.float32)
    squares = ((PEAKS - point.T) ** 2).sum(axis=1)
    assert squares[1] < squares[0]

    assert_array_equal(nearest_peaks(point, PEAKS), [0])

    many_points = np.repeat(point, 200_000, axis=1)
    assert_array_equal(nearest_peaks(many_points, PEAKS), np.zeros(200_000))


def test_nothing_to_decide() -> None:
    no_points = np.zeros((2, 0), dtype=np.float32)
    assert nearest_peaks(no_points, PEAKS).shape == (0,)
    assert nearest_peaks(no_points, PEAKS[:0]).shape == (0,)

    far_points = np.full((2, 3), 1e9, dtype=np.float32)
    assert_array_equal(nearest_peaks(far_points, PEAKS[:1]), [0, 0, 0])
