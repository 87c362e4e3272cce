"""Which transform a frame, a past moment or an agent is warped with: products of the motions in between.

All 6-vectors and matrices that go in are right-handed; what comes out has the handedness of the protocol's native
orientation, as `warping` takes it. The warps `stretched` and `fiery` compute in float32 as their codes do, `exact` in
float64.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.exact import single_precision
from deepaccident_devkit.geometry import conventions
from deepaccident_devkit.geometry.conventions import flip_pose, flip_six_vector
from deepaccident_devkit.motion.augmentation import Augmentation
from deepaccident_devkit.motion.protocols import LabelProtocol
from deepaccident_devkit.support.arrays import AnyArray, checked
from deepaccident_devkit.v2x import future_egomotion


class _Arithmetic(NamedTuple):
    matrices: Callable[[AnyArray], AnyArray]
    rigid_inverse: Callable[[AnyArray], AnyArray]
    inverse: Callable[[AnyArray], AnyArray]
    product: Callable[[AnyArray, AnyArray], AnyArray]


_SINGLE = _Arithmetic(
    single_precision.pose_matrices, single_precision.rigid_inverse, single_precision.inverse, single_precision.product
)
_DOUBLE = _Arithmetic(conventions.matrices_of_six, np.linalg.inv, np.linalg.inv, np.matmul)


def egomotion(world_from_ego: ArrayLike, valid: ArrayLike, rules: LabelProtocol) -> AnyArray:
    """An agent's motion from each of its moments to the next, as `v2x.future_egomotion`, in a protocol's arithmetic.

    The released code has the poses in float32. If a sample point lies on a border between cells, their last bits decide
    to which cell it belongs.

    Args:
        world_from_ego: (T + 1, 4, 4) right-handed poses in the order of time.
        valid: (T + 1,) whether each moment is in the recording.
        rules: whose arithmetic.

    Returns:
        (T, 6) right-handed `next_from_this`, float32; zero where a moment or the next is not in the recording.

    Raises:
        GeometryError: another shape.
    """
    if rules.warp == "exact":
        return future_egomotion(world_from_ego, valid).astype(np.float32)
    poses = checked("world_from_ego", world_from_ego, (None, 4, 4)).astype(np.float32)
    known = checked("valid", valid, (len(poses),), np.bool_)
    both = known[:-1] & known[1:]
    motion = np.zeros((len(both), 6), dtype=np.float32)
    next_from_world = single_precision.rigid_inverse(poses[1:][both])
    # torch's atan2 is not correctly rounded, so its angles can differ in the last bit: at a tie, where a sample point
    # lies on a border between cells, a cell can (one in three of about 330 warped outputs of the released code)
    next_from_this = single_precision.fused_product(next_from_world, poses[:-1][both])
    motion[both] = conventions.six_vectors_of(next_from_this).astype(np.float32)
    return motion


def present_from_frames(
    egomotion: ArrayLike, rules: LabelProtocol, augmentation: Augmentation | None = None
) -> AnyArray:
    """Transforms of the present and each future frame to the present: C_i = E_0⁻¹ E_1⁻¹ … E_{i−1}⁻¹.

    Args:
        egomotion: (T, 6) right-handed, `next_from_this` from the present on; the last row is not used.
        rules: whose arithmetic and handedness.
        augmentation: of both frames; C becomes A C A⁻¹.

    Returns:
        (T, 4, 4); the first is the identity.

    Raises:
        GeometryError: another shape.
    """
    arithmetic = _arithmetic(rules)
    this_from_next = arithmetic.rigid_inverse(_native_matrices(egomotion, rules)[:-1])
    chain = [np.eye(4, dtype=this_from_next.dtype)]
    for step in this_from_next:
        chain.append(arithmetic.product(chain[-1], step))
    return _augmented(np.stack(chain), rules, augmentation)


def frames_from_next(egomotion: ArrayLike, rules: LabelProtocol, augmentation: Augmentation | None = None) -> AnyArray:
    """Transforms from each frame's next frame to that frame; the released code has a special way to invert these.

    Args:
        egomotion: (T, 6) right-handed, `next_from_this`.
        rules: whose arithmetic and handedness.
        augmentation: of both frames; E⁻¹ becomes A E⁻¹ A⁻¹.

    Returns:
        (T, 4, 4).

    Raises:
        GeometryError: another shape.
    """
    inverse = _arithmetic(rules).inverse(_native_matrices(egomotion, rules))
    return _augmented(inverse, rules, augmentation)


def present_from_past(egomotion: ArrayLike, rules: LabelProtocol, augmentation: Augmentation | None = None) -> AnyArray:
    """Transforms of each past moment to the present.

    The released code and FIERY multiply the motions in the order of time, E_0 E_1, and so are wrong from the second
    moment before the present on; `exact` multiplies E_1 E_0.

    Args:
        egomotion: (P, 6) right-handed, `next_from_this` of the P moments before the present, the oldest first.
        rules: whose arithmetic, handedness and order.
        augmentation: of both frames; the product becomes A · product · A⁻¹.

    Returns:
        (P, 4, 4), the oldest first.

    Raises:
        GeometryError: another shape.
    """
    arithmetic = _arithmetic(rules)
    steps = _native_matrices(egomotion, rules)
    chain = list(steps[-1:])
    for step in steps[-2::-1]:
        pair = (chain[-1], step) if rules.warp == "exact" else (step, chain[-1])
        chain.append(arithmetic.product(*pair))
    return _augmented(np.reshape(chain[::-1], steps.shape), rules, augmentation)


def ego_from_agents(
    relative_pose: ArrayLike, rules: LabelProtocol, augmentation: Augmentation | None = None
) -> AnyArray:
    """Transforms (K, 4, 4) of agents' frames to the ego's from right-handed 6-vectors (K, 6); raises GeometryError."""
    return _augmented(_native_matrices(relative_pose, rules), rules, augmentation)


def _arithmetic(rules: LabelProtocol) -> _Arithmetic:
    return _DOUBLE if rules.warp == "exact" else _SINGLE


def _native_matrices(six: ArrayLike, rules: LabelProtocol) -> AnyArray:
    vectors = checked("egomotion", six, (None, 6))
    return _arithmetic(rules).matrices(vectors if rules.right_handed else flip_six_vector(vectors))


def _augmented(transforms: AnyArray, rules: LabelProtocol, augmentation: Augmentation | None) -> AnyArray:
    """A · transforms · A⁻¹."""
    if augmentation is None or not len(transforms):
        return transforms
    arithmetic = _arithmetic(rules)
    given = augmentation.matrix if rules.right_handed else flip_pose(augmentation.matrix)
    matrix = given[None].astype(transforms.dtype)
    return arithmetic.product(arithmetic.product(matrix, transforms), arithmetic.inverse(matrix))
