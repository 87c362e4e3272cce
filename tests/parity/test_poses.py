"""The golden poses (tests/data/golden, g_poses): relative to the ego, and from moment to moment.
Within 1e-4 (float32).

Made by the released functions under numpy 1.23.5 and torch 2.13 (tests/data/golden/README.md) on
CARLA's raw, left-handed poses; the formulas are docs/released_code.md, Poses.
"""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from deepaccident_devkit.geometry import conventions
from deepaccident_devkit.geometry.conventions import flip_pose, flip_six_vector
from deepaccident_devkit.taxonomy import AGENTS
from deepaccident_devkit.v2x import future_egomotion, relative_pose_to_ego

TOLERANCE = 1e-4
STEP = 5
"""Frames between two moments."""
TO_THE_PRESENT, MOMENTS = 2, 8


@pytest.mark.golden_rows("g_poses", "relative_pose_to_ego")
def test_relative_poses_equal_the_released_codes(golden_row) -> None:
    raw = golden_row["ego_to_world"]
    relative = relative_pose_to_ego(raw)
    assert_allclose(relative, golden_row["relative_pose_to_ego"], rtol=0, atol=TOLERANCE)
    assert_allclose(relative[0], 0, atol=1e-9)
    assert_allclose(
        flip_six_vector(relative_pose_to_ego(flip_pose(raw))), relative, rtol=0, atol=1e-9
    )


@pytest.mark.golden_rows("g_poses", "pose_vec2mat")
def test_matrices_of_six_vectors_equal_the_released_codes(golden_row) -> None:
    matrices = conventions.matrices_of_six(golden_row["relative_pose_to_ego"])
    assert_allclose(matrices, golden_row["pose_vec2mat"], rtol=0, atol=TOLERANCE)


@pytest.mark.golden_cases("g_poses", "chains")
def test_future_egomotion_equals_the_released_codes(golden) -> None:
    chain, part = golden.entry, golden.whole
    all_poses = golden.array("chain_ego_to_world")[AGENTS.index(chain["agent"])]
    pose_at = dict(zip(part["chain_timestamps"], all_poses, strict=True))
    times = [chain["timestamp"] + STEP * (k - TO_THE_PRESENT) for k in range(MOMENTS)]
    valid = np.array([time in pose_at and time <= part["chain_scenario_length"] for time in times])
    assert [frame != "invalid" for frame in chain["frames"]] == valid[:-1].tolist()
    raw = np.stack([pose_at.get(time, np.full((4, 4), np.nan)) for time in times])
    motion = future_egomotion(raw, valid)
    assert_allclose(motion, golden["egomotion"], rtol=0, atol=TOLERANCE)
    right_handed = future_egomotion(flip_pose(np.nan_to_num(raw)), valid)
    assert_allclose(flip_six_vector(right_handed), motion, rtol=0, atol=1e-9)
