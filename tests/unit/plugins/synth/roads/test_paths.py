"""Paths: sampled densely, smooth, and consistent with their own numbers."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepaccident_devkit.plugins.synth.roads.paths import (
    SPACING,
    crossing,
    join_pieces,
    lane_change,
    quarter_turn,
    straight,
)

CIRCLE = join_pieces((3.0, -2.0), 0.4, [(40.0, 0.05, 0.05)])


def assert_consistent(path, atol=1e-3):
    """Assert that steps have their stated lengths, that yaw is the direction of the steps, and
    curvature the turn of yaw per metre.
    """
    steps = np.diff(path.xy, axis=0)
    lengths = np.diff(path.s)
    assert lengths.max() <= SPACING + 1e-9
    np.testing.assert_allclose(np.hypot(*steps.T), lengths, atol=atol * SPACING)

    directions = np.arctan2(steps[:, 1], steps[:, 0])
    middle_yaw = (path.yaw[:-1] + path.yaw[1:]) / 2
    np.testing.assert_allclose(directions, np.angle(np.exp(1j * middle_yaw)), atol=atol)
    np.testing.assert_allclose(np.diff(path.yaw) / lengths, path.curvature[:-1], atol=0.01)


def test_an_arc_lies_on_its_circle():
    radius = 20
    centre = np.array([3.0, -2.0]) + radius * np.array([-np.sin(0.4), np.cos(0.4)])
    distances = np.hypot(*(CIRCLE.xy - centre).T)

    np.testing.assert_allclose(distances, radius, atol=1e-9)
    assert CIRCLE.length == 40
    assert CIRCLE.yaw[-1] == pytest.approx(0.4 + 40 * 0.05, abs=1e-12)
    assert_consistent(CIRCLE)


@given(st.floats(-10, 60), st.floats(-3, 3))
def test_project_undoes_at(s, left):
    x, y, yaw, _ = CIRCLE.at(s)
    point = [
        x - left * np.sin(yaw),
        y + left * np.cos(yaw),
    ]

    np.testing.assert_allclose(CIRCLE.project([point]), [[s], [left]], atol=5e-4)


@pytest.mark.parametrize("offset", [3.5, -3.5])
def test_a_lane_change_shifts_the_rest_and_bends_gently(offset):
    path = lane_change(straight((0.0, 0.0), 0.0, 100.0), 20.0, 35.0, offset)
    assert_consistent(path)
    x, y = path.xy.T
    np.testing.assert_allclose(y[x < 20], 0, atol=1e-9)
    np.testing.assert_allclose(y[x > 55], offset, atol=1e-9)

    directions = np.sign(np.diff(y).round(12))
    assert (directions * np.sign(offset) >= 0).all()
    # of the quintic: 10/√3 · offset / length²
    largest_curvature = 10 / np.sqrt(3) * 3.5 / 35**2
    np.testing.assert_allclose(np.abs(path.curvature).max(), largest_curvature, rtol=0.05)


def test_lines_meet_at_their_common_point():
    east = straight((-10.0, 1.0), 0.0, 30.0)
    north = straight((2.0, -20.0), np.pi / 2, 50.0)
    np.testing.assert_allclose(crossing(east, north), (12.0, 21.0), atol=1e-9)
    np.testing.assert_allclose(crossing(north, east), (21.0, 12.0), atol=1e-9)


LANE = straight((0.0, 0.0), 0.0, 120.0)


@pytest.mark.parametrize(
    ("other", "options", "x_range", "y_range"),
    [
        (  # it joins
            lane_change(straight((0.0, 3.5), 0.0, 120.0), 30.0, 40.0, -3.5),
            {"within": 0.5},
            (30, 70),
            (0.4, 0.5),
        ),
        (  # the first of two counts
            join_pieces((5.0, -1.0), np.pi / 3, [(10.0, -0.25, -0.25)]),
            {},
            (5, 6),
            (-0.01, 0.01),
        ),
    ],
)
def test_paths_meet_where_they_have_come_near(other, options, x_range, y_range):
    meeting = crossing(LANE, other, **options)
    x, y, _, _ = other.at(meeting.s_b)

    assert x_range[0] < x < x_range[1]
    assert y_range[0] < y <= y_range[1]
    assert abs(meeting.s_a - x) < 0.2


@pytest.mark.parametrize(
    "other",
    [
        straight((0.0, 3.5), 0.0, 50.0),
        straight((60.0, -9.0), np.pi / 2, 20.0),
    ],
)
def test_paths_beside_each_other_never_meet(other):
    lane = straight((0.0, 0.0), 0.0, 50.0)
    assert crossing(lane, other) is None


@pytest.mark.parametrize("left", [True, False])
@pytest.mark.parametrize("tangent", [3.0, 14.0])
def test_a_quarter_turn_ends_on_the_other_line(left, tangent):
    path = join_pieces((0.0, 0.0), 0.0, quarter_turn(tangent, left=left))
    sign = 1 if left else -1

    np.testing.assert_allclose(path.xy[-1], [tangent, sign * tangent], atol=1e-7)
    np.testing.assert_allclose(path.yaw[-1], sign * np.pi / 2, atol=1e-7)
    np.testing.assert_allclose(path.curvature[[0, -1]], 0, atol=1e-7)
