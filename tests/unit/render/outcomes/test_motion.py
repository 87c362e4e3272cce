"""Predicted instances as found, false and missed, against the counts of the evaluation."""

import numpy as np
import pytest
from drawing import picture, title_of
from matplotlib.colors import to_rgb
from numpy.testing import assert_allclose

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import MotionEvaluator, MotionOutput, instances_of
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.render import detached_figure
from deepaccident_devkit.render.outcomes import motion_outcome
from deepaccident_devkit.render.outcomes.evaluation import render_evaluation
from deepaccident_devkit.render.styles import OUTCOME_COLORS


def damaged(labels: MotionLabels) -> MotionOutput:
    """The labels without one instance, with one too many, and with one that is four cells off in later frames."""
    instance = labels.instance.copy()
    instance[instance == 3] = 0
    instance[:, 2:8, 2:12] = 90
    moved = instance[1:] == 4
    instance[1:][moved] = 0
    instance[1:][np.roll(moved, 4, axis=-2)] = 4
    return instances_of(instance, labels.config.grid)


def test_motion_outcomes_are_those_that_are_counted(da_motion: DeepAccident, sample: str, labels: MotionLabels) -> None:
    output = damaged(labels)
    outcome = motion_outcome(output, labels)
    evaluator = MotionEvaluator("released")
    evaluator.update(sample, output, labels)
    counted = evaluator.compute().ranges["100x100"]
    assert len(outcome.matches) == counted.true_positive
    sides = {"true": (labels.instance, counted.false_negative), "predicted": (outcome.predicted.instance, None)}
    for side, (instance, missed) in sides.items():
        cells = outcome.outcomes(side)  # type: ignore[arg-type]
        frames = [np.unique(here[kind == 2]) for here, kind in zip(instance, cells, strict=False)]
        total = counted.false_positive if missed is None else missed
        assert sum(map(len, frames)) == total > 0
    figure = render_evaluation(da_motion, sample, output, fig=detached_figure((10, 6)))
    left, right = figure.axes
    assert left.get_title() == f"true instances: {counted.true_positive} found, {counted.false_negative} missed"
    assert right.get_title().endswith(f"{counted.true_positive} right, {counted.false_positive} false")
    assert f"PQ {counted.pq:.1f} %" in title_of(figure)
    present = np.isin(labels.instance[0], 3)
    assert_allclose(picture(left)[present], np.broadcast_to(to_rgb(OUTCOME_COLORS["missed"]), (present.sum(), 3)))
    assert_allclose(picture(right)[4, 4], to_rgb(OUTCOME_COLORS["false"]))


def test_what_lies_beyond_the_range_is_not_judged(labels: MotionLabels, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("deepaccident_devkit.render.outcomes.above.RANGES", {"30x30": 30.0})
    output = instances_of(labels.instance, labels.config.grid)
    cells = motion_outcome(output, labels).outcomes("true")
    here = labels.instance[0] > 0
    assert set(np.unique(cells[0][here]).tolist()) == {1, 3}
