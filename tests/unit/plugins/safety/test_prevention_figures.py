"""The figure of prevented accidents: lines show the curves, points the predictors."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.figure_texts import STYLES, find_text_faults
from support.rendered_pixels import new_axes, read_words
from support.text_contents import missing_parts

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
from deepaccident_devkit.render import style

GROUP = "bystander"


def make_figures(avoided: float, cost: float) -> PreventionFigures:
    shares = dict.fromkeys(OUTCOMES, 0.0) | {"avoided": avoided, "unchanged": 1 - avoided}
    outcome = OutcomeFigures(
        warned=1.0, shares=shares, counts={}, extrapolated=0.0, braking_seconds_per_minute=cost
    )
    by_latency = {0.0: dict.fromkeys(SETTINGS, outcome)}
    return PreventionFigures(
        threshold=0.5,
        quiet_braking=0.5,
        accidents=4,
        recordings=4,
        minutes=0.5,
        right=by_latency,
        any_alarm=by_latency,
        lasting=by_latency,
    )


def make_result() -> PreventedResult:
    avoided = np.array([[0.0], [0.25], [0.75]]) * np.linspace(0.5, 1, len(SETTINGS))
    cost = np.array([[0.0], [0.5], [20.0]]) + np.zeros(len(SETTINGS))
    curve = PreventionCurve(
        threshold=np.array([np.inf, 0.9, 0.5]),
        braking_seconds_per_minute=cost,
        avoided=avoided,
        mitigated=avoided / 5,
    )
    return PreventedResult(
        operating_by="given",
        alarms="right",
        groups={GROUP: make_figures(0.25, 0.5)},
        references={
            "always": {GROUP: make_figures(1.0, 45.0)},
            "never": {GROUP: make_figures(0.0, float("nan"))},
        },
        curves={GROUP: curve},
        dropped=(),
        skipped=(),
    )


def test_lines_are_the_curves_and_points_the_predictors() -> None:
    result = make_result()
    ax = render_prevention(result, ax=new_axes())
    lines = {line.get_label(): line for line in ax.lines}

    avoided = result.curves[GROUP].avoided
    nominal = avoided[:, SETTINGS.index(NOMINAL)]
    np.testing.assert_array_equal(
        lines[f"avoided by braking at {NOMINAL}"].get_xydata(),
        np.column_stack([[0, 0.5, 20], nominal]),
    )
    np.testing.assert_allclose(lines["avoided or milder"].get_ydata(), 1.2 * nominal)
    heights = [np.asarray(line.get_ydata()).tolist() for line in ax.lines]
    assert not missing_parts(heights, *avoided.T.tolist())

    points = [tuple(line.get_xydata()[0]) for line in ax.lines if line.get_marker() == "o"]
    assert points == [(0.5, 0.25), (45.0, 1.0)]
    assert GROUP in read_words(ax)


@pytest.mark.parametrize("medium", STYLES)
def test_words_are_apart_and_large(medium: Any) -> None:
    with style(medium):
        ax = render_prevention(make_result())
        assert find_text_faults(ax.figure) == []


def test_nothing_to_show_is_said() -> None:
    empty = replace(make_result(), groups={}, curves={})
    ax = render_prevention(empty, ax=new_axes())
    assert "needs accidents" in read_words(ax)
