import numpy as np
import pytest
from numpy.testing import assert_allclose
from pyquaternion import Quaternion

from deepaccident_devkit.geometry import quaternions

# the identity and half turns about each axis, where three of the four formulas divide by zero
HALF_TURNS = [np.diag(signs) for signs in ([1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1])]


@pytest.mark.parametrize(("index", "rotation"), list(enumerate(HALF_TURNS)))
def test_half_turns_have_one_nonzero_element(index: int, rotation: np.ndarray) -> None:
    expected = np.eye(4)[index]
    assert_allclose(np.abs(quaternions.from_matrix(rotation)), expected)
    assert_allclose(np.abs(quaternions.single_from_matrix(rotation)), expected)


def test_against_pyquaternion() -> None:
    rows = np.random.default_rng(0).normal(size=(200, 4))
    oracles = [Quaternion(row).unit for row in rows]
    elements = np.array([q.elements if q.w >= 0 else -q.elements for q in oracles])
    matrices = np.array([q.rotation_matrix for q in oracles])
    yaws = np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0])
    assert_allclose(quaternions.to_matrix(elements), matrices, atol=1e-12)
    assert_allclose(quaternions.from_matrix(matrices), elements, atol=1e-9)
    single_elements = [quaternions.single_from_matrix(matrix) for matrix in matrices]
    assert_allclose(single_elements, elements, atol=1e-9)
    assert_allclose(quaternions.yaw_of(elements), yaws, atol=1e-9)

    products = [(a * b).elements for a, b in zip(oracles[:100], oracles[100:], strict=True)]
    multipliers = quaternions.left_multiplier(np.array([q.elements for q in oracles[:100]]))
    right_elements = np.array([q.elements for q in oracles[100:]])
    assert_allclose((multipliers @ right_elements[:, :, None])[..., 0], products, atol=1e-12)
    single_multiplier = quaternions.single_left_multiplier(matrices[0])
    assert_allclose(single_multiplier, quaternions.left_multiplier(elements[0]), atol=1e-9)


@pytest.mark.parametrize("shape", [(), (0,), (3,), (2, 3)])
def test_leading_axes_are_kept(shape: tuple[int, ...]) -> None:
    yaw = np.full(shape, 0.7)
    quaternion = quaternions.from_yaw(yaw)
    matrix = quaternions.to_matrix(quaternion)

    assert quaternion.shape == (*shape, 4)
    assert matrix.shape == (*shape, 3, 3)
    assert quaternions.left_multiplier(quaternion).shape == (*shape, 4, 4)
    assert_allclose(quaternions.from_matrix(matrix), quaternion, atol=1e-12)
    assert_allclose(quaternions.yaw_of(quaternion), yaw)


def test_yaw_of_a_pitched_heading() -> None:
    yaw = Quaternion(axis=(0, 0, 1), angle=2.0)
    climbing = yaw * Quaternion(axis=(0, 1, 0), angle=-0.4)
    assert quaternions.yaw_of(climbing.elements) == pytest.approx(2.0)
