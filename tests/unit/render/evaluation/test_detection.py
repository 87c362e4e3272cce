"""Panels of detection results: what they draw is what the result says."""

from drawing import new_axes, words
from numpy.testing import assert_array_equal
from refusals import assert_refused

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation.detection.result import DetectionResult
from deepaccident_devkit.render.evaluation import render_precision_recall


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
