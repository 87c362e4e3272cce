"""Outcomes from above agree with the metrics, and are drawn where they are."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex, to_rgb
from support.rendered_pixels import read_title
from support.replay_page import normal_scenario

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import (
    Accident,
    DetectedBoxes,
    MotionEvaluator,
    MotionOutput,
    box_truth,
    detection_truth,
    instances_of,
)
from deepaccident_devkit.evaluation.drawing import Drawing
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.render import detached_figure
from deepaccident_devkit.render.outcomes import render_evaluation
from deepaccident_devkit.render.outcomes.described import sample_drawing
from deepaccident_devkit.render.styles import MUTED_COLOR, OUTCOME_COLORS


def test_an_alarm_where_no_accident_comes(da_motion: DeepAccident) -> None:
    token = da_motion.get_sample(normal_scenario(da_motion), "ego_vehicle", 5)["token"]
    alarm = Accident(positions=np.array([[5.0, 0.0], [7.0, 0.0]]), time=1.0)
    figure = render_evaluation(da_motion, token, [alarm], fig=detached_figure((9, 5)))
    assert read_title(figure).endswith(
        "FP within 5/10/15 m; no collision ahead; alarm for a collision in 1.0 s, score 1"
    )
    assert [ax.get_title() for ax in figure.axes] == ["ego, front", ""]


def test_the_outcome_names_several_of_a_kind(da_motion: DeepAccident, sample: str) -> None:
    far = Accident(positions=np.array([[40.0, 40.0], [42.0, 40.0]]), time=1.0)
    described = sample_drawing(da_motion, sample, [far, replace(far, score=0.5)])
    assert described.words.startswith("accident: 2 FP + FN within 5/10/15 m; collision in 1.0 s")


def test_the_pair_and_its_paths_lead_to_the_collision(da_motion: DeepAccident, sample: str) -> None:
    accident: Any = box_truth(da_motion, sample).accident
    drawing = sample_drawing(da_motion, sample, []).drawing

    (pair,) = drawing.boxes
    assert {*pair.boxes.actor_id.tolist()} == {*accident.ids}
    starts = {tuple(path.xy[0].round(1)) for path in drawing.paths}
    assert starts == {tuple(center.round(1)) for center in pair.boxes.center[:, :2]}
    ends = [path.xy[-1] for path in drawing.paths]
    distances = np.linalg.norm(np.array(ends)[:, None] - accident.positions, axis=-1)
    assert distances.min(axis=0).max() < 0.01
    assert drawing.alarm is not None
    assert not drawing.alarm.fires


def test_detections_are_coloured_by_their_matches(da_motion: DeepAccident, sample: str) -> None:
    truth = detection_truth(da_motion, sample, "paper")
    is_near = (np.abs(truth.center[:, :2]) < 50).all(axis=1)  # well within the protocol's area
    missed, *matched = np.flatnonzero(is_near).tolist()
    center = np.vstack([truth.center[matched] + [0.3, 0.0, 0.0], [[20.0, -45.0, 0.0]]])
    detected = DetectedBoxes.from_arrays(
        center,
        np.vstack([truth.size[matched], [[4.0, 2.0, 1.5]]]),
        np.append(truth.yaw[matched], 0.0),
        np.linspace(1, 0.5, len(center)),
        category=np.append(truth.category[matched], 0),
        frame="lidar",
    )

    figure = render_evaluation(
        da_motion, sample, detected, protocol="paper", fig=detached_figure((9, 5))
    )

    centers = {}
    for shape in figure.axes[1].collections:
        if isinstance(shape, PolyCollection) and len(shape.get_paths()):
            color = to_hex(shape.get_edgecolor()[0])
            vertices = [path.vertices[:4].mean(axis=0) for path in shape.get_paths()]
            centers.setdefault(color, vertices)
    ego_from_world = da_motion.world_from(sample, "ego").inverse()
    ego_from_lidar = ego_from_world @ da_motion.world_from(sample, "lidar")
    false_center, missed_center = ego_from_lidar.apply(np.array([center[-1], truth.center[missed]]))
    np.testing.assert_allclose(centers[OUTCOME_COLORS["false"]], [false_center[:2]], atol=1e-6)
    drawn_missed = np.array(centers[MUTED_COLOR])
    assert np.linalg.norm(drawn_missed - missed_center[:2], axis=1).min() < 1e-6
    assert figure.axes[1].get_title() == f"prediction: {len(matched)} detected, 1 false"


def damage_instances(labels: MotionLabels) -> MotionOutput:
    """Predict the labels without instance 3, with an extra instance 90, and with instance 4 off by
    four cells in later frames.
    """
    instance = np.where(labels.instance == 3, 0, labels.instance)
    instance[:, 2:8, 2:12] = 90
    is_moved = instance[1:] == 4
    instance[1:][is_moved] = 0
    instance[1:][np.roll(is_moved, 4, axis=-2)] = 4
    return instances_of(instance, labels.config.grid)


def counted_instances(drawing: Drawing) -> dict[str, int]:
    """Count the instances of each role over all frames."""
    return {
        cells.role: sum(len(np.unique(ids[ids > 0])) for ids in cells.instance)
        for cells in drawing.cells
    }


def test_motion_outcomes_agree_with_the_counts(
    da_motion: DeepAccident, sample: str, labels: MotionLabels
) -> None:
    output = damage_instances(labels)
    evaluator = MotionEvaluator("released")
    evaluator.update(sample, output, labels)
    expected = evaluator.compute().ranges["100x100"]

    counts = counted_instances(sample_drawing(da_motion, sample, output).drawing)

    assert counts["truth"] == counts["right"] == expected.true_positive > 0
    assert counts["missed"] == expected.false_negative > 0
    assert counts["false"] == expected.false_positive > 0

    figure = render_evaluation(da_motion, sample, output, fig=detached_figure((10, 6)))
    left, right = figure.axes
    assert left.get_title() == f"truth: {counts['truth']} found, {counts['missed']} missed"
    assert right.get_title() == f"prediction: {counts['right']} right, {counts['false']} false"
    missed_cells = left.images[-1].get_array()[labels.instance[0] == 3]
    missed_color = [*to_rgb(OUTCOME_COLORS["missed"]), 1]
    np.testing.assert_allclose(missed_cells, np.tile(missed_color, (len(missed_cells), 1)))
    cells = right.images[-1].get_array()
    np.testing.assert_allclose(cells[4, 4], [*to_rgb(OUTCOME_COLORS["false"]), 1])
    assert cells[30, 4, 3] == 0  # the road shows through free cells


def test_what_lies_beyond_the_range_is_not_judged(
    da_motion: DeepAccident,
    sample: str,
    labels: MotionLabels,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    output = instances_of(labels.instance, labels.config.grid)
    all_counts = counted_instances(sample_drawing(da_motion, sample, output).drawing)
    monkeypatch.setattr("deepaccident_devkit.evaluation.motion.RANGES", {"30x30": 30.0})
    counts = counted_instances(sample_drawing(da_motion, sample, output).drawing)
    assert 0 < counts["right"] < all_counts["right"]
    assert counts["false"] == counts["missed"] == 0
