"""Predictions over the truth in cameras: where lines are, what they mean, and what stands around them."""

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from drawing import has_color, legend_words, new_axes, of_kind, on_canvas, rendered, texts, title_of, words
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_hex, to_rgba
from picture_texts import text_faults
from wording import lacking

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
from deepaccident_devkit.render.boxes import NEAREST_DRAWN, camera_name
from deepaccident_devkit.render.outcomes import (
    draw_outcome_in_camera,
    render_evaluation,
    render_outcome_in_cameras,
    sample_verdict,
)
from deepaccident_devkit.render.outcomes.above import FORESEEN_COLOR
from deepaccident_devkit.render.outcomes.verdicts import AccidentVerdict
from deepaccident_devkit.render.styles import COLLIDER_COLOR, MISSING_COLOR, OUTCOME_COLORS
from deepaccident_devkit.taxonomy import CAMERAS, OWN_ACTOR_ID
from deepaccident_devkit.v2x.poses import camera_of

IN_ORDER = [f"Camera_{place}" for place in ("FrontLeft", "Front", "FrontRight", "BackLeft", "Back", "BackRight")]
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


def on_the_ground(dataset: DeepAccident, sample: str, channel: str, places: Any, ground: float = 0.0) -> Any:
    """Points (N, 3) of the optical frame of places (N, 2) of the ego frame."""
    points = np.column_stack([places, np.full(len(places), ground)])
    return dataset.ego_from(sample, channel).inverse().apply(points)


def perfect(dataset: DeepAccident, sample: str) -> DetectedBoxes:
    truth = detection_truth(dataset, sample, "released")
    return DetectedBoxes(boxes=truth, scores=np.ones(len(truth)))


def blocks(labels: MotionLabels, *frames: tuple[float, float, float, float]) -> MotionOutput:
    """An instance whose cells fill a rectangle in each frame: first and last x, first and last y, metres."""
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
    return AccidentVerdict(sample=sample, compared=ComparedAccidents(true=true, predicted=alarms), truth=None, words="")


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
        pixels, depth = lens.project(corners[corners[:, 2] > NEAREST_DRAWN])
        for color in (OUTCOME_COLORS["right"], "black"):
            assert gaps(pixels, lines_in(ax, color, dashed=False)).max(initial=0) < 1e-6
        assert set(outcomes(ax)) <= {"right"}
        inside = pixels[lens.in_image(pixels, depth, min_depth=NEAREST_DRAWN, margin=2)]
        seen += len(inside)
        if channel == "Camera_Front":
            picture = rendered(ax)
            assert {has_color(picture, place, OUTCOME_COLORS["right"]) for place in on_canvas(ax, inside)} == {True}
    assert seen > 20


def test_a_shifted_box_is_false_and_the_true_one_missed(da: DeepAccident, approach: str) -> None:
    given = perfect(da, approach)
    verdict: Any = sample_verdict(da, approach, given)
    to_camera = da.world_from(approach, "Camera_Front").inverse() @ da.world_from(approach, given.boxes.frame)
    depth, center = to_camera.apply(given.boxes.center)[:, 2], given.boxes.center.copy()
    row = min((each for each in verdict.matches.truth.tolist() if depth[each] > 5), key=lambda each: depth[each])
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


def test_the_box_around_the_cameras_is_left_out(da: DeepAccident, approach: str) -> None:
    given = perfect(da, approach)
    own = given.boxes.actor_id == OWN_ACTOR_ID
    boxes = replace(given.boxes, size=np.where(own[:, None], 2 * given.boxes.size, given.boxes.size))
    nothing = DetectedBoxes(boxes=boxes.select([]), scores=given.scores[:0])
    verdicts: list[Any] = [sample_verdict(da, approach, each) for each in (given, nothing)]
    for rows in (verdicts[0].matches.truth, verdicts[1].matches.missed):
        assert OWN_ACTOR_ID in boxes.actor_id[rows]
    to_camera = da.world_from(approach, "Camera_Front").inverse() @ da.world_from(approach, boxes.frame)
    corners = boxes.select(own).transform(to_camera, "Camera_Front").corners()[0]
    pixels, _ = camera_of(da, f"{approach}/Camera_Front").project(corners[corners[:, 2] > NEAREST_DRAWN])
    assert len(pixels) == 4
    detected = DetectedBoxes(boxes=boxes, scores=given.scores)
    for verdict, shown in zip(verdicts, (detected, nothing), strict=True):
        ax = in_camera(da, replace(verdict, truth=boxes, detected=shown))
        lines = [line for color in ("black", *OUTCOME_COLORS.values()) for line in lines_in(ax, color)]
        assert (len(lines) >= 12, gaps(pixels, lines).min() > 0.1) == (True, True)


def test_the_nearest_detections_are_on_top(da: DeepAccident, approach: str) -> None:
    ax = in_camera(da, sample_verdict(da, approach, perfect(da, approach)))
    boxes = da.boxes(approach, "Camera_Front")
    pixels, _ = camera_of(da, f"{approach}/Camera_Front").project(boxes.corners().reshape(-1, 3))
    first = np.array([line[0] for line in lines_in(ax, OUTCOME_COLORS["right"])])
    apart = np.linalg.norm(first[:, None] - np.nan_to_num(pixels, nan=np.inf), axis=-1)
    depth = boxes.center[apart.argmin(axis=1)[apart.min(axis=1) < 1e-6] // 8, 2]
    assert len(np.unique(depth)) > 2
    assert (np.diff(depth) < 1e-9).all()


def test_cells_are_polygons_on_the_ground(da_motion: DeepAccident, sample: str, labels: MotionLabels) -> None:
    later, color = (20.0, 22.0, 3.0, 4.0), OUTCOME_COLORS["false"]
    verdict = sample_verdict(da_motion, sample, blocks(labels, AHEAD, AHEAD, later), label=labels)
    for frame, rectangle in ((None, AHEAD), (0, AHEAD), (2, later)):
        ax = in_camera(da_motion, verdict, frame=frame)
        (line,) = lines_in(ax, color, dashed=False)
        ground = on_the_ground(da_motion, sample, "Camera_Front", corners_of(rectangle))
        corners, _ = camera_of(da_motion, f"{sample}/Camera_Front").project(ground)
        assert gaps(corners, [line]).max() < 1e-6
        np.testing.assert_allclose(
            [line[:, 1].min(), line[:, 1].max()], [corners[:, 1].min(), corners[:, 1].max()], atol=1e-6
        )
        shapes = [each for each in ax.collections if isinstance(each, PolyCollection) and len(each.get_paths())]
        (filled,) = [each for each in shapes if to_hex(each.get_facecolor()[0]) == color]
        assert filled.get_paths()[0].contains_point(corners.mean(axis=0))
        assert "right" not in outcomes(ax)


def test_cells_behind_the_camera_are_cut_off(da_motion: DeepAccident, sample: str, labels: MotionLabels) -> None:
    around, lens = (-5.0, 12.0, -1.0, 1.0), camera_of(da_motion, f"{sample}/Camera_Front")
    ax = in_camera(da_motion, sample_verdict(da_motion, sample, blocks(labels, around, around), label=labels))
    (line,) = lines_in(ax, OUTCOME_COLORS["false"])
    assert np.isfinite(line).all()
    near, far = np.split(on_the_ground(da_motion, sample, "Camera_Front", corners_of(around)), 2)
    assert (near[:, 2] < 0).all()
    share = (NEAREST_DRAWN - near[:, 2:]) / (far - near)[:, 2:]
    pixels, depth = lens.project(np.concatenate([near + share * (far - near), far]))
    np.testing.assert_allclose(depth[:2], NEAREST_DRAWN)
    assert gaps(pixels, [line]).max() < 1e-6
    assert pixels[:2, 1].min() > 5 * lens.height


def test_missed_instances_are_dashed_around_their_cells(
    da_motion: DeepAccident, sample: str, labels: MotionLabels
) -> None:
    grid, checked = labels.config.grid, 0
    steps = grid.x[2] / 2 * np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)])
    verdict = sample_verdict(da_motion, sample, instances_of(np.zeros_like(labels.instance), grid))
    for channel, frame in (("Camera_Front", 0), ("Camera_Back", 0), ("Camera_Back", 2)):
        ax, instance = in_camera(da_motion, verdict, channel, frame=frame), labels.instance[frame]
        lines = lines_in(ax, OUTCOME_COLORS["missed"], dashed=True)
        bounds = np.array([[line.min(axis=0), line.max(axis=0)] for line in lines])
        assert outcomes(ax) == ["missed"]
        for identity in set(np.unique(instance).tolist()) - {0}:
            corners = (grid.centers()[instance == identity][:, None] + steps).reshape(-1, 2)
            optical = on_the_ground(da_motion, sample, channel, corners)
            if (optical[:, 2] > NEAREST_DRAWN).all():
                pixels, _ = camera_of(da_motion, f"{sample}/{channel}").project(optical)
                expected = np.array([pixels.min(axis=0), pixels.max(axis=0)])
                assert np.abs(bounds - expected).max(axis=(1, 2)).min() < 1e-6
                checked += 1
    assert checked > 5


def test_instances_are_judged_frame_by_frame(da_motion: DeepAccident, sample: str, labels: MotionLabels) -> None:
    shown = labels.instance.copy()
    shown[1:] = 0  # exact now, and nothing later
    verdict = sample_verdict(da_motion, sample, instances_of(shown, labels.config.grid), label=labels)
    kinds = [outcomes(in_camera(da_motion, verdict, "Camera_Back", frame=frame)) for frame in (0, 2)]
    assert kinds == [["right"], ["missed"]]


@pytest.mark.parametrize(("agent", "ground"), [("ego_vehicle", 0.0), ("infrastructure", -4.0)])
def test_places_of_accidents_are_on_the_ground(da: DeepAccident, approach: str, agent: str, ground: float) -> None:
    sample = approach.replace("ego_vehicle", agent)
    assert abs(np.median(da.boxes(sample, "ego").bottom_corners()[..., 2]) - ground) < 0.7
    true = Accident(positions=np.array([[15.0, 2.0], [18.0, -1.0]]), time=1.5)
    alarm = Accident(positions=np.array([[14.0, 3.0], [17.0, 0.0]]), time=1.2, score=0.8)
    ax = in_camera(da, verdict_of(sample, true, alarm), size=(8, 4.5))
    assert texts(ax) == ["in 1.5 s", "in 1.2 s, score 0.8"]
    lens, ego_from_camera = camera_of(da, f"{sample}/Camera_Front"), da.ego_from(sample, "Camera_Front")

    def grounded(pixels: Any) -> Any:
        """Where rays through pixels meet the ground, in the ego frame."""
        rays = ego_from_camera.rotate(np.insert(pixels, 2, 1, axis=1) @ np.linalg.inv(lens.intrinsic).T)
        share = (ground - ego_from_camera.translation[2]) / rays[:, 2]
        return (ego_from_camera.translation + share[:, None] * rays)[:, :2]

    lines = lines_in(ax, COLLIDER_COLOR)
    rings = [grounded(line) for line in lines if len(line) > 4]
    for ring, place in zip(rings, true.positions, strict=True):
        np.testing.assert_allclose(np.linalg.norm(ring - place, axis=1), 1.0)
        np.testing.assert_allclose(ring.min(axis=0), place - 1)
    joined = [grounded(line) for line in lines if len(line) == 2 and abs(line[0, 0] - line[1, 0]) > 0.5]
    np.testing.assert_allclose(joined[-1], true.positions)  # the edges of the pair's boxes are below
    crosses = np.array([grounded(line) for line in lines_in(ax, FORESEEN_COLOR) if len(line) == 2][-4:])
    np.testing.assert_allclose(crosses.mean(axis=1), np.repeat(alarm.positions, 2, axis=0), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(np.diff(crosses, axis=1), axis=-1), 2.0)
    tops = on_the_ground(da, sample, "Camera_Front", alarm.positions, ground + 1.5)
    assert gaps(lens.project(tops)[0], lines_in(ax, FORESEEN_COLOR)).max() < 1e-6


def test_words_stand_between_the_places_that_are_seen(da: DeepAccident, approach: str) -> None:
    alarm = Accident(positions=np.array([[15.0, 2.0], [4.0, 25.0]]), time=1.2, score=0.8)
    beside = Accident(positions=np.array([[-15.0, 2.0], [-18.0, -1.0]]), time=0.7, score=0.3)
    verdict = verdict_of(approach, None, alarm, beside)
    front, back = (in_camera(da, verdict, channel, size=(8, 4.5)) for channel in ("Camera_Front", "Camera_Back"))
    assert (texts(front), texts(back)) == (["in 1.2 s, score 0.8"], ["in 0.7 s, score 0.3"])
    places = on_the_ground(da, approach, "Camera_Front", alarm.positions[:1])
    np.testing.assert_allclose(front.texts[0].xy, camera_of(da, f"{approach}/Camera_Front").project(places)[0][0])
    for ax in (front, back):
        rendered(ax)
        assert ax.texts[0].get_visible()


def predictions(dataset: DeepAccident, token: str, labels: MotionLabels) -> list[tuple[Any, dict[str, Any]]]:
    accident: Any = box_truth(dataset, token).accident
    near = Accident(positions=accident.positions + 1.5, time=accident.time, score=0.9)
    motion = instances_of(np.roll(labels.instance, 2, axis=-1), labels.config.grid)
    hows = ({}, {"task": "accident", "protocol": "boxes"}, {"label": labels})
    return [*((given, {}) for given in (perfect(dataset, token), [near], [])), *((motion, how) for how in hows)]


@pytest.mark.slow
def test_the_verdict_is_that_of_the_views_from_above(
    da_motion: DeepAccident, sample: str, labels: MotionLabels
) -> None:
    for given, how in predictions(da_motion, sample, labels):
        beside = render_evaluation(da_motion, sample, given, fig=detached_figure((12, 7)), **how)
        over = render_outcome_in_cameras(da_motion, sample, given, fig=detached_figure((15, 7)), **how)
        assert title_of(over) == title_of(beside)
        assert [ax.get_title() for ax in over.axes] == [*map(camera_name, IN_ORDER)]


def test_frames_and_legends_are_named(da_motion: DeepAccident, sample: str, labels: MotionLabels) -> None:
    ahead = {"label": labels, "frame": 2}
    for given, how, title, legend in (
        (blocks(labels, AHEAD, AHEAD, AHEAD), ahead, "instances in 1.0 s 30x30 m: IoU", ["right", "false", "missed"]),
        (perfect(da_motion, sample), {}, "mean average precision of this sample", ["true box of a detection"]),
        ([], {}, "accident: 5 m: FN, 10 m: FN, 15 m: FN", ["accident to come", "foreseen"]),
    ):
        figure = render_outcome_in_cameras(da_motion, sample, given, fig=detached_figure((8, 6)), **how)
        assert title in title_of(figure)
        assert not lacking(legend_words(figure), *legend)


def test_a_missing_image_is_a_grey_panel_with_the_prediction(da_partial: DeepAccident, approach: str) -> None:
    given = perfect(da_partial, approach)
    figure = render_outcome_in_cameras(da_partial, approach, given, fig=detached_figure((10, 4)))
    front, back = (figure.axes[IN_ORDER.index(f"Camera_{place}")] for place in ("Front", "Back"))
    assert (len(front.images), len(back.images), to_hex(front.get_facecolor())) == (0, 1, MISSING_COLOR)
    assert words(front) == "front\nnot downloaded"
    assert len(lines_in(front, OUTCOME_COLORS["right"])) >= 12


@pytest.mark.slow
@pytest.mark.parametrize("where", [None, "paper", "slide"])
def test_words_are_in_the_picture_and_apart(
    da_motion: DeepAccident, sample: str, labels: MotionLabels, where: Any
) -> None:
    with style(where) if where else nullcontext():
        for given, how in predictions(da_motion, sample, labels):
            assert text_faults(render_outcome_in_cameras(da_motion, sample, given, **how)) == []
