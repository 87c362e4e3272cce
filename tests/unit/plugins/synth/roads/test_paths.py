"""Paths: sampled densely, smooth, and true to their own numbers."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepaccident_devkit.plugins.synth.roads.paths import (
    SPACING,
    bent,
    crossing,
    lane_change,
    quarter_turn,
    straight,
)

CIRCLE = bent((3.0, -2.0), 0.4, [(40.0, 0.05, 0.05)])


def assert_consistent(path, atol=1e-3):
    """Steps are as long as they say, yaw is the direction of the steps, curvature how fast yaw
    turns.
    """
    steps = np.diff(path.xy, axis=0)
    assert np.diff(path.s).max() <= SPACING + 1e-9
    np.testing.assert_allclose(np.hypot(*steps.T), np.diff(path.s), atol=atol * SPACING)
    middle_yaw = (path.yaw[:-1] + path.yaw[1:]) / 2
    np.testing.assert_allclose(
        np.arctan2(steps[:, 1], steps[:, 0]), np.angle(np.exp(1j * middle_yaw)), atol=atol
    )
    np.testing.assert_allclose(np.diff(path.yaw) / np.diff(path.s), path.curvature[:-1], atol=0.01)


def test_an_arc_lies_on_its_circle():
    centre = np.array([3.0, -2.0]) + 20 * np.array([-np.sin(0.4), np.cos(0.4)])
    np.testing.assert_allclose(np.hypot(*(CIRCLE.xy - centre).T), 20, atol=1e-9)
    assert (CIRCLE.length, CIRCLE.yaw[-1]) == (40, pytest.approx(0.4 + 40 * 0.05, abs=1e-12))
    assert_consistent(CIRCLE)


@given(st.floats(-10, 60), st.floats(-3, 3))
def test_project_undoes_at(s, left):
    x, y, yaw, _ = CIRCLE.at(s)
    found = CIRCLE.project([[x - left * np.sin(yaw), y + left * np.cos(yaw)]])
    np.testing.assert_allclose(found, [[s], [left]], atol=5e-4)


@pytest.mark.parametrize("offset", [3.5, -3.5])
def test_a_lane_change_shifts_the_rest_and_bends_gently(offset):
    path = lane_change(straight((0.0, 0.0), 0.0, 100.0), 20.0, 35.0, offset)
    assert_consistent(path)
    x, y = path.xy.T
    np.testing.assert_allclose(y[x < 20], 0, atol=1e-9)
    np.testing.assert_allclose(y[x > 55], offset, atol=1e-9)
    assert (np.sign(np.diff(y).round(12)) * np.sign(offset) >= 0).all()
    # of the quintic: 10/√3 · offset / length²
    np.testing.assert_allclose(
        np.abs(path.curvature).max(), 10 / np.sqrt(3) * 3.5 / 35**2, rtol=0.05
    )


def test_lines_meet_at_their_common_point():
    east, north = straight((-10.0, 1.0), 0.0, 30.0), straight((2.0, -20.0), np.pi / 2, 50.0)
    meetings = [crossing(east, north), crossing(north, east)]
    np.testing.assert_allclose(meetings, [(12.0, 21.0), (21.0, 12.0)], atol=1e-9)


LANE = straight((0.0, 0.0), 0.0, 120.0)


@pytest.mark.parametrize(
    ("other", "within", "places"),
    [
        (
            lane_change(straight((0.0, 3.5), 0.0, 120.0), 30.0, 40.0, -3.5),
            0.5,
            (30, 70, 0.4, 0.5),
        ),  # it joins
        (
            bent((5.0, -1.0), np.pi / 3, [(10.0, -0.25, -0.25)]),
            None,
            (5, 6, -0.01, 0.01),
        ),  # the first of two counts
    ],
)
def test_paths_meet_where_they_have_come_near(other, within, places):
    meeting = crossing(LANE, other, **({} if within is None else {"within": within}))
    x, y, _, _ = other.at(meeting.s_b)
    left, right, low, high = places
    assert (left < x < right, low < y <= high, abs(meeting.s_a - x) < 0.2) == (True, True, True)


@pytest.mark.parametrize(
    "other", [straight((0.0, 3.5), 0.0, 50.0), straight((60.0, -9.0), np.pi / 2, 20.0)]
)
def test_paths_beside_each_other_never_meet(other):
    assert crossing(straight((0.0, 0.0), 0.0, 50.0), other) is None


@pytest.mark.parametrize("left", [True, False])
@pytest.mark.parametrize("tangent", [3.0, 14.0])
def test_it_ends_on_the_other_line(left, tangent):
    path, sign = bent((0.0, 0.0), 0.0, quarter_turn(tangent, left=left)), 1 if left else -1
    end = [*path.xy[-1], path.yaw[-1], path.curvature[0], path.curvature[-1]]
    np.testing.assert_allclose(end, [tangent, sign * tangent, sign * np.pi / 2, 0, 0], atol=1e-7)
