"""Accidents foreseen: places, metres and words."""

from dataclasses import replace

import numpy as np
import pytest
from drawing import new_axes, rendered, title_of

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import Accident, AccidentContext, AccidentEvaluator, box_truth
from deepaccident_devkit.evaluation.accident.scoring import ComparedAccidents
from deepaccident_devkit.render import detached_figure
from deepaccident_devkit.render.outcomes import draw_accident_outcome
from deepaccident_devkit.render.outcomes.above import difference_words, verdict_words
from deepaccident_devkit.render.outcomes.evaluation import render_evaluation


def test_accidents_without_truth(da_motion: DeepAccident) -> None:
    normal = next(scenario for scenario in da_motion.scenario if not scenario["collision"])
    token = da_motion.get_sample(normal, "ego_vehicle", 5)["token"]
    alarm = Accident(positions=np.array([[5.0, 0.0], [7.0, 0.0]]), time=1.0)
    figure = render_evaluation(da_motion, token, [alarm], fig=detached_figure((9, 5)))
    assert title_of(figure).endswith("5 m: FP, 10 m: FP, 15 m: FP")
    assert figure.axes[0].get_title() == "truth: no accident comes"
    nothing = ComparedAccidents(true=None, predicted=())
    assert difference_words(nothing) == "no accident comes, none is foreseen"
    assert not draw_accident_outcome(nothing, ax=new_axes()).lines


def test_the_verdict_names_several_of_a_kind(da_motion: DeepAccident, sample: str) -> None:
    evaluator = AccidentEvaluator("boxes")
    far = Accident(positions=np.array([[40.0, 40.0], [42.0, 40.0]]), time=1.0)
    evaluator.update(sample, [far, replace(far, score=0.5)], None, AccidentContext(truth=box_truth(da_motion, sample)))
    assert verdict_words(evaluator.compute()) == "5 m: 2 FP + FN, 10 m: 2 FP + FN, 15 m: 2 FP + FN"


@pytest.mark.parametrize("off", [0.0, 0.5, 1.0, 2.0, 4.0])
def test_words_cover_neither_circles_nor_crosses(da_motion: DeepAccident, sample: str, off: float) -> None:
    truth = box_truth(da_motion, sample)
    assert truth.accident is not None
    alarm = replace(truth.accident, positions=truth.accident.positions + np.array([off, -off]))
    ax = draw_accident_outcome(ComparedAccidents(true=truth.accident, predicted=(alarm,)), truth, ax=new_axes())
    rendered(ax)
    chips = [text.get_window_extent() for text in ax.texts if text.get_visible()]
    assert len(chips) == 3
    for place in ax.transData.transform(np.concatenate([truth.accident.positions, alarm.positions])):
        assert not any(chip.padded(3).contains(*place) for chip in chips)
