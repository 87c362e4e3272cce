import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.traffic.simulate import simulate


@pytest.fixture(scope="module", params=["car", "truck", "motorcycle", "cyclist"])
def turning(request, driver):
    """Two users of a category, one turning left and one right, and their simulation."""
    left = driver("west", "left", category=request.param, max_speed=6.0)
    right = driver("east", "right", category=request.param, max_speed=6.0)
    users = [left, right]
    return users, simulate(users, begin=0.0, end=12.0)


def test_turns_are_driven_along_the_path_to_its_end(turning):
    users, run = turning

    for row, user in enumerate(users):
        along, left = user.path.project(run.poses[:, row, :2])
        assert along[-1] > user.route.exit_s
        assert np.abs(left).max() < 0.85
        assert abs(left[-1]) < 0.1


def test_a_pedestrian_stays_on_its_path_and_stops_at_its_end(walker):
    user = walker()
    run = simulate([user], begin=0.0, end=16.0)
    along, left = user.path.project(run.poses[:, 0, :2])

    np.testing.assert_allclose(left, 0.0, atol=1e-9)
    assert (np.diff(along) >= 0).all()
    assert along[-1] == pytest.approx(user.path.length, abs=0.5)
