import itertools
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.descriptions import (
    ObservationRule,
    coalition_leads,
    observed_actors,
    shapley_values,
)
from deepaccident_devkit.descriptions.observation import by_rule, coalition_members, first_together
from deepaccident_devkit.errors import ChoiceError, ConfigError, GeometryError
from deepaccident_devkit.tables import visible_mask
from deepaccident_devkit.taxonomy import AGENTS
from deepaccident_devkit.v2x.tracks import scenario_tracks


@pytest.fixture
def accident(da_motion: DeepAccident) -> Mapping[str, Any]:
    return da_motion.find(collision=True)[0]


def own_id(da: DeepAccident, scenario: Mapping[str, Any], agent: str) -> int | None:
    return da.get("agent", f"{scenario['token']}/{agent}")["actor_id"]


def test_annotated_is_the_tracks_agents(
    da_motion: DeepAccident, accident: Mapping[str, Any]
) -> None:
    actors, tracks = all_actors(da_motion, accident), scenario_tracks(da_motion, accident["token"])
    agents, observed = observed_actors(
        da_motion, accident, actors, ObservationRule(kind="annotated")
    )
    assert (agents, observed.shape) == (AGENTS, (5, len(actors), accident["num_frames"]))
    expected = np.zeros_like(observed)
    for which, actor in enumerate(actors):
        rows = np.flatnonzero(tracks.actor_id == actor)
        expected[:, which, tracks.index[rows] - 1] = (
            tracks.agents[rows] >> np.arange(5)[:, None] & 1
        )
    np.testing.assert_array_equal(observed, expected)
    assert 0 < expected.mean() < 1


def all_actors(da: DeepAccident, scenario: Mapping[str, Any]) -> list[int]:
    """The pair, and the actors that are no agents."""
    own = {own_id(da, scenario, agent) for agent in AGENTS}
    ids = np.unique(scenario_tracks(da, scenario["token"]).actor_id).tolist()
    return [*scenario["collision"]["ids"], *(actor for actor in ids if actor not in own)]


@pytest.mark.parametrize("kind", ["points", "released"])
def test_rules_on_each_label(
    da_motion: DeepAccident, accident: Mapping[str, Any], kind: str
) -> None:
    actors = all_actors(da_motion, accident)
    rule = ObservationRule(kind=kind, least_points=3)
    _, observed = observed_actors(da_motion, accident["token"], actors, rule)
    expected = np.zeros_like(observed)
    for (row, agent), frame in itertools.product(enumerate(AGENTS), range(accident["num_frames"])):
        sample = da_motion.get_sample(accident["token"], agent, frame + 1)
        boxes, ids = da_motion.boxes(sample, "lidar"), da_motion.actor_ids(sample)
        seen = boxes.num_lidar_pts >= 3
        if kind == "released":
            columns = boxes.center[:, :2], boxes.category, boxes.num_lidar_pts, boxes.camera_visible
            seen = visible_mask(*columns, infrastructure=agent == "infrastructure")
        expected[row, :, frame] = np.isin(
            actors, [*ids[seen], own_id(da_motion, accident, agent) or -1]
        )
    np.testing.assert_array_equal(observed, expected)
    assert 0 < expected[4].mean() < 1


def test_the_pole_has_a_distance_of_its_own() -> None:
    """A car 12 m away with one point, which the released rule calls seen by the pole and not by a
    vehicle.
    """
    columns = {
        "num_lidar_pts": np.array([9, 1, 1]),
        "translation": np.array([[0.0, 0, 0], [12, 0, 0], [0, 12, 0]]),
        "category": np.zeros(3, dtype=np.int8),
        "camera_visible": np.zeros(3, dtype=bool),
    }
    dataset: Any = SimpleNamespace(columns=lambda _: columns)
    seen = by_rule(
        dataset,
        slice(0, 3),
        np.array([1, 2]),
        np.array([False, True]),
        ObservationRule(kind="released"),
    )
    assert seen.tolist() == [False, True]


def test_who_observes_itself(da_motion: DeepAccident, accident: Mapping[str, Any]) -> None:
    rule, ego = (
        ObservationRule(kind="points", least_points=10**9),
        own_id(da_motion, accident, "ego_vehicle"),
    )
    _, observed = observed_actors(da_motion, accident, [ego], rule)
    assert (
        observed.all(axis=(1, 2)).tolist()
        == observed.any(axis=(1, 2)).tolist()
        == [True, *[False] * 4]
    )


def test_what_does_not_fit_is_refused() -> None:
    assert_refused(
        (
            lambda: ObservationRule(kind="seen"),
            ChoiceError,
            ("kind", "points, released, annotated", "'seen'"),
        ),
        (
            lambda: ObservationRule(least_points=0),
            ConfigError,
            ("least_points", "from 1", "found 0"),
        ),
        (
            lambda: ObservationRule(least_points=1.5),
            ConfigError,
            ("least_points", "a whole number"),
        ),
        (
            lambda: coalition_leads(np.zeros((5, 3, 4), dtype=bool)),
            GeometryError,
            ("observed", "found (5, 3, 4)"),
        ),
        (lambda: shapley_values(np.zeros(6)), GeometryError, ("2^n coalitions", "(6,)")),
    )


observations = st.integers(1, 12).flatmap(lambda frames: arrays(np.bool_, (5, 2, frames)))


def plain_lead(observed: np.ndarray, agents: list[int]) -> float:
    both = observed[agents].any(axis=0).all(axis=0)
    return (len(both) - 1 - np.argmax(both)) / 10 if both.any() else 0.0


@given(observations)
def test_leads_are_those_of_a_plain_search(observed: np.ndarray) -> None:
    plain = [
        plain_lead(observed, [0, *(np.flatnonzero(members) + 1)])
        for members in coalition_members(4)
    ]
    assert coalition_leads(observed) == pytest.approx(plain, abs=1e-12)


@given(observations)
def test_more_agents_never_see_later(observed: np.ndarray) -> None:
    leads = coalition_leads(observed)
    assert all(
        leads[fewer | more] >= leads[fewer]
        for fewer, more in itertools.product(range(16), repeat=2)
    )


@given(observations)
def test_shapley_values_share_the_whole_gain_and_are_means_over_orders(
    observed: np.ndarray,
) -> None:
    leads = coalition_leads(observed)
    values = shapley_values(leads)
    assert values.sum() == pytest.approx(leads[-1] - leads[0], abs=1e-9)
    assert (values >= -1e-12).all()
    gains = np.zeros((24, 4))
    for row, order in enumerate(itertools.permutations(range(4))):
        joined = np.cumsum([0, *(1 << partner for partner in order)])
        gains[row, order] = np.diff(leads[joined])
    np.testing.assert_allclose(values, gains.mean(axis=0), atol=1e-9)


def test_both_must_be_observed_at_the_same_frame() -> None:
    observed = np.zeros((2, 2, 5), dtype=bool)
    observed[0, 0, 0] = observed[0, 1, 1] = True
    alone = first_together(observed).tolist()
    observed[1, 1, 0] = True
    assert (alone, first_together(observed).tolist()) == ([-1, -1], [-1, 0])
    assert coalition_leads(observed).tolist() == pytest.approx([0, 0.4])
    assert shapley_values(coalition_leads(observed)).tolist() == pytest.approx([0.4])
