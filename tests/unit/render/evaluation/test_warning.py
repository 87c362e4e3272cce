"""The panel of warning results: what it draws is what the result says."""

from drawing import new_axes, words

from deepaccident_devkit.evaluation.warning import WarningEvaluator
from deepaccident_devkit.render.evaluation import render_predictors


def test_nothing_to_warn_of_is_said() -> None:
    assert "no recording" in words(render_predictors(WarningEvaluator().compute(), ax=new_axes()))
