import itertools
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from support.expected_errors import assert_raises

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


def agent_id(da: DeepAccident, scenario: Mapping[str, Any], agent: str) -> int | None:
    return da.get("agent", f"{scenario['token']}/{agent}")["actor_id"]


def list_actors(da: DeepAccident, scenario: Mapping[str, Any]) -> list[int]:
    """Return the colliding pair, and the actors that are not agents."""
    agent_ids = {agent_id(da, scenario, agent) for agent in AGENTS}
    ids = np.unique(scenario_tracks(da, scenario["token"]).actor_id).tolist()
    return [*scenario["collision"]["ids"], *(actor for actor in ids if actor not in agent_ids)]


def test_annotated_is_the_tracks_agents(
    da_motion: DeepAccident, accident: Mapping[str, Any]
) -> None:
    actors = list_actors(da_motion, accident)
    rule = ObservationRule(kind="annotated")
    agents, observed = observed_actors(da_motion, accident, actors, rule)
    assert agents == AGENTS
    assert observed.shape == (5, len(actors), accident["num_frames"])

    tracks = scenario_tracks(da_motion, accident["token"])
    expected = np.zeros_like(observed)
    for actor_index, actor in enumerate(actors):
        rows = np.flatnonzero(tracks.actor_id == actor)
        agent_bits = tracks.agents[rows] >> np.arange(5)[:, None] & 1
        expected[:, actor_index, tracks.index[rows] - 1] = agent_bits
    np.testing.assert_array_equal(observed, expected)
    assert 0 < expected.mean() < 1


@pytest.mark.parametrize("kind", ["points", "released"])
def test_rules_on_each_label(
    da_motion: DeepAccident, accident: Mapping[str, Any], kind: str
) -> None:
    actors = list_actors(da_motion, accident)
    rule = ObservationRule(kind=kind, least_points=3)
    _, observed = observed_actors(da_motion, accident["token"], actors, rule)
    expected = np.zeros_like(observed)
    for (row, agent), frame in itertools.product(enumerate(AGENTS), range(accident["num_frames"])):
        sample = da_motion.get_sample(accident["token"], agent, frame + 1)
        boxes = da_motion.boxes(sample, "lidar")
        is_seen = boxes.num_lidar_pts >= 3
        if kind == "released":
            columns = boxes.center[:, :2], boxes.category, boxes.num_lidar_pts, boxes.camera_visible
            is_seen = visible_mask(*columns, infrastructure=agent == "infrastructure")
        seen_ids = da_motion.actor_ids(sample)[is_seen]
        own_id = agent_id(da_motion, accident, agent) or -1
        expected[row, :, frame] = np.isin(actors, [*seen_ids, own_id])
    np.testing.assert_array_equal(observed, expected)
    assert 0 < expected[4].mean() < 1


def test_the_pole_has_a_distance_of_its_own() -> None:
    """A car 12 m away with one point is seen by the infrastructure but not by a vehicle."""
    columns = {
        "num_lidar_pts": np.array([9, 1, 1]),
        "translation": np.array([[0.0, 0, 0], [12, 0, 0], [0, 12, 0]]),
        "category": np.zeros(3, dtype=np.int8),
        "camera_visible": np.zeros(3, dtype=bool),
    }
    dataset: Any = SimpleNamespace(columns=lambda _: columns)
    is_infrastructure = np.array([False, True])
    rule = ObservationRule(kind="released")
    is_seen = by_rule(dataset, slice(0, 3), np.array([1, 2]), is_infrastructure, rule)
    assert is_seen.tolist() == [False, True]


def test_an_agent_always_observes_itself(
    da_motion: DeepAccident, accident: Mapping[str, Any]
) -> None:
    rule = ObservationRule(kind="points", least_points=10**9)
    ego = agent_id(da_motion, accident, "ego_vehicle")
    _, observed = observed_actors(da_motion, accident, [ego], rule)
    assert observed[0].all()
    assert not observed[1:].any()


def test_what_does_not_fit_is_refused() -> None:
    assert_raises(
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
    sees_both = observed[agents].any(axis=0).all(axis=0)
    if not sees_both.any():
        return 0.0
    return (len(sees_both) - 1 - np.argmax(sees_both)) / 10


@given(observations)
def test_leads_are_those_of_a_plain_search(observed: np.ndarray) -> None:
    expected = []
    for members in coalition_members(4):
        partners = np.flatnonzero(members) + 1
        expected.append(plain_lead(observed, [0, *partners]))
    assert coalition_leads(observed) == pytest.approx(expected, abs=1e-12)


@given(observations)
def test_more_agents_never_see_later(observed: np.ndarray) -> None:
    leads = coalition_leads(observed)
    for coalition, newcomers in itertools.product(range(16), repeat=2):
        assert leads[coalition | newcomers] >= leads[coalition]


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
        coalitions = np.cumsum([0, *(1 << partner for partner in order)])
        gains[row, order] = np.diff(leads[coalitions])
    np.testing.assert_allclose(values, gains.mean(axis=0), atol=1e-9)


def test_both_must_be_observed_at_the_same_frame() -> None:
    observed = np.zeros((2, 2, 5), dtype=bool)
    observed[0, 0, 0] = observed[0, 1, 1] = True
    assert first_together(observed).tolist() == [-1, -1]
    observed[1, 1, 0] = True
    assert first_together(observed).tolist() == [-1, 0]
    assert coalition_leads(observed).tolist() == pytest.approx([0, 0.4])
    assert shapley_values(coalition_leads(observed)).tolist() == pytest.approx([0.4])
