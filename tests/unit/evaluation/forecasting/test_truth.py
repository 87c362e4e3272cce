"""`forecasting_truth`, against the tables of a synthetic release in plain loops."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import TokenError
from deepaccident_devkit.evaluation.forecasting import ForecastingTruth, forecasting_truth
from deepaccident_devkit.taxonomy import AGENTS, INFRASTRUCTURE
from deepaccident_devkit.v2x.cooperation import visible_instances


@pytest.fixture(scope="module")
def accident(da_motion: DeepAccident) -> str:
    return next(each["token"] for each in da_motion.scenario if each["collision"] is not None)


def members(truth: ForecastingTruth, name: str) -> set[int]:
    """The actors of a group."""
    row = truth.members[truth.groups.index(name)]
    return set(truth.actor_id[row].tolist())


def last_frames(da: DeepAccident, scenario: str, agent: str, back: int) -> str:
    return f"{scenario}/{agent}/{da.get('scenario', scenario)['num_frames'] - back:03d}"


@pytest.mark.parametrize("agent", ["ego_vehicle", "other_vehicle", INFRASTRUCTURE])
def test_paths_are_those_of_the_tracks(da_motion: DeepAccident, accident: str, agent: str) -> None:
    token = last_frames(da_motion, accident, agent, 12)
    present = int(token.rsplit("/", 1)[1])
    truth = forecasting_truth(da_motion, token, 2.0)
    own = da_motion.get("agent", f"{accident}/{agent}")["actor_id"]
    ego_from_world = da_motion.world_from(token, "ego").inverse()
    places: dict[int, dict[int, np.ndarray]] = {}
    for row in da_motion.track:
        if row["instance_token"].startswith(f"{accident}/"):
            actor = da_motion.get("instance", row["instance_token"])["actor_id"]
            frame = int(row["frame_token"].rsplit("/", 1)[1])
            places.setdefault(actor, {})[frame] = ego_from_world.apply(
                np.array(row["translation"])
            )[:2]
    expected = sorted(actor for actor, those in places.items() if present in those and actor != own)
    assert (truth.scenario, truth.actor_id.tolist()) == (accident, expected)
    nowhere = np.full(2, np.nan)
    for actor, here, path in zip(expected, truth.present, truth.path, strict=True):
        assert_allclose(here, places[actor][present], atol=1e-9)
        steps = [places[actor].get(present + step, nowhere) for step in range(1, 21)]
        assert_allclose(path, steps, atol=1e-9)
    assert np.isfinite(truth.path[:, :12]).any()
    assert np.isnan(truth.path[:, 12:]).all()


@pytest.mark.parametrize("agent", ["ego_vehicle", INFRASTRUCTURE])
def test_each_actor_is_in_one_group_of_a_kind(
    da_motion: DeepAccident, accident: str, agent: str
) -> None:
    token = last_frames(da_motion, accident, agent, 15)
    truth = forecasting_truth(da_motion, token)
    everybody = set(truth.actor_id.tolist())
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
        parts = [members(truth, name) for name in names]
        assert set().union(*parts) == everybody
        assert sum(map(len, parts)) == len(everybody)
    own = da_motion.get("agent", f"{accident}/{agent}")["actor_id"]
    assert members(truth, "collider") == set(
        da_motion.get("scenario", accident)["collision"]["ids"]
    ) - {own}
    for kind, agents in (("seen by ego", [agent]), ("seen by nobody", [*AGENTS])):
        seen = {
            da_motion.get("instance", each)["actor_id"]
            for each in visible_instances(da_motion, token, agents=agents)
        }
        assert members(truth, kind) == (everybody & seen if len(agents) == 1 else everybody - seen)


@pytest.mark.parametrize(
    ("back", "group"),
    [(1, "0–1 s"), (10, "0–1 s"), (11, "1–2 s"), (20, "1–2 s"), (21, "2–3 s"), (34, "3–4 s")],
)
def test_seconds_to_the_impact(
    da_motion: DeepAccident, accident: str, back: int, group: str
) -> None:
    truth = forecasting_truth(da_motion, last_frames(da_motion, accident, "ego_vehicle", back))
    assert [name for name in truth.groups if "impact" in name or name == "normal"] == [
        f"{group} to impact"
    ]


def test_of_a_normal_scenario(da_motion: DeepAccident) -> None:
    normal = next(each["token"] for each in da_motion.scenario if each["collision"] is None)
    truth = forecasting_truth(da_motion, f"{normal}/ego_vehicle/005")
    assert members(truth, "normal") == members(truth, "other") == set(truth.actor_id.tolist())
    assert members(truth, "collider") == set()
    assert_array_equal(truth.path.shape, (len(truth.actor_id), 50, 2))


def test_what_has_no_truth(da_motion: DeepAccident) -> None:
    assert_refused(
        (
            lambda: forecasting_truth(da_motion, "a/b/ego_vehicle/001"),
            TokenError,
            "a/b/ego_vehicle/001",
        )
    )
