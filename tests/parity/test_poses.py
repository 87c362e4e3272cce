"""The golden poses (tests/data/golden, g_poses): relative to the ego, and from moment to moment,
within 1e-4 (float32).

The released functions made them under numpy 1.23.5 and torch 2.13 (tests/data/golden/README.md)
from CARLA's raw, left-handed poses; the formulas are in docs/released_code.md, Poses.
"""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from deepaccident_devkit.geometry import conventions
from deepaccident_devkit.geometry.conventions import flip_pose, flip_six_vector
from deepaccident_devkit.taxonomy import AGENTS
from deepaccident_devkit.v2x import future_egomotion, relative_pose_to_ego

TOLERANCE = 1e-4
STEP_FRAMES = 5
"""Frames between two moments."""
NUM_MOMENTS = 8
PRESENT_MOMENT = 2


@pytest.mark.golden_rows("g_poses", "relative_pose_to_ego")
def test_relative_poses_equal_the_released_codes(golden_row) -> None:
    raw = golden_row["ego_to_world"]
    relative = relative_pose_to_ego(raw)
    assert_allclose(relative, golden_row["relative_pose_to_ego"], rtol=0, atol=TOLERANCE)
    assert_allclose(relative[0], 0, atol=1e-9)
    right_handed = relative_pose_to_ego(flip_pose(raw))
    assert_allclose(flip_six_vector(right_handed), relative, rtol=0, atol=1e-9)


@pytest.mark.golden_rows("g_poses", "pose_vec2mat")
def test_matrices_of_six_vectors_equal_the_released_codes(golden_row) -> None:
    matrices = conventions.matrices_of_six(golden_row["relative_pose_to_ego"])
    assert_allclose(matrices, golden_row["pose_vec2mat"], rtol=0, atol=TOLERANCE)


@pytest.mark.golden_cases("g_poses", "chains")
def test_future_egomotion_equals_the_released_codes(golden) -> None:
    chain = golden.entry
    poses = golden.array("chain_ego_to_world")[AGENTS.index(chain["agent"])]
    pose_by_frame = dict(zip(golden.whole["chain_timestamps"], poses, strict=True))
    last_frame = golden.whole["chain_scenario_length"]

    raw = np.full((NUM_MOMENTS, 4, 4), np.nan)
    valid = np.zeros(NUM_MOMENTS, dtype=bool)
    for moment in range(NUM_MOMENTS):
        frame = chain["timestamp"] + STEP_FRAMES * (moment - PRESENT_MOMENT)
        if frame in pose_by_frame:
            raw[moment] = pose_by_frame[frame]
            valid[moment] = frame <= last_frame
    expected_valid = [frame != "invalid" for frame in chain["frames"]]
    assert expected_valid == valid[:-1].tolist()

    motion = future_egomotion(raw, valid)
    assert_allclose(motion, golden["egomotion"], rtol=0, atol=TOLERANCE)
    right_handed = future_egomotion(flip_pose(np.nan_to_num(raw)), valid)
    assert_allclose(flip_six_vector(right_handed), motion, rtol=0, atol=1e-9)
