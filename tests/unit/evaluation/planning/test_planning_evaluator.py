"""What `PlanningEvaluator` takes and refuses, the rules of cells, and scenes of a release."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from support.expected_errors import assert_raises
from support.planning_scenes import (
    PLAN_SOURCE,
    SCENARIO,
    blocked_ego_scene,
    constant_speed_plan,
    straight_footprints,
)

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, EvaluationError, GeometryError
from deepaccident_devkit.evaluation.planning import (
    CELL_PROTOCOLS,
    PLANNING_PROTOCOLS,
    Plan,
    PlanningEvaluator,
    PlanningResult,
    PlanningScene,
    planning_scene,
    trivial_plans,
)

TOKEN = f"{SCENARIO}/ego_vehicle/001"


@pytest.mark.parametrize("protocol", PLANNING_PROTOCOLS)
def test_without_samples_there_is_nothing(protocol: str) -> None:
    result = PlanningEvaluator(protocol).compute()
    assert (result.samples, dict(result.means), result.notes) == (0, {}, ())


def test_the_protocols() -> None:
    assert list(PLANNING_PROTOCOLS) == [
        "clean",
        "uniad",
        "stp3",
        "vad",
        "bev_planner",
        "uniad_own_box",
        "stp3_own_box",
        "vad_own_box",
        "bev_planner_own_box",
    ]
    assert PlanningEvaluator().settings == {
        "leads": [3.0, 2.0, 1.0, 0.5],
        "most_acceleration": 10.0,
        "braking": 3.0,
    }
    assert PlanningEvaluator.needs_whole_recordings is True
    assert PlanningEvaluator.needs_meta is True
    assert PlanningEvaluator.vehicles_only is True


def test_what_cannot_be_evaluated() -> None:
    update = partial(PlanningEvaluator("uniad").update, TOKEN)
    scene = blocked_ego_scene(10)
    short = constant_speed_plan(10, seconds=2)
    assert_raises(
        (
            lambda: PlanningEvaluator("released"),
            ChoiceError,
            ("protocol", "clean, uniad", "released"),
        ),
        (
            lambda: update([], scene),
            EvaluationError,
            (TOKEN, "one Plan or more", "none"),
        ),
        (
            lambda: update([3], scene),
            EvaluationError,
            ("found int",),
        ),
        (
            lambda: update([short], scene),
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
            "times: expected at least one time after the present",
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


def evaluate(protocol: str, plan: Plan, scene: PlanningScene) -> PlanningResult:
    evaluator = PlanningEvaluator(protocol)
    evaluator.update(TOKEN, [plan], scene)
    return evaluator.compute()


@pytest.mark.parametrize("protocol", CELL_PROTOCOLS)
def test_a_plan_equal_to_the_recorded_accident_has_no_collision(protocol: str) -> None:
    obstacle = straight_footprints((20.0, 0.0), 0.0, 0.0, 31)
    scene = blocked_ego_scene(10, other_cars=[obstacle])
    result = evaluate(protocol, trivial_plans(scene)["recorded"], scene)
    for table in ("1 s", "2 s", "3 s", "mean"):
        numbers = result.means[table][PLAN_SOURCE]
        assert numbers["l2"] == pytest.approx(0, abs=1e-9)
        assert numbers["collision"] == 0
    assert result.means["mean"][PLAN_SOURCE]["left_out"] > 0
    assert "has 0 % collisions" in result.notes[0]


def test_the_definitions_disagree_on_one_plan() -> None:
    """The plan drives through a parked car at 2.5 s, beside the recorded path."""
    parked_car = straight_footprints((25.0, 6.0), 0.0, 0.0, 31)
    scene = blocked_ego_scene(10, other_cars=[parked_car], partner=False)
    plan = Plan(
        times=np.arange(1, 7) * 0.5,
        path=np.array([[5.0, 0], [10, 0], [15, 0], [20, 6], [25, 6], [30, 6]]),
    )
    for protocol, expected in {
        "uniad_own_box": [0, 0, 0],
        "stp3_own_box": pytest.approx([0, 0, 100 / 6]),
        "bev_planner_own_box": [0, 0, 100],
    }.items():
        means = evaluate(protocol, plan, scene).means
        collisions = [means[f"{horizon} s"][PLAN_SOURCE]["collision"] for horizon in (1, 2, 3)]
        assert collisions == expected


def test_without_a_whole_future_only_uniad_counts() -> None:
    short = blocked_ego_scene(10, seconds=2.0)
    standing = constant_speed_plan(0)
    for protocol, samples in {"uniad": 1, "stp3": 0, "vad": 0, "bev_planner": 0}.items():
        result = evaluate(protocol, standing, short)
        assert result.counted["3 s"][PLAN_SOURCE]["l2"] == samples
    assert evaluate("uniad", standing, short).means["3 s"][PLAN_SOURCE] == pytest.approx(
        {"l2": 0, "collision": 0, "point_collision": 0, "left_out": 100, "l2_endpoint": np.nan},
        nan_ok=True,
    )


def test_pedestrians_count_by_the_rules_that_draw_them() -> None:
    walker = straight_footprints((20.0, 0.0), 0.0, 0.0, 31)
    scene = blocked_ego_scene(10, other_cars=[walker], partner=False)
    for protocol, is_pedestrian, is_seen, is_drawn in (
        ("uniad_own_box", True, True, False),
        ("uniad_own_box", False, False, True),
        ("stp3_own_box", True, True, True),
        ("stp3_own_box", False, False, False),
        ("vad_own_box", True, False, True),
    ):
        changed = replace(
            scene,
            is_pedestrian=np.array([is_pedestrian]),
            seen=np.array([is_seen]),
        )
        result = evaluate(protocol, constant_speed_plan(10), changed)
        assert (result.means["mean"][PLAN_SOURCE]["left_out"] > 0) == is_drawn, protocol


def test_headings_are_those_of_the_steps() -> None:
    plan = Plan(
        times=[1, 2, 3, 4],
        path=[[5, 0], [5.05, 0.05], [5.05, 5], [0, 5]],
    )
    headings = plan.poses(np.array([0, 1, 2, 3, 4, 6]))[:, 2]
    assert headings == pytest.approx([0, 0, 0, np.pi / 2, np.pi, np.pi], abs=0.02)
    [continued] = plan.poses(np.array([5.0]))
    assert continued[:2] == pytest.approx([-5.05, 5])


def find_collider_sample(da_motion: DeepAccident) -> tuple[str, str, int]:
    """Return scenario, agent and frame of a sample of a vehicle that collides, 1 s before the
    end.
    """
    scenario = next(
        scenario
        for scenario in da_motion.scenario
        if scenario["collision"] and scenario["collision"]["agents"][0]
    )
    return scenario["token"], scenario["collision"]["agents"][0], scenario["num_frames"] - 10


def test_a_scene_of_a_release(da_motion: DeepAccident) -> None:
    scenario, agent, frame = find_collider_sample(da_motion)
    token = f"{scenario}/{agent}/{frame:03d}"
    scene = planning_scene(da_motion, token)
    assert scene.recorded.shape == (11, 3)
    assert scene.recorded[0] == pytest.approx([0, 0, 0], abs=1e-9)

    world_from_end = da_motion.world_from(
        f"{scenario}/{agent}/{frame + 10:03d}",
        "ego",
    )
    end = da_motion.world_from(token, "ego").inverse() @ world_from_end
    assert scene.recorded[-1, :2] == pytest.approx(end.translation[:2])
    assert (scene.is_twin, scene.is_collider) == (False, True)
    assert scene.to_end == pytest.approx(1.0)
    assert scene.partner.sum() == 1
    assert da_motion.get("agent", f"{scenario}/{agent}")["actor_id"] not in scene.actor_id
    first_step = scene.recorded[1, :2] - scene.recorded[0, :2]
    assert np.hypot(*scene.before) == pytest.approx(np.hypot(*first_step) / 0.1, abs=1.0)


def test_a_twin_is_cut_to_the_accident(da_motion: DeepAccident) -> None:
    accident, agent, frame = find_collider_sample(da_motion)
    scenario = accident.replace("_accident/", "_normal/")
    token = f"{scenario}/{agent}/{frame:03d}"
    scene = planning_scene(da_motion, token)
    assert (scene.is_twin, scene.is_collider, scene.partner.any()) == (True, True, False)
    assert scene.to_end == pytest.approx(1.0)
    assert len(scene.recorded) == 11
    frames_to_end = da_motion.scenario.get(scenario)["num_frames"] - frame
    assert len(planning_scene(da_motion, token, cut=False).recorded) == frames_to_end + 1


def test_the_roadside_has_no_plan(da_motion: DeepAccident) -> None:
    scenario, _, frame = find_collider_sample(da_motion)
    with pytest.raises(EvaluationError, match="labels of the infrastructure never have one"):
        planning_scene(da_motion, f"{scenario}/infrastructure/{frame:03d}")
