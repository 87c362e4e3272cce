from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, ConfigError
from deepaccident_devkit.safety import ObservationRule, observed_actors
from deepaccident_devkit.safety.observation import _seen
from deepaccident_devkit.tables import visible_mask
from deepaccident_devkit.taxonomy import AGENTS
from deepaccident_devkit.v2x.tracks import scenario_tracks


@pytest.fixture
def accident(da_motion: DeepAccident) -> Mapping[str, Any]:
    return da_motion.find(collision=True)[0]


def own_id(da: DeepAccident, scenario: Mapping[str, Any], agent: str) -> int | None:
    return da.get("agent", f"{scenario['token']}/{agent}")["actor_id"]


def others(da: DeepAccident, scenario: Mapping[str, Any]) -> list[int]:
    """The actors that are no agents."""
    own = {own_id(da, scenario, agent) for agent in AGENTS}
    ids = np.unique(scenario_tracks(da, scenario["token"]).actor_id).tolist()
    return [actor for actor in ids if actor not in own]


def test_annotated_is_the_tracks_agents(da_motion: DeepAccident, accident: Mapping[str, Any]) -> None:
    actors = [*accident["collision"]["ids"], *others(da_motion, accident)]
    agents, observed = observed_actors(da_motion, accident, actors, ObservationRule(kind="annotated"))
    assert agents == AGENTS
    assert observed.shape == (5, len(actors), accident["num_frames"])
    tracks = scenario_tracks(da_motion, accident["token"])
    expected = np.zeros_like(observed)
    for which, actor in enumerate(actors):
        rows = np.flatnonzero(tracks.actor_id == actor)
        expected[:, which, tracks.index[rows] - 1] = tracks.agents[rows] >> np.arange(5)[:, None] & 1
    np.testing.assert_array_equal(observed, expected)
    assert expected.any()
    assert not expected.all()


@pytest.mark.parametrize("kind", ["points", "released"])
def test_rules_on_each_label(da_motion: DeepAccident, accident: Mapping[str, Any], kind: str) -> None:
    actors = [*accident["collision"]["ids"], *others(da_motion, accident)]
    rule = ObservationRule(kind=kind, least_points=3)
    _, observed = observed_actors(da_motion, accident["token"], actors, rule)
    expected = np.zeros_like(observed)
    for row, agent in enumerate(AGENTS):
        for frame in range(accident["num_frames"]):
            sample = da_motion.get_sample(accident["token"], agent, frame + 1)
            boxes, ids = da_motion.boxes(sample, "lidar"), da_motion.actor_ids(sample)
            seen = boxes.num_lidar_pts >= 3
            if kind == "released":
                seen = visible_mask(
                    boxes.center[:, :2],
                    boxes.category,
                    boxes.num_lidar_pts,
                    boxes.camera_visible,
                    infrastructure=agent == "infrastructure",
                )
            expected[row, :, frame] = np.isin(actors, ids[seen])
        expected[row, [actor == own_id(da_motion, accident, agent) for actor in actors]] = True
    np.testing.assert_array_equal(observed, expected)
    assert 0 < expected[4].mean() < 1


def test_the_pole_has_a_distance_of_its_own() -> None:
    """A car 12 m away with one point, which the released rule calls seen by the pole and not by a vehicle."""
    columns = {
        "num_lidar_pts": np.array([9, 1, 1]),
        "translation": np.array([[0.0, 0, 0], [12, 0, 0], [0, 12, 0]]),
        "category": np.zeros(3, dtype=np.int8),
        "camera_visible": np.zeros(3, dtype=bool),
    }
    dataset: Any = SimpleNamespace(columns=lambda _: columns)
    by_pole = np.array([False, True])
    rule = ObservationRule(kind="released")
    assert _seen(dataset, slice(0, 3), np.array([1, 2]), by_pole, rule).tolist() == [False, True]


def test_who_observes_itself(da_motion: DeepAccident, accident: Mapping[str, Any]) -> None:
    ego = own_id(da_motion, accident, "ego_vehicle")
    rule = ObservationRule(kind="points", least_points=10**9)
    _, observed = observed_actors(da_motion, accident, [ego], rule)
    assert observed[0].all()
    assert not observed[1:].any()


def test_rules_are_checked_and_say_what_they_are() -> None:
    assert ObservationRule(kind="Points").text == "at least 5 LiDAR points"  # type: ignore[arg-type]
    assert ObservationRule(kind="annotated").text == "annotated"
    for error, words, refused in (
        (
            ChoiceError,
            "kind: expected one of points, released, annotated, found 'seen'",
            lambda: ObservationRule(kind="seen"),
        ),
        (ConfigError, "least_points: expected a whole number from 1, found 0", lambda: ObservationRule(least_points=0)),
        (ConfigError, "least_points: expected a whole number", lambda: ObservationRule(least_points=1.5)),
    ):
        with pytest.raises(error, match=words):
            refused()
