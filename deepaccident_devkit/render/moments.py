"""Several panels of one moment."""

from __future__ import annotations

from typing import TYPE_CHECKING

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.render.axes import figure_or_new
from deepaccident_devkit.render.bev import render_bev
from deepaccident_devkit.render.camera import render_sample_data
from deepaccident_devkit.taxonomy import AGENTS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_CAMERA_GRID = (
    ("Camera_FrontLeft", "Camera_Front", "Camera_FrontRight"),
    ("Camera_BackLeft", "Camera_Back", "Camera_BackRight"),
)


def render_sample(dataset: Dataset, sample: RowArgument, *, fig: Figure | None = None) -> Figure:
    """Draw a sample: its six cameras as they look, and boxes and LiDAR from above.

    Args:
        dataset: the release.
        sample: token or record.
        fig: an empty figure to draw on; a new one if None.

    Returns:
        The figure drawn on.

    Raises:
        TokenError: no such sample.
        MissingFileError: an image was not downloaded.
    """
    record = dataset.get("sample", sample)
    fig = figure_or_new(fig, (16, 7))
    axes = fig.subplot_mosaic([[*_CAMERA_GRID[0], "bev"], [*_CAMERA_GRID[1], "bev"]], width_ratios=(4, 4, 4, 4.5))
    for channel in (*_CAMERA_GRID[0], *_CAMERA_GRID[1]):
        render_sample_data(dataset, f"{record['token']}/{channel}", ax=axes[channel])
    render_bev(dataset, record, ax=axes["bev"])
    fig.suptitle(record["token"])
    return fig


def render_frame(dataset: Dataset, frame: RowArgument, *, fig: Figure | None = None) -> Figure:
    """Draw what the agents of a moment see to the front, and each one's boxes and LiDAR from above.

    Args:
        dataset: the release.
        frame: token or record.
        fig: an empty figure to draw on; a new one if None.

    Returns:
        The figure drawn on, a column an agent that is there.

    Raises:
        TokenError: no such frame.
        MissingFileError: an image was not downloaded.
    """
    record = dataset.get("frame", frame)
    samples = dataset.samples_of(record)
    fig = figure_or_new(fig, (4 * len(AGENTS), 6.5))
    axes = fig.subplots(2, len(samples), squeeze=False, height_ratios=(9, 16))
    for column, sample in enumerate(samples):
        render_sample_data(dataset, f"{sample['token']}/Camera_Front", ax=axes[0, column]).set_title(sample["agent"])
        render_bev(dataset, sample, ax=axes[1, column]).set_title("")
    end = record["time_to_impact"]
    countdown = "" if end is None else f", {end:.1f} s to the impact"
    fig.suptitle(f"{record['token']}, t = {record['timestamp']:.1f} s{countdown}")
    return fig
