"""`forecasting_truth`, against the tables of a synthetic release in plain loops."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import TokenError
from deepaccident_devkit.evaluation.forecasting import ForecastingTruth, forecasting_truth
from deepaccident_devkit.taxonomy import AGENTS, INFRASTRUCTURE
from deepaccident_devkit.v2x.cooperation import visible_instances


@pytest.fixture(scope="module")
def accident(da_motion: DeepAccident) -> str:
    return next(
        scenario["token"] for scenario in da_motion.scenario if scenario["collision"] is not None
    )


def read_group(truth: ForecastingTruth, name: str) -> set[int]:
    row = truth.members[truth.groups.index(name)]
    return set(truth.actor_id[row].tolist())


def token_before_end(da: DeepAccident, scenario: str, agent: str, frames: int) -> str:
    frame = da.get("scenario", scenario)["num_frames"] - frames
    return f"{scenario}/{agent}/{frame:03d}"


@pytest.mark.parametrize("agent", ["ego_vehicle", "other_vehicle", INFRASTRUCTURE])
def test_paths_are_those_of_the_tracks(da_motion: DeepAccident, accident: str, agent: str) -> None:
    token = token_before_end(da_motion, accident, agent, 12)
    present = frame_number(token)
    truth = forecasting_truth(da_motion, token, 2.0)

    own_id = da_motion.get("agent", f"{accident}/{agent}")["actor_id"]
    ego_from_world = da_motion.world_from(token, "ego").inverse()
    positions: dict[int, dict[int, np.ndarray]] = {}
    for row in da_motion.track:
        if row["instance_token"].startswith(f"{accident}/"):
            actor = da_motion.get("instance", row["instance_token"])["actor_id"]
            position = ego_from_world.apply(np.array(row["translation"]))[:2]
            positions.setdefault(actor, {})[frame_number(row["frame_token"])] = position
    actors = sorted(actor for actor in positions if present in positions[actor] and actor != own_id)
    assert truth.scenario == accident
    assert truth.actor_id.tolist() == actors
    unknown = np.full(2, np.nan)
    for actor, position, path in zip(actors, truth.present, truth.path, strict=True):
        assert_allclose(position, positions[actor][present], atol=1e-9)
        frames = range(present + 1, present + 21)
        expected = [positions[actor].get(frame, unknown) for frame in frames]
        assert_allclose(path, expected, atol=1e-9)
    assert np.isfinite(truth.path[:, :12]).any()
    assert np.isnan(truth.path[:, 12:]).all()


def frame_number(token: str) -> int:
    return int(token.rsplit("/", 1)[1])


@pytest.mark.parametrize("agent", ["ego_vehicle", INFRASTRUCTURE])
def test_each_actor_is_in_one_group_of_a_kind(
    da_motion: DeepAccident, accident: str, agent: str
) -> None:
    token = token_before_end(da_motion, accident, agent, 15)
    truth = forecasting_truth(da_motion, token)
    actors = set(truth.actor_id.tolist())
    kinds = {
        "class": [name for name in truth.groups if name.startswith("class ")],
        "role": ["collider", "other"],
        "seen": ["seen by ego", "seen by a partner alone", "seen by nobody"],
        "motion": ["moving", "standing"],
        "impact": ["1–2 s to impact"],
        "all": ["all"],
    }
    assert {*truth.groups} == {name for names in kinds.values() for name in names}
    for names in kinds.values():
        groups = [read_group(truth, name) for name in names]
        assert set().union(*groups) == actors
        assert sum(map(len, groups)) == len(actors)

    own_id = da_motion.get("agent", f"{accident}/{agent}")["actor_id"]
    collision_ids = set(da_motion.get("scenario", accident)["collision"]["ids"])
    assert read_group(truth, "collider") == collision_ids - {own_id}

    def seen_by(agents: list[str]) -> set[int]:
        instances = visible_instances(da_motion, token, agents=agents)
        return {da_motion.get("instance", instance)["actor_id"] for instance in instances}

    assert read_group(truth, "seen by ego") == actors & seen_by([agent])
    assert read_group(truth, "seen by nobody") == actors - seen_by([*AGENTS])


@pytest.mark.parametrize(
    ("frames_before_end", "group"),
    [(1, "0–1 s"), (10, "0–1 s"), (11, "1–2 s"), (20, "1–2 s"), (21, "2–3 s"), (34, "3–4 s")],
)
def test_seconds_to_the_impact(
    da_motion: DeepAccident, accident: str, frames_before_end: int, group: str
) -> None:
    token = token_before_end(da_motion, accident, "ego_vehicle", frames_before_end)
    groups = forecasting_truth(da_motion, token).groups
    impact_groups = [name for name in groups if "impact" in name or name == "normal"]
    assert impact_groups == [f"{group} to impact"]


def test_a_normal_scenario_has_no_colliders(da_motion: DeepAccident) -> None:
    normal = next(
        scenario["token"] for scenario in da_motion.scenario if scenario["collision"] is None
    )
    truth = forecasting_truth(da_motion, f"{normal}/ego_vehicle/005")
    actors = set(truth.actor_id.tolist())
    assert read_group(truth, "normal") == actors
    assert read_group(truth, "other") == actors
    assert read_group(truth, "collider") == set()
    assert_array_equal(
        truth.path.shape,
        (len(truth.actor_id), 50, 2),
    )


def test_what_has_no_truth(da_motion: DeepAccident) -> None:
    assert_raises(
        (
            lambda: forecasting_truth(da_motion, "a/b/ego_vehicle/001"),
            TokenError,
            "a/b/ego_vehicle/001",
        )
    )
