"""A prediction over the truth in the agent's cameras: boxes, cells on the ground, and the places of accidents."""

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
from deepaccident_devkit.render.captions import draw_legend, is_there, set_scene_title
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

# Metres: the height of the posts at places, since rings far away are flat.
_POST: Final = 1.5
# Points around a post that no words cover: left, low, right and high.
_MARK: Final = (-6.0, -6.0, 6.0, 6.0)
# Points by which the casing of a line is wider.
_CASING: Final = 1.4
# Edges around lines that are pale; others have white edges.
CASINGS: Final = {OUTCOME_COLORS["missed"]: "black"}
# Inches.
_SIZE: Final = (14.7, 7.1125)
_TURN: Final = np.linspace(0, 2 * np.pi, 33)
_RING: Final = [np.column_stack([np.cos(_TURN), np.sin(_TURN)])]
# The ring around a true place and the cross at a foreseen one, of a radius of 1 m.
_CROSS: Final = [np.sqrt(0.5) * np.array(arm) for arm in ([[-1, -1], [1, 1]], [[-1, 1], [1, -1]])]
# Points around the middle of a panel's upper edge, where words about a missing image are: left, low, right, high.
_MISSING: Final = (-58.0, -48.0, 58.0, 0.0)
# How opaque the ground of instances is.
_FILL: Final = 0.3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraView:
    """A camera's panel, and what lies on the ground in it.

    The ground is flat: z = 0 in a vehicle's ego frame, `POLE_HEIGHT` below the infrastructure's.

    Attributes:
        camera: token of the image (sample data).
        sample: token; the image is its own, or that of another agent at its moment.
        lens: the camera's intrinsics.
        optical_from_ego: of the sample.
        ground: z of the ground in the ego frame, metres.
        ax: in pixels.
    """

    camera: str
    sample: str
    lens: PinholeCamera
    optical_from_ego: SE3
    ground: float
    ax: Axes

    def optical(self, places: FloatArray, height: float = 0.0) -> FloatArray:
        """Points (N, 3) of the optical frame, so many metres above places (N, 2) of the ego frame."""
        return self.optical_from_ego.apply(
            np.column_stack([places, np.full(len(places), self.ground + height)])
        )

    def on_ground(self, lines: Sequence[FloatArray]) -> list[FloatArray]:
        """Lines (P, 2) on the ground, metres of the ego frame, as pixels (V, 2) of their parts in front of the camera.

        The ends of a cut are far below the image, and so is the line between two of them.
        """
        if not lines:
            return []
        points, owner = (
            self.optical(np.concatenate(lines)),
            np.repeat(np.arange(len(lines)), [*map(len, lines)]),
        )
        within = owner[1:] == owner[:-1]
        pixels, drawn = segments_in_image(
            np.stack([points[:-1], points[1:]], axis=1)[within], self.lens
        )
        rows, starts = np.unique(owner[1:][within][drawn], return_index=True)
        return np.split(pixels.reshape(-1, 2), 2 * starts[1:]) if len(rows) else []

    def draw_lines(
        self, lines: Sequence[FloatArray], color: str, *, width: float, dashed: bool = False
    ) -> None:
        """Render lines (V, 2) in pixels, on wider ones that set them off from the image."""
        from matplotlib.collections import LineCollection

        below = LineCollection(
            lines, colors=CASINGS.get(color, CASING_COLOR), linewidths=width + _CASING, alpha=0.7
        )
        above = LineCollection(
            lines, colors=color, linewidths=width, linestyles=DASHED if dashed else "solid"
        )
        self.ax.add_collection(below, autolim=False)  # the image has set the limits
        self.ax.add_collection(above, autolim=False)

    def posts(self, places: FloatArray) -> FloatArray:
        """Feet and tops (V, 2, 2), pixels, of posts at places (N, 2) of the ego frame; of those in front alone."""
        pixels, _ = segments_in_image(
            np.stack([self.optical(places), self.optical(places, _POST)], axis=1), self.lens
        )
        return pixels

    def write(self, words: str, places: FloatArray, color: str) -> None:
        """Write words beside places (N, 2) of the ego frame: between the feet of the posts that the image shows."""
        posts = self.posts(places)
        seen = posts[self.lens.in_image(posts[:, 0])]
        if len(seen):
            u, v = seen[:, 0].mean(axis=0).tolist()
            keep_free(self.ax, seen, margin=_MARK)
            write_beside(self.ax, words, (u, v), color)


def view_of(
    dataset: Dataset, sample: str, camera: str, ax: Axes, *, image: bool = True
) -> CameraView:
    """A panel with an image of a sample, or of another agent at its moment (both are tokens), or with its absence."""
    lens = camera_of(dataset, camera)
    draw_image(dataset, dataset.get("sample_data", camera), ax, image=image)
    if not is_there(dataset, camera):
        keep_free(ax, [[(lens.width / 2, 0.0)]], margin=_MISSING)
    return CameraView(
        camera=camera,
        sample=sample,
        lens=lens,
        optical_from_ego=dataset.world_from(*camera.rsplit("/", 1)).inverse()
        @ dataset.world_from(sample, "ego"),
        ground=-POLE_HEIGHT if dataset.get("sample", sample)["agent"] == INFRASTRUCTURE else 0.0,
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
    """Render a model's prediction over the truth in the cameras of the sample's agent, by a protocol's verdict.

    Detections: matched and false boxes, missed true boxes dashed, and thin the true boxes that were found. Motion: the
    cells of predicted instances on the ground, right or false, and of missed true ones, dashed. Accidents: boxes of
    the pair, red rings at the places where two collide, black crosses at the foreseen places, with their times; posts
    of 1.5 m stand on both. What does not count, such as boxes and instances beyond the protocol's range, is not
    rendered, nor the agent's own box, which is around its cameras.

    The ground is taken to be flat: the plane z = 0 of a vehicle's ego frame, and for the infrastructure 4 m below its
    LiDAR. Occlusion is ignored: boxes and places are rendered even if other things hide them.

    Arguments and errors are those of `render_evaluation`. The `frame` is one of motion (None: the present): later ones
    show where instances will be, in the image of now.
    """
    verdict = sample_verdict(dataset, sample, prediction, task=task, protocol=protocol, label=label)
    number = _checked_frame(verdict, frame)
    ahead = number * verdict.outcome.true.step if isinstance(verdict, MotionVerdict) else 0.0
    words = f"instances in {ahead:.1f} s" if ahead else ""
    fig = figure_or_new(fig, _SIZE)
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
    """Render one panel (a channel) of `render_outcome_in_cameras`, in pixels. Raises ChoiceError."""
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
    """Render accidents over the truth in an image (a token), of any agent at the moment: places, and boxes of the pair.

    The true accident is below the foreseen ones, and its words find their place first.
    """
    view, true = view_of(dataset, verdict.sample, camera, ax, image=image), verdict.compared.true
    record, boxes = dataset.get("sample_data", camera), boxes_of(dataset, verdict)
    own = dataset.get("agent", dataset.get("sample", record["sample_token"])["agent_token"])[
        "actor_id"
    ]
    optical = boxes.transform(
        dataset.world_from(*camera.rsplit("/", 1)).inverse(), record["channel"]
    )
    draw_camera_boxes(dataset, record, optical.select(boxes.actor_id != own), {"boxes"}, ax)
    if true is not None:
        _draw_places(true.positions, _RING, COLLIDER_COLOR, view)
        view.write(f"in {true.time:.1f} s", true.positions, COLLIDER_COLOR)
    for alarm in verdict.compared.predicted:
        _draw_places(alarm.positions, _CROSS, FORESEEN_COLOR, view)
        view.write(alarm_words(alarm), alarm.positions, FORESEEN_COLOR)
    return ax


def _checked_frame(verdict: Verdict, frame: int | None) -> int:
    """The number of a frame of motion, 0 for None; raises ChoiceError."""
    if frame is None:
        return 0
    if not isinstance(verdict, MotionVerdict):
        raise ChoiceError(f"frame: only motion has frames, found {frame!r}; leave it out")
    count = len(verdict.outcome.true.instance)
    if frame not in range(count):
        raise ChoiceError(f"frame: expected a recorded one, from 0 to {count - 1}, found {frame!r}")
    return frame


def _draw_detection(verdict: DetectionVerdict, dataset: Dataset, view: CameraView) -> None:
    """The true boxes that are found below the detections, of which the nearest are on top."""
    sample, channel, matches = view.sample, view.camera.rsplit("/", 1)[1], verdict.matches
    own = verdict.truth.actor_id == OWN_ACTOR_ID
    others, missed = ~own[matches.truth], matches.missed[~own[matches.missed]]
    optical = dataset.world_from(sample, channel).inverse() @ dataset.world_from(
        sample, verdict.rules.frame
    )
    truth, detected = (
        each.transform(optical, channel) for each in (verdict.truth, verdict.detected.boxes)
    )
    _draw_edges(truth.select(matches.truth[others]), "black", view, width=0.7)
    boxes = detected.select(np.concatenate([matches.detection[others], matches.false]))
    kinds = np.repeat(["right", "false"], [int(others.sum()), len(matches.false)])
    order = np.argsort(-boxes.center[:, 2], kind="stable")
    draw_boxes_in_image(
        boxes.select(order),
        view.lens,
        view.ax,
        [OUTCOME_COLORS[kind] for kind in kinds[order].tolist()],
    )
    _draw_edges(truth.select(missed), OUTCOME_COLORS["missed"], view, width=1.6, dashed=True)


def _draw_edges(
    optical: Boxes, color: str, view: CameraView, *, width: float, dashed: bool = False
) -> None:
    pixels, _ = segments_in_image(optical.corners()[:, EDGES].reshape(-1, 2, 3), view.lens)
    view.draw_lines(list(pixels), color, width=width, dashed=dashed)


def _draw_motion(verdict: MotionVerdict, frame: int, view: CameraView) -> None:
    from matplotlib.collections import PolyCollection

    outcome = verdict.outcome
    missed = outcome.judged("true", frame)["missed"]
    for name, ids in outcome.judged("predicted", frame).items():
        areas = view.on_ground(_outlines(outcome.predicted, frame, ids))
        filled = PolyCollection(
            areas, facecolors=OUTCOME_COLORS[name], alpha=_FILL, edgecolors="none"
        )
        view.ax.add_collection(filled, autolim=False)
        view.draw_lines(areas, OUTCOME_COLORS[name], width=1.6)
    view.draw_lines(
        view.on_ground(_outlines(outcome.true, frame, missed)),
        OUTCOME_COLORS["missed"],
        width=1.6,
        dashed=True,
    )


def _outlines(maps: MotionMaps, frame: int, ids: AnyArray) -> list[FloatArray]:
    """Closed lines (P, 2), metres of the ego frame, around the cells of instances; holes have none."""
    low, _, size = np.array([maps.grid.x, maps.grid.y]).T
    polygons = [
        part
        for identity in ids.tolist()
        for part in outlines(maps.instance[frame] == identity, np.zeros(2), 1.0).geoms
    ]
    return [low + np.asarray(part.exterior.coords) * size for part in polygons]


def _draw_places(
    places: FloatArray, mark: Sequence[FloatArray], color: str, view: CameraView
) -> None:
    """A mark and a post at each of two places (2, 2), and a thin line from one to the other."""
    view.draw_lines([*view.on_ground([places]), *view.posts(places)], color, width=1.2)
    view.draw_lines(
        view.on_ground([place + line for place in places for line in mark]), color, width=1.8
    )


def _handles(verdict: Verdict) -> list[Artist]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    if isinstance(verdict, AccidentVerdict):
        how: dict[str, Any] = {"linestyle": "none", "markersize": 9, "markeredgewidth": 1.8}
        ring = Line2D(
            [],
            [],
            marker="o",
            fillstyle="none",
            color=COLLIDER_COLOR,
            label="accident to come",
            **how,
        )
        return [ring, Line2D([], [], marker="x", color=FORESEEN_COLOR, label="foreseen", **how)]
    detects = isinstance(verdict, DetectionVerdict)
    fills: list[Artist] = [
        Patch(label=words, facecolor=(OUTCOME_COLORS[kind], 0.4), edgecolor=OUTCOME_COLORS[kind])
        for kind, words in {"right": "detected" if detects else "right", "false": "false"}.items()
    ]
    pale = OUTCOME_COLORS["missed"]
    missed = Patch(label="missed", facecolor=pale, edgecolor=CASINGS[pale], linestyle=DASHED)
    found = (
        [Line2D([], [], color="black", linewidth=0.9, label="true box of a detection")]
        if detects
        else []
    )
    return [*fills, missed, *found]
