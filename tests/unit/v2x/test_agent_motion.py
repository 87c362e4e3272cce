"""An agent's series equal those of the circle and the line that it drives."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from support import tiny_release
from support.tiny_release import SCENARIO_TOKEN

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import TokenError


def write_moving_ego(
    root: Path,
    monkeypatch: pytest.MonkeyPatch,
    pose_of: Callable[[float], tuple[float, float, float]],
    frames: int = 30,
) -> DeepAccident:
    """Write a release whose ego has the given CARLA pose (yaw in degrees, x, y) in each frame."""

    def ego_to_world(agent: str, frame: int) -> np.ndarray:
        yaw, x, y = pose_of(frame / 10) if agent == "ego_vehicle" else (0.0, -10.0, 0.0)
        return tiny_release.pose(yaw, x=x, y=y, z=0.5)

    monkeypatch.setattr(tiny_release, "ego_to_world", ego_to_world)
    tiny_release.write_tiny_release(root, frames=frames)
    return DeepAccident("v1", root, verbose=False)


def test_a_circle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Through a heading of π. CARLA's y and yaw are those of the world with other signs.
    radius, rate = 20.0, 0.4

    def pose_of(time: float) -> tuple[float, float, float]:
        angle = rate * time + 2.6
        x = radius * np.sin(angle)
        y = radius * (1 - np.cos(angle))
        return -np.degrees(angle), x, -y

    da = write_moving_ego(tmp_path, monkeypatch, pose_of)
    motion = da.agent_motion(f"{SCENARIO_TOKEN}/ego_vehicle")

    assert_allclose(motion.time, np.arange(30) / 10, atol=1e-9)
    inner = slice(2, -2)
    assert_allclose(motion.yaw_rate, rate, atol=1e-6)
    assert_allclose(motion.speed[inner], radius * rate, rtol=1e-3)
    assert_allclose(motion.acceleration[inner], 0, atol=1e-6)
    assert_allclose(motion.lateral_acceleration[inner], radius * rate**2, rtol=1e-3)
    assert_allclose(motion.curvature[inner], 1 / radius, rtol=1e-3)


def test_braking_on_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # 6 m/s, and −3 m/s² until the agent stands; along CARLA's y, so −y of the world.
    def pose_of(time: float) -> tuple[float, float, float]:
        driven = min(time, 2.0)
        return 90.0, 5.0, 6 * driven - 1.5 * driven**2

    da = write_moving_ego(tmp_path, monkeypatch, pose_of, frames=40)
    motion = da.agent_motion(da.agent.get(f"{SCENARIO_TOKEN}/ego_vehicle"))

    assert_allclose(motion.speed[1:18], 6 - 3 * np.arange(0.2, 1.85, 0.1), atol=1e-6)
    assert_allclose(motion.acceleration[2:17], -3, atol=1e-6)
    assert_allclose(motion.speed[25:], 0, atol=1e-9)
    assert_allclose(motion.lateral_acceleration, 0, atol=1e-6)
    assert_array_equal(np.isnan(motion.curvature), motion.speed < 0.5)


def test_a_pole_and_a_single_frame_stand_still(tmp_path: Path) -> None:
    tiny_release.write_tiny_release(tmp_path, frames=1)
    da = DeepAccident("v1", tmp_path, verbose=False)
    for agent in ("ego_vehicle", "infrastructure"):
        motion = da.agent_motion(f"{SCENARIO_TOKEN}/{agent}")
        assert motion.time.tolist() == motion.speed.tolist() == motion.yaw_rate.tolist() == [0.0]
        assert np.isnan(motion.curvature).all()
        assert not motion.speed.flags.writeable


def test_an_unknown_agent(da: DeepAccident) -> None:
    with pytest.raises(TokenError, match="agents are"):
        da.agent_motion(f"{da.scenario[0]['token']}/other")
