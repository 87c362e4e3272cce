"""Panels of warning results: what they draw is what the result says."""

import math
from typing import Any

import numpy as np
from drawing import new_axes, words
from numpy.testing import assert_array_equal

from deepaccident_devkit.evaluation.metrics.warning.result import WarningCurve, WarningResult
from deepaccident_devkit.render.evaluation import (
    render_detection_rates,
    render_false_alarms,
    render_warning_curve,
    render_warning_times,
)


def warned(**changes: Any) -> WarningResult:
    values: dict[str, Any] = {
        "samples": 30,
        "recordings": {"accident": 3, "normal": 2},
        "minutes": {"accident": 0.5, "normal": 0.25},
        "warned_share": 2 / 3,
        "recording_precision": 0.5,
        "tta0": 2 / 3,
        "mean_warning": 1.0,
        "median_warning": 1.0,
        "warning_seconds": np.array([0.5, 1.5]),
        "lasting_share": 0.0,
        "mean_lasting": math.nan,
        "median_lasting": math.nan,
        "mean_reach": 3.0,
        "detection_rate": {1.0: 0.5, 2.0: math.nan},
        "detection_recordings": {1.0: 2, 2.0: 0},
        "time_in_alarm": {"accident": 0.1, "normal": 0.0},
        "alarm_seconds_per_minute": {"accident": 6.0, "normal": 0.0},
        "false_alarms": {"accident": 1, "normal": 0},
        "false_alarms_per_minute": {"accident": 2.0, "normal": 0.0},
        "alarms": 4,
        "precision": 0.5,
        "unjudged": 0,
        "beyond": 0,
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
