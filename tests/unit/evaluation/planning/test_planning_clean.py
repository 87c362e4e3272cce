"""The protocol `clean` of planning, on scenes whose numbers follow from school physics."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from planning_scenes import CAR, GIVEN, SCENARIO, plan_at, scene, straight

from deepaccident_devkit.evaluation.breakdowns import cluster_of
from deepaccident_devkit.evaluation.intervals import (
    intervals_of,
    leaving_out,
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


def result_of(*scenes: PlanningScene, plan: Plan | None = None) -> PlanningResult:
    evaluator = PlanningEvaluator()
    for number, each in enumerate(scenes):
        evaluator.update(TOKEN.format(number), [plan or plan_at(10)], each)
    return evaluator.compute()


def lead(result: PlanningResult, row: str = GIVEN, seconds: float = 3) -> dict[str, float]:
    return dict(result.means[f"lead {seconds:g} s"][row])


def test_the_recorded_plan_avoids_nothing_and_causes_nothing() -> None:
    found = result_of(scene(10))
    numbers = lead(found, "recorded")
    assert numbers == pytest.approx(
        {
            **dict.fromkeys(
                ("avoided", "striking", "struck", "lost", "lost_way", "prolonged", "infeasible"), 0
            ),
            "impact_speed": 10,
            "relative_speed": 10,
        }
    )
    assert {found.means[f"{horizon} s"]["recorded"]["l2"] for horizon in (1, 2, 3)} == {0}
    assert found.means["3 s"]["recorded"]["contact"] == 100


def test_constant_velocity_is_the_recording_where_that_is_straight_and_uniform() -> None:
    found = result_of(scene(10))
    assert lead(found, "constant velocity") == pytest.approx(lead(found, "recorded"), abs=1e-9)


@pytest.mark.parametrize(("speed", "infeasible"), [(4.0, 0), (5.0, 0), (5.1, 100), (12.0, 100)])
def test_standing_at_once_loses_all_and_is_infeasible_above_5_metres_a_second(
    speed: float, infeasible: int
) -> None:
    found = result_of(scene(speed))
    numbers = lead(found, "standing")
    assert (numbers["avoided"], numbers["lost"], numbers["striking"]) == (100, 100, 0)
    assert numbers["infeasible"] == infeasible
    for horizon in (1, 2, 3):
        assert found.means[f"{horizon} s"]["standing"]["l2"] == pytest.approx(speed * horizon)


@given(st.floats(2.0, 25.0))
def test_full_braking_stands_after_v_squared_over_16_metres(speed: float) -> None:
    numbers = lead(result_of(scene(speed)), "full braking")
    stops = min(speed * 3, speed**2 / 16 if speed / 8 <= 3 else speed * 3 - 36)
    assert numbers["lost_way"] == pytest.approx(speed * 3 - stops, abs=0.02)
    assert numbers["lost_way"] >= 0
    assert numbers["avoided"] == (100 if speed * 3 > speed**2 / 16 else 0)


def test_braking_too_late_is_slower_at_the_impact() -> None:
    found = result_of(scene(10, seconds=0.5))
    numbers = lead(found, "full braking", 0.5)
    within_a_step = 8 * 0.1 / 2
    assert numbers["avoided"] == 0
    assert numbers["impact_speed"] == pytest.approx(np.sqrt(100 - 2 * 8 * 5), abs=within_a_step)


def test_a_plan_that_ends_goes_straight_on() -> None:
    found = result_of(scene(10), plan=plan_at(10, seconds=1.5))
    assert (lead(found)["avoided"], lead(found)["prolonged"]) == (0, 100)


@pytest.mark.parametrize("frames", [slice(-2, -1), slice(-3, -1), slice(-12, -1), slice(1, -1)])
def test_a_partner_goes_on_whatever_labels_it_lacks_before_the_last(frames: slice) -> None:
    crossing = straight((14.2, -6.0), np.pi / 2, 2.0, 31)
    labelled = replace(scene(4), footprint=crossing[:, None])
    footprint = crossing[:, None].copy()
    footprint[frames] = np.nan
    lacking = replace(labelled, footprint=footprint)
    late, given = result_of(labelled, plan=plan_at(3.5)), result_of(lacking, plan=plan_at(3.5))
    assert (lead(late)["avoided"], lead(late)["prolonged"]) == (0, 100)
    assert lead(given) == pytest.approx(lead(late))


@pytest.mark.parametrize("gap", [0, 1, 5, 15, 20, 40])
def test_contacts_with_actors_who_lack_labels_are_found(gap: int) -> None:
    frames = gap + 21
    path = np.column_stack([straight((0, 0), 0.0, 10.0, frames)[:, :2], np.zeros(frames)])
    middle = (frames - 1) / 2 * 0.1
    crossing = straight((10 * middle, -12 * middle), np.pi / 2, 12.0, frames)[:, None]
    lacking = crossing.copy()
    lacking[11 : 11 + gap] = np.nan
    times = [
        first_contacts(path, np.array(CAR), others, np.zeros(1), np.array([5.0])).time[0]
        for others in (crossing, lacking)
    ]
    assert times[1] == pytest.approx(times[0])
    assert times[0] < middle


@pytest.mark.parametrize(
    ("plan", "told"),
    [
        (plan_at(10), []),
        (plan_at(10, seconds=0.5), ["continued straight on: 1 plan ending before 3 s"]),
        (
            replace(plan_at(10), times=plan_at(10).times * 10),
            ["suspicious: 1 path longer than 10 s"],
        ),
        (
            replace(plan_at(10), yaw=np.linspace(0, 6.3, 6)),
            ["suspicious: 1 plan with a yaw beyond 2π"],
        ),
    ],
)
def test_notes_on_what_looks_wrong_in_a_plan(plan: Plan, told: list[str]) -> None:
    notes = result_of(scene(10), plan=plan).notes
    assert [note[: len(start)] for note, start in zip(notes, told, strict=True)] == told


def test_new_collisions_are_of_whom_the_recording_does_not_touch() -> None:
    beside = straight((20, 4), 0.0, 0.0, 31)  # a parked car to the left
    swerve = Plan(
        times=np.array([1.0, 2.0, 3.0]), path=np.array([[10.0, 0.0], [20.0, 4.0], [20.0, 4.0]])
    )
    numbers = lead(result_of(scene(10, others=[beside]), plan=swerve))
    assert (numbers["avoided"], numbers["striking"], numbers["struck"]) == (100, 100, 0)


def test_who_stands_is_struck_by_a_follower() -> None:
    follower = straight((-10, 0), 0.0, 10.0, 31)
    numbers = lead(result_of(scene(10, others=[follower])), "standing")
    assert (numbers["striking"], numbers["struck"]) == (0, 100)


def test_who_drives_is_struck_from_behind_its_rear_edge_alone() -> None:
    follower, crosser = straight((-6, 0), 0.0, 10.0, 31), straight((9, -10), np.pi / 2, 5.0, 31)
    behind = lead(result_of(scene(10, others=[follower]), plan=plan_at(5)))
    beside = lead(result_of(scene(10, others=[crosser]), plan=plan_at(5)))
    assert (behind["striking"], behind["struck"]) == (0, 100)
    assert (beside["striking"], beside["struck"]) == (100, 0)


def test_actors_that_overlap_at_the_present_are_left_out_and_counted() -> None:
    found = result_of(scene(10, others=[straight((0.5, 0.5), 0.0, 10.0, 31)]))
    assert lead(found)["striking"] == 0
    assert found.notes == ("left out: 1 actor touching the ego at the present",)


def test_twins_are_the_price() -> None:
    twin = replace(scene(10, partner=False), is_twin=True, is_collider=True)
    numbers = lead(result_of(twin), "full braking")
    assert numbers["lost_twins"] == pytest.approx(100 * (30 - 6.25) / 30, abs=0.1)
    assert (numbers["braking_twins"], "avoided" in numbers, "lost" in numbers) == (
        100,
        False,
        False,
    )


def of_speeds(*speeds: float) -> tuple[PlanningEvaluator, list[str]]:
    """Plans of these speeds in an accident recorded at 10 m/s and in its twin; a pair of scenarios
    a speed.
    """
    evaluator, tokens = PlanningEvaluator(), []
    twin = replace(scene(10, partner=False), is_twin=True, is_collider=True)
    for number, speed in enumerate(speeds):
        for ending, each in (("accident", scene(10)), ("normal", twin)):
            tokens.append(f"type1_subtype1_{ending}/Town01_{number}/ego_vehicle/001")
            evaluator.update(tokens[-1], [plan_at(speed)], each)
    return evaluator, tokens


def test_intervals_of_progress_lost_cross_zero() -> None:
    """Of plans that go farther than the recording as often as not, a plain jackknife by t says the
    same.
    """
    evaluator, tokens = of_speeds(7, 13, 8, 12, 9, 11, 9.5, 11.5)
    clusters = evaluator.clustered({token: cluster_of(scenario_of(token)) for token in tokens})
    paths = [
        f"means/lead 3 s/{GIVEN}/{name}"
        for name in ("lost", "lost_way", "lost_twins", "lost_way_twins")
    ]
    ends = intervals_of(evaluator, clusters, evaluator.compute()).ends
    values = numbers_of_draws(evaluator, clusters, np.ones((1, 8), dtype=np.int64), paths)[0]
    left_out = numbers_of_draws(evaluator, clusters, leaving_out(8), paths)
    half = 2.365 * np.sqrt(7 / 8 * ((left_out - values) ** 2).sum(axis=0))
    for path, value, expected in zip(paths, values, half, strict=True):
        assert ends[path] == pytest.approx((value - expected, value + expected), rel=0.1)
        assert ends[path][0] < 0 < ends[path][1]


@settings(max_examples=10)
@given(st.floats(0.0, 30.0), st.floats(1.0, 30.0), st.floats(-10.0, 10.0), st.booleans())
def test_what_can_be_negative_is_a_signed_number(
    planned: float, recorded: float, aside: float, twin: bool
) -> None:
    true = replace(scene(recorded, partner=not twin), is_twin=twin, is_collider=True)
    times = np.arange(1, 7) * 0.5
    numbers = lead(
        result_of(
            true, plan=Plan(times=times, path=np.column_stack([times * planned, times * aside]))
        )
    )
    for column, value in numbers.items():
        least, most = range_of(
            f"means/lead 3 s/{GIVEN}/{column}", np.array([value]), PlanningResult.rows
        )
        assert np.isnan(value) or least - 1e-6 <= value <= most + 1e-6
        assert (least < 0) == column.startswith("lost")


def test_bystanders_have_tables_of_their_own() -> None:
    found = result_of(replace(scene(10, partner=False), is_collider=False))
    assert "lead 3 s" not in found.means
    assert found.means["bystander, lead 3 s"]["standing"]["lost"] == 100


@pytest.mark.parametrize(
    ("to_end", "table"), [(3.2, "lead 3 s"), (2.8, "lead 3 s"), (0.7, "lead 0.5 s"), (4.0, None)]
)
def test_a_sample_counts_at_the_nearest_lead(to_end: float, table: str | None) -> None:
    found = result_of(replace(scene(10), to_end=to_end, to_contact=np.nan))
    assert [name for name in found.means if name.startswith("lead")] == ([table] if table else [])


def test_leads_to_the_contact_stand_beside() -> None:
    found = result_of(replace(scene(10), to_contact=1.0))
    assert [name for name in found.means if name.startswith("lead")] == [
        "lead 3 s",
        "lead 1 s to contact",
    ]


def gone_by(scene: PlanningScene, side: float) -> PlanningScene:
    """The same accident with a partner that stands aside."""
    moved = scene.footprint.copy()
    moved[:, 0, 1] += side
    return replace(scene, footprint=moved)


def test_an_accident_that_the_recording_does_not_show_is_left_out_by_name() -> None:
    found = result_of(gone_by(scene(10), CAR[1] + 1.5))
    assert "lead 3 s" not in found.means
    assert found.notes == (f"{SCENARIO}: the pair is 1.50 m apart at the end; left out: 1 sample",)
    near = result_of(gone_by(scene(10), CAR[1] + 0.5))
    assert lead(near, "recorded")["avoided"] == 0  # the gap at the end counts as contact


def test_of_several_plans_the_one_with_the_highest_score_counts() -> None:
    evaluator = PlanningEvaluator()
    given = [
        replace(plan_at(10), score=0.1),
        replace(plan_at(0), score=0.9),
        replace(plan_at(5), score=0.9),
    ]
    evaluator.update(TOKEN.format(1), given, scene(10))
    assert evaluator.compute().means["1 s"][GIVEN]["l2"] == pytest.approx(10)


def test_the_box_turns_with_the_ego_frame() -> None:
    path = box_path(np.array([[5.0, 0.0, 0.0], [5.0, 0.0, np.pi / 2]]), np.array([1.0, 0.5]))
    assert path == pytest.approx(np.array([[6.0, 0.5, 0.0], [4.5, 1.0, np.pi / 2]]))


def test_trivial_plans_look_3_seconds_ahead() -> None:
    plans = trivial_plans(scene(10, seconds=1.0))
    assert list(plans) == ["recorded", "standing", "constant velocity", "full braking"]
    assert [each.times[-1] for each in plans.values()] == pytest.approx([3.0] * 4)
    assert plans["recorded"].path[-1] == pytest.approx([30, 0])
