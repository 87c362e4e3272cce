"""Predictions beside labels, with the verdict of a protocol."""

from typing import Any

import numpy as np
import pytest
from matplotlib import pyplot as plt
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex
from support.figure_texts import STYLES, find_text_faults
from support.rendered_pixels import (
    box_footprints,
    collections_of_kind,
    ground_colors,
    read_title,
)

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
    true_accident: Any = box_truth(da_motion, sample).accident
    near = Accident(
        positions=true_accident.positions + np.array([3.0, 0.0]),
        time=true_accident.time + 0.5,
        score=0.9,
    )
    foreseen, missed = (
        render_evaluation(da_motion, sample, alarms, fig=detached_figure((10, 6)))
        for alarms in ([near], [])
    )

    outcome = "accident: FP + FN within 5 m, TP within 10/15 m; collision in 1.0 s; alarm for"
    assert outcome in read_title(foreseen)
    assert read_title(foreseen).endswith("position error 6.0 m (both actors), 0.5 s late")
    points = {line.get_marker(): line.get_xydata() for line in foreseen.axes[1].lines}
    np.testing.assert_allclose(
        [points["o"], points["x"]], [true_accident.positions, near.positions]
    )
    assert read_title(missed).endswith("FN within 5/10/15 m; collision in 1.0 s; no alarm")


def test_an_accident_is_shown_on_the_road_and_in_the_camera_that_sees_both_best(
    da: DeepAccident, approach_sample: str
) -> None:
    true_accident: Any = box_truth(da, approach_sample).accident
    foreseen = Accident(
        positions=true_accident.positions + 2.0, time=true_accident.time, ids=true_accident.ids
    )
    camera, above = render_evaluation(
        da, approach_sample, [foreseen], fig=detached_figure((12, 6))
    ).axes

    boxes = da.boxes(approach_sample, "world")
    pair = boxes.select(np.isin(boxes.actor_id, [*collider_ids(da, approach_sample)]))
    frame = da.get("sample", approach_sample)["frame_token"]
    view: Any = best_view(da, [sample["token"] for sample in da.samples_of(frame)], pair)
    agent, _, channel = view.camera.rsplit("/", 3)[1:]
    assert camera.get_title() == f"{short_name(agent)}, {camera_name(channel)}"
    np.testing.assert_array_equal(camera.images[0].get_array(), da.load_image(view.camera))

    (road,) = above.images
    assert BEV_COLORS["road"] in ground_colors(road)


def test_the_pair_that_collides_is_red_in_every_task(
    da_motion: DeepAccident, sample: str, labels: MotionLabels
) -> None:
    detected = predict_labels(da_motion, sample)
    motion = instances_of(labels.instance, labels.config.grid)
    for prediction, panels in ((detected, (0, 1)), ([], (1,)), (motion, (0, 1))):
        figure = render_evaluation(da_motion, sample, prediction, fig=detached_figure((10, 6)))
        for panel in panels:
            footprints = set()
            for shape in collections_of_kind(figure.axes[panel], PolyCollection):
                colors = {to_hex(color) for color in shape.get_edgecolor()}
                if colors == {COLLIDER_COLOR}:
                    footprints |= box_footprints(shape)
            assert len(footprints) == 2


def predict_labels(dataset: DeepAccident, sample: str) -> DetectedBoxes:
    """Predict exactly the boxes of the labels."""
    boxes = dataset.boxes(sample)
    return DetectedBoxes(boxes=boxes, scores=np.ones(len(boxes)))


@pytest.mark.slow
@pytest.mark.parametrize("medium", STYLES)
def test_words_are_in_the_picture_and_apart(
    da_motion: DeepAccident, sample: str, labels: MotionLabels, medium: Any
) -> None:
    accident = box_truth(da_motion, sample).accident
    near = Accident(positions=accident.positions + 1.5, time=accident.time, score=0.9)
    motion = instances_of(labels.instance, labels.config.grid)
    predictions = (predict_labels(da_motion, sample), [accident], [near], [], motion)

    with style(medium):
        for prediction in predictions:
            figure = render_evaluation(da_motion, sample, prediction)
            assert find_text_faults(figure) == []
            plt.close(figure)
