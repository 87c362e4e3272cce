"""The protocol `clean` of planning, on scenes with numbers that follow from school physics."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.planning_scenes import (
    CAR_FOOTPRINT,
    PLAN_SOURCE,
    SCENARIO,
    blocked_ego_scene,
    constant_speed_plan,
    straight_footprints,
)

from deepaccident_devkit.evaluation.breakdowns import cluster_of
from deepaccident_devkit.evaluation.intervals import (
    intervals_of,
    leave_one_out_draws,
    numbers_of_draws,
    range_of,
)
from deepaccident_devkit.evaluation.planning import (
    PlanningEvaluator,
    PlanningResult,
    PlanningScene,
    trivial_plans,
)
from deepaccident_devkit.evaluation.planning.clean import box_path
from deepaccident_devkit.evaluation.planning.contacts import first_contacts
from deepaccident_devkit.evaluation.planning.scene import Plan
from deepaccident_devkit.evaluation.runs.setups import scenario_of

TOKEN = f"{SCENARIO}/ego_vehicle/{{:03d}}"
TWIN = replace(blocked_ego_scene(10, partner=False), is_twin=True, is_collider=True)


def evaluate(*scenes: PlanningScene, plan: Plan | None = None) -> PlanningResult:
    evaluator = PlanningEvaluator()
    for number, scene in enumerate(scenes):
        evaluator.update(
            TOKEN.format(number),
            [plan or constant_speed_plan(10)],
            scene,
        )
    return evaluator.compute()


def read_lead(
    result: PlanningResult, row: str = PLAN_SOURCE, seconds: float = 3
) -> dict[str, float]:
    return dict(result.means[f"lead {seconds:g} s"][row])


def test_the_recorded_plan_avoids_nothing_and_causes_nothing() -> None:
    result = evaluate(blocked_ego_scene(10))
    assert read_lead(result, "recorded") == pytest.approx(
        {
            "avoided": 0,
            "striking": 0,
            "struck": 0,
            "lost": 0,
            "lost_way": 0,
            "prolonged": 0,
            "infeasible": 0,
            "impact_speed": 10,
            "relative_speed": 10,
        }
    )
    for horizon in (1, 2, 3):
        assert result.means[f"{horizon} s"]["recorded"]["l2"] == 0
    assert result.means["3 s"]["recorded"]["contact"] == 100


def test_constant_velocity_is_the_recording_where_that_is_straight_and_uniform() -> None:
    result = evaluate(blocked_ego_scene(10))
    recorded = read_lead(result, "recorded")
    assert read_lead(result, "constant velocity") == pytest.approx(recorded, abs=1e-9)


@pytest.mark.parametrize(("speed", "infeasible"), [(4.0, 0), (5.0, 0), (5.1, 100), (12.0, 100)])
def test_standing_at_once_loses_all_and_is_infeasible_above_5_metres_a_second(
    speed: float, infeasible: int
) -> None:
    result = evaluate(blocked_ego_scene(speed))
    numbers = read_lead(result, "standing")
    assert (numbers["avoided"], numbers["lost"], numbers["striking"]) == (100, 100, 0)
    assert numbers["infeasible"] == infeasible
    for horizon in (1, 2, 3):
        l2 = result.means[f"{horizon} s"]["standing"]["l2"]
        assert l2 == pytest.approx(speed * horizon)


@given(st.floats(2.0, 25.0))
def test_full_braking_stands_after_v_squared_over_16_metres(speed: float) -> None:
    numbers = read_lead(evaluate(blocked_ego_scene(speed)), "full braking")
    recorded_way = speed * 3
    braked_way = recorded_way - 36 if speed > 24 else speed**2 / 16
    lost_way = max(recorded_way - braked_way, 0)
    assert numbers["lost_way"] == pytest.approx(lost_way, abs=0.02)
    assert numbers["lost_way"] >= 0
    assert numbers["avoided"] == (100 if recorded_way > speed**2 / 16 else 0)


def test_braking_too_late_is_slower_at_the_impact() -> None:
    numbers = read_lead(evaluate(blocked_ego_scene(10, seconds=0.5)), "full braking", 0.5)
    half_a_step = 8 * 0.1 / 2
    assert numbers["avoided"] == 0
    assert numbers["impact_speed"] == pytest.approx(np.sqrt(100 - 2 * 8 * 5), abs=half_a_step)


def test_a_plan_that_ends_goes_straight_on() -> None:
    result = evaluate(
        blocked_ego_scene(10),
        plan=constant_speed_plan(10, seconds=1.5),
    )
    numbers = read_lead(result)
    assert (numbers["avoided"], numbers["prolonged"]) == (0, 100)


@pytest.mark.parametrize("frames", [slice(-2, -1), slice(-3, -1), slice(-12, -1), slice(1, -1)])
def test_a_partner_goes_on_whatever_labels_it_lacks_before_the_last(frames: slice) -> None:
    crossing = straight_footprints((14.2, -6.0), np.pi / 2, 2.0, 31)[:, None]
    with_gap = crossing.copy()
    with_gap[frames] = np.nan
    scene = blocked_ego_scene(4)
    plan = constant_speed_plan(3.5)

    expected = read_lead(evaluate(replace(scene, footprint=crossing), plan=plan))
    numbers = read_lead(evaluate(replace(scene, footprint=with_gap), plan=plan))

    assert (expected["avoided"], expected["prolonged"]) == (0, 100)
    assert numbers == pytest.approx(expected)


@pytest.mark.parametrize("gap", [0, 1, 5, 15, 20, 40])
def test_contacts_with_actors_that_lack_labels_are_found(gap: int) -> None:
    frames = gap + 21
    path = straight_footprints((0, 0), 0.0, 10.0, frames)[:, [0, 1, 4]]
    middle_s = (frames - 1) / 2 * 0.1
    crossing = straight_footprints((10 * middle_s, -12 * middle_s), np.pi / 2, 12.0, frames)[
        :, None
    ]
    with_gap = crossing.copy()
    with_gap[11 : 11 + gap] = np.nan

    expected, contact = (
        first_contacts(
            path,
            np.array(CAR_FOOTPRINT),
            footprint,
            np.zeros(1),
            np.array([5.0]),
        ).time[0]
        for footprint in (crossing, with_gap)
    )

    assert contact == pytest.approx(expected)
    assert expected < middle_s


@pytest.mark.parametrize(
    ("plan", "expected"),
    [
        (constant_speed_plan(10), []),
        (constant_speed_plan(10, seconds=0.5), ["continued straight on: 1 plan ending before 3 s"]),
        (
            replace(constant_speed_plan(10), times=constant_speed_plan(10).times * 10),
            ["suspicious: 1 path longer than 10 s"],
        ),
        (
            replace(constant_speed_plan(10), yaw=np.linspace(0, 6.3, 6)),
            ["suspicious: 1 plan with a yaw beyond 2π"],
        ),
    ],
)
def test_suspicious_plans_are_noted(plan: Plan, expected: list[str]) -> None:
    notes = evaluate(blocked_ego_scene(10), plan=plan).notes
    for note, beginning in zip(notes, expected, strict=True):
        assert note.startswith(beginning)


def test_new_collisions_are_with_actors_that_the_recording_does_not_touch() -> None:
    parked_to_the_left = straight_footprints((20, 4), 0.0, 0.0, 31)
    swerve = Plan(
        times=np.array([1.0, 2.0, 3.0]),
        path=np.array([[10.0, 0.0], [20.0, 4.0], [20.0, 4.0]]),
    )
    scene = blocked_ego_scene(10, other_cars=[parked_to_the_left])
    numbers = read_lead(evaluate(scene, plan=swerve))
    assert (numbers["avoided"], numbers["striking"], numbers["struck"]) == (100, 100, 0)


def test_a_standing_ego_is_struck_by_a_follower() -> None:
    follower = straight_footprints((-10, 0), 0.0, 10.0, 31)
    numbers = read_lead(evaluate(blocked_ego_scene(10, other_cars=[follower])), "standing")
    assert (numbers["striking"], numbers["struck"]) == (0, 100)


def test_a_driving_ego_is_struck_only_from_behind_its_rear_edge() -> None:
    follower = straight_footprints((-6, 0), 0.0, 10.0, 31)
    crosser = straight_footprints(
        (9, -10),
        np.pi / 2,
        5.0,
        31,
    )
    for other, striking, struck in ((follower, 0, 100), (crosser, 100, 0)):
        scene = blocked_ego_scene(10, other_cars=[other])
        numbers = read_lead(evaluate(scene, plan=constant_speed_plan(5)))
        assert (numbers["striking"], numbers["struck"]) == (striking, struck)


@pytest.mark.parametrize("yaw", [0.0, np.pi / 2, 2.5, -1.0])
def test_an_ego_of_any_heading_is_struck_only_by_the_follower(yaw: float) -> None:
    forward = np.array([np.cos(yaw), np.sin(yaw)])
    left = np.array([-np.sin(yaw), np.cos(yaw)])
    path = straight_footprints((0, 0), yaw, 5.0, 31)[:, [0, 1, 4]]
    follower = straight_footprints(tuple(-6 * forward), yaw, 10.0, 31)
    crosser = straight_footprints(tuple(9 * forward - 10 * left), yaw + np.pi / 2, 5.0, 31)

    contacts = first_contacts(
        path,
        np.array(CAR_FOOTPRINT),
        np.stack([follower, crosser], axis=1),
        np.zeros(2),
        np.full(2, 3.0),
    )

    assert np.isfinite(contacts.time).all()
    assert contacts.struck.tolist() == [True, False]


def test_actors_that_overlap_at_the_present_are_left_out_and_counted() -> None:
    overlapping = straight_footprints((0.5, 0.5), 0.0, 10.0, 31)
    result = evaluate(blocked_ego_scene(10, other_cars=[overlapping]))
    assert read_lead(result)["striking"] == 0
    assert result.notes == ("excluded: 1 actor touching ego in the sample's own frame",)


def test_twins_show_what_braking_costs() -> None:
    numbers = read_lead(evaluate(TWIN), "full braking")
    assert numbers["lost_twins"] == pytest.approx(100 * (30 - 6.25) / 30, abs=0.1)
    assert numbers["braking_twins"] == 100
    assert not {"avoided", "lost"} & numbers.keys()


def evaluate_speeds(*speeds: float) -> tuple[PlanningEvaluator, list[str]]:
    """Evaluate plans of these speeds in an accident recorded at 10 m/s and in its twin.

    Each speed has its own pair of scenarios.
    """
    evaluator = PlanningEvaluator()
    tokens = []
    for number, speed in enumerate(speeds):
        for ending, scene in (("accident", blocked_ego_scene(10)), ("normal", TWIN)):
            token = f"type1_subtype1_{ending}/Town01_{number}/ego_vehicle/001"
            evaluator.update(token, [constant_speed_plan(speed)], scene)
            tokens.append(token)
    return evaluator, tokens


def test_intervals_of_progress_lost_cross_zero() -> None:
    """The plans go farther than the recording as often as not; a plain jackknife with Student's t
    gives the same intervals.
    """
    evaluator, tokens = evaluate_speeds(7, 13, 8, 12, 9, 11, 9.5, 11.5)
    clusters = evaluator.clustered({token: cluster_of(scenario_of(token)) for token in tokens})
    paths = [
        f"means/lead 3 s/{PLAN_SOURCE}/{name}"
        for name in ("lost", "lost_way", "lost_twins", "lost_way_twins")
    ]

    intervals = intervals_of(evaluator, clusters, evaluator.compute()).ends

    values = numbers_of_draws(evaluator, clusters, np.ones((1, 8), dtype=np.int64), paths)[0]
    left_out = numbers_of_draws(evaluator, clusters, leave_one_out_draws(8), paths)
    half_widths = 2.365 * np.sqrt(7 / 8 * ((left_out - values) ** 2).sum(axis=0))
    for path, value, half_width in zip(paths, values, half_widths, strict=True):
        low, high = intervals[path]
        assert (low, high) == pytest.approx((value - half_width, value + half_width), rel=0.1)
        assert low < 0 < high


@settings(max_examples=10)
@given(st.floats(0.0, 30.0), st.floats(1.0, 30.0), st.floats(-10.0, 10.0), st.booleans())
def test_what_can_be_negative_is_a_signed_number(
    planned: float, recorded: float, aside: float, twin: bool
) -> None:
    scene = replace(
        blocked_ego_scene(recorded, partner=not twin),
        is_twin=twin,
        is_collider=True,
    )
    times = np.arange(1, 7) * 0.5
    path = np.column_stack([times * planned, times * aside])
    numbers = read_lead(evaluate(scene, plan=Plan(times=times, path=path)))
    for column, value in numbers.items():
        low, high = range_of(
            f"means/lead 3 s/{PLAN_SOURCE}/{column}",
            np.array([value]),
            PlanningResult.rows,
        )
        assert np.isnan(value) or low - 1e-6 <= value <= high + 1e-6
        assert (low < 0) == column.startswith("lost")


def test_bystanders_have_tables_of_their_own() -> None:
    result = evaluate(replace(blocked_ego_scene(10, partner=False), is_collider=False))
    assert "lead 3 s" not in result.means
    assert result.means["bystander, lead 3 s"]["standing"]["lost"] == 100


@pytest.mark.parametrize(
    ("to_end", "tables"),
    [(3.2, ["lead 3 s"]), (2.8, ["lead 3 s"]), (0.7, ["lead 0.5 s"]), (4.0, [])],
)
def test_a_sample_counts_at_the_nearest_lead(to_end: float, tables: list[str]) -> None:
    result = evaluate(replace(blocked_ego_scene(10), to_end=to_end, to_contact=np.nan))
    assert [name for name in result.means if name.startswith("lead")] == tables


def test_leads_to_the_contact_stand_beside() -> None:
    result = evaluate(replace(blocked_ego_scene(10), to_contact=1.0))
    tables = [name for name in result.means if name.startswith("lead")]
    assert tables == ["lead 3 s", "lead 1 s to contact"]


def move_partner_aside(scene: PlanningScene, metres: float) -> PlanningScene:
    footprint = scene.footprint.copy()
    footprint[:, 0, 1] += metres
    return replace(scene, footprint=footprint)


def test_an_accident_that_the_recording_does_not_show_is_left_out_by_name() -> None:
    width_m = CAR_FOOTPRINT[1]
    result = evaluate(move_partner_aside(blocked_ego_scene(10), width_m + 1.5))
    assert "lead 3 s" not in result.means
    assert result.notes == (f"{SCENARIO}: the pair is 1.50 m apart at the end; excluded: 1 sample",)
    # a gap of 0.5 m at the end counts as contact
    result = evaluate(move_partner_aside(blocked_ego_scene(10), width_m + 0.5))
    assert read_lead(result, "recorded")["avoided"] == 0


def test_the_plan_with_the_highest_score_counts() -> None:
    evaluator = PlanningEvaluator()
    plans = [
        replace(constant_speed_plan(10), score=0.1),
        replace(constant_speed_plan(0), score=0.9),
        replace(constant_speed_plan(5), score=0.9),
    ]
    evaluator.update(TOKEN.format(1), plans, blocked_ego_scene(10))
    assert evaluator.compute().means["1 s"][PLAN_SOURCE]["l2"] == pytest.approx(10)


def test_the_box_turns_with_the_ego_frame() -> None:
    path = box_path(
        np.array([[5.0, 0.0, 0.0], [5.0, 0.0, np.pi / 2]]),
        np.array([1.0, 0.5]),
    )
    expected = np.array([[6.0, 0.5, 0.0], [4.5, 1.0, np.pi / 2]])
    assert path == pytest.approx(expected)


def test_trivial_plans_look_3_seconds_ahead() -> None:
    plans = trivial_plans(blocked_ego_scene(10, seconds=1.0))
    assert list(plans) == ["recorded", "standing", "constant velocity", "full braking"]
    for plan in plans.values():
        assert plan.times[-1] == pytest.approx(3.0)
    assert plans["recorded"].path[-1] == pytest.approx([30, 0])
