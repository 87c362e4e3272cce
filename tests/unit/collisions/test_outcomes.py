"""What warnings change in accidents with simple physics, and laws that hold for erratic ones."""

from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from support.braking_accidents import (
    erratic_accidents,
    head_on_accident,
    make_accident,
    rear_end_accident,
    straight_path,
    swap_actors,
)
from support.expected_errors import assert_raises

from deepaccident_devkit.collisions.outcomes import (
    BRAKINGS,
    MAX_END_GAP_M,
    OUTCOMES,
    Braking,
    delta_v_of,
    delta_v_ranges,
    outcomes_of,
    reductions_of,
    undisturbed,
)
from deepaccident_devkit.collisions.recorded import Accident
from deepaccident_devkit.errors import ConfigError, GeometryError

AT_ONCE = (Braking(reaction=0.0, deceleration=5.0),)
FIRST_BRAKES, SECOND_BRAKES, BOTH_BRAKE = (True, False), (False, True), (True, True)


def outcome_names(codes: np.ndarray) -> list[str]:
    return [OUTCOMES[code] for code in codes.ravel()]


def test_the_nine_ways_to_brake() -> None:
    expected = list(product((0.5, 1.0, 1.5), (4.0, 6.0, 8.0)))
    assert [(braking.reaction, braking.deceleration) for braking in BRAKINGS] == expected
    message = "Braking: expected a reaction time of 0 s or more"
    assert_raises(
        *[
            (partial(Braking, reaction=reaction, deceleration=deceleration), ConfigError, message)
            for reaction, deceleration in ((-0.1, 4.0), (0.5, 0.0), (np.nan, 4.0), (0.5, np.inf))
        ],
    )


def test_a_striker_that_brakes_earlier_hits_slower_and_then_not_at_all() -> None:
    """10 m/s of closing speed need 10 m of way at 5 m/s²: the last moment is 1 s before the end."""
    warning_times = [np.nan, 5.0, 4.99, 4.5, 4.01, 3.99]
    outcomes = outcomes_of(rear_end_accident(20, 10), FIRST_BRAKES, warning_times, brakings=AT_ONCE)
    assert outcome_names(outcomes.outcome) == [
        "unchanged",
        "unchanged",
        "unchanged",
        "mitigated",
        "mitigated",
        "avoided",
    ]
    np.testing.assert_array_equal(
        outcomes.extrapolated.ravel(), [False, False, True, True, True, False]
    )
    assert outcomes.time[0, 0] == pytest.approx(5, abs=1e-6)
    assert np.isinf(outcomes.time[-1, 0])
    # 5 m left at 4.5 s: 10 τ − 5 τ²/2 = 5
    closing_speed = np.sqrt(100 - 2 * 5 * 5)
    assert outcomes.speeds[3, 0] == pytest.approx([10 + closing_speed, 10], abs=1e-3)
    assert outcomes.delta_v[3, 0] == pytest.approx([closing_speed / 2, closing_speed / 2], abs=1e-3)
    reductions = [0, 0, 1 - np.sqrt(0.99), 1 - closing_speed / 10, 0.9, 1]
    assert outcomes.reduction[:, 0] == pytest.approx(reductions, abs=2e-3)
    assert np.isnan(outcomes.speeds[-1, 0]).all()
    np.testing.assert_array_equal(outcomes.delta_v[-1, 0], 0)


def test_a_leader_that_brakes_is_hit_harder() -> None:
    outcomes = outcomes_of(
        rear_end_accident(20, 10), SECOND_BRAKES, [0.0, 4.6, 4.9], brakings=AT_ONCE
    )
    # it is also hit harder if it stands already
    assert outcome_names(outcomes.outcome) == ["worsened", "worsened", "unchanged"]
    assert outcomes.speeds[0, 0] == pytest.approx([20, 0])
    assert outcomes.reduction[0, 0] == pytest.approx(-1)
    assert -0.3 < outcomes.reduction[1, 0] < -0.1 < outcomes.reduction[2, 0] < 0
    assert not outcomes.extrapolated.any()


def test_a_stopped_one_is_hit() -> None:
    """A car that brakes in time stands when the oncoming car, which does not brake, arrives."""
    accident = head_on_accident(10.0)
    outcomes = outcomes_of(accident, FIRST_BRAKES, [2.5], brakings=AT_ONCE)
    assert outcome_names(outcomes.outcome) == ["stopped"]
    assert outcomes.extrapolated[0, 0]
    assert outcomes.speeds[0, 0] == pytest.approx([0, 10])
    assert outcomes.reduction[0, 0] == pytest.approx(0.5)
    assert outcome_names(outcomes_of(accident, BOTH_BRAKE, [2.5], brakings=AT_ONCE).outcome) == [
        "avoided"
    ]
    # both still move at the contact
    assert outcome_names(outcomes_of(accident, BOTH_BRAKE, [4.5], brakings=AT_ONCE).outcome) == [
        "mitigated"
    ]


def test_a_car_that_stood_in_the_recording_is_not_stopped_by_braking() -> None:
    num_frames = 51
    standing_path = np.tile([0.0, 0.0, 0.0], (num_frames, 1))
    accident = make_accident(standing_path, straight_path((-54, 0), 0, 10, num_frames))
    outcomes = outcomes_of(accident, FIRST_BRAKES, [1.0], brakings=AT_ONCE)
    assert outcome_names(outcomes.outcome) == ["unchanged"]
    assert outcomes.reduction[0, 0] == pytest.approx(0)


def test_without_a_warning_or_brakers_nothing_changes() -> None:
    accident = rear_end_accident()
    for outcomes in (
        outcomes_of(accident, FIRST_BRAKES, [np.nan, np.nan]),
        outcomes_of(accident, (False, False), [0.0, 1.0]),
        outcomes_of(
            accident, BOTH_BRAKE, [4.5, 7.0]
        ),  # the shortest reaction ends with the recording
    ):
        assert outcomes.outcome.shape == (2, 9)
        assert set(outcome_names(outcomes.outcome)) == {"unchanged"}
        assert not outcomes.extrapolated.any()
        np.testing.assert_array_equal(outcomes.reduction, 0)
    assert_raises(
        (
            lambda: outcomes_of(accident, FIRST_BRAKES, [[1.0]]),
            GeometryError,
            "warning_times: expected",
        ),
    )


def test_latency_and_reaction_delay_the_braking() -> None:
    accident = rear_end_accident()
    braking = Braking(reaction=0.5, deceleration=5.0)
    delayed = outcomes_of(accident, FIRST_BRAKES, [3.7], brakings=[braking], latency=0.3)
    at_once = outcomes_of(accident, FIRST_BRAKES, [4.5], brakings=AT_ONCE)
    assert 5 < delayed.time[0, 0] == at_once.time[0, 0] < np.inf

    from_start = outcomes_of(accident, FIRST_BRAKES, [0.0], brakings=AT_ONCE)
    before_start = outcomes_of(accident, FIRST_BRAKES, [-7.0], brakings=AT_ONCE)
    np.testing.assert_array_equal(from_start.reduction, before_start.reduction)


def test_the_check_of_a_recording() -> None:
    check = undisturbed(rear_end_accident(20, 10))
    assert check.usable
    assert check.collides
    assert check.margin == pytest.approx(1e-9, abs=1e-9)
    assert check.time == pytest.approx(5, abs=1e-6)
    assert check.speeds == pytest.approx([20, 10])
    assert check.delta_v == pytest.approx([5, 5])


@pytest.mark.parametrize(
    ("gap", "usable"), [(0.9 * MAX_END_GAP_M, True), (1.1 * MAX_END_GAP_M, False)]
)
def test_the_gap_at_the_end_counts_as_contact_up_to_a_metre(gap: float, usable: bool) -> None:
    accident = rear_end_accident()
    paths = accident.paths.copy()
    paths[1, :, 0] += gap
    check = undisturbed(replace(accident, paths=paths))
    assert check.margin == pytest.approx(gap)
    assert check.collides
    assert check.usable == usable
    assert check.time == pytest.approx(5, abs=1e-6)


def test_delta_v_and_its_range() -> None:
    np.testing.assert_allclose(delta_v_of([1000, 3000], [8.0, 0.0]), [[6, 2], [0, 0]])
    first_range = [8 * 2100 / 3400, 8 * 3900 / 4600]
    second_range = [8 * 700 / 4600, 8 * 1300 / 3400]
    np.testing.assert_allclose(delta_v_ranges([1000, 3000], 8.0), [first_range, second_range])


def test_no_delta_v_in_the_recording() -> None:
    """Two cars that touch drive side by side at the same speed; only braking changes that."""
    accident = make_accident(straight_path((0, 0), 0, 10, 31), straight_path((0, 2), 0, 10, 31))
    outcomes = outcomes_of(accident, FIRST_BRAKES, [np.nan, 1.0], brakings=AT_ONCE)
    # they touch before either brakes
    assert outcome_names(outcomes.outcome) == ["unchanged", "unchanged"]
    np.testing.assert_array_equal(outcomes.reduction, 0)
    np.testing.assert_array_equal(reductions_of(np.array([2.0, 0.0, 0.0])), [-np.inf, 0.0, 0.0])


@settings(max_examples=12)
@given(st.floats(8, 30), st.floats(0, 0.9), st.floats(2, 9), st.integers(0, 100))
def test_earlier_braking_of_a_striker_from_behind_never_hits_faster(
    speed: float, share: float, deceleration: float, seed: int
) -> None:
    """The leader may brake and speed up as it likes."""
    rng = np.random.default_rng(seed)
    num_frames = 41
    leader_speeds = np.maximum(share * speed + np.repeat(rng.normal(0, 2, 8), 5), 0)
    leader_distances = np.append(0, np.cumsum(leader_speeds)) / 10
    last_leader_x = 3.9 + speed * (num_frames - 1) / 10
    leader_path = np.zeros((num_frames, 3))
    leader_path[:, 0] = leader_distances - leader_distances[-1] + last_leader_x
    accident = make_accident(straight_path((0, 0), 0, speed, num_frames), leader_path)
    # otherwise it drives into the leader earlier, possibly more than once
    assume(undisturbed(accident).time > 3.9)

    warning_times = np.arange(0, 4.05, 0.05)
    braking = Braking(reaction=0, deceleration=deceleration)
    outcomes = outcomes_of(accident, FIRST_BRAKES, warning_times, brakings=[braking])
    impact_speeds = np.nan_to_num(outcomes.speeds[:, 0, 0], nan=-1.0)
    assert (np.diff(impact_speeds) >= -1e-3).all()


@settings(max_examples=6)
@given(erratic_accidents())
def test_pairs_are_symmetric(accident: Accident) -> None:
    times = np.linspace(0, 2, 7)
    for mask in (FIRST_BRAKES, SECOND_BRAKES, BOTH_BRAKE):
        outcomes = outcomes_of(accident, mask, times)
        swapped = outcomes_of(swap_actors(accident), (mask[1], mask[0]), times)
        np.testing.assert_array_equal(outcomes.outcome, swapped.outcome)
        np.testing.assert_allclose(outcomes.time, swapped.time, atol=2e-6)
        np.testing.assert_allclose(outcomes.speeds, swapped.speeds[..., ::-1])
        np.testing.assert_allclose(outcomes.delta_v, swapped.delta_v[..., ::-1])


@settings(max_examples=15)
@given(erratic_accidents())
def test_a_replay_without_braking_is_the_recording(accident: Accident) -> None:
    check = undisturbed(accident)
    outcomes = outcomes_of(accident, BOTH_BRAKE, [np.nan])
    assert check.collides
    assert check.time <= accident.duration
    assert (outcomes.time == check.time).all()
    np.testing.assert_array_equal(outcomes.speeds[0, 0], check.speeds)
    np.testing.assert_array_equal(outcomes.delta_v[0, 0], check.delta_v)
