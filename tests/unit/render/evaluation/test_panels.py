"""Panels of breakdowns and comparisons: each group or number has a bar and an interval."""

from pathlib import Path
from typing import Any

import pytest
from matplotlib.colors import to_hex
from matplotlib.text import Text
from numpy.testing import assert_array_equal
from support.figure_texts import STYLES, find_text_faults
from support.rendered_pixels import new_axes
from support.text_contents import missing_parts

from deepaccident_devkit.evaluation import DetectionEvaluator, Resampling
from deepaccident_devkit.evaluation.breakdowns import Breakdown, Group
from deepaccident_devkit.evaluation.detection import DetectionResult
from deepaccident_devkit.evaluation.runs import ComparedNumber, Comparison
from deepaccident_devkit.render import detached_figure, style
from deepaccident_devkit.render.evaluation import render_breakdown, render_comparison
from deepaccident_devkit.render.evaluation.panels import Bar, draw_bars
from deepaccident_devkit.render.styles import AGENT_COLORS


def test_each_group_of_a_breakdown_has_a_bar_and_an_interval(detected: DetectionResult) -> None:
    def make_group(
        value: str | None, result: Any, samples: int, **intervals: tuple[float, float]
    ) -> Group[Any]:
        num_scenarios = samples // 2 or 1
        return Group(
            value=value,
            result=result,
            notes=(),
            intervals=intervals,
            samples=samples,
            scenarios=num_scenarios,
            clusters=num_scenarios,
        )

    breakdown = Breakdown(
        by="agent",
        groups=(
            make_group("infrastructure", detected, 5, mean_average_precision=(40.0, 50.0)),
            make_group(None, DetectionEvaluator("paper").compute(), 1),
        ),
        without_infrastructure=(),
        resampling=Resampling(),
    )

    ax = render_breakdown(breakdown, "mean_average_precision", ax=new_axes())

    (bar,) = ax.patches
    assert (bar.get_width(), to_hex(bar.get_facecolor())) == (43.75, AGENT_COLORS["infrastructure"])
    assert_array_equal(ax.lines[0].get_xdata(), (40, 50))
    assert read_row_names(ax) == [
        "infrastructure\n5 samples, 2 scenarios",
        "unknown\n1 sample, 1 scenario",
    ]


def test_an_interval_below_zero_is_within_the_panel() -> None:
    """A percentage that can be negative has no end at 100 %."""
    negative_bar = Bar(label="lost", value=-1.7, interval=(-24.7, 21.3), text="-1.70 %")
    ax = draw_bars([negative_bar, Bar(label="none")], new_axes(), 100.0)
    low, high = ax.get_xlim()
    assert low <= -24.7
    assert 21.3 <= high < 40

    positive_bar = Bar(label="share", value=30.0, interval=(20.0, 40.0))
    positive_ax = draw_bars([positive_bar], new_axes(), 100.0)
    assert positive_ax.get_xlim()[0] == 0
    assert positive_ax.get_xticks()[-1] == 100


FIGURE_SIZE = (7.2, 5.0)


def read_row_names(ax: Any) -> list[str]:
    return [label.get_text() for label in ax.get_yticklabels()]


def make_number(name: str, **changes: Any) -> ComparedNumber:
    """Make a headline number that is 0.25 more in b."""
    values: dict[str, Any] = {
        "headline": name,
        "unit": "share",
        "a": 0.5,
        "b": 0.75,
        "difference": 0.25,
        "low": -0.1,
        "high": 0.6,
        "p": 0.2,
        "adjusted_p": 0.2,
        "real": False,
        "better": None,
        "higher_is_better": True,
        **changes,
    }
    return ComparedNumber(number=name, family="headlines", decision="", **values)


def make_comparison(*numbers: ComparedNumber, **changes: Any) -> Comparison:
    values: dict[str, Any] = {
        "a": Path("runs/single/accident"),
        "b": Path("runs/five/accident"),
        "samples": 1200,
        "scenarios": 16,
        "clusters": 8,
        "partial": (),
        "resampling": Resampling(),
        **changes,
    }
    return Comparison(
        task="accident",
        protocol="boxes",
        numbers=numbers,
        left_out=0,
        swaps=128,
        all_swaps=True,
        **values,
    )


def make_comparison_of_all_units() -> Comparison:
    """Make a comparison of a dozen numbers, some without an interval and some significant."""
    shares = [make_number(name) for name in ("apa", "precision", "average_precision")]
    shares += [make_number(f"accuracy@{metres}", real=True, better="a") for metres in (5, 10, 15)]
    lower = {"higher_is_better": False, "a": 2.0, "b": 1.5, "difference": -0.5, "low": None}
    return make_comparison(
        *shares,
        make_number("false_alarm_rate", **{**lower, "a": 0.2, "b": 0.2, "difference": -0.0001}),
        make_number("position_error", unit="m", real=True, better="b", **lower),
        make_number("time_error", unit="s", **lower),
        make_number("lateness", unit="s", higher_is_better=None, a=-0.163, b=-0.151),
        make_number("iou 100x100", unit="%", a=40.0, b=52.0, difference=12.0, low=2.0, high=19.0),
    )


def test_a_number_is_at_its_difference() -> None:
    worse = {
        "a": 2.0,
        "b": 1.5,
        "difference": -0.5,
        "low": -0.75,
        "high": -0.25,
        "real": True,
        "better": "b",
        "higher_is_better": False,
    }
    comparison = make_comparison(
        make_number("apa"),
        make_number("error", unit="m", **worse),
        make_number("recall", low=None, high=None),
        make_number("other", headline=None),
        make_number("unknown", b=None, difference=None),
    )

    shares, metres = render_comparison(comparison, fig=detached_figure(FIGURE_SIZE)).axes

    assert read_row_names(shares) == ["APA ↑\n0.500 → 0.750", "recall ↑\n0.500 → 0.750"]
    assert read_row_names(metres) == ["error ↓\n2.000 → 1.500"]
    _, whisker, dot, dot_without_whisker = shares.lines
    assert_array_equal(whisker.get_xydata(), [(-0.1, 0), (0.6, 0)])
    assert_array_equal(dot.get_xydata(), [(0.25, 0)])
    assert_array_equal(dot_without_whisker.get_xydata(), [(0.25, 1)])
    assert dot.get_markerfacecolor() == "white" != metres.lines[-1].get_markerfacecolor()


@pytest.mark.parametrize("medium", STYLES)
def test_words_of_a_comparison_are_apart_in_every_style(medium: Any) -> None:
    with style(medium):
        fig = render_comparison(make_comparison_of_all_units())
        assert find_text_faults(fig) == []
    texts = [text.get_text() for text in fig.findobj(Text)]
    assert "0.000" in texts  # and no sign on zero
    note = fig.get_supxlabel()
    assert not missing_parts(note, "A: single", "B: five", "↑ higher is better", "↓ lower")
    assert "fewer than 6 scenario pairs" in note.replace("\n", " ")


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"clusters": 3}, "3 scenario pairs, at least 6 needed"),
        ({"resampling": Resampling(resamples=0)}, "without resamples"),
    ],
    ids=["few", "no resamples"],
)
def test_dots_without_whiskers_have_a_reason(changes: dict[str, Any], reason: str) -> None:
    comparison = make_comparison(make_number("apa", low=None, high=None), **changes)
    fig = render_comparison(comparison, fig=detached_figure(FIGURE_SIZE))
    assert reason in fig.get_supxlabel()


def test_a_tiny_difference_looks_tiny_and_titles_can_be_left_out() -> None:
    number = make_number("time_error", unit="s", difference=0.012, low=None, high=None)
    with style(title=False):
        fig = render_comparison(make_comparison(number), fig=detached_figure(FIGURE_SIZE))
    low, high = fig.axes[0].get_xlim()
    assert high - low > 0.2
    assert fig.get_suptitle() == ""


def test_no_words_are_cut_and_partial_runs_are_marked() -> None:
    numbers = [make_number(f"quite_a_long_name_{row}", real=True, better="b") for row in range(6)]
    comparison = make_comparison(*numbers, partial=("a: PARTIAL",))
    fig = render_comparison(comparison, fig=detached_figure(FIGURE_SIZE))
    assert find_text_faults(fig) == []
    assert "\na: PARTIAL" in fig.get_suptitle()
