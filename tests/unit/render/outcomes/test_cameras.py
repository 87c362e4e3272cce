"""Predictions over the truth in cameras: where the lines are and what they mean."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_hex, to_rgba
from support.figure_texts import STYLES, find_text_faults
from support.rendered_pixels import collections_of_kind, new_axes

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import (
    Accident,
    DetectedBoxes,
    MotionOutput,
    box_truth,
    detection_truth,
    instances_of,
)
from deepaccident_devkit.evaluation.drawing import Drawing, DrawnPlaces
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.render import detached_figure, style
from deepaccident_devkit.render.boxes import NEAR_PLANE_M
from deepaccident_devkit.render.outcomes import render_outcome_in_cameras
from deepaccident_devkit.render.outcomes.described import sample_drawing
from deepaccident_devkit.render.outcomes.drawings import (
    best_camera_of_drawing,
    draw_drawing_in_camera,
)
from deepaccident_devkit.render.styles import MISSING_COLOR, OUTCOME_COLORS, PREDICTED_COLOR
from deepaccident_devkit.taxonomy import CAMERAS, OWN_ACTOR_ID
from deepaccident_devkit.v2x.poses import camera_of

CAMERAS_IN_ORDER = [
    "Camera_FrontLeft",
    "Camera_Front",
    "Camera_FrontRight",
    "Camera_BackLeft",
    "Camera_Back",
    "Camera_BackRight",
]
AHEAD_M = (10.0, 14.0, -1.0, 1.0)  # first and last x, first and last y, in front of the ego


def find_lines(ax: Any, color: str, *, dashed: bool | None = None) -> list[Any]:
    """Return the lines (V, 2) of a colour, without their casings, which are not opaque."""
    lines_of_color = []
    for collection in collections_of_kind(ax, LineCollection):
        is_dashed = collection.get_linestyle()[0][1] is not None
        if dashed not in (None, is_dashed):
            continue
        lines = collection.get_segments()
        line_colors = np.broadcast_to(collection.get_colors(), (len(lines), 4))
        for line, line_color in zip(lines, line_colors, strict=True):
            if np.allclose(line_color, to_rgba(color), atol=1e-3):
                lines_of_color.append(line)
    return lines_of_color


def distances_to_lines(pixels: Any, lines: Sequence[Any]) -> Any:
    """Return the distances (N,), in pixels, from pixels (N, 2) to the nearest corner of lines."""
    corners = np.concatenate([*lines, np.full((1, 2), np.inf)])
    distances = np.linalg.norm(pixels[:, None] - corners, axis=-1)
    return distances.min(axis=1)


def ground_in_camera(
    dataset: DeepAccident, sample: str, channel: str, positions: Any, ground: float = 0.0
) -> Any:
    """Transform ground positions (N, 2) of the ego frame to points (N, 3) of the optical frame."""
    points = np.column_stack([positions, np.full(len(positions), ground)])
    return dataset.ego_from(sample, channel).inverse().apply(points)


def predict_labels(dataset: DeepAccident, sample: str) -> DetectedBoxes:
    """Predict exactly the boxes of the labels."""
    truth = detection_truth(dataset, sample, "released")
    return DetectedBoxes(boxes=truth, scores=np.ones(len(truth)))


def predict_rectangles(
    labels: MotionLabels, *frames: tuple[float, float, float, float]
) -> MotionOutput:
    """Predict an instance that fills a rectangle in each frame: first and last x, first and last y,
    metres.
    """
    grid = labels.config.grid.with_orientation("devkit")
    min_x, _, x_step = grid.x
    min_y, _, y_step = grid.y
    instance = np.zeros((len(labels.instance), *grid.shape), dtype=np.int32)
    for cells, (first_x, last_x, first_y, last_y) in zip(instance, frames, strict=False):
        first_column, last_column = (round((x - min_x) / x_step) for x in (first_x, last_x))
        first_row, last_row = (round((y - min_y) / y_step) for y in (first_y, last_y))
        cells[first_row:last_row, first_column:last_column] = 1
    return instances_of(instance, grid)


def rectangle_corners(rectangle: tuple[float, float, float, float]) -> Any:
    first_x, last_x, first_y, last_y = rectangle
    return np.array([(x, y) for x in (first_x, last_x) for y in (first_y, last_y)])


def find_outcomes(ax: Any) -> list[str]:
    """Return the kinds of outcomes that have lines."""
    return [kind for kind, color in OUTCOME_COLORS.items() if find_lines(ax, color)]


def draw_in_camera(
    da: DeepAccident,
    sample: str,
    prediction: Any,
    channel: str = "Camera_Front",
    *,
    size: tuple[float, float] = (5, 5),
    frame: int = 0,
) -> Any:
    ax = new_axes(size)
    drawing = sample_drawing(da, sample, prediction).drawing
    draw_drawing_in_camera(da, sample, drawing, f"{sample}/{channel}", ax, frame=frame)
    return ax


def test_detected_boxes_are_where_the_labels_have_them(
    da: DeepAccident, approach_sample: str
) -> None:
    detected = predict_labels(da, approach_sample)
    drawing = sample_drawing(da, approach_sample, detected).drawing
    (found,) = [drawn.boxes for drawn in drawing.boxes if drawn.role == "truth"]
    matched_ids = {*found.actor_id.tolist()} - {OWN_ACTOR_ID}
    num_corners = 0
    for channel in CAMERAS:
        ax = draw_in_camera(da, approach_sample, detected, channel, size=(4, 2.5))

        boxes = da.boxes(approach_sample, channel)
        corners = boxes.corners()[np.isin(boxes.actor_id, [*matched_ids])].reshape(-1, 3)
        camera = camera_of(da, f"{approach_sample}/{channel}")
        pixels, depth = camera.project(corners[corners[:, 2] > NEAR_PLANE_M])
        for color in (OUTCOME_COLORS["right"], "black"):
            distances = distances_to_lines(pixels, find_lines(ax, color, dashed=False))
            assert distances.max(initial=0) < 1e-6
        assert set(find_outcomes(ax)) <= {"right"}
        assert not ax.texts  # all scores are 1

        in_image = camera.in_image(pixels, depth, min_depth=NEAR_PLANE_M, margin=2)
        num_corners += in_image.sum()
    assert num_corners > 20


def test_a_shifted_box_is_false_and_the_true_one_missed(
    da: DeepAccident, approach_sample: str
) -> None:
    exact = predict_labels(da, approach_sample)
    camera_from_boxes = da.world_from(approach_sample, "Camera_Front").inverse() @ da.world_from(
        approach_sample, exact.boxes.frame
    )
    depth = camera_from_boxes.apply(exact.boxes.center)[:, 2]
    row = int(np.where(depth > 5, depth, np.inf).argmin())
    center = exact.boxes.center.copy()
    center[row] = [*center[row, :2] * 0.5, center[row, 2] + 30.0]
    scores = np.linspace(0.3, 0.7, len(center))
    shifted = DetectedBoxes(boxes=replace(exact.boxes, center=center), scores=scores)

    ax = draw_in_camera(da, approach_sample, shifted)

    camera = camera_of(da, f"{approach_sample}/Camera_Front")
    for kind, boxes in (("false", shifted.boxes), ("missed", exact.boxes)):
        box_in_camera = boxes.select([row]).transform(camera_from_boxes, "Camera_Front")
        pixels, _ = camera.project(box_in_camera.corners()[0])
        lines = find_lines(ax, OUTCOME_COLORS[kind], dashed=kind == "missed")
        assert len(lines) == 12
        assert distances_to_lines(pixels, lines).max() < 1e-6
    missed_pixels = pixels
    for color in (OUTCOME_COLORS["right"], "black"):
        assert distances_to_lines(missed_pixels, find_lines(ax, color)).max() > 0.1
    written = [text.get_text() for text in ax.texts]
    assert 0 < len(written) <= 10
    assert {*written} <= {f"{score:.2f}" for score in scores.tolist()}


def test_cells_are_polygons_on_the_ground(
    da_motion: DeepAccident, sample: str, labels: MotionLabels
) -> None:
    later = (20.0, 22.0, 3.0, 4.0)
    output = predict_rectangles(labels, AHEAD_M, AHEAD_M, later)
    camera = camera_of(da_motion, f"{sample}/Camera_Front")
    color = OUTCOME_COLORS["false"]
    for frame, rectangle in ((0, AHEAD_M), (2, later)):
        ax = draw_in_camera(da_motion, sample, output, frame=frame)

        (line,) = find_lines(ax, color, dashed=False)
        ground_corners = rectangle_corners(rectangle)
        points = ground_in_camera(da_motion, sample, "Camera_Front", ground_corners)
        corners, _ = camera.project(points)
        assert distances_to_lines(corners, [line]).max() < 1e-6
        np.testing.assert_allclose(
            [line[:, 1].min(), line[:, 1].max()],
            [corners[:, 1].min(), corners[:, 1].max()],
            atol=1e-6,
        )

        (filled,) = [
            shape
            for shape in ax.collections
            if isinstance(shape, PolyCollection)
            and len(shape.get_paths())
            and to_hex(shape.get_facecolor()[0]) == color
        ]
        assert filled.get_paths()[0].contains_point(corners.mean(axis=0))
        assert "right" not in find_outcomes(ax)


def test_instances_are_judged_frame_by_frame(
    da_motion: DeepAccident, sample: str, labels: MotionLabels
) -> None:
    instance = labels.instance.copy()
    instance[1:] = 0  # exact now, and nothing later
    output = instances_of(instance, labels.config.grid)
    present, later = (
        draw_in_camera(da_motion, sample, output, "Camera_Back", frame=frame) for frame in (0, 2)
    )

    assert find_outcomes(present) == ["right"]
    assert find_outcomes(later) == ["missed"]


@pytest.mark.parametrize(("agent", "ground"), [("ego_vehicle", 0.0), ("infrastructure", -4.0)])
def test_places_are_on_the_ground(
    da: DeepAccident, approach_sample: str, agent: str, ground: float
) -> None:
    sample = approach_sample.replace("ego_vehicle", agent)
    box_bottoms = da.boxes(sample, "ego").bottom_corners()[..., 2]
    assert abs(np.median(box_bottoms) - ground) < 0.7
    alarm = Accident(positions=np.array([[14.0, 3.0], [17.0, 0.0]]), time=1.2, score=0.8)

    ax = draw_in_camera(da, sample, [alarm], size=(8, 4.5))

    points = ground_in_camera(da, sample, "Camera_Front", alarm.positions, ground)
    pixels, _ = camera_of(da, f"{sample}/Camera_Front").project(points)
    assert distances_to_lines(pixels, find_lines(ax, PREDICTED_COLOR)).max() < 1e-6
    assert "in 1.2 s, score 0.8" in [text.get_text() for text in ax.texts]


def test_what_is_below_the_images_of_the_pole_does_not_choose_its_camera(
    da: DeepAccident, approach_sample: str
) -> None:
    sample = approach_sample.replace("ego_vehicle", "infrastructure")
    positions = np.array([[1.5, 0.0], [1.6, 0.0], [1.7, 0.0], [-20.0, 0.0]])
    place = DrawnPlaces(xy=positions, time=0.0, role="predicted")
    camera = best_camera_of_drawing(da, sample, Drawing(places=(place,)))
    assert camera == f"{sample}/Camera_Back"


def make_predictions(
    dataset: DeepAccident, token: str, labels: MotionLabels
) -> list[tuple[Any, dict[str, Any]]]:
    """Make predictions of every kind, each with the options to judge it with."""
    accident: Any = box_truth(dataset, token).accident
    near = Accident(positions=accident.positions + 1.5, time=accident.time, score=0.9)
    motion = instances_of(np.roll(labels.instance, 2, axis=-1), labels.config.grid)
    exact = predict_labels(dataset, token)
    detected = DetectedBoxes(boxes=exact.boxes, scores=np.linspace(0.2, 0.9, len(exact)))
    return [
        (detected, {}),
        ([near], {}),
        ([], {}),
        (motion, {"frame": 2}),
        (motion, {"task": "accident", "protocol": "boxes"}),
    ]


def test_a_missing_image_is_a_grey_panel_with_the_prediction(
    da_partial: DeepAccident, approach_sample: str
) -> None:
    figure = render_outcome_in_cameras(
        da_partial,
        approach_sample,
        predict_labels(da_partial, approach_sample),
        fig=detached_figure((10, 4)),
    )
    panels = dict(zip(CAMERAS_IN_ORDER, figure.axes, strict=False))
    front = panels["Camera_Front"]

    assert len(front.images) == 0
    assert to_hex(front.get_facecolor()) == MISSING_COLOR
    assert len(find_lines(front, OUTCOME_COLORS["right"])) >= 12
    assert len(panels["Camera_Back"].images) == 1


@pytest.mark.slow
@pytest.mark.parametrize("medium", STYLES)
def test_words_are_in_the_picture_and_apart(
    da_motion: DeepAccident, sample: str, labels: MotionLabels, medium: Any
) -> None:
    with style(medium):
        for prediction, options in make_predictions(da_motion, sample, labels):
            figure = render_outcome_in_cameras(da_motion, sample, prediction, **options)
            assert find_text_faults(figure) == []
