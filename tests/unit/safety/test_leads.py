import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from refusals import assert_refused

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.safety import COALITIONS, PARTNERS, coalition_leads, shapley_values
from deepaccident_devkit.safety.observation import coalition_members, first_together

observations = st.integers(1, 12).flatmap(lambda frames: arrays(np.bool_, (5, 2, frames)))


def plain_lead(observed: np.ndarray, agents: list[int]) -> float:
    frames = observed.shape[-1]
    for frame in range(frames):
        if all(any(observed[agent, which, frame] for agent in agents) for which in range(2)):
            return (frames - 1 - frame) / 10
    return 0.0


@given(observations)
def test_leads_are_those_of_a_plain_search(observed: np.ndarray) -> None:
    for lead, members in zip(coalition_leads(observed), coalition_members(4), strict=True):
        assert lead == pytest.approx(plain_lead(observed, [0, *(np.flatnonzero(members) + 1)]), abs=1e-12)


@given(observations)
def test_more_agents_never_see_later(observed: np.ndarray) -> None:
    leads = coalition_leads(observed)
    for fewer, more in itertools.product(range(16), repeat=2):
        if fewer & more == fewer:
            assert leads[more] >= leads[fewer]


@given(observations)
def test_shapley_values_share_the_whole_gain_and_are_means_over_orders(observed: np.ndarray) -> None:
    leads = coalition_leads(observed)
    values = shapley_values(leads)
    assert values.sum() == pytest.approx(leads[-1] - leads[0], abs=1e-9)
    assert (values >= -1e-12).all()
    gains = np.zeros((24, 4))
    for row, order in enumerate(itertools.permutations(range(4))):
        joined = 0
        for partner in order:
            gains[row, partner] = leads[joined | 1 << partner] - leads[joined]
            joined |= 1 << partner
    np.testing.assert_allclose(values, gains.mean(axis=0), atol=1e-9)


@given(arrays(np.bool_, (3, 5, 2, 7)))
def test_several_recordings_at_once(observed: np.ndarray) -> None:
    padded = np.concatenate([np.zeros((3, 5, 2, 4), dtype=bool), observed], axis=-1)
    one_by_one = np.array([coalition_leads(each) for each in observed])
    np.testing.assert_array_equal(coalition_leads(padded), one_by_one)
    np.testing.assert_allclose(shapley_values(one_by_one), [shapley_values(each) for each in one_by_one])


def test_both_must_be_observed_at_the_same_frame() -> None:
    observed = np.zeros((2, 2, 5), dtype=bool)
    observed[0, 0, 0] = observed[0, 1, 1] = True
    assert first_together(observed).tolist() == [-1, -1]
    observed[1, 1, 0] = True
    assert first_together(observed).tolist() == [-1, 0]
    assert coalition_leads(observed).tolist() == pytest.approx([0, 0.4])
    assert shapley_values(coalition_leads(observed)).tolist() == pytest.approx([0.4])


def test_partners_are_numbered_by_bits() -> None:
    assert COALITIONS[0] == ("ego_vehicle",)
    assert COALITIONS[8] == ("ego_vehicle", "infrastructure")
    assert COALITIONS[15] == ("ego_vehicle", *PARTNERS)
    assert shapley_values([3.0]).shape == (0,)


def test_wrong_shapes_are_named() -> None:
    assert_refused(
        (
            lambda: coalition_leads(np.zeros((5, 3, 4), dtype=bool)),
            GeometryError,
            r"observed: expected shape \(…, agents, 2, frames\), found \(5, 3, 4\)",
        ),
        (lambda: shapley_values(np.zeros(6)), GeometryError, "2\\^n coalitions, found shape \\(6,\\)"),
    )
