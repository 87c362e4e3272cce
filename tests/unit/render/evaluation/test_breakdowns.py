"""Panels of breakdowns: a bar and an interval a group."""

from drawing import new_axes
from numpy.testing import assert_allclose, assert_array_equal

from deepaccident_devkit.evaluation import Resampling
from deepaccident_devkit.evaluation.breakdowns import Breakdown, Group
from deepaccident_devkit.evaluation.detection import DetectionEvaluator
from deepaccident_devkit.evaluation.detection.result import DetectionResult
from deepaccident_devkit.render.evaluation import render_breakdown
from deepaccident_devkit.render.styles import AGENT_COLORS


def test_breakdowns_have_a_bar_and_an_interval_a_group(detected: DetectionResult) -> None:
    group = Group(
        value="infrastructure",
        result=detected,
        samples=5,
        scenarios=2,
        clusters=2,
        notes=(),
        intervals={"mean_average_precision": (40.0, 50.0)},
    )
    single = Group(
        value=None,
        result=DetectionEvaluator("paper").compute(),
        samples=1,
        scenarios=1,
        clusters=1,
        intervals={},
        notes=(),
    )
    broken = Breakdown(by="agent", groups=(group, single), without_infrastructure=(), resampling=Resampling())
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
