"""What `PlanningEvaluator` takes and refuses, the rules of cells, and scenes of a release."""

from dataclasses import replace

import numpy as np
import pytest
from planning_scenes import GIVEN, SCENARIO, plan_at, scene, straight
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, EvaluationError, GeometryError
from deepaccident_devkit.evaluation.planning import (
    CELL_PROTOCOLS,
    PLANNING_PROTOCOLS,
    Plan,
    PlanningEvaluator,
    planning_scene,
    trivial_plans,
)

TOKEN = f"{SCENARIO}/ego_vehicle/001"


@pytest.mark.parametrize("protocol", PLANNING_PROTOCOLS)
def test_without_samples_there_is_nothing(protocol: str) -> None:
    found = PlanningEvaluator(protocol).compute()
    assert (found.samples, dict(found.means), found.notes) == (0, {}, ())


def test_the_protocols() -> None:
    public = ("uniad", "stp3", "vad", "bev_planner")
    assert tuple(PLANNING_PROTOCOLS) == ("clean", *public, *(f"{name}_own_box" for name in public))
    assert PlanningEvaluator().settings == {
        "leads": [3.0, 2.0, 1.0, 0.5],
        "most_acceleration": 10.0,
        "braking": 3.0,
    }
    facts = (
        PlanningEvaluator.needs_whole_recordings,
        PlanningEvaluator.needs_meta,
        PlanningEvaluator.vehicles_only,
    )
    assert facts == (True, True, True)


def test_what_cannot_be_evaluated() -> None:
    evaluator, short = PlanningEvaluator("uniad"), plan_at(10, seconds=2)
    assert_refused(
        (
            lambda: PlanningEvaluator("released"),
            ChoiceError,
            ("protocol", "clean, uniad", "released"),
        ),
        (
            lambda: evaluator.update(TOKEN, [], scene(10)),
            EvaluationError,
            (TOKEN, "one Plan or more", "none"),
        ),
        (lambda: evaluator.update(TOKEN, [3], scene(10)), EvaluationError, ("found int",)),
        (
            lambda: evaluator.update(TOKEN, [short], scene(10)),
            EvaluationError,
            ("ends after 2 s", "3 s ahead", "clean"),
        ),
        (
            lambda: Plan(times=[1, 1], path=np.zeros((2, 2))),
            GeometryError,
            "times: expected ascending seconds",
        ),
        (
            lambda: Plan(times=[0], path=np.zeros((1, 2))),
            GeometryError,
            "times: expected a plan for after the present",
        ),
        (lambda: Plan(times=[1, 2], path=np.zeros((3, 2))), GeometryError, "path: expected shape"),
        (
            lambda: Plan(times=[1, 2], path=np.full((2, 2), np.nan)),
            GeometryError,
            "path: not all numbers are finite",
        ),
        (
            lambda: Plan(times=[1], path=np.zeros((1, 2)), yaw=[np.inf]),
            GeometryError,
            "not all numbers are finite",
        ),
    )


@pytest.mark.parametrize("protocol", CELL_PROTOCOLS)
def test_a_plan_equal_to_the_recorded_accident_has_no_collision(protocol: str) -> None:
    evaluator, through = (
        PlanningEvaluator(protocol),
        scene(10, others=[straight((20.0, 0.0), 0.0, 0.0, 31)]),
    )
    evaluator.update(TOKEN, [trivial_plans(through)["recorded"]], through)
    found = evaluator.compute()
    for table in ("1 s", "2 s", "3 s", "mean"):
        assert found.means[table][GIVEN]["l2"] == pytest.approx(0, abs=1e-9)
        assert found.means[table][GIVEN]["collision"] == 0
    assert found.means["mean"][GIVEN]["left_out"] > 0
    assert "has 0 % collisions" in found.notes[0]


def test_the_definitions_disagree_on_one_plan() -> None:
    """A plan that drives through a parked car at 2.5 s, beside the recorded path."""
    beside = straight((25.0, 6.0), 0.0, 0.0, 31)
    path = np.array([[5.0, 0], [10, 0], [15, 0], [20, 6], [25, 6], [30, 6]])
    plan = Plan(times=np.arange(1, 7) * 0.5, path=path)
    found = {}
    for protocol in ("uniad_own_box", "stp3_own_box", "bev_planner_own_box"):
        evaluator = PlanningEvaluator(protocol)
        evaluator.update(TOKEN, [plan], scene(10, others=[beside], partner=False))
        found[protocol] = [
            evaluator.compute().means[f"{each} s"][GIVEN]["collision"] for each in (1, 2, 3)
        ]
    assert found["uniad_own_box"] == [0, 0, 0]
    assert found["stp3_own_box"] == pytest.approx([0, 0, 100 / 6])
    assert found["bev_planner_own_box"] == [0, 0, 100]


def test_without_a_whole_future_only_uniad_counts() -> None:
    short = scene(10, seconds=2.0)
    for protocol, samples in (("uniad", 1), ("stp3", 0), ("vad", 0), ("bev_planner", 0)):
        evaluator = PlanningEvaluator(protocol)
        evaluator.update(TOKEN, [plan_at(0)], short)
        assert evaluator.compute().counted["3 s"][GIVEN]["l2"] == samples
    uniad = PlanningEvaluator("uniad")
    uniad.update(TOKEN, [plan_at(0)], short)
    assert uniad.compute().means["3 s"][GIVEN] == pytest.approx(
        {"l2": 0, "collision": 0, "point_collision": 0, "left_out": 100, "l2_endpoint": np.nan},
        nan_ok=True,
    )


def test_pedestrians_count_by_the_rules_that_draw_them() -> None:
    walker = straight((20.0, 0.0), 0.0, 0.0, 31)
    given = scene(10, others=[walker], partner=False)
    for protocol, pedestrian, seen, drawn in (
        ("uniad_own_box", True, True, False),
        ("uniad_own_box", False, False, True),
        ("stp3_own_box", True, True, True),
        ("stp3_own_box", False, False, False),
        ("vad_own_box", True, False, True),
    ):
        evaluator = PlanningEvaluator(protocol)
        marked = replace(given, is_pedestrian=np.array([pedestrian]), seen=np.array([seen]))
        evaluator.update(TOKEN, [plan_at(10)], marked)
        assert (evaluator.compute().means["mean"][GIVEN]["left_out"] > 0) == drawn, protocol


def test_headings_are_those_of_the_steps() -> None:
    plan = Plan(times=[1, 2, 3, 4], path=[[5, 0], [5.05, 0.05], [5.05, 5], [0, 5]])
    assert plan.poses(np.array([0, 1, 2, 3, 4, 6]))[:, 2] == pytest.approx(
        [0, 0, 0, np.pi / 2, np.pi, np.pi], abs=0.02
    )
    assert plan.poses(np.array([5.0]))[0, :2] == pytest.approx([-5.05, 5])


def collider(da_motion: DeepAccident) -> tuple[str, int]:
    """A sample of a vehicle that collides, 1 s before the end, and how many frames are left."""
    scenario = next(
        each for each in da_motion.scenario if each["collision"] and each["collision"]["agents"][0]
    )
    agent, last = scenario["collision"]["agents"][0], scenario["num_frames"]
    return f"{scenario['token']}/{agent}/{last - 10:03d}", 10


def test_a_scene_of_a_release(da_motion: DeepAccident) -> None:
    token, left = collider(da_motion)
    found = planning_scene(da_motion, token)
    assert found.recorded.shape == (left + 1, 3)
    assert found.recorded[0] == pytest.approx([0, 0, 0], abs=1e-9)
    scenario, agent, number = token.rsplit("/", 2)
    later = f"{scenario}/{agent}/{int(number) + left:03d}"
    there = da_motion.world_from(token, "ego").inverse() @ da_motion.world_from(later, "ego")
    assert found.recorded[-1, :2] == pytest.approx(there.translation[:2])
    assert (found.is_twin, found.is_collider, found.to_end) == (False, True, pytest.approx(1.0))
    assert found.partner.sum() == 1
    own = da_motion.get("agent", f"{scenario}/{agent}")["actor_id"]
    assert own not in found.actor_id
    speed = np.hypot(*found.before)
    assert speed == pytest.approx(
        np.hypot(*np.diff(found.recorded[:2, :2], axis=0)[0]) / 0.1, abs=1.0
    )


def test_a_twin_is_cut_to_the_accident(da_motion: DeepAccident) -> None:
    token, _ = collider(da_motion)
    twin = token.replace("_accident/", "_normal/")
    found = planning_scene(da_motion, twin)
    assert (found.is_twin, found.is_collider, found.partner.any()) == (True, True, False)
    assert (found.to_end, len(found.recorded)) == (pytest.approx(1.0), 11)
    scenario, _, number = twin.rsplit("/", 2)
    left = da_motion.scenario.get(scenario)["num_frames"] - int(number)
    assert len(planning_scene(da_motion, twin, cut=False).recorded) == left + 1


def test_the_roadside_has_no_plan(da_motion: DeepAccident) -> None:
    token = collider(da_motion)[0]
    scenario, _, number = token.rsplit("/", 2)
    with pytest.raises(EvaluationError, match="roadside, which does not drive"):
        planning_scene(da_motion, f"{scenario}/infrastructure/{number}")
