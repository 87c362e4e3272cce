"""`render_outcome_in_cameras`: a prediction and its truth in all cameras of an agent."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation.detection import DetectedBoxes
from deepaccident_devkit.evaluation.drawing import Drawing
from deepaccident_devkit.evaluation.predictions import MotionOutput
from deepaccident_devkit.render.captions import draw_legend, set_scene_title
from deepaccident_devkit.render.figures import figure_or_new, lay_out_figure
from deepaccident_devkit.render.outcomes.described import sample_drawing
from deepaccident_devkit.render.outcomes.drawings import draw_drawing_in_camera, drawing_handles
from deepaccident_devkit.render.samples import CAMERA_GRID, TALL_CAMERA_GRID
from deepaccident_devkit.render.styles import current_style, in_own_settings

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_FIGURE_SIZE_IN = (14.7, 7.1125)


@in_own_settings
def render_outcome_in_cameras(
    dataset: Dataset,
    sample: RowArgument,
    prediction: MotionOutput | DetectedBoxes | Sequence[Any],
    *,
    task: str | None = None,
    protocol: Any = None,
    frame: int | None = None,
    fig: Figure | None = None,
) -> Figure:
    """Render what a task describes of a prediction in the cameras of the sample's agent.

    Boxes and the ground cells of motion are right, false, or missed (dashed). Paths and places are
    on the ground, which is assumed to be flat: the plane z = 0 in a vehicle's ego frame, or 4 m
    below the infrastructure's LiDAR. Each place has a post of 1.5 m. What does not count, such as
    boxes and instances beyond the protocol's range, is not rendered. The agent's own box is not
    rendered either, because its cameras are inside it.

    Arguments and errors are as for `render_evaluation`. `frame` is the index of the motion frame to
    show (None: the current one); a later frame shows, in the current image, where instances will
    be.
    """
    described = sample_drawing(dataset, sample, prediction, task=task, protocol=protocol)
    drawing = described.drawing
    number, words = _frame_to_show(drawing, frame)
    fig = figure_or_new(fig, _FIGURE_SIZE_IN, column=1.3)
    grid = TALL_CAMERA_GRID if current_style().layout == "column" else CAMERA_GRID
    for channel, ax in fig.subplot_mosaic([[*row] for row in grid]).items():
        camera = f"{described.sample}/{channel}"
        draw_drawing_in_camera(dataset, described.sample, drawing, camera, ax, frame=number)
    draw_legend(fig, drawing_handles(drawing))
    set_scene_title(fig, dataset, described.sample, words, below=described.words)
    return lay_out_figure(fig)


def _frame_to_show(drawing: Drawing, frame: int | None) -> tuple[int, str]:
    """Return the index of a frame of cells, 0 for None, and words about a later one.

    Raises:
        ChoiceError: There is no such frame.
    """
    if frame is None:
        return 0, ""
    if not drawing.cells:
        raise ChoiceError(f"frame: only predicted motion has frames, found {frame!r}; leave it out")
    times = drawing.cells[0].times
    if frame not in range(len(times)):
        raise ChoiceError(
            f"frame: expected a recorded frame, from 0 to {len(times) - 1}, found {frame!r}"
        )
    words = f"instances in {times[frame]:.1f} s" if times[frame] else ""
    return frame, words
