"""A prediction over the truth in cameras: boxes, cells on the ground, places of accidents."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation.detection import DetectedBoxes
from deepaccident_devkit.evaluation.predictions import Prediction
from deepaccident_devkit.geometry import SE3, Boxes, PinholeCamera
from deepaccident_devkit.geometry.cell_outlines import outlines
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.render.boxes import (
    EDGES,
    draw_boxes_in_image,
    segments_in_image,
    write_beside,
)
from deepaccident_devkit.render.camera import draw_camera_boxes, draw_image
from deepaccident_devkit.render.captions import draw_legend, has_sensor_file, set_scene_title
from deepaccident_devkit.render.chips import keep_free
from deepaccident_devkit.render.figures import axes_or_new, figure_or_new, settled
from deepaccident_devkit.render.motion_maps import MotionMaps
from deepaccident_devkit.render.outcomes.above import DASHED, FORESEEN_COLOR, alarm_words
from deepaccident_devkit.render.outcomes.verdicts import (
    AccidentVerdict,
    DetectionVerdict,
    MotionVerdict,
    Verdict,
    boxes_of,
    sample_verdict,
)
from deepaccident_devkit.render.samples import CAMERA_GRID
from deepaccident_devkit.render.styles import (
    CASING_COLOR,
    COLLIDER_COLOR,
    OUTCOME_COLORS,
    in_own_settings,
)
from deepaccident_devkit.support.arrays import AnyArray, FloatArray
from deepaccident_devkit.support.text import choice
from deepaccident_devkit.taxonomy import CAMERAS, INFRASTRUCTURE, OWN_ACTOR_ID, POLE_HEIGHT
from deepaccident_devkit.v2x.poses import camera_of

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Metres: the height of the posts at positions, since distant rings look flat.
_POST_HEIGHT_M: Final = 1.5
# Points around a post that no words cover: left, low, right and high.
_MARK_MARGIN_PT: Final = (-6.0, -6.0, 6.0, 6.0)
# Points by which the casing of a line is wider.
_CASING_WIDTH_PT: Final = 1.4
# Line colour → colour of its casing, for pale lines; other casings are white.
CASINGS: Final = {OUTCOME_COLORS["missed"]: "black"}
_FIGURE_SIZE_IN: Final = (14.7, 7.1125)
_ANGLES_RAD: Final = np.linspace(0, 2 * np.pi, 33)
# The ring around a true position and the cross at a foreseen one, of a radius of 1 m.
_RING: Final = [np.column_stack([np.cos(_ANGLES_RAD), np.sin(_ANGLES_RAD)])]
_CROSS: Final = [np.sqrt(0.5) * np.array(arm) for arm in ([[-1, -1], [1, 1]], [[-1, 1], [1, -1]])]
# Points around the middle of a panel's upper edge, where the words about a missing image are:
# left, low, right, high.
_MISSING_WORDS_MARGIN_PT: Final = (-58.0, -48.0, 58.0, 0.0)
# Opacity of the ground of instances.
_GROUND_OPACITY: Final = 0.3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraView:
    """A camera's panel, and the ground in it.

    The ground is flat: z = 0 in a vehicle's ego frame, `POLE_HEIGHT` below the infrastructure's.

    Attributes:
        camera: Token of the image (sample data).
        sample: Token; the image is its own, or that of another agent at its moment.
        lens: Intrinsics of the camera.
        optical_from_ego: Pose of the sample's ego frame in the optical frame.
        ground: Height z of the ground in the ego frame, metres.
        ax: Axes in pixels.
    """

    camera: str
    sample: str
    lens: PinholeCamera
    optical_from_ego: SE3
    ground: float
    ax: Axes

    def optical(self, positions: FloatArray, height: float = 0.0) -> FloatArray:
        """Return points (N, 3) of the optical frame, above positions (N, 2) of the ego frame.

        The height above the ground is in metres.
        """
        z = np.full(len(positions), self.ground + height)
        points = np.column_stack([positions, z])
        return self.optical_from_ego.apply(points)

    def on_ground(self, lines: Sequence[FloatArray]) -> list[FloatArray]:
        """Return the visible parts (V, 2), pixels, of lines (P, 2) on the ground, in the ego frame.

        Visible parts are in front of the camera. The ends of a cut are far below the image, and so
        is the line between two of them.
        """
        if not lines:
            return []
        points = self.optical(np.concatenate(lines))
        line_numbers = np.repeat(np.arange(len(lines)), [*map(len, lines)])
        within_line = line_numbers[1:] == line_numbers[:-1]
        segments = np.stack([points[:-1], points[1:]], axis=1)[within_line]
        pixels, drawn = segments_in_image(segments, self.lens)
        drawn_numbers = line_numbers[1:][within_line][drawn]
        numbers, starts = np.unique(drawn_numbers, return_index=True)
        if not len(numbers):
            return []
        return np.split(pixels.reshape(-1, 2), 2 * starts[1:])

    def draw_lines(
        self, lines: Sequence[FloatArray], color: str, *, width: float, dashed: bool = False
    ) -> None:
        """Render lines (V, 2) in pixels, on wider ones that set them off from the image."""
        from matplotlib.collections import LineCollection

        casing_color = CASINGS.get(color, CASING_COLOR)
        casings = LineCollection(
            lines, colors=casing_color, linewidths=width + _CASING_WIDTH_PT, alpha=0.7
        )
        line_style = DASHED if dashed else "solid"
        collection = LineCollection(lines, colors=color, linewidths=width, linestyles=line_style)
        self.ax.add_collection(casings, autolim=False)  # the image has set the limits
        self.ax.add_collection(collection, autolim=False)

    def posts(self, positions: FloatArray) -> FloatArray:
        """Return feet and tops (V, 2, 2), pixels, of posts at positions (N, 2) of the ego frame.

        Only posts in front of the camera are returned.
        """
        ends = [self.optical(positions), self.optical(positions, _POST_HEIGHT_M)]
        pixels, _ = segments_in_image(np.stack(ends, axis=1), self.lens)
        return pixels

    def write(self, words: str, positions: FloatArray, color: str) -> None:
        """Write words beside positions (N, 2) of the ego frame.

        The words are between the feet of the posts in the image.
        """
        posts = self.posts(positions)
        visible = posts[self.lens.in_image(posts[:, 0])]
        if len(visible):
            u, v = visible[:, 0].mean(axis=0).tolist()
            keep_free(self.ax, visible, margin=_MARK_MARGIN_PT)
            write_beside(self.ax, words, (u, v), color)


def view_of(
    dataset: Dataset, sample: str, camera: str, ax: Axes, *, image: bool = True
) -> CameraView:
    """Return a panel with an image of a sample's moment, or with words on its absence.

    The image is that of any agent; sample and camera are tokens.
    """
    lens = camera_of(dataset, camera)
    draw_image(dataset, dataset.get("sample_data", camera), ax, image=image)
    if not has_sensor_file(dataset, camera):
        keep_free(ax, [[(lens.width / 2, 0.0)]], margin=_MISSING_WORDS_MARGIN_PT)
    optical_from_world = dataset.world_from(*camera.rsplit("/", 1)).inverse()
    ground = 0.0
    if dataset.get("sample", sample)["agent"] == INFRASTRUCTURE:
        ground = -POLE_HEIGHT
    return CameraView(
        camera=camera,
        sample=sample,
        lens=lens,
        optical_from_ego=optical_from_world @ dataset.world_from(sample, "ego"),
        ground=ground,
        ax=ax,
    )


@in_own_settings
def render_outcome_in_cameras(
    dataset: Dataset,
    sample: RowArgument,
    prediction: Prediction | DetectedBoxes,
    *,
    task: str | None = None,
    protocol: Any = None,
    label: MotionLabels | None = None,
    frame: int | None = None,
    fig: Figure | None = None,
) -> Figure:
    """Render a prediction over the truth in the cameras of the sample's agent.

    The outcome is that of a protocol's verdict. Detections: matched and false boxes, missed true
    boxes dashed, and matched true boxes with thin lines. Motion: the cells of predicted instances
    on the ground, right or false, and of missed true ones, dashed. Accidents: boxes of the pair,
    red rings at the positions where two collide, black crosses at the foreseen positions, with
    their times; posts of 1.5 m stand on both. What does not count, such as boxes and instances
    beyond the protocol's range, is not rendered, nor is the agent's own box, which is around its
    cameras.

    The ground is assumed to be flat: the plane z = 0 of a vehicle's ego frame, and for the
    infrastructure 4 m below its LiDAR. Occlusion is ignored: boxes and positions are rendered even
    if other things hide them.

    Arguments and errors are as for `render_evaluation`. The `frame` is one of motion (None: the
    present): later ones show where instances will be, in the present image.
    """
    verdict = sample_verdict(dataset, sample, prediction, task=task, protocol=protocol, label=label)
    number = _checked_frame(verdict, frame)
    seconds, words = 0.0, ""
    if isinstance(verdict, MotionVerdict):
        seconds = number * verdict.outcome.true.step
    if seconds:
        words = f"instances in {seconds:.1f} s"
    fig = figure_or_new(fig, _FIGURE_SIZE_IN)
    for channel, ax in fig.subplot_mosaic([[*row] for row in CAMERA_GRID]).items():
        draw_outcome_in_camera(dataset, verdict, channel, frame=frame, ax=ax)
    draw_legend(fig, _handles(verdict))
    set_scene_title(fig, dataset, verdict.sample, words, below=verdict.words)
    return settled(fig)


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
    channel, number = choice("camera", camera, CAMERAS), _checked_frame(verdict, frame)
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
    """Render positions of accidents and boxes of the pair in an image (a token) of any agent.

    The true accident is below the foreseen ones, and its words are placed first.
    """
    view, true = view_of(dataset, verdict.sample, camera, ax, image=image), verdict.compared.true
    record, boxes = dataset.get("sample_data", camera), boxes_of(dataset, verdict)
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
        view.write(alarm_words(alarm), alarm.positions, FORESEEN_COLOR)
    return ax


def _checked_frame(verdict: Verdict, frame: int | None) -> int:
    """Return the number of a frame of motion, 0 for None; raises ChoiceError."""
    if frame is None:
        return 0
    if not isinstance(verdict, MotionVerdict):
        raise ChoiceError(f"frame: only motion has frames, found {frame!r}; leave it out")
    count = len(verdict.outcome.true.instance)
    if frame not in range(count):
        raise ChoiceError(f"frame: expected a recorded one, from 0 to {count - 1}, found {frame!r}")
    return frame


def _draw_detection(verdict: DetectionVerdict, dataset: Dataset, view: CameraView) -> None:
    """Draw matched true boxes below the detections, and these with the nearest on top.

    The agent's own box is left out.
    """
    sample, channel, matches = view.sample, view.camera.rsplit("/", 1)[1], verdict.matches
    is_own = verdict.truth.actor_id == OWN_ACTOR_ID
    counted = ~is_own[matches.truth]
    missed = matches.missed[~is_own[matches.missed]]
    optical_from_world = dataset.world_from(sample, channel).inverse()
    optical = optical_from_world @ dataset.world_from(sample, verdict.rules.frame)
    truth = verdict.truth.transform(optical, channel)
    detected = verdict.detected.boxes.transform(optical, channel)
    _draw_edges(truth.select(matches.truth[counted]), "black", view, width=0.7)
    boxes = detected.select(np.concatenate([matches.detection[counted], matches.false]))
    kinds = np.repeat(["right", "false"], [int(counted.sum()), len(matches.false)])
    order = np.argsort(-boxes.center[:, 2], kind="stable")
    colors = [OUTCOME_COLORS[kind] for kind in kinds[order].tolist()]
    draw_boxes_in_image(boxes.select(order), view.lens, view.ax, colors)
    _draw_edges(truth.select(missed), OUTCOME_COLORS["missed"], view, width=1.6, dashed=True)


def _draw_edges(
    optical: Boxes, color: str, view: CameraView, *, width: float, dashed: bool = False
) -> None:
    edges = optical.corners()[:, EDGES].reshape(-1, 2, 3)
    pixels, _ = segments_in_image(edges, view.lens)
    view.draw_lines(list(pixels), color, width=width, dashed=dashed)


def _draw_motion(verdict: MotionVerdict, frame: int, view: CameraView) -> None:
    from matplotlib.collections import PolyCollection

    outcome = verdict.outcome
    missed = outcome.judged("true", frame)["missed"]
    for name, ids in outcome.judged("predicted", frame).items():
        color = OUTCOME_COLORS[name]
        areas = view.on_ground(_outlines(outcome.predicted, frame, ids))
        polygons = PolyCollection(areas, facecolors=color, alpha=_GROUND_OPACITY, edgecolors="none")
        view.ax.add_collection(polygons, autolim=False)
        view.draw_lines(areas, color, width=1.6)
    areas = view.on_ground(_outlines(outcome.true, frame, missed))
    view.draw_lines(areas, OUTCOME_COLORS["missed"], width=1.6, dashed=True)


def _outlines(maps: MotionMaps, frame: int, ids: AnyArray) -> list[FloatArray]:
    """Return closed lines (P, 2), metres of the ego frame, around the cells of instances.

    Holes have no lines.
    """
    low, _, size = np.array([maps.grid.x, maps.grid.y]).T
    lines = []
    for identity in ids.tolist():
        cells = maps.instance[frame] == identity
        for polygon in outlines(cells, np.zeros(2), 1.0).geoms:
            lines.append(low + np.asarray(polygon.exterior.coords) * size)
    return lines


def _draw_positions(
    positions: FloatArray, mark: Sequence[FloatArray], color: str, view: CameraView
) -> None:
    """Draw a mark and a post at each of two positions (2, 2), and a thin line between them."""
    thin_lines = [*view.on_ground([positions]), *view.posts(positions)]
    view.draw_lines(thin_lines, color, width=1.2)
    marks = [position + line for position in positions for line in mark]
    view.draw_lines(view.on_ground(marks), color, width=1.8)


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
            label="accident to come",
            **style,
        )
        cross = Line2D([], [], marker="x", color=FORESEEN_COLOR, label="foreseen", **style)
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
