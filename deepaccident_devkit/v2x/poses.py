"""Poses of agents, and transforms between them.

See docs/released_code.md, Poses. Every function works for both kinds of handedness: right-handed poses (the devkit's)
give right-handed 6-vectors, CARLA's raw poses give those of the released code; `geometry.conventions.flip_six_vector`
converts one into the other.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError, GeometryError
from deepaccident_devkit.geometry import SE3, conventions
from deepaccident_devkit.geometry.conventions import inverses
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, checked

Poses = Sequence[SE3] | ArrayLike
"""Poses of several agents or moments: SE3 objects, or an array (K, 4, 4)."""


def transform(
    dataset: Dataset,
    target_sample: RowArgument,
    source_sample: RowArgument,
    target: str = "ego",
    source: str = "ego",
) -> SE3:
    """The transform `target_from_source` between frames of any two agents and moments of one scenario.

    Args:
        dataset: the release.
        target_sample: token or record of the sample to which the target frame belongs.
        source_sample: token or record of the sample to which the source frame belongs.
        target: `world`, `ego`, `lidar` or a channel (cameras: the optical frame).
        source: the same choice as for `target`.

    Raises:
        TokenError: no such sample.
        ChoiceError: no such frame, or the samples are of two scenarios, whose worlds have nothing in common.
    """
    scenarios = [dataset.get("sample", sample)["scenario_token"] for sample in (target_sample, source_sample)]
    if scenarios[0] != scenarios[1]:
        raise ChoiceError(
            f"transform: expected two samples of one scenario, found {scenarios[0]} and {scenarios[1]}; "
            "scenarios take place in different worlds"
        )
    world_from_target = dataset.world_from(target_sample, target)
    return world_from_target.inverse() @ dataset.world_from(source_sample, source)


def relative_pose_to_ego(world_from_agent: Poses) -> FloatArray:
    """Agents' poses in the ego's frame: `ego_from_agent` of each as a 6-vector (docs/released_code.md, Poses).

    Args:
        world_from_agent: (K, 4, 4), or K SE3: poses of one moment, the ego's first.

    Returns:
        (K, 6) metres and radians, in the ego's frame and the poses' handedness; row 0 is zero up to rounding.

    Raises:
        GeometryError: the poses have another shape, or there is none.
    """
    poses = _stacked("world_from_agent", world_from_agent)
    if not len(poses):
        raise GeometryError("world_from_agent: expected the ego's pose and its partners', found none")
    return conventions.six_vectors_of(inverses(poses[:1]) @ poses)


def future_egomotion(world_from_ego: Poses, valid: ArrayLike | None = None) -> FloatArray:
    """An agent's motion from each of its moments to the next: `next_from_this` as 6-vectors.

    See docs/released_code.md, Poses. A row maps points of a moment's ego frame into the next moment's ego frame. For
    the seven rows of the released code give eight poses: 1 s before the present to 2.5 s after it, in steps of 0.5 s.

    Args:
        world_from_ego: (T + 1, 4, 4), or T + 1 SE3: poses of one agent in the order of time.
        valid: (T + 1,) whether each moment is in the recording; the poses of other moments do not matter. None if all
            are.

    Returns:
        (T, 6) metres and radians, in the poses' handedness; a row is zero (no motion) if its moment or the next is
        not valid.

    Raises:
        GeometryError: the shapes do not fit, or there is no pose.
    """
    poses = _stacked("world_from_ego", world_from_ego)
    if not len(poses):
        raise GeometryError("world_from_ego: expected at least one pose, found none")
    known: BoolArray = checked("valid", np.ones(len(poses)) if valid is None else valid, (len(poses),), np.bool_)
    both = known[:-1] & known[1:]
    motion = np.zeros((len(poses) - 1, 6))
    motion[both] = conventions.six_vectors_of(inverses(poses[1:][both]) @ poses[:-1][both])
    return motion


def _stacked(name: str, poses: Poses) -> FloatArray:
    """The poses as an array (K, 4, 4)."""
    matrices: Any = poses
    if isinstance(poses, Iterable) and not isinstance(poses, np.ndarray):
        matrices = [pose.matrix if isinstance(pose, SE3) else pose for pose in poses]
    return checked(name, matrices, (None, 4, 4))
