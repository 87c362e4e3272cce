"""A prediction on top of the truth in camera images: boxes, ground cells, accident positions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation.detection import DetectedBoxes
from deepaccident_devkit.evaluation.predictions import Prediction
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.geometry.cell_outlines import outlines
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.render.boxes import (
    EDGES,
    draw_boxes_in_image,
    segments_in_image,
)
from deepaccident_devkit.render.camera import draw_camera_boxes
from deepaccident_devkit.render.captions import draw_legend, set_scene_title
from deepaccident_devkit.render.figures import axes_or_new, figure_or_new, lay_out_figure
from deepaccident_devkit.render.motion_maps import MotionMaps
from deepaccident_devkit.render.outcomes.above import DASHED, FORESEEN_COLOR
from deepaccident_devkit.render.outcomes.camera_view import CASINGS, CameraView, view_of
from deepaccident_devkit.render.outcomes.described import sample_drawing, task_to_describe
from deepaccident_devkit.render.outcomes.drawings import draw_drawing_in_camera, drawing_handles
from deepaccident_devkit.render.outcomes.verdicts import (
    AccidentVerdict,
    DetectionVerdict,
    MotionVerdict,
    Verdict,
    boxes_of,
    sample_verdict,
)
from deepaccident_devkit.render.samples import CAMERA_GRID, TALL_CAMERA_GRID
from deepaccident_devkit.render.styles import (
    COLLIDER_COLOR,
    OUTCOME_COLORS,
    current_style,
    in_own_settings,
)
from deepaccident_devkit.support.arrays import AnyArray, FloatArray
from deepaccident_devkit.support.text import choice
from deepaccident_devkit.taxonomy import CAMERAS, OWN_ACTOR_ID

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_FIGURE_SIZE_IN = (14.7, 7.1125)
_ANGLES_RAD = np.linspace(0, 2 * np.pi, 33)
# The ring around a true position and the cross at a foreseen one, of a radius of 1 m.
_RING = [np.column_stack([np.cos(_ANGLES_RAD), np.sin(_ANGLES_RAD)])]
_CROSS = [np.sqrt(0.5) * np.array(arm) for arm in ([[-1, -1], [1, 1]], [[-1, 1], [1, -1]])]
# Opacity of instances' cells on the ground.
_GROUND_OPACITY = 0.3


@in_own_settings
def render_outcome_in_cameras(
    dataset: Dataset,
    sample: RowArgument,
    prediction: Prediction | DetectedBoxes | Sequence[Any],
    *,
    task: str | None = None,
    protocol: Any = None,
    label: MotionLabels | None = None,
    frame: int | None = None,
    fig: Figure | None = None,
) -> Figure:
    """Render a prediction over the truth in the cameras of the sample's agent.

    A protocol decides what is right. For detections, matched and false boxes are shown, missed true
    boxes (dashed), and matched true boxes (thin lines). For motion, the ground cells of predicted
    instances are shown, right or false, and of missed true ones (dashed). For accidents, the
    pair's boxes are shown, with red rings at the positions where they collide, and black crosses at
    the foreseen positions, labelled with times; each position also has a post of 1.5 m. What does
    not count, such as boxes and instances beyond the protocol's range, is not rendered. The agent's
    own box is not rendered either, because its cameras are inside it.

    The ground is assumed to be flat: the plane z = 0 in a vehicle's ego frame, or 4 m below the
    infrastructure's LiDAR. Occlusion is ignored: boxes and positions are rendered even if other
    things hide them.

    Arguments and errors are as for `render_evaluation`. `frame` is the index of the motion frame to
    show (None: the current one); a later frame shows, in the current image, where instances will
    be.
    """
    described_task = task_to_describe(prediction, task)
    if described_task:
        described = sample_drawing(
            dataset, sample, prediction, task=described_task, protocol=protocol
        )
        drawing = described.drawing

        def draw(channel: str, ax: Axes) -> None:
            camera = f"{described.sample}/{channel}"
            draw_drawing_in_camera(dataset, described.sample, drawing, camera, ax)

        handles = drawing_handles(drawing)
        return _render_cameras(dataset, described.sample, draw, handles, described.words, fig)
    verdict = sample_verdict(
        dataset, sample, cast(Any, prediction), task=task, protocol=protocol, label=label
    )
    number = _checked_frame(verdict, frame)
    words = ""
    if isinstance(verdict, MotionVerdict):
        seconds = number * verdict.outcome.true.step
        if seconds:
            words = f"instances in {seconds:.1f} s"

    def draw_verdict(channel: str, ax: Axes) -> None:
        draw_outcome_in_camera(dataset, verdict, channel, frame=frame, ax=ax)

    handles = _handles(verdict)
    return _render_cameras(
        dataset, verdict.sample, draw_verdict, handles, verdict.words, fig, words
    )


def _render_cameras(
    dataset: Dataset,
    sample: str,
    draw: Callable[[str, Axes], object],
    handles: Sequence[Artist],
    verdict_words: str,
    fig: Figure | None,
    words: str = "",
) -> Figure:
    """Render a panel for each camera of a sample's agent, a legend and a title."""
    fig = figure_or_new(fig, _FIGURE_SIZE_IN, column=1.3)
    grid = TALL_CAMERA_GRID if current_style().layout == "column" else CAMERA_GRID
    for channel, ax in fig.subplot_mosaic([[*row] for row in grid]).items():
        draw(channel, ax)
    draw_legend(fig, handles)
    set_scene_title(fig, dataset, sample, words, below=verdict_words)
    return lay_out_figure(fig)


@in_own_settings
def draw_outcome_in_camera(
    dataset: Dataset,
    verdict: Verdict,
    camera: str,
    *,
    frame: int | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Render one panel (a channel) of `render_outcome_in_cameras`, in pixels.

    Raises:
        ChoiceError: No such camera, or no such frame.
    """
    channel = choice("camera", camera, CAMERAS)
    number = _checked_frame(verdict, frame)
    ax = axes_or_new(ax, (8, 5))
    token = f"{verdict.sample}/{channel}"
    if isinstance(verdict, AccidentVerdict):
        return draw_accidents_in_camera(dataset, verdict, token, ax)
    view = view_of(dataset, verdict.sample, token, ax)
    if isinstance(verdict, DetectionVerdict):
        _draw_detection(verdict, dataset, view)
    else:
        _draw_motion(verdict, number, view)
    return ax


def draw_accidents_in_camera(
    dataset: Dataset, verdict: AccidentVerdict, camera: str, ax: Axes, *, image: bool = True
) -> Axes:
    """Render accident positions and the pair's boxes in an image (a token) of any agent.

    The true accident is drawn beneath the foreseen ones, but its words are placed first.
    """
    view = view_of(dataset, verdict.sample, camera, ax, image=image)
    true = verdict.compared.true
    record = dataset.get("sample_data", camera)
    boxes = boxes_of(dataset, verdict)
    agent_token = dataset.get("sample", record["sample_token"])["agent_token"]
    own_actor = dataset.get("agent", agent_token)["actor_id"]
    optical_from_world = dataset.world_from(*camera.rsplit("/", 1)).inverse()
    optical = boxes.transform(optical_from_world, record["channel"])
    pair = optical.select(boxes.actor_id != own_actor)
    draw_camera_boxes(dataset, record, pair, {"boxes"}, ax)
    if true is not None:
        _draw_positions(true.positions, _RING, COLLIDER_COLOR, view)
        view.write(f"in {true.time:.1f} s", true.positions, COLLIDER_COLOR)
    for alarm in verdict.compared.predicted:
        _draw_positions(alarm.positions, _CROSS, FORESEEN_COLOR, view)
        view.write(alarm.words, alarm.positions, FORESEEN_COLOR)
    return ax


def _checked_frame(verdict: Verdict, frame: int | None) -> int:
    """Return the index of a motion frame, 0 for None; raise ChoiceError if there is none such."""
    if frame is None:
        return 0
    if not isinstance(verdict, MotionVerdict):
        raise ChoiceError(f"frame: only predicted motion has frames, found {frame!r}; leave it out")
    count = len(verdict.outcome.true.instance)
    if frame not in range(count):
        raise ChoiceError(
            f"frame: expected a recorded frame, from 0 to {count - 1}, found {frame!r}"
        )
    return frame


def _draw_detection(verdict: DetectionVerdict, dataset: Dataset, view: CameraView) -> None:
    """Draw matched true boxes beneath the detections; the nearest are on top.

    The agent's own box is left out.
    """
    matches = verdict.matches
    channel = view.camera.rsplit("/", 1)[1]
    is_own = verdict.truth.actor_id == OWN_ACTOR_ID
    is_counted = ~is_own[matches.truth]
    optical_from_world = dataset.world_from(view.sample, channel).inverse()
    world_from_truth = dataset.world_from(view.sample, verdict.rules.frame)
    optical_from_truth = optical_from_world @ world_from_truth
    truth = verdict.truth.transform(optical_from_truth, channel)
    detected = verdict.detected.boxes.transform(optical_from_truth, channel)
    matched_rows = matches.truth[is_counted]
    missed_rows = matches.missed[~is_own[matches.missed]]
    right_rows = matches.detection[is_counted]
    boxes = detected.select(np.concatenate([right_rows, matches.false]))
    kinds = np.repeat(["right", "false"], [len(right_rows), len(matches.false)])
    depth = boxes.center[:, 2]
    order = np.argsort(-depth, kind="stable")
    colors = [OUTCOME_COLORS[kind] for kind in kinds[order].tolist()]
    _draw_edges(truth.select(matched_rows), "black", view, width=0.7)
    draw_boxes_in_image(boxes.select(order), view.lens, view.ax, colors)
    missed_boxes = truth.select(missed_rows)
    _draw_edges(missed_boxes, OUTCOME_COLORS["missed"], view, width=1.6, dashed=True)


def _draw_edges(
    optical: Boxes, color: str, view: CameraView, *, width: float, dashed: bool = False
) -> None:
    corners = optical.corners()
    edges = corners[:, EDGES].reshape(-1, 2, 3)
    pixels, _ = segments_in_image(edges, view.lens)
    view.draw_lines(list(pixels), color, width=width, dashed=dashed)


def _draw_motion(verdict: MotionVerdict, frame: int, view: CameraView) -> None:
    """Draw the cells of predicted instances on the ground, and the outlines of missed true ones."""
    from matplotlib.collections import PolyCollection

    outcome = verdict.outcome
    missed_ids = outcome.judged("true", frame)["missed"]
    for kind, ids in outcome.judged("predicted", frame).items():
        color = OUTCOME_COLORS[kind]
        areas = view.on_ground(_outlines(outcome.predicted, frame, ids))
        polygons = PolyCollection(areas, facecolors=color, alpha=_GROUND_OPACITY, edgecolors="none")
        view.ax.add_collection(polygons, autolim=False)
        view.draw_lines(areas, color, width=1.6)
    areas = view.on_ground(_outlines(outcome.true, frame, missed_ids))
    view.draw_lines(areas, OUTCOME_COLORS["missed"], width=1.6, dashed=True)


def _outlines(maps: MotionMaps, frame: int, ids: AnyArray) -> list[FloatArray]:
    """Return closed lines (P, 2), metres in the ego frame, around the cells of instances.

    Holes are not outlined.
    """
    low, _, cell_size = np.array([maps.grid.x, maps.grid.y]).T
    lines = []
    for instance_id in ids.tolist():
        cells = maps.instance[frame] == instance_id
        for polygon in outlines(cells, np.zeros(2), 1.0).geoms:
            corners = np.asarray(polygon.exterior.coords)
            lines.append(low + corners * cell_size)
    return lines


def _draw_positions(
    positions: FloatArray, mark: Sequence[FloatArray], color: str, view: CameraView
) -> None:
    """Draw a mark and a post at each of two positions (2, 2), joined by a thin line."""
    thin_lines = [*view.on_ground([positions]), *view.posts(positions)]
    view.draw_lines(thin_lines, color, width=1.2)
    mark_lines = []
    for position in positions:
        mark_lines += [position + line for line in mark]
    view.draw_lines(view.on_ground(mark_lines), color, width=1.8)


def _handles(verdict: Verdict) -> list[Artist]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    if isinstance(verdict, AccidentVerdict):
        style: dict[str, Any] = {"linestyle": "none", "markersize": 9, "markeredgewidth": 1.8}
        ring = Line2D(
            [],
            [],
            marker="o",
            fillstyle="none",
            color=COLLIDER_COLOR,
            label="actual collision",
            **style,
        )
        cross = Line2D([], [], marker="x", color=FORESEEN_COLOR, label="predicted", **style)
        return [ring, cross]
    is_detection = isinstance(verdict, DetectionVerdict)
    handles: list[Artist] = []
    for kind in ("right", "false"):
        label = "detected" if is_detection and kind == "right" else kind
        color = OUTCOME_COLORS[kind]
        handles.append(Patch(label=label, facecolor=(color, 0.4), edgecolor=color))
    pale = OUTCOME_COLORS["missed"]
    handles.append(Patch(label="missed", facecolor=pale, edgecolor=CASINGS[pale], linestyle=DASHED))
    if is_detection:
        handles.append(
            Line2D([], [], color="black", linewidth=0.9, label="true box of a detection")
        )
    return handles
