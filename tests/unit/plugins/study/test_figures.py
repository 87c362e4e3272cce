"""The figures of a study: words are apart in every style, and a column shows two numbers."""

from typing import Any

import pytest
from matplotlib import pyplot as plt
from support.figure_texts import STYLES, find_text_faults

from deepaccident_devkit.plugins.study.figures import curves_figure, rows_figure, series_keys
from deepaccident_devkit.plugins.study.summary import ALL, MAIN_NUMBERS
from deepaccident_devkit.render import style
from deepaccident_devkit.render.styles import current_style

LATENCIES = (0.0, 0.5, 1.0)


def make_row(value: float, over: tuple[str, float, str] | None = None) -> dict[str, Any]:
    """Make a row in which all main numbers have the same value and two seeds."""
    seeds = {"0": value - 1, "1": value + 1}
    estimate = {"value": value, "low": value - 4, "high": value + 4, "seeds": seeds}
    return {"groups": {ALL: dict.fromkeys(MAIN_NUMBERS, estimate)}, "over": over}


def make_summary() -> dict[str, Any]:
    rows = {
        "sees single": make_row(30.0),
        "five agents, fused features": make_row(40.0),
    }
    for latency in LATENCIES:
        over = ("latency", latency, "late boxes")
        rows[f"late boxes, {latency} s"] = make_row(35.0 - 5 * latency, over)
    return {"rows": rows, "headline": None}


@pytest.mark.parametrize("medium", STYLES)
def test_words_are_apart_and_large(medium: Any) -> None:
    summary = make_summary()
    with style(medium):
        figures = [rows_figure(summary), curves_figure(summary, "latency")]
        for figure in figures:
            assert find_text_faults(figure) == []
        num_panels = 2 if current_style().layout == "column" else len(MAIN_NUMBERS)
    assert [len(figure.axes) for figure in figures] == [num_panels, num_panels]
    plt.close("all")


def test_dots_are_the_values() -> None:
    summary = make_summary()
    assert series_keys(summary) == ["latency"]
    line = curves_figure(summary, "latency").axes[0].lines[1]
    assert line.get_xydata().tolist() == [[0.0, 35.0], [0.5, 32.5], [1.0, 30.0]]
    plt.close("all")
