"""What warnings make of accidents whose physics is plain, and laws over wild ones."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from refusals import assert_refused
from replayed_accidents import accident, head_on, rear_end, straight, swapped, wild_accidents

from deepaccident_devkit.collisions.outcomes import (
    BRAKINGS,
    MOST_MARGIN,
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
FIRST, SECOND, BOTH = (True, False), (False, True), (True, True)


def names(codes: np.ndarray) -> list[str]:
    return [OUTCOMES[code] for code in codes.ravel()]


def test_the_nine_ways_to_brake() -> None:
    assert [(each.reaction, each.deceleration) for each in BRAKINGS] == [
        (reaction, deceleration) for reaction in (0.5, 1.0, 1.5) for deceleration in (4.0, 6.0, 8.0)
    ]
    assert_refused(
        *[
            (
                partial(Braking, reaction=wrong[0], deceleration=wrong[1]),
                ConfigError,
                "Braking: expected a reaction of 0 s or more",
            )
            for wrong in ((-0.1, 4.0), (0.5, 0.0), (np.nan, 4.0), (0.5, np.inf))
        ],
    )


def test_a_striker_that_brakes_earlier_hits_slower_and_then_not_at_all() -> None:
    """10 m/s of closing speed need 10 m of way at 5 m/s²: the last moment is 1 s before the end."""
    told = outcomes_of(
        rear_end(20, 10), FIRST, [np.nan, 5.0, 4.99, 4.5, 4.01, 3.99], brakings=AT_ONCE
    )
    assert names(told.outcome) == [
        "unchanged",
        "unchanged",
        "unchanged",
        "mitigated",
        "mitigated",
        "avoided",
    ]
    np.testing.assert_array_equal(
        told.extrapolated.ravel(), [False, False, True, True, True, False]
    )
    assert told.time[0, 0] == pytest.approx(5, abs=1e-6)
    assert np.isinf(told.time[-1, 0])
    # 5 m left at 4.5 s: 10 τ − 5 τ²/2 = 5
    slower = np.sqrt(100 - 2 * 5 * 5)
    assert told.speeds[3, 0] == pytest.approx([10 + slower, 10], abs=1e-3)
    assert told.delta_v[3, 0] == pytest.approx([slower / 2, slower / 2], abs=1e-3)
    assert told.reduction[:, 0] == pytest.approx(
        [0, 0, 1 - np.sqrt(0.99), 1 - slower / 10, 0.9, 1], abs=2e-3
    )
    assert np.isnan(told.speeds[-1, 0]).all()
    np.testing.assert_array_equal(told.delta_v[-1, 0], 0)


def test_a_leader_that_brakes_is_hit_harder() -> None:
    told = outcomes_of(rear_end(20, 10), SECOND, [0.0, 4.6, 4.9], brakings=AT_ONCE)
    assert names(told.outcome) == ["worsened", "worsened", "unchanged"]  # also if it stands already
    assert (told.speeds[0, 0], told.reduction[0, 0]) == (pytest.approx([20, 0]), pytest.approx(-1))
    assert -0.3 < told.reduction[1, 0] < -0.1 < told.reduction[2, 0] < 0
    assert not told.extrapolated.any()


def test_a_stopped_one_is_hit() -> None:
    """Who brakes in time in front of oncoming traffic stands when the other, who does not,
    comes.
    """
    case = head_on(10.0)
    told = outcomes_of(case, FIRST, [2.5], brakings=AT_ONCE)
    assert names(told.outcome) == ["stopped"]
    assert told.extrapolated[0, 0]
    assert (told.speeds[0, 0], told.reduction[0, 0]) == (pytest.approx([0, 10]), pytest.approx(0.5))
    assert names(outcomes_of(case, BOTH, [2.5], brakings=AT_ONCE).outcome) == ["avoided"]
    # both still move at the contact
    assert names(outcomes_of(case, BOTH, [4.5], brakings=AT_ONCE).outcome) == ["mitigated"]


def test_who_stood_in_the_recording_too_is_not_stopped_by_braking() -> None:
    frames = 51
    hit = accident(np.tile([0.0, 0.0, 0.0], (frames, 1)), straight((-54, 0), 0, 10, frames))
    told = outcomes_of(hit, FIRST, [1.0], brakings=AT_ONCE)
    assert (names(told.outcome), told.reduction[0, 0]) == (["unchanged"], pytest.approx(0))


def test_without_a_warning_or_brakers_nothing_changes() -> None:
    case = rear_end()
    for told in (
        outcomes_of(case, FIRST, [np.nan, np.nan]),
        outcomes_of(case, (False, False), [0.0, 1.0]),
        outcomes_of(case, BOTH, [4.5, 7.0]),  # the shortest reaction ends with the recording
    ):
        assert (told.outcome.shape, set(names(told.outcome))) == ((2, 9), {"unchanged"})
        assert not told.extrapolated.any()
        np.testing.assert_array_equal(told.reduction, 0)
    assert_refused(
        (lambda: outcomes_of(case, FIRST, [[1.0]]), GeometryError, "warning_times: expected"),
    )


def test_latency_and_reaction_delay_the_braking() -> None:
    case = rear_end()
    late = outcomes_of(
        case, FIRST, [3.7], brakings=[Braking(reaction=0.5, deceleration=5.0)], latency=0.3
    )
    assert (
        5 < late.time[0, 0] == outcomes_of(case, FIRST, [4.5], brakings=AT_ONCE).time[0, 0] < np.inf
    )
    from_start = outcomes_of(case, FIRST, [0.0], brakings=AT_ONCE)
    np.testing.assert_array_equal(
        from_start.reduction, outcomes_of(case, FIRST, [-7.0], brakings=AT_ONCE).reduction
    )


def test_the_check_of_a_recording() -> None:
    check = undisturbed(rear_end(20, 10))
    assert check.usable
    assert check.collides
    assert (check.margin, check.time) == (pytest.approx(1e-9, abs=1e-9), pytest.approx(5, abs=1e-6))
    assert (check.speeds, check.delta_v) == (pytest.approx([20, 10]), pytest.approx([5, 5]))


@pytest.mark.parametrize(("gap", "usable"), [(0.9 * MOST_MARGIN, True), (1.1 * MOST_MARGIN, False)])
def test_the_gap_at_the_end_counts_as_contact_up_to_a_metre(gap: float, usable: bool) -> None:
    case = rear_end()
    paths = case.paths.copy()
    paths[1, :, 0] += gap
    check = undisturbed(replace(case, paths=paths))
    assert check.margin == pytest.approx(gap)
    assert check.collides
    assert (check.usable, check.time) == (usable, pytest.approx(5, abs=1e-6))


def test_delta_v_and_its_range() -> None:
    np.testing.assert_allclose(delta_v_of([1000, 3000], [8.0, 0.0]), [[6, 2], [0, 0]])
    ranges = delta_v_ranges([1000, 3000], 8.0)
    np.testing.assert_allclose(
        ranges, [[8 * 2100 / 3400, 8 * 3900 / 4600], [8 * 700 / 4600, 8 * 1300 / 3400]]
    )


def test_no_delta_v_in_the_recording() -> None:
    """Both drive side by side at the same speed and touch all the time: only braking makes a
    difference of speeds.
    """
    told = outcomes_of(
        accident(straight((0, 0), 0, 10, 31), straight((0, 2), 0, 10, 31)),
        FIRST,
        [np.nan, 1.0],
        brakings=AT_ONCE,
    )
    assert names(told.outcome) == ["unchanged", "unchanged"]  # they touch before anyone brakes
    np.testing.assert_array_equal(told.reduction, 0)
    np.testing.assert_array_equal(reductions_of(np.array([2.0, 0.0, 0.0])), [-np.inf, 0.0, 0.0])


@settings(max_examples=12)
@given(st.floats(8, 30), st.floats(0, 0.9), st.floats(2, 9), st.integers(0, 100))
def test_earlier_braking_of_a_striker_from_behind_never_hits_faster(
    speed: float, share: float, deceleration: float, seed: int
) -> None:
    """The leader may brake and speed up as it likes."""
    rng, frames = np.random.default_rng(seed), 41
    way = (
        np.append(0, np.cumsum(np.maximum(share * speed + np.repeat(rng.normal(0, 2, 8), 5), 0)))
        / 10
    )
    second = np.column_stack(
        [way - way[-1] + 3.9 + speed * (frames - 1) / 10, np.zeros(frames), np.zeros(frames)]
    )
    case = accident(straight((0, 0), 0, speed, frames), second)
    assume(
        undisturbed(case).time > 3.9
    )  # else it drives into the leader before, and may do so more than once
    told = outcomes_of(
        case,
        FIRST,
        np.arange(0, 4.05, 0.05),
        brakings=[Braking(reaction=0, deceleration=deceleration)],
    )
    assert (np.diff(np.nan_to_num(told.speeds[:, 0, 0], nan=-1.0)) >= -1e-3).all()


@settings(max_examples=6)
@given(wild_accidents())
def test_pairs_are_symmetric(case: Accident) -> None:
    times = np.linspace(0, 2, 7)
    for mask in (FIRST, SECOND, BOTH):
        one = outcomes_of(case, mask, times)
        two = outcomes_of(swapped(case), (mask[1], mask[0]), times)
        np.testing.assert_array_equal(one.outcome, two.outcome)
        np.testing.assert_allclose(one.time, two.time, atol=2e-6)
        np.testing.assert_allclose(one.speeds, two.speeds[..., ::-1])
        np.testing.assert_allclose(one.delta_v, two.delta_v[..., ::-1])


@settings(max_examples=15)
@given(wild_accidents())
def test_a_replay_without_braking_is_the_recording(case: Accident) -> None:
    check, told = undisturbed(case), outcomes_of(case, BOTH, [np.nan])
    assert check.collides
    assert check.time <= case.duration
    assert (told.time == check.time).all()
    np.testing.assert_array_equal(told.speeds[0, 0], check.speeds)
    np.testing.assert_array_equal(told.delta_v[0, 0], check.delta_v)
