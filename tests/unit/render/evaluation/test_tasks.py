"""Panels of accident results agree with the counts that they are drawn from."""

from dataclasses import replace
from typing import Any

import numpy as np
from support.expected_errors import assert_raises
from support.planning_scenes import blocked_ego_scene, constant_speed_plan
from support.rendered_pixels import new_axes, read_words

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation import (
    AccidentEvaluator,
    BoxAccidents,
    DetectionResult,
    MotionEvaluator,
)
from deepaccident_devkit.evaluation.planning import PlanningEvaluator
from deepaccident_devkit.render.evaluation import (
    render_accuracy,
    render_alarms,
    render_errors,
    render_plans,
    render_precision_recall,
    render_quality_by_time,
)
from deepaccident_devkit.render.evaluation.tasks import accuracy_by_distance, alarm_precision_recall

NOTHING_LEFT_OUT = {"unjudged": 0, "beyond": 0, "at_impact": False, "unplaced": False}


def evaluate_alarms(*samples: tuple[bool, list[dict[str, Any]]]) -> AccidentEvaluator:
    """Evaluate samples, each given as whether an accident comes and the alarms that are raised."""
    evaluator = AccidentEvaluator(BoxAccidents())
    for number, (positive, alarms) in enumerate(samples):
        counts = {
            "positive": positive,
            "named": "meta" if positive else "none",
            "alarms": alarms,
            **NOTHING_LEFT_OUT,
        }
        evaluator.add(str(number), counts)
    return evaluator


def make_alarm(position: float | None, score: float, time: float | None = 0.0) -> dict[str, Any]:
    return {"position": position, "time": time, "id": 0, "score": score}


def evaluate_five_samples() -> AccidentEvaluator:
    """Evaluate three accidents, one without an alarm, and two other samples, one with an alarm."""
    return evaluate_alarms(
        (True, [make_alarm(3.0, 0.9, 0.5), make_alarm(8.0, 0.4)]),
        (True, [make_alarm(12.0, 0.7, -0.5)]),
        (True, []),
        (False, [make_alarm(None, 0.8, None)]),
        (False, []),
    )


def test_the_accuracy_curve_goes_through_the_official_points() -> None:
    evaluator = evaluate_five_samples()
    accuracies = [within.accuracy for within in evaluator.compute().within.values()]
    curve = accuracy_by_distance(evaluator, np.array([0.0, 5, 10, 15]))
    np.testing.assert_array_equal(curve, [0, *accuracies])

    ax = render_accuracy(evaluator, ax=new_axes())
    x, y = ax.lines[0].get_data()
    np.testing.assert_array_equal(y[np.isin(x, (5, 10, 15))], curve[1:])


def test_samples_that_do_not_count_change_no_curve() -> None:
    """A sample at the impact, or with an accident that cannot be placed, is left out."""
    evaluator = evaluate_five_samples()
    expected = accuracy_by_distance(evaluator, np.array([5.0, 10, 15]))
    for name in ("at_impact", "unplaced"):
        counts = {"positive": True, "named": "meta", "alarms": [make_alarm(1.0, 0.9)]}
        evaluator.add(name, {**counts, **NOTHING_LEFT_OUT, name: True})
    curve = accuracy_by_distance(evaluator, np.array([5.0, 10, 15]))
    np.testing.assert_array_equal(curve, expected)
    accuracies = [within.accuracy for within in evaluator.compute().within.values()]
    np.testing.assert_array_equal(curve, accuracies)


def test_released_counts_only_have_points() -> None:
    empty = AccidentEvaluator("released")
    assert accuracy_by_distance(empty, np.array([5.0])) is None
    ax = render_accuracy(empty, ax=new_axes())
    assert "nothing to count" in read_words(ax)
    lengths = [len(line.get_xdata()) for line in ax.lines]
    assert lengths == [2, 2, 2]  # the three distances, no curve


def test_the_area_under_the_alarms_is_the_average_precision() -> None:
    evaluator = evaluate_five_samples()
    recall, precision = alarm_precision_recall(evaluator)
    area = np.sum(np.diff(recall, prepend=0) * precision)
    result = evaluator.compute()
    np.testing.assert_allclose(
        [area, recall[-1], precision[-1]],
        [result.average_precision, result.recall, result.precision],
    )

    ax = render_alarms(evaluator, ax=new_axes())
    np.testing.assert_array_equal(ax.lines[0].get_xydata(), np.column_stack([recall, precision]))
    assert "no alarms" in read_words(render_alarms(AccidentEvaluator("paper"), ax=new_axes()))


def test_errors_are_counted() -> None:
    def read_bars(evaluator: AccidentEvaluator, error: Any) -> dict[float, float]:
        ax = render_errors(evaluator, error, ax=new_axes())
        return {round(bar.get_x(), 2): bar.get_height() for bar in ax.patches if bar.get_height()}

    evaluator = evaluate_five_samples()
    assert read_bars(evaluator, "position") == {3: 1, 12: 1}  # of the surest alarm of each accident
    assert read_bars(evaluator, "time") == {0.25: 1, -0.75: 1}
    far = evaluate_alarms((True, [make_alarm(99.0, 0.5)]))
    assert read_bars(far, "position") == {20: 1}  # the last bin has no upper limit
    empty_ax = render_errors(AccidentEvaluator("boxes"), "time", ax=new_axes())
    assert "no accident has a prediction" in read_words(empty_ax)


def test_precision_is_drawn_up_to_the_recall_that_is_reached(detected: DetectionResult) -> None:
    car, truck = (
        render_precision_recall(detected, name, ax=new_axes()) for name in ("car", "truck")
    )

    np.testing.assert_array_equal(car.lines[0].get_xydata(), [(0.25, 1), (0.5, 0.5), (0.75, 0.5)])
    assert len(truck.lines) == 0
    assert "no true boxes" in read_words(truck)
    assert_raises(
        (
            lambda: render_precision_recall(detected, "bus"),
            ChoiceError,
            ("name", "car, van, truck", "'bus'"),
        ),
        (
            lambda: render_precision_recall(detected, "car", ring=1),
            ChoiceError,
            ("ring", "0 to 0", "found 1"),
        ),
    )


def evaluate_motion() -> MotionEvaluator:
    """Evaluate the motion of two samples, one with two frames and one with a single frame."""
    evaluator = MotionEvaluator("paper")
    for token, num_frames in {"a": 2, "b": 1}.items():
        vehicle_counts = [
            [0.8] * num_frames,
            [1] * num_frames,
            [0, 2][:num_frames],
            [0] * num_frames,
        ]
        counts = {
            "samples": 1,
            "frames": num_frames,
            "instance_maps": 0,
            "cells": [[3, 1, 0], [0, 0, 0]],
            "vpq": [vehicle_counts, [[0.0] * num_frames] * 4],
            "paths": None,
        }
        evaluator.add(token, counts)
    return evaluator


def test_motion_is_drawn_by_frame() -> None:
    ax = render_quality_by_time(evaluate_motion(), ax=new_axes())
    np.testing.assert_allclose(ax.lines[0].get_xydata(), [(0, 80), (0.5, 40)])
    assert np.isnan(ax.lines[1].get_ydata()).all()
    empty_ax = render_quality_by_time(MotionEvaluator(), ax=new_axes())
    assert "nothing to count" in read_words(empty_ax)


def test_plans_are_drawn_where_they_avoid_and_lose() -> None:
    evaluator = PlanningEvaluator()
    empty_ax = render_plans(evaluator.compute(), ax=new_axes())
    assert "no accident with a twin" in read_words(empty_ax)

    twin = replace(blocked_ego_scene(10, partner=False), is_twin=True, is_collider=True)
    for number, scene in enumerate((blocked_ego_scene(10), twin)):
        evaluator.update(f"a/b/{number:03d}", [constant_speed_plan(10)], scene)
    ax = render_plans(evaluator.compute(), ax=new_axes())
    plan_lines = ax.lines[::2]  # each is followed by its large dot
    points = [line.get_xydata()[0].round(1).tolist() for line in plan_lines]
    assert points == [[0, 0], [0, 0], [100, 100], [0, 0], [79.2, 100]]
