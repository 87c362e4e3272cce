"""Panels of evaluations: what they draw is what the results and counts say."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation import AccidentEvaluator, Bootstrap, MotionEvaluator
from deepaccident_devkit.evaluation.accident import BoxAccidents
from deepaccident_devkit.evaluation.accident.scoring import Scoring
from deepaccident_devkit.evaluation.breakdowns import Breakdown, Group
from deepaccident_devkit.evaluation.detection import DetectionEvaluator, DetectionResult
from deepaccident_devkit.evaluation.warning import WarningResult
from deepaccident_devkit.evaluation.warning.result import WarningCurve
from deepaccident_devkit.render import detached_figure
from deepaccident_devkit.render.colors import AGENT_COLORS
from deepaccident_devkit.render.evaluation import (
    render_accuracy,
    render_alarms,
    render_average_precisions,
    render_breakdown,
    render_detection_rates,
    render_errors,
    render_false_alarms,
    render_outcomes,
    render_precision_recall,
    render_quality_by_time,
    render_ranges,
    render_warning_curve,
    render_warning_times,
)
from deepaccident_devkit.render.evaluation.accident import accuracy_by_distance, alarm_precision_recall


def new_axes() -> Any:
    return detached_figure((5, 4)).add_subplot()


def words(ax: Any) -> str:
    return "\n".join([ax.get_title(), *(text.get_text() for text in ax.texts)])


def alarm(position: float | None, score: float, time: float | None = 0.0) -> dict[str, Any]:
    return {"position": position, "time": time, "id": 0, "score": score}


def boxes(**choices: Any) -> AccidentEvaluator:
    """Three accidents, one of which nobody foresees, and two samples without, one with an alarm."""
    evaluator = AccidentEvaluator(BoxAccidents(**choices))
    samples = {
        "a": (True, [alarm(3.0, 0.9, 0.5), alarm(8.0, 0.4)]),
        "b": (True, [alarm(12.0, 0.7, -0.5)]),
        "c": (True, []),
        "d": (False, [alarm(None, 0.8, None)]),
        "e": (False, []),
    }
    for token, (positive, alarms) in samples.items():
        named = "meta" if positive else "none"
        evaluator.add(token, {"positive": positive, "named": named, "alarms": alarms, "unjudged": 0})
    return evaluator


@pytest.mark.parametrize(
    "choices",
    [{}, {"scoring": Scoring(far_is_missed=False, limit_counts=True)}, {"scoring": Scoring(time_tolerance=0.1)}],
)
def test_the_accuracy_curve_goes_through_the_official_points(choices: dict[str, Any]) -> None:
    evaluator = boxes(**choices)
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
        evaluator.add(token, {"positive": positive, "named": "none", "alarms": alarms, "unjudged": 0})
    assert [each.tolist() for each in alarm_precision_recall(evaluator)] == [[1.0], [0.5]]


def test_outcomes_and_errors_are_counted() -> None:
    result = boxes().compute()
    ax = render_outcomes(result, ax=new_axes())
    assert_array_equal(
        [[bar.get_height() for bar in kind] for kind in ax.containers],
        [[getattr(each, case) for each in result.within.values()] for case in ("tp", "fp", "fn")],
    )
    ax = render_errors(boxes(), "position", ax=new_axes())
    drawn = {round(bar.get_x()): bar.get_height() for bar in ax.patches if bar.get_height()}
    assert drawn == {3: 1, 12: 1}  # of the surest alarm of each accident
    far = AccidentEvaluator("boxes")
    far.add("a", {"positive": True, "named": "meta", "alarms": [alarm(99.0, 0.5)], "unjudged": 0})
    ax = render_errors(far, "position", ax=new_axes())
    assert [bar.get_x() for bar in ax.patches if bar.get_height()] == [20]  # the last bin: and more
    ax = render_errors(boxes(), "time", ax=new_axes())
    assert {bar.get_x() + 0.25: bar.get_height() for bar in ax.patches if bar.get_height()} == {0.5: 1, -0.5: 1}
    assert "no accident has a prediction" in words(render_errors(AccidentEvaluator("boxes"), "time", ax=new_axes()))


def detected() -> DetectionResult:
    """Two classes at two thresholds; nobody of the third is there."""
    precision = np.zeros((3, 1, 2, 4))
    precision[0] = [[[1, 0.5, 0.5, 0], [1, 1, 1, 0]]]
    precision[1] = 0.25
    recall = np.broadcast_to([0.25, 0.5, 0.75, 1.0], precision.shape)
    average = np.array([[[50.0, 75.0]], [[25.0, 25.0]], [[math.nan, math.nan]]])
    return DetectionResult(
        mean_average_precision=43.75,
        class_average_precision={"car": 62.5, "van": 25.0, "truck": math.nan},
        mean_errors={"ATE": 0.5},
        classes=("car", "van", "truck"),
        ranges=np.array([[0.0, 50.0]]),
        thresholds=np.tile([0.5, 2.0], (3, 1)),
        average_precision=average,
        precision=precision,
        recall=recall,
        errors=np.ones((3, 4)),
        truths=np.array([[8], [4], [0]]),
        detections=np.array([[9], [3], [2]]),
        samples=5,
    )


def test_precision_is_drawn_up_to_the_recall_that_is_reached() -> None:
    ax = render_precision_recall(detected(), "car", ax=new_axes())
    assert_array_equal(ax.lines[0].get_xydata(), [(0.25, 1), (0.5, 0.5), (0.75, 0.5)])
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["0.5: AP 50.0 %", "2: AP 75.0 %"]
    assert words(ax) == "car: 8 true, 9 detected"
    ax = render_precision_recall(detected(), "truck", ax=new_axes())
    assert not ax.lines
    assert "none in the truth" in words(ax)
    with pytest.raises(ChoiceError, match="name: expected one of car, van, truck, found 'bus'"):
        render_precision_recall(detected(), "bus")
    with pytest.raises(ChoiceError, match="ring: expected 0 to 0, found 1"):
        render_precision_recall(detected(), "car", ring=1)


def test_bars_are_average_precisions() -> None:
    ax = render_average_precisions(detected(), ax=new_axes())
    assert [bar.get_width() for bar in ax.patches] == [62.5, 25.0]
    assert [text.get_text() for text in ax.texts] == ["62.5 %", "25.0 %", "–"]
    assert [label.get_text() for label in ax.get_yticklabels()] == ["car\n8 true", "van\n4 true", "truck\n0 true"]
    render_average_precisions(DetectionEvaluator("paper").compute(), ax=new_axes()).figure.draw_without_rendering()


def test_breakdowns_have_a_bar_and_an_interval_a_group() -> None:
    group = Group(
        value="infrastructure",
        result=detected(),
        samples=5,
        scenarios=2,
        intervals={"mean_average_precision": (40.0, 50.0)},
    )
    single = Group(value=None, result=DetectionEvaluator("paper").compute(), samples=1, scenarios=1, intervals={})
    broken = Breakdown(by="agent", groups=(group, single), without_infrastructure=(), bootstrap=Bootstrap())
    ax = render_breakdown("detection", broken, "mean_average_precision", ax=new_axes())
    (bar,) = ax.patches
    assert bar.get_width() == 43.75
    assert_allclose(
        bar.get_facecolor()[:3], [int(AGENT_COLORS["infrastructure"][at : at + 2], 16) / 255 for at in (1, 3, 5)]
    )
    assert_array_equal(ax.lines[0].get_xdata(), (40, 50))
    assert [text.get_text() for text in ax.texts] == ["43.75 %", "–"]
    assert [label.get_text() for label in ax.get_yticklabels()] == [
        "infrastructure\n5 samples, 2 scen.",
        "not known\n1 sample, 1 scen.",
    ]
    assert ax.get_xlabel() == "mAP (%)"


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


def test_motion_is_drawn_by_range_and_frame() -> None:
    ax = render_ranges(moving().compute(), ax=new_axes())
    near, far = [[bar.get_height() for bar in kind] for kind in ax.containers]
    assert_allclose(near[:2], (75.0, 100 * 2.4 / 4))
    assert far == [0, 0, 0, 0]
    assert [text.get_text() for text in ax.texts][4:] == ["–"] * 4
    ax = render_quality_by_time(moving(), ax=new_axes())
    assert_allclose(ax.lines[0].get_xydata(), [(0, 80), (0.5, 40)])
    assert np.isnan(ax.lines[1].get_ydata()).all()
    assert "nothing to count" in words(render_quality_by_time(MotionEvaluator(), ax=new_axes()))


def warned(**changes: Any) -> WarningResult:
    values: dict[str, Any] = {
        "samples": 30,
        "recordings": {"accident": 3, "normal": 2},
        "minutes": {"accident": 0.5, "normal": 0.25},
        "warned_share": 2 / 3,
        "mean_warning": 1.0,
        "median_warning": 1.0,
        "warning_seconds": np.array([0.5, 1.5]),
        "lasting_share": 0.0,
        "mean_lasting": math.nan,
        "median_lasting": math.nan,
        "mean_reach": 3.0,
        "detection_rate": {1.0: 0.5, 2.0: math.nan},
        "detection_recordings": {1.0: 2, 2.0: 0},
        "false_alarms": {"accident": 1, "normal": 0},
        "false_alarms_per_minute": {"accident": 2.0, "normal": 0.0},
        "alarms": 4,
        "precision": 0.5,
        "unjudged": 0,
        "curve": WarningCurve(
            threshold=np.array([0.9, 0.5]),
            detection_rate=np.array([0.0, 0.5]),
            mean_warning=np.array([math.nan, 1.0]),
            false_alarms_per_minute=np.array([0.0, 4.0]),
            false_alarms_in_accidents=np.array([0.0, 2.0]),
        ),
    }
    return WarningResult(**(values | changes))


def test_warnings_are_drawn() -> None:
    ax = render_warning_times(warned(), ax=new_axes())
    assert [(bar.get_x(), bar.get_height()) for bar in ax.patches if bar.get_height()] == [(0.5, 1), (1.5, 1)]
    assert "2 of 3 recordings" in words(ax)
    ax = render_detection_rates(warned(), ax=new_axes())
    assert [text.get_text() for text in ax.texts] == ["0.500", "–"]
    ax = render_false_alarms(warned(), ax=new_axes())
    assert [bar.get_width() for bar in ax.patches] == [2.0, 0.0]
    assert ax.get_yticklabels()[0].get_text() == "accident\n1 in 0.5 min"
    ax = render_warning_curve(warned(), ax=new_axes())
    assert_array_equal(ax.lines[0].get_xydata(), [(0, 0), (4, 0.5)])
    assert "≥ 0.9" in words(ax)


def test_nothing_to_warn_of_is_said() -> None:
    nothing = np.zeros(0)
    curve = WarningCurve(**dict.fromkeys(WarningCurve.__dataclass_fields__, nothing))
    empty = warned(warning_seconds=nothing, curve=curve, detection_rate={}, false_alarms_per_minute={})
    assert "no recording has a right alarm" in words(render_warning_times(empty, ax=new_axes()))
    assert "needs alarms" in words(render_warning_curve(empty, ax=new_axes()))
    for draw in (render_detection_rates, render_false_alarms):
        assert "nothing to count" in words(draw(empty, ax=new_axes()))
