"""Predictions over the truth in cameras: where lines are, what they mean, and what stands around
them.
"""

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from drawing import has_color, new_axes, of_kind, on_canvas, rendered
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_hex, to_rgba
from picture_texts import text_faults

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import (
    Accident,
    DetectedBoxes,
    MotionOutput,
    box_truth,
    detection_truth,
    instances_of,
)
from deepaccident_devkit.evaluation.accident.scoring import ComparedAccidents
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.render import detached_figure, style
from deepaccident_devkit.render.boxes import NEAR_PLANE_M
from deepaccident_devkit.render.outcomes import (
    draw_outcome_in_camera,
    render_outcome_in_cameras,
    sample_verdict,
)
from deepaccident_devkit.render.outcomes.above import FORESEEN_COLOR
from deepaccident_devkit.render.outcomes.verdicts import AccidentVerdict
from deepaccident_devkit.render.styles import COLLIDER_COLOR, MISSING_COLOR, OUTCOME_COLORS
from deepaccident_devkit.taxonomy import CAMERAS, OWN_ACTOR_ID
from deepaccident_devkit.v2x.poses import camera_of

IN_ORDER = [
    f"Camera_{place}"
    for place in ("FrontLeft", "Front", "FrontRight", "BackLeft", "Back", "BackRight")
]
AHEAD = (10.0, 14.0, -1.0, 1.0)
"""First and last x, first and last y of an instance in front of the ego, metres."""


def lines_in(ax: Any, color: str, *, dashed: bool | None = None) -> list[Any]:
    """The lines (V, 2) of a colour, without casings, which are not opaque."""
    found = []
    for each in of_kind(ax, LineCollection):
        lines, fits = each.get_segments(), dashed in (None, each.get_linestyle()[0][1] is not None)
        colors = np.broadcast_to(each.get_colors(), (len(lines), 4))
        shown = [np.allclose(own, to_rgba(color), atol=1e-3) for own in colors]
        found += [line for line, its in zip(lines, shown, strict=True) if its and fits]
    return found


def gaps(places: Any, lines: Sequence[Any]) -> Any:
    """Pixels from each of some places (N, 2) to the nearest corner of lines."""
    corners = np.concatenate([*lines, np.full((1, 2), np.inf)])
    return np.linalg.norm(places[:, None] - corners, axis=-1).min(axis=1)


def on_the_ground(
    dataset: DeepAccident, sample: str, channel: str, places: Any, ground: float = 0.0
) -> Any:
    """Points (N, 3) of the optical frame of places (N, 2) of the ego frame."""
    points = np.column_stack([places, np.full(len(places), ground)])
    return dataset.ego_from(sample, channel).inverse().apply(points)


def perfect(dataset: DeepAccident, sample: str) -> DetectedBoxes:
    truth = detection_truth(dataset, sample, "released")
    return DetectedBoxes(boxes=truth, scores=np.ones(len(truth)))


def blocks(labels: MotionLabels, *frames: tuple[float, float, float, float]) -> MotionOutput:
    """An instance whose cells fill a rectangle in each frame: first and last x, first and last y,
    metres.
    """
    grid = labels.config.grid.with_orientation("devkit")
    instance = np.zeros((len(labels.instance), *grid.shape), dtype=np.int32)
    for cells, (first_x, last_x, first_y, last_y) in zip(instance, frames, strict=False):
        columns = slice(*(round((x - grid.x[0]) / grid.x[2]) for x in (first_x, last_x)))
        cells[slice(*(round((y - grid.y[0]) / grid.y[2]) for y in (first_y, last_y))), columns] = 1
    return instances_of(instance, grid)


def corners_of(rectangle: tuple[float, float, float, float]) -> Any:
    first_x, last_x, first_y, last_y = rectangle
    return np.array([(x, y) for x in (first_x, last_x) for y in (first_y, last_y)])


def verdict_of(sample: str, true: Accident | None, *alarms: Accident) -> AccidentVerdict:
    return AccidentVerdict(
        sample=sample, compared=ComparedAccidents(true=true, predicted=alarms), truth=None, words=""
    )


def outcomes(ax: Any) -> list[str]:
    """The kinds of outcomes that have lines."""
    return [kind for kind, color in OUTCOME_COLORS.items() if lines_in(ax, color)]


def in_camera(da: DeepAccident, verdict: Any, channel: str = "Camera_Front", **how: Any) -> Any:
    return draw_outcome_in_camera(da, verdict, channel, ax=new_axes(how.pop("size", (5, 5))), **how)


def test_detected_boxes_are_where_the_labels_have_them(da: DeepAccident, approach: str) -> None:
    given, seen = perfect(da, approach), 0
    verdict: Any = sample_verdict(da, approach, given)
    counted = set(given.boxes.actor_id[verdict.matches.truth].tolist()) - {OWN_ACTOR_ID}
    for channel in CAMERAS:
        ax, boxes = in_camera(da, verdict, channel, size=(4, 2.5)), da.boxes(approach, channel)
        lens = camera_of(da, f"{approach}/{channel}")
        corners = boxes.corners()[np.isin(boxes.actor_id, [*counted])].reshape(-1, 3)
        pixels, depth = lens.project(corners[corners[:, 2] > NEAR_PLANE_M])
        for color in (OUTCOME_COLORS["right"], "black"):
            assert gaps(pixels, lines_in(ax, color, dashed=False)).max(initial=0) < 1e-6
        assert set(outcomes(ax)) <= {"right"}
        inside = pixels[lens.in_image(pixels, depth, min_depth=NEAR_PLANE_M, margin=2)]
        seen += len(inside)
        if channel == "Camera_Front":
            picture = rendered(ax)
            assert {
                has_color(picture, place, OUTCOME_COLORS["right"])
                for place in on_canvas(ax, inside)
            } == {True}
    assert seen > 20


def test_a_shifted_box_is_false_and_the_true_one_missed(da: DeepAccident, approach: str) -> None:
    given = perfect(da, approach)
    verdict: Any = sample_verdict(da, approach, given)
    to_camera = da.world_from(approach, "Camera_Front").inverse() @ da.world_from(
        approach, given.boxes.frame
    )
    depth, center = to_camera.apply(given.boxes.center)[:, 2], given.boxes.center.copy()
    row = min(
        (each for each in verdict.matches.truth.tolist() if depth[each] > 5),
        key=lambda each: depth[each],
    )
    center[row] = [*center[row, :2] * 0.5, center[row, 2] + 30.0]
    moved = DetectedBoxes(boxes=replace(given.boxes, center=center), scores=given.scores)
    ax = in_camera(da, sample_verdict(da, approach, moved))
    shown = {}
    for kind, boxes in (("false", moved.boxes), ("missed", given.boxes)):
        corners = boxes.select([row]).transform(to_camera, "Camera_Front").corners()[0]
        shown[kind], _ = camera_of(da, f"{approach}/Camera_Front").project(corners)
        lines = lines_in(ax, OUTCOME_COLORS[kind], dashed=kind == "missed")
        assert (len(lines), gaps(shown[kind], lines).max() < 1e-6) == (12, True)
    for color in (OUTCOME_COLORS["right"], "black"):
        assert gaps(shown["missed"], lines_in(ax, color)).max() > 0.1


def test_cells_are_polygons_on_the_ground(
    da_motion: DeepAccident, sample: str, labels: MotionLabels
) -> None:
    later, color = (20.0, 22.0, 3.0, 4.0), OUTCOME_COLORS["false"]
    verdict = sample_verdict(da_motion, sample, blocks(labels, AHEAD, AHEAD, later), label=labels)
    for frame, rectangle in ((None, AHEAD), (0, AHEAD), (2, later)):
        ax = in_camera(da_motion, verdict, frame=frame)
        (line,) = lines_in(ax, color, dashed=False)
        ground = on_the_ground(da_motion, sample, "Camera_Front", corners_of(rectangle))
        corners, _ = camera_of(da_motion, f"{sample}/Camera_Front").project(ground)
        assert gaps(corners, [line]).max() < 1e-6
        np.testing.assert_allclose(
            [line[:, 1].min(), line[:, 1].max()],
            [corners[:, 1].min(), corners[:, 1].max()],
            atol=1e-6,
        )
        shapes = [
            each
            for each in ax.collections
            if isinstance(each, PolyCollection) and len(each.get_paths())
        ]
        (filled,) = [each for each in shapes if to_hex(each.get_facecolor()[0]) == color]
        assert filled.get_paths()[0].contains_point(corners.mean(axis=0))
        assert "right" not in outcomes(ax)


def test_instances_are_judged_frame_by_frame(
    da_motion: DeepAccident, sample: str, labels: MotionLabels
) -> None:
    shown = labels.instance.copy()
    shown[1:] = 0  # exact now, and nothing later
    verdict = sample_verdict(
        da_motion, sample, instances_of(shown, labels.config.grid), label=labels
    )
    kinds = [
        outcomes(in_camera(da_motion, verdict, "Camera_Back", frame=frame)) for frame in (0, 2)
    ]
    assert kinds == [["right"], ["missed"]]


@pytest.mark.parametrize(("agent", "ground"), [("ego_vehicle", 0.0), ("infrastructure", -4.0)])
def test_places_of_accidents_are_on_the_ground(
    da: DeepAccident, approach: str, agent: str, ground: float
) -> None:
    sample = approach.replace("ego_vehicle", agent)
    assert abs(np.median(da.boxes(sample, "ego").bottom_corners()[..., 2]) - ground) < 0.7
    true = Accident(positions=np.array([[15.0, 2.0], [18.0, -1.0]]), time=1.5)
    alarm = Accident(positions=np.array([[14.0, 3.0], [17.0, 0.0]]), time=1.2, score=0.8)
    ax = in_camera(da, verdict_of(sample, true, alarm), size=(8, 4.5))
    lens, ego_from_camera = (
        camera_of(da, f"{sample}/Camera_Front"),
        da.ego_from(sample, "Camera_Front"),
    )

    def grounded(pixels: Any) -> Any:
        """Where rays through pixels meet the ground, in the ego frame."""
        rays = ego_from_camera.rotate(
            np.insert(pixels, 2, 1, axis=1) @ np.linalg.inv(lens.intrinsic).T
        )
        share = (ground - ego_from_camera.translation[2]) / rays[:, 2]
        return (ego_from_camera.translation + share[:, None] * rays)[:, :2]

    lines = lines_in(ax, COLLIDER_COLOR)
    rings = [grounded(line) for line in lines if len(line) > 4]
    for ring, place in zip(rings, true.positions, strict=True):
        np.testing.assert_allclose(np.linalg.norm(ring - place, axis=1), 1.0)
    crosses = np.array(
        [grounded(line) for line in lines_in(ax, FORESEEN_COLOR) if len(line) == 2][-4:]
    )
    np.testing.assert_allclose(
        crosses.mean(axis=1), np.repeat(alarm.positions, 2, axis=0), atol=1e-9
    )


def predictions(
    dataset: DeepAccident, token: str, labels: MotionLabels
) -> list[tuple[Any, dict[str, Any]]]:
    accident: Any = box_truth(dataset, token).accident
    near = Accident(positions=accident.positions + 1.5, time=accident.time, score=0.9)
    motion = instances_of(np.roll(labels.instance, 2, axis=-1), labels.config.grid)
    hows = ({}, {"task": "accident", "protocol": "boxes"}, {"label": labels})
    return [
        *((given, {}) for given in (perfect(dataset, token), [near], [])),
        *((motion, how) for how in hows),
    ]


def test_a_missing_image_is_a_grey_panel_with_the_prediction(
    da_partial: DeepAccident, approach: str
) -> None:
    given = perfect(da_partial, approach)
    figure = render_outcome_in_cameras(da_partial, approach, given, fig=detached_figure((10, 4)))
    front, back = (figure.axes[IN_ORDER.index(f"Camera_{place}")] for place in ("Front", "Back"))
    assert (len(front.images), len(back.images), to_hex(front.get_facecolor())) == (
        0,
        1,
        MISSING_COLOR,
    )
    assert len(lines_in(front, OUTCOME_COLORS["right"])) >= 12


@pytest.mark.slow
@pytest.mark.parametrize("where", [None, "paper", "slide"])
def test_words_are_in_the_picture_and_apart(
    da_motion: DeepAccident, sample: str, labels: MotionLabels, where: Any
) -> None:
    with style(where) if where else nullcontext():
        for given, how in predictions(da_motion, sample, labels):
            assert text_faults(render_outcome_in_cameras(da_motion, sample, given, **how)) == []
