"""The picture of prevented accidents: its lines are the curves, its points the predictors."""

from dataclasses import replace

import numpy as np
from drawing import new_axes, words
from wording import lacking

from deepaccident_devkit.collisions import OUTCOMES
from deepaccident_devkit.plugins.safety.prevention_figures import render_prevention
from deepaccident_devkit.plugins.safety.prevention_result import (
    NOMINAL,
    SETTINGS,
    OutcomeFigures,
    PreventedResult,
    PreventionCurve,
    PreventionFigures,
)

GROUP = "bystander"


def figures(avoided: float, cost: float) -> PreventionFigures:
    shares = dict.fromkeys(OUTCOMES, 0.0) | {"avoided": avoided, "unchanged": 1 - avoided}
    one = OutcomeFigures(
        warned=1.0, shares=shares, counts={}, extrapolated=0.0, braking_seconds_per_minute=cost
    )
    ends = {0.0: dict.fromkeys(SETTINGS, one)}
    return PreventionFigures(
        threshold=0.5,
        quiet_braking=0.5,
        accidents=4,
        recordings=4,
        minutes=0.5,
        right=ends,
        any_alarm=ends,
        lasting=ends,
    )


def prevented() -> PreventedResult:
    share = np.array([[0.0], [0.25], [0.75]]) * np.linspace(0.5, 1, len(SETTINGS))
    cost = np.array([[0.0], [0.5], [20.0]]) + np.zeros(len(SETTINGS))
    threshold = np.array([np.inf, 0.9, 0.5])
    curve = PreventionCurve(
        threshold=threshold, braking_seconds_per_minute=cost, avoided=share, mitigated=share / 5
    )
    references = {
        "always": {GROUP: figures(1.0, 45.0)},
        "never": {GROUP: figures(0.0, float("nan"))},
    }
    return PreventedResult(
        operating_by="given",
        alarms="right",
        groups={GROUP: figures(0.25, 0.5)},
        references=references,
        curves={GROUP: curve},
        dropped=(),
        skipped=(),
    )


def test_lines_are_the_curves_and_points_the_predictors() -> None:
    result = prevented()
    ax = render_prevention(result, ax=new_axes())
    avoided, nominal = result.curves[GROUP].avoided, SETTINGS.index(NOMINAL)
    lines = {line.get_label(): line for line in ax.lines}
    at = lines[f"at {NOMINAL}"]
    np.testing.assert_array_equal(
        at.get_xydata(), np.column_stack([[0, 0.5, 20], avoided[:, nominal]])
    )
    np.testing.assert_allclose(lines["or milder"].get_ydata(), 1.2 * avoided[:, nominal])
    drawn = [np.asarray(line.get_ydata()).tolist() for line in ax.lines]
    assert not lacking(drawn, *avoided.T.tolist())
    points = [tuple(line.get_xydata()[0]) for line in ax.lines if line.get_marker() == "o"]
    assert points == [(0.5, 0.25), (45.0, 1.0)]
    assert GROUP in words(ax)


def test_nothing_to_show_is_said() -> None:
    ax = render_prevention(replace(prevented(), groups={}, curves={}), ax=new_axes())
    assert "needs accidents" in words(ax)
