"""Pictures of predictions: trails, and outcomes beside labels, against the counts of the evaluation."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_hex, to_rgb
from numpy.testing import assert_allclose, assert_array_equal

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, EvaluationError
from deepaccident_devkit.evaluation import (
    Accident,
    AccidentEvaluator,
    DetectedBoxes,
    MotionEvaluator,
    MotionOutput,
    accident_context,
    box_truth,
    detection_truth,
    instances_of,
)
from deepaccident_devkit.evaluation.accident import PROTOCOLS, ComparedAccidents, compared_accidents
from deepaccident_devkit.geometry.bev_grid import ORIENTATIONS
from deepaccident_devkit.motion import MotionHeads, MotionLabels
from deepaccident_devkit.render import detached_figure
from deepaccident_devkit.render.colors import COLLIDER_COLOR, OUTCOME_COLORS
from deepaccident_devkit.render.motion import draw_motion_map, draw_motion_output, draw_motion_trail
from deepaccident_devkit.render.motion_cells import PALEST
from deepaccident_devkit.render.outcomes import draw_accident_outcome, draw_detection_outcome, motion_outcome
from deepaccident_devkit.render.outcomes.accident import difference_words, verdict_words
from deepaccident_devkit.render.outcomes.evaluation import render_evaluation


@pytest.fixture(scope="module")
def sample(da_motion: DeepAccident) -> str:
    """A sample of the ego, 1 s before the impact."""
    accident = next(scenario for scenario in da_motion.scenario if scenario["collision"])
    return da_motion.get_sample(accident, "ego_vehicle", accident["num_frames"] - 10)["token"]


@pytest.fixture(scope="module")
def labels(da_motion: DeepAccident, sample: str) -> MotionLabels:
    return da_motion.motion_labels(sample).to_present()


def axes(size: float = 5) -> Any:
    return detached_figure((size, size)).add_subplot()


def picture(ax: Any) -> Any:
    return np.asarray(ax.images[0].get_array())


def damaged(labels: MotionLabels) -> MotionOutput:
    """The labels without one instance, with one too many, and with one that is four cells off in later frames."""
    instance = labels.instance.copy()
    instance[instance == 3] = 0
    instance[:, 2:8, 2:12] = 90
    moved = instance[1:] == 4
    instance[1:][moved] = 0
    instance[1:][np.roll(moved, 4, axis=-2)] = 4
    return instances_of(instance, labels.config.grid)


def test_a_trail_is_opaque_at_the_present_and_paler_after(labels: MotionLabels) -> None:
    grid, instance = labels.config.grid, np.zeros((3, *labels.config.grid.shape), dtype=np.int32)
    for frame, column in enumerate((50, 56, 62)):
        instance[frame, 100:104, column : column + 8] = 1
    ax = draw_motion_trail(instances_of(instance, grid), marked={1}, ax=axes())
    red, cells = np.array(to_rgb(COLLIDER_COLOR)), picture(ax)
    assert_allclose(cells[101, 51], red)
    assert_allclose(cells[101, 57], red)  # the present is on top
    assert_allclose(cells[101, 60], 1 - (1 + PALEST) / 2 * (1 - red))
    assert_allclose(cells[101, 69], 1 - PALEST * (1 - red))
    assert_allclose(cells[90, 51], 1)
    (path,) = next(each for each in ax.collections if isinstance(each, LineCollection)).get_segments()
    assert_allclose(path, [(-50 + 0.5 * (column + 4), 1.0) for column in (50, 56, 62)])
    none = draw_motion_trail(instances_of(instance, grid), layers=["ids"], ax=axes())
    assert not none.images
    assert [text.get_text() for text in none.texts] == ["1"]


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_outputs_are_drawn_as_they_lie(labels: MotionLabels, orientation: Any) -> None:
    heads = MotionHeads.from_labels(labels).in_orientation(orientation)
    output = MotionOutput(grid=labels.config.grid.with_orientation(orientation), heads=(heads,))
    ax = draw_motion_map(output, "instance", 0, ax=axes())
    assert_array_equal((picture(ax) != 1).any(axis=-1), labels.segmentation[0] == 1)
    for name in ("offset", "flow"):
        mine = picture(draw_motion_map(output, name, 0, ax=axes()))
        assert_allclose(mine, picture(draw_motion_map(labels, name, 0, ax=axes())), atol=1e-6)


def test_outputs_have_the_rows_that_they_have(labels: MotionLabels) -> None:
    output = MotionOutput(grid=labels.config.grid, heads=(MotionHeads.from_labels(labels),))
    figure = draw_motion_output(output, fig=detached_figure((10, 8)))
    assert len(figure.axes) == 4 * (5 + 1)
    alone = instances_of(labels.instance, labels.config.grid)
    assert len(draw_motion_output(alone, fig=detached_figure((10, 3))).axes) == 5 + 1
    assert len(draw_motion_output(alone, style="trail", fig=detached_figure((6, 5))).axes) == 2
    with pytest.raises(ChoiceError, match="map: this prediction has instance alone, not flow; give heads for it"):
        draw_motion_map(alone, "flow", 0, ax=axes())
    with pytest.raises(ChoiceError, match="prediction: expected a number from 0 to 0, or from the end, found 1"):
        draw_motion_output(alone, number=1)
    with pytest.raises(ChoiceError, match="style: expected one of maps, trail, found 'film'"):
        draw_motion_output(alone, style="film")  # type: ignore[arg-type]


def test_labels_as_a_trail(da_motion: DeepAccident, sample: str) -> None:
    figure = da_motion.render_motion_labels(sample, style="trail", fig=detached_figure((6, 6)))
    assert len(figure.axes) == 2
    assert figure.get_suptitle() == sample
    with pytest.raises(ChoiceError, match="trail: each frame is in its own ego frame; warp the labels"):
        da_motion.render_motion_labels(sample, style="trail", at_present=False)
    with pytest.raises(ChoiceError, match=r"layers: expected any of .*, found 'velocities'"):
        da_motion.render_motion_labels(sample, style="trail", layers=["velocities"])


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
    assert f"PQ {counted.pq:.1f} %" in figure.get_suptitle()
    present = np.isin(labels.instance[0], 3)
    assert_allclose(picture(left)[present], np.broadcast_to(to_rgb(OUTCOME_COLORS["missed"]), (present.sum(), 3)))
    assert_allclose(picture(right)[4, 4], to_rgb(OUTCOME_COLORS["false"]))


def test_what_lies_beyond_the_range_is_not_judged(labels: MotionLabels) -> None:
    rules = replace(MotionEvaluator("released").protocol, ranges=(30.0,))
    output = instances_of(labels.instance, labels.config.grid)
    cells = motion_outcome(output, labels, rules).outcomes("true")
    here = labels.instance[0] > 0
    assert set(np.unique(cells[0][here]).tolist()) == {1, 3}


def test_accidents_have_their_metres_and_verdict(da_motion: DeepAccident, sample: str) -> None:
    true = box_truth(da_motion, sample).accident
    assert true is not None
    near = Accident(positions=true.positions + np.array([3.0, 0.0]), time=true.time + 0.5, score=0.9)
    figure = render_evaluation(da_motion, sample, [near], fig=detached_figure((10, 6)))
    left, right = figure.axes
    assert figure.get_suptitle().endswith("accident: 5 m: FP + FN, 10 m: TP, 15 m: TP")
    assert right.get_title() == f"an accident comes in {true.time:.1f} s; foreseen 6.0 m off in sum, +0.5 s"
    assert [text.get_text() for text in right.texts] == [f"in {near.time:.1f} s, score 0.9", "3.0 m", "3.0 m"]
    assert_allclose(left.lines[0].get_xydata(), true.positions)
    assert_allclose(right.lines[1].get_xydata(), near.positions)
    assert left.get_xlim() == right.get_xlim()
    assert not left.texts
    silent = render_evaluation(da_motion, sample, [], fig=detached_figure((10, 6)))
    assert silent.get_suptitle().endswith("5 m: FN, 10 m: FN, 15 m: FN")
    assert silent.axes[1].get_title().endswith("none is foreseen")


@pytest.mark.parametrize("protocol", ["released", "paper", "boxes"])
def test_motion_is_seen_as_accidents_by_every_protocol(
    da_motion: DeepAccident, sample: str, labels: MotionLabels, protocol: str
) -> None:
    instance = np.zeros_like(labels.instance)
    for frame, step in enumerate((0, 4, 8, 8, 8)):  # two that drive into each other
        instance[frame, 100:104, 110 + step : 118 + step] = 1
        instance[frame, 102:106, 139 - 2 * step : 147 - 2 * step] = 2
    output = instances_of(instance, labels.config.grid)
    figure = render_evaluation(
        da_motion, sample, output, task="accident", protocol=protocol, fig=detached_figure((9, 5))
    )
    context = accident_context(da_motion, sample, 2.0)
    rules = PROTOCOLS[protocol]
    evaluator = AccidentEvaluator(rules)
    evaluator.update(sample, output, labels, context)
    assert figure.get_suptitle().endswith(verdict_words(evaluator.compute()))
    compared = compared_accidents(output, labels, context, rules)
    assert len(compared.predicted) == 1
    true, predicted = (2 * [compared.true.positions] if compared.true else []), compared.predicted[0].positions
    drawn = [line.get_xydata() for ax in figure.axes for line in ax.lines if line.get_marker() == "o"]
    assert_allclose(drawn, true)
    crosses = [line.get_xydata() for line in figure.axes[1].lines if line.get_marker() == "x"]
    assert_allclose(crosses, [predicted])


def test_accidents_without_truth(da_motion: DeepAccident) -> None:
    normal = next(scenario for scenario in da_motion.scenario if not scenario["collision"])
    token = da_motion.get_sample(normal, "ego_vehicle", 5)["token"]
    alarm = Accident(positions=np.array([[5.0, 0.0], [7.0, 0.0]]), time=1.0)
    figure = render_evaluation(da_motion, token, [alarm], fig=detached_figure((9, 5)))
    assert figure.get_suptitle().endswith("5 m: FP, 10 m: FP, 15 m: FP")
    assert figure.axes[0].get_title() == "truth: no accident comes"
    nothing = ComparedAccidents(true=None, predicted=())
    assert difference_words(nothing) == "no accident comes, none is foreseen"
    assert not draw_accident_outcome(nothing, ax=axes()).lines


def test_detections_are_coloured_by_their_matches(da_motion: DeepAccident, sample: str) -> None:
    truth = detection_truth(da_motion, sample, "paper")
    truth = truth.select((np.abs(truth.center[:, :2]) < 50).all(axis=1))  # well within the protocol's area
    some = np.arange(2, len(truth))
    center = np.vstack([truth.center[some] + (0.3, 0.0, 0.0), [[20.0, -45.0, 0.0]]])
    detected = DetectedBoxes.from_arrays(
        center,
        np.vstack([truth.size[some], [[4.0, 2.0, 1.5]]]),
        np.append(truth.yaw[some], 0.0),
        np.linspace(1, 0.5, len(center)),
        category=np.append(truth.category[some], 0),
    )
    ax = draw_detection_outcome(detected, truth, "paper", ax=axes())
    shapes = {
        to_hex(each.get_edgecolor()[0]): each.get_paths()
        for each in ax.collections
        if isinstance(each, PolyCollection) and len(each.get_paths())
    }
    (false,) = shapes[OUTCOME_COLORS["false"]]
    assert_allclose(false.vertices[:4].mean(axis=0), (20, -45))
    missed = [path.vertices[:4].mean(axis=0) for path in shapes[OUTCOME_COLORS["missed"]]]
    assert_allclose(missed, truth.center[:2, :2], atol=1e-6)
    assert len(shapes[OUTCOME_COLORS["right"]]) == len(some)
    assert ax.get_title() == f"at 2 m: {len(some)} TP, 1 FP, 2 FN; centres off by 0.30 m on average"
    ego_from_lidar = da_motion.ego_from(sample, "lidar01")
    moved = DetectedBoxes(boxes=detected.boxes.transform(ego_from_lidar, "ego"), scores=detected.scores)
    figure = render_evaluation(da_motion, sample, moved, protocol="paper", fig=detached_figure((10, 6)))
    assert figure.axes[1].get_title().startswith(f"at 2 m: {len(some)} TP, 1 FP, ")
    assert figure.axes[0].get_title().startswith(f"true boxes: {len(some)} found, ")


def test_what_cannot_be_evaluated_is_named(da_motion: DeepAccident, sample: str) -> None:
    with pytest.raises(ChoiceError, match="task: expected accident of this prediction, found 'motion'"):
        render_evaluation(da_motion, sample, [], task="motion")
    with pytest.raises(EvaluationError, match="the released protocol compares motion"):
        render_evaluation(da_motion, sample, [], protocol="released")
    with pytest.raises(ChoiceError, match=r"layers: expected any of .*, found 'labels'"):
        render_evaluation(da_motion, sample, [], layers=["labels"])


def test_the_verdict_names_several_of_a_kind(da_motion: DeepAccident, sample: str) -> None:
    evaluator = AccidentEvaluator("boxes")
    far = Accident(positions=np.array([[40.0, 40.0], [42.0, 40.0]]), time=1.0)
    evaluator.update(sample, [far, replace(far, score=0.5)], box_truth(da_motion, sample))
    assert verdict_words(evaluator.compute()) == "5 m: 2 FP + FN, 10 m: 2 FP + FN, 15 m: 2 FP + FN"
