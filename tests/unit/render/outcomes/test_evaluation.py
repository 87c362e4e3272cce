"""Predictions beside labels, with the verdict of a protocol."""

from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest
from drawing import of_kind, title_of
from matplotlib import pyplot as plt
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex
from matplotlib.contour import ContourSet
from picture_texts import text_faults

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import (
    Accident,
    DetectedBoxes,
    box_truth,
    instances_of,
)
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.render import detached_figure, style
from deepaccident_devkit.render.boxes import camera_name, collider_ids
from deepaccident_devkit.render.camera import best_view
from deepaccident_devkit.render.outcomes.evaluation import (
    render_evaluation,
)
from deepaccident_devkit.render.styles import BEV_COLORS, COLLIDER_COLOR
from deepaccident_devkit.taxonomy import short_name


def test_accidents_have_their_metres_and_verdict(da_motion: DeepAccident, sample: str) -> None:
    true: Any = box_truth(da_motion, sample).accident
    near = Accident(
        positions=true.positions + np.array([3.0, 0.0]), time=true.time + 0.5, score=0.9
    )
    figure, silent = (
        render_evaluation(da_motion, sample, given, fig=detached_figure((10, 6)))
        for given in ([near], [])
    )
    above = figure.axes[1]
    assert title_of(figure).endswith("accident: 5 m: FP + FN, 10 m: TP, 15 m: TP")
    marked = {
        line.get_marker(): line.get_xydata()
        for line in above.lines
        if line.get_marker() in ("o", "x")
    }
    np.testing.assert_allclose([marked["o"], marked["x"]], [true.positions, near.positions])
    assert title_of(silent).endswith("5 m: FN, 10 m: FN, 15 m: FN")


def test_an_accident_is_shown_on_the_road_and_in_the_camera_that_sees_both_best(
    da: DeepAccident, approach: str
) -> None:
    true: Any = box_truth(da, approach).accident
    named = Accident(positions=true.positions + 2.0, time=true.time, ids=true.ids)
    camera, above = render_evaluation(da, approach, [named], fig=detached_figure((12, 6))).axes
    own = da.boxes(approach, "world")
    pair = own.select(np.isin(own.actor_id, [*collider_ids(da, approach)]))
    moment = da.get("sample", approach)["frame_token"]
    best: Any = best_view(da, [each["token"] for each in da.samples_of(moment)], pair)
    agent, _, channel = best.camera.rsplit("/", 3)[1:]
    assert camera.get_title() == f"{short_name(agent)}, {camera_name(channel)}"
    np.testing.assert_array_equal(camera.images[0].get_array(), da.load_image(best.camera))
    (road,) = above.images
    assert BEV_COLORS["road"] in {
        to_hex(color / 255) for color in np.unique(road.get_array().reshape(-1, 3), axis=0)
    }
    corners = [
        path.vertices[:4] for each in of_kind(above, PolyCollection) for path in each.get_paths()
    ]
    middles = np.mean(corners, axis=1)
    assert np.linalg.norm(middles[:, None] - true.positions, axis=-1).min(axis=0).max() < 1.0


def test_the_pair_that_collides_is_red_in_every_task(
    da_motion: DeepAccident, sample: str, labels: MotionLabels
) -> None:
    assert len(collider_ids(da_motion, sample)) == 2
    accident, boxes = box_truth(da_motion, sample).accident, da_motion.boxes(sample)
    detected = DetectedBoxes(boxes=boxes, scores=np.ones(len(boxes)))
    motion = instances_of(labels.instance, labels.config.grid)
    for prediction, panel, count in ((detected, 0, 2), ([accident], 1, 4), (motion, 0, 2)):
        ax = render_evaluation(da_motion, sample, prediction, fig=detached_figure((10, 6))).axes[
            panel
        ]
        edges = [each for each in ax.collections if isinstance(each, (ContourSet, PolyCollection))]
        colors = [to_hex(color) for each in edges for color in each.get_edgecolor()]
        assert colors.count(COLLIDER_COLOR) == count  # of an accident also at the impact


def faults_of_predictions(dataset: DeepAccident, token: str) -> list[str]:
    """What is wrong with the words of detections, and of accidents that are foreseen exactly,
    nearly and not at all.
    """
    boxes, accident = dataset.boxes(token), box_truth(dataset, token).accident
    near = Accident(positions=accident.positions + 1.5, time=accident.time, score=0.9)
    detected, faults = DetectedBoxes(boxes=boxes, scores=np.ones(len(boxes))), []
    for given in (detected, [accident], [near], []):
        picture = render_evaluation(dataset, token, given)
        faults += text_faults(picture)
        plt.close(picture)
    return faults


@pytest.mark.slow
@pytest.mark.parametrize("where", [None, "paper"])
def test_words_are_in_the_picture_and_apart(
    da_motion: DeepAccident, sample: str, labels: MotionLabels, where: Any
) -> None:
    with style(where) if where else nullcontext():
        assert faults_of_predictions(da_motion, sample) == []
        output = instances_of(labels.instance, labels.config.grid)
        assert text_faults(render_evaluation(da_motion, sample, output)) == []
