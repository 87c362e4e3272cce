"""`CameraView`: the panel of a camera, and the ground in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.geometry import SE3, PinholeCamera
from deepaccident_devkit.render.boxes import segments_in_image, write_beside
from deepaccident_devkit.render.camera import draw_image
from deepaccident_devkit.render.captions import has_sensor_file
from deepaccident_devkit.render.chips import keep_free
from deepaccident_devkit.render.styles import CASING_COLOR, OUTCOME_COLORS
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.taxonomy import INFRASTRUCTURE, POLE_HEIGHT
from deepaccident_devkit.v2x.poses import camera_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Height in metres of the posts that mark positions; without them, distant rings look flat.
POST_HEIGHT_M = 1.5
# Margin in points around a post that words do not cover: left, below, right and above.
_MARK_MARGIN_PT = (-6.0, -6.0, 6.0, 6.0)
# Line style of missed boxes and instances.
DASHED: Final = (0, (2, 1))
# How much wider than a line its casing is, in points.
_CASING_WIDTH_PT = 1.4
# Casing colour by line colour, for pale lines; all other casings are white.
CASINGS: Final = {OUTCOME_COLORS["missed"]: "black"}
# Margin in points around the middle of a panel's upper edge, where the words about a missing image
# are: left, below, right and above.
_MISSING_WORDS_MARGIN_PT = (-58.0, -48.0, 58.0, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraView:
    """The panel of a camera, with the geometry to draw on the ground in it.

    The ground is flat: z = 0 in a vehicle's ego frame, `POLE_HEIGHT` below the infrastructure's.

    Attributes:
        camera: Token of the image (sample data).
        sample: Token of the sample; the image is this sample's, or another agent's in the same
            frame.
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
        """Transform positions (N, 2) in the ego frame to points (N, 3) in the optical frame.

        `height` is their height above the ground, metres.
        """
        z = np.full(len(positions), self.ground + height)
        ego_points = np.column_stack([positions, z])
        return self.optical_from_ego.apply(ego_points)

    def on_ground(self, lines: Sequence[FloatArray]) -> list[FloatArray]:
        """Project the parts of ground lines that are in front of the camera to pixels.

        Where a line is cut, the new ends are far below the image, and so is the line between them.

        Args:
            lines: Lines in the ego frame, shape (P, 2) each, metres.

        Returns:
            The parts of each line that has any, shape (V, 2) each, pixels.
        """
        if not lines:
            return []
        points = self.optical(np.concatenate(lines))
        line_numbers = np.repeat(np.arange(len(lines)), [*map(len, lines)])
        is_within_line = line_numbers[1:] == line_numbers[:-1]
        segments = np.stack([points[:-1], points[1:]], axis=1)[is_within_line]
        segment_numbers = line_numbers[1:][is_within_line]
        pixels, is_drawn = segments_in_image(segments, self.lens)
        numbers, first_segments = np.unique(segment_numbers[is_drawn], return_index=True)
        if not len(numbers):
            return []
        return np.split(pixels.reshape(-1, 2), 2 * first_segments[1:])

    def draw_lines(
        self,
        lines: Sequence[FloatArray],
        color: str,
        *,
        width: float,
        dashed: bool = False,
        opacity: float = 1.0,
    ) -> None:
        """Render lines (V, 2) in pixels, with a casing that sets them off from the image."""
        from matplotlib.collections import LineCollection

        if not lines:
            return
        casing_color = CASINGS.get(color, CASING_COLOR)
        casings = LineCollection(
            lines, colors=casing_color, linewidths=width + _CASING_WIDTH_PT, alpha=0.7 * opacity
        )
        line_style = DASHED if dashed else "solid"
        collection = LineCollection(
            lines, colors=color, linewidths=width, linestyles=line_style, alpha=opacity
        )
        self.ax.add_collection(casings, autolim=False)  # the image has set the limits
        self.ax.add_collection(collection, autolim=False)

    def fill(self, areas: Sequence[FloatArray], color: str, *, opacity: float) -> None:
        """Fill areas with the outlines (V, 2), pixels."""
        from matplotlib.collections import PolyCollection

        polygons = PolyCollection(areas, facecolors=color, alpha=opacity, edgecolors="none")
        self.ax.add_collection(polygons, autolim=False)

    def posts(self, positions: FloatArray) -> FloatArray:
        """Return the feet and tops, shape (V, 2, 2), pixels, of posts at positions (N, 2).

        Positions are in the ego frame; posts behind the camera are left out.
        """
        feet = self.optical(positions)
        tops = self.optical(positions, POST_HEIGHT_M)
        segments = np.stack([feet, tops], axis=1)
        pixels, _ = segments_in_image(segments, self.lens)
        return pixels

    def write(self, words: str, positions: FloatArray, color: str) -> None:
        """Write words near positions (N, 2) in the ego frame.

        They are written at the mean position of the posts' feet in the image. If no foot is in the
        image, nothing is written.
        """
        posts = self.posts(positions)
        feet = posts[:, 0]
        in_image = self.lens.in_image(feet)
        if in_image.any():
            u, v = feet[in_image].mean(axis=0).tolist()
            keep_free(self.ax, posts[in_image], margin=_MARK_MARGIN_PT)
            write_beside(self.ax, words, (u, v), color)


def view_of(
    dataset: Dataset, sample: str, camera: str, ax: Axes, *, image: bool = True
) -> CameraView:
    """Render an image in a panel, or words about its absence, and return its `CameraView`.

    The image may be of any agent in the sample's frame; `sample` and `camera` are tokens.
    """
    lens = camera_of(dataset, camera)
    draw_image(dataset, dataset.get("sample_data", camera), ax, image=image)
    if not has_sensor_file(dataset, camera):
        keep_free(ax, [[(lens.width / 2, 0.0)]], margin=_MISSING_WORDS_MARGIN_PT)
    optical_from_world = dataset.world_from(*camera.rsplit("/", 1)).inverse()
    return CameraView(
        camera=camera,
        sample=sample,
        lens=lens,
        optical_from_ego=optical_from_world @ dataset.world_from(sample, "ego"),
        ground=ground_height(dataset, sample),
        ax=ax,
    )


def ground_height(dataset: Dataset, sample: str) -> float:
    """Return the height of the ground in a sample's ego frame, metres."""
    if dataset.get("sample", sample)["agent"] == INFRASTRUCTURE:
        return -POLE_HEIGHT
    return 0.0
