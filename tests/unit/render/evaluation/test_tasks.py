"""Panels of accident results: what they draw is what the counts say."""

from dataclasses import replace
from typing import Any

import numpy as np
from drawing import new_axes, words
from planning_scenes import plan_at, scene
from refusals import assert_refused

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

LEFT_OUT = {"unjudged": 0, "beyond": 0, "at_impact": False, "unplaced": False}


def evaluated(*samples: tuple[bool, list[dict[str, Any]]]) -> AccidentEvaluator:
    """Of whether an accident comes, and what is foreseen."""
    evaluator = AccidentEvaluator(BoxAccidents())
    for number, (positive, alarms) in enumerate(samples):
        told = {"positive": positive, "named": "meta" if positive else "none", "alarms": alarms}
        evaluator.add(str(number), {**told, **LEFT_OUT})
    return evaluator


def alarm(position: float | None, score: float, time: float | None = 0.0) -> dict[str, Any]:
    return {"position": position, "time": time, "id": 0, "score": score}


def boxes() -> AccidentEvaluator:
    """Three accidents, one of which nobody foresees, and two samples without, one with an alarm."""
    near, late, wrong = alarm(3.0, 0.9, 0.5), alarm(12.0, 0.7, -0.5), alarm(None, 0.8, None)
    return evaluated(
        (True, [near, alarm(8.0, 0.4)]), (True, [late]), (True, []), (False, [wrong]), (False, [])
    )


def test_the_accuracy_curve_goes_through_the_official_points() -> None:
    evaluator = boxes()
    result, curve = evaluator.compute(), accuracy_by_distance(evaluator, np.array([0.0, 5, 10, 15]))
    np.testing.assert_array_equal(curve, [0, *(each.accuracy for each in result.within.values())])
    ax = render_accuracy(evaluator, ax=new_axes())
    x, y = ax.lines[0].get_data()
    np.testing.assert_array_equal(y[np.isin(x, (5, 10, 15))], curve[1:])


def test_released_counts_have_points_alone() -> None:
    empty = AccidentEvaluator("released")
    assert accuracy_by_distance(empty, np.array([5.0])) is None
    ax = render_accuracy(empty, ax=new_axes())
    assert "nothing to count" in words(ax)
    assert [len(line.get_xdata()) for line in ax.lines] == [
        2,
        2,
        2,
    ]  # the three distances, no curve


def test_the_area_under_the_alarms_is_the_average_precision() -> None:
    evaluator = boxes()
    result, (recall, precision) = evaluator.compute(), alarm_precision_recall(evaluator)
    area = np.sum(np.diff(recall, prepend=0) * precision)
    np.testing.assert_allclose(
        [area, recall[-1], precision[-1]],
        [result.average_precision, result.recall, result.precision],
    )
    ax = render_alarms(evaluator, ax=new_axes())
    np.testing.assert_array_equal(ax.lines[0].get_xydata(), np.column_stack([recall, precision]))
    assert "no alarms" in words(render_alarms(AccidentEvaluator("paper"), ax=new_axes()))


def test_errors_are_counted() -> None:
    def bars(evaluator: AccidentEvaluator, error: Any) -> dict[float, float]:
        ax = render_errors(evaluator, error, ax=new_axes())
        return {round(bar.get_x(), 2): bar.get_height() for bar in ax.patches if bar.get_height()}

    assert bars(boxes(), "position") == {3: 1, 12: 1}  # of the surest alarm of each accident
    assert bars(boxes(), "time") == {0.25: 1, -0.75: 1}
    assert bars(evaluated((True, [alarm(99.0, 0.5)])), "position") == {
        20: 1
    }  # the last bin: and more
    assert "no accident has a prediction" in words(
        render_errors(AccidentEvaluator("boxes"), "time", ax=new_axes())
    )


def test_precision_is_drawn_up_to_the_recall_that_is_reached(detected: DetectionResult) -> None:
    ax, nobody = (
        render_precision_recall(detected, name, ax=new_axes()) for name in ("car", "truck")
    )
    np.testing.assert_array_equal(ax.lines[0].get_xydata(), [(0.25, 1), (0.5, 0.5), (0.75, 0.5)])
    assert (len(nobody.lines), "none in the truth" in words(nobody)) == (0, True)
    assert_refused(
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


def moving() -> MotionEvaluator:
    """Two samples, of two frames and of one."""
    evaluator = MotionEvaluator("paper")
    for token, frames in {"a": 2, "b": 1}.items():
        vpq = [[[0.8] * frames, [1] * frames, [0, 2][:frames], [0] * frames], [[0.0] * frames] * 4]
        counts = {
            "samples": 1,
            "frames": frames,
            "instance_maps": 0,
            "cells": [[3, 1, 0], [0, 0, 0]],
            "vpq": vpq,
            "paths": None,
        }
        evaluator.add(token, counts)
    return evaluator


def test_motion_is_drawn_by_frame() -> None:
    ax = render_quality_by_time(moving(), ax=new_axes())
    np.testing.assert_allclose(ax.lines[0].get_xydata(), [(0, 80), (0.5, 40)])
    assert np.isnan(ax.lines[1].get_ydata()).all()
    assert "nothing to count" in words(render_quality_by_time(MotionEvaluator(), ax=new_axes()))


def test_plans_stand_where_they_avoid_and_lose() -> None:
    evaluator = PlanningEvaluator()
    assert "no accident with a twin" in words(render_plans(evaluator.compute(), ax=new_axes()))
    twin = replace(scene(10, partner=False), is_twin=True, is_collider=True)
    for number, each in enumerate((scene(10), twin)):
        evaluator.update(f"a/b/{number:03d}", [plan_at(10)], each)
    ax = render_plans(evaluator.compute(), ax=new_axes())
    drawn = [line.get_xydata()[0].round(1).tolist() for line in ax.lines]
    assert drawn == [[0, 0], [0, 0], [100, 100], [0, 0], [79.2, 100]]
