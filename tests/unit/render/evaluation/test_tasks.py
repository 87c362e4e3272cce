"""Panels of accident results: what they draw is what the counts say."""

from typing import Any

import numpy as np
from drawing import new_axes, words
from numpy.testing import assert_allclose, assert_array_equal
from refusals import assert_refused

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation import AccidentEvaluator, MotionEvaluator
from deepaccident_devkit.evaluation.accident.boxes import BoxAccidents
from deepaccident_devkit.evaluation.detection.result import DetectionResult
from deepaccident_devkit.evaluation.warning import WarningEvaluator
from deepaccident_devkit.render.evaluation import (
    render_accuracy,
    render_alarms,
    render_errors,
    render_precision_recall,
    render_predictors,
    render_quality_by_time,
)
from deepaccident_devkit.render.evaluation.tasks import accuracy_by_distance, alarm_precision_recall

LEFT_OUT = {"unjudged": 0, "beyond": 0, "at_impact": False, "unplaced": False}


def alarm(position: float | None, score: float, time: float | None = 0.0) -> dict[str, Any]:
    return {"position": position, "time": time, "id": 0, "score": score}


def boxes() -> AccidentEvaluator:
    """Three accidents, one of which nobody foresees, and two samples without, one with an alarm."""
    evaluator = AccidentEvaluator(BoxAccidents())
    samples = {
        "a": (True, [alarm(3.0, 0.9, 0.5), alarm(8.0, 0.4)]),
        "b": (True, [alarm(12.0, 0.7, -0.5)]),
        "c": (True, []),
        "d": (False, [alarm(None, 0.8, None)]),
        "e": (False, []),
    }
    for token, (positive, alarms) in samples.items():
        named = "meta" if positive else "none"
        evaluator.add(
            token,
            {"positive": positive, "named": named, "alarms": alarms, **LEFT_OUT},
        )
    return evaluator


def test_the_accuracy_curve_goes_through_the_official_points() -> None:
    evaluator = boxes()
    result, curve = evaluator.compute(), accuracy_by_distance(evaluator, np.array([0.0, 5, 10, 15]))
    assert curve is not None
    assert_array_equal(curve[1:], [each.accuracy for each in result.within.values()])
    assert curve[0] == 0
    ax = render_accuracy(evaluator, ax=new_axes())
    x, y = ax.lines[0].get_data()
    assert_array_equal(y[np.isin(x, (5, 10, 15))], curve[1:])
    assert f"APA {result.apa:.3f}" in words(ax)
    assert f"{result.within[10].accuracy:.3f}" in words(ax)


def test_released_counts_have_points_alone() -> None:
    empty = AccidentEvaluator("released")
    assert accuracy_by_distance(empty, np.array([5.0])) is None
    ax = render_accuracy(empty, ax=new_axes())
    assert "nothing to count" in words(ax)
    assert [len(line.get_xdata()) for line in ax.lines] == [2, 2, 2]  # the three distances, no curve


def test_the_area_under_the_alarms_is_the_average_precision() -> None:
    evaluator = boxes()
    recall, precision = alarm_precision_recall(evaluator)
    assert_allclose(np.sum(np.diff(recall, prepend=0) * precision), evaluator.compute().average_precision)
    assert_allclose(recall[-1], evaluator.compute().recall)
    assert_allclose(precision[-1], evaluator.compute().precision)
    ax = render_alarms(evaluator, ax=new_axes())
    assert_array_equal(ax.lines[0].get_xydata(), np.column_stack([recall, precision]))
    assert "no alarms" in words(render_alarms(AccidentEvaluator("paper"), ax=new_axes()))


def test_equally_sure_alarms_come_in_together() -> None:
    evaluator = AccidentEvaluator("boxes")
    for token, positive in {"a": True, "b": False}.items():
        alarms = [alarm(1.0 if positive else None, 0.5, 0.0 if positive else None)]
        evaluator.add(
            token,
            {"positive": positive, "named": "none", "alarms": alarms, **LEFT_OUT},
        )
    assert [each.tolist() for each in alarm_precision_recall(evaluator)] == [[1.0], [0.5]]


def test_errors_are_counted() -> None:
    ax = render_errors(boxes(), "position", ax=new_axes())
    drawn = {round(bar.get_x()): bar.get_height() for bar in ax.patches if bar.get_height()}
    assert drawn == {3: 1, 12: 1}  # of the surest alarm of each accident
    far = AccidentEvaluator("boxes")
    far.add(
        "a",
        {
            "positive": True,
            "named": "meta",
            "alarms": [alarm(99.0, 0.5)],
            "unjudged": 0,
            "beyond": 0,
            "at_impact": False,
            "unplaced": False,
        },
    )
    ax = render_errors(far, "position", ax=new_axes())
    assert [bar.get_x() for bar in ax.patches if bar.get_height()] == [20]  # the last bin: and more
    ax = render_errors(boxes(), "time", ax=new_axes())
    assert {bar.get_x() + 0.25: bar.get_height() for bar in ax.patches if bar.get_height()} == {0.5: 1, -0.5: 1}
    assert "no accident has a prediction" in words(render_errors(AccidentEvaluator("boxes"), "time", ax=new_axes()))


def test_precision_is_drawn_up_to_the_recall_that_is_reached(detected: DetectionResult) -> None:
    ax = render_precision_recall(detected, "car", ax=new_axes())
    assert_array_equal(ax.lines[0].get_xydata(), [(0.25, 1), (0.5, 0.5), (0.75, 0.5)])
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["0.5: AP 50.0 %", "2: AP 75.0 %"]
    assert words(ax) == "car: 8 true, 9 detected"
    ax = render_precision_recall(detected, "truck", ax=new_axes())
    assert not ax.lines
    assert "none in the truth" in words(ax)
    assert_refused(
        (
            lambda: render_precision_recall(detected, "bus"),
            ChoiceError,
            "name: expected one of car, van, truck, found 'bus'",
        ),
        (lambda: render_precision_recall(detected, "car", ring=1), ChoiceError, "ring: expected 0 to 0, found 1"),
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
    assert_allclose(ax.lines[0].get_xydata(), [(0, 80), (0.5, 40)])
    assert np.isnan(ax.lines[1].get_ydata()).all()
    assert "nothing to count" in words(render_quality_by_time(MotionEvaluator(), ax=new_axes()))


def test_nothing_to_warn_of_is_said() -> None:
    assert "no recording" in words(render_predictors(WarningEvaluator().compute(), ax=new_axes()))
