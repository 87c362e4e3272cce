"""Panels of breakdowns: a bar and an interval a group."""

from pathlib import Path
from typing import Any

from drawing import new_axes
from matplotlib.colors import to_hex
from numpy.testing import assert_array_equal
from picture_texts import text_faults

from deepaccident_devkit.evaluation import DetectionEvaluator, Resampling
from deepaccident_devkit.evaluation.breakdowns import Breakdown, Group
from deepaccident_devkit.evaluation.detection import DetectionResult
from deepaccident_devkit.evaluation.runs import ComparedNumber, Comparison
from deepaccident_devkit.render import detached_figure
from deepaccident_devkit.render.evaluation import render_breakdown, render_comparison
from deepaccident_devkit.render.evaluation.panels import Bar, draw_bars
from deepaccident_devkit.render.styles import AGENT_COLORS


def test_breakdowns_have_a_bar_and_an_interval_a_group(detected: DetectionResult) -> None:
    def group(
        value: str | None, result: Any, samples: int, **intervals: tuple[float, float]
    ) -> Group[Any]:
        counts = {"samples": samples, "scenarios": samples // 2 or 1, "clusters": samples // 2 or 1}
        return Group(value=value, result=result, notes=(), intervals=intervals, **counts)

    known = group("infrastructure", detected, 5, mean_average_precision=(40.0, 50.0))
    groups = (known, group(None, DetectionEvaluator("paper").compute(), 1))
    broken = Breakdown(
        by="agent", groups=groups, without_infrastructure=(), resampling=Resampling()
    )
    ax = render_breakdown(broken, "mean_average_precision", ax=new_axes())
    (bar,) = ax.patches
    assert (bar.get_width(), to_hex(bar.get_facecolor())) == (43.75, AGENT_COLORS["infrastructure"])
    assert_array_equal(ax.lines[0].get_xdata(), (40, 50))
    named = [label.get_text() for label in ax.get_yticklabels()]
    assert named == ["infrastructure\n5 samples, 2 scen.", "not known\n1 sample, 1 scen."]


def test_an_interval_below_zero_is_within_the_panel() -> None:
    """Of a percentage that can be negative, whose bars have no end at 100 %."""
    bars = [
        Bar(label="lost", value=-1.7, interval=(-24.7, 21.3), text="-1.70 %"),
        Bar(label="none"),
    ]
    ax = draw_bars(bars, new_axes(), 100.0)
    low, high = ax.get_xlim()
    assert low <= -24.7
    assert 21.3 <= high < 40
    positive = draw_bars([Bar(label="share", value=30.0, interval=(20.0, 40.0))], new_axes(), 100.0)
    assert positive.get_xlim()[0] == 0
    assert positive.get_xticks()[-1] == 100


SIZE = (7.2, 5.0)


PLACES = [(-0.1, 0), (0.6, 0), (0.25, 0), (0.25, 1)]
"""Of the whisker's ends, its dot and one without a whisker."""


def compared(name: str, **changes: Any) -> ComparedNumber:
    """A headline number that is 0.25 more in b."""
    values: dict[str, Any] = {
        "headline": name,
        "unit": "share",
        "a": 0.5,
        "b": 0.75,
        "difference": 0.25,
    }
    tested: dict[str, Any] = {
        "low": -0.1,
        "high": 0.6,
        "p": 0.2,
        "adjusted_p": 0.2,
        "real": False,
        "better": None,
    }
    return ComparedNumber(
        number=name, family="headlines", decision="", **{**values, **tested, **changes}
    )


def comparison(*numbers: ComparedNumber, **changes: Any) -> Comparison:
    folders = {"a": Path("runs/single"), "b": Path("runs/five")}
    counts = {"samples": 1200, "scenarios": 16, "clusters": 8, "left_out": 0, "swaps": 128}
    others: dict[str, Any] = {
        "partial": (),
        "resampling": Resampling(),
        "all_swaps": True,
        **changes,
    }
    return Comparison(
        task="accident", protocol="boxes", numbers=numbers, **folders, **counts, **others
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
    }
    numbers = (
        compared("apa"),
        compared("error", unit="m", **worse),
        compared("recall", low=None, high=None),
        compared("other", headline=None),
        compared("unknown", b=None, difference=None),
    )
    shares, metres = render_comparison(comparison(*numbers), fig=detached_figure(SIZE)).axes
    assert [label.get_text() for label in shares.get_yticklabels()] == [
        "apa\n0.500 → 0.750",
        "recall\n0.500 → 0.750",
    ]
    _, whisker, dot, alone = shares.lines
    assert_array_equal([*whisker.get_xydata(), *dot.get_xydata(), *alone.get_xydata()], PLACES)
    assert dot.get_markerfacecolor() == "white" != metres.lines[-1].get_markerfacecolor()


def test_no_words_are_cut_and_partial_runs_are_marked() -> None:
    numbers = [compared(f"quite_a_long_name_{row}", real=True, better="b") for row in range(6)]
    fig = render_comparison(
        comparison(*numbers, partial=("a: PARTIAL",)), fig=detached_figure(SIZE)
    )
    assert text_faults(fig) == []
    assert "\na: PARTIAL" in fig.get_suptitle()
