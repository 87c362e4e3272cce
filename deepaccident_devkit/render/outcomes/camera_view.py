"""`CameraView`: lines on the ground, and words beside them, in a camera's image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.geometry import SE3, PinholeCamera
from deepaccident_devkit.render.boxes import segments_in_image, write_beside
from deepaccident_devkit.render.chips import keep_free
from deepaccident_devkit.render.colors import CASING_COLOR, OUTCOME_COLORS
from deepaccident_devkit.render.outcomes.detection import DASHED
from deepaccident_devkit.taxonomy import INFRASTRUCTURE, POLE_HEIGHT
from deepaccident_devkit.v2x.projection import camera_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_POST: Final = 1.5
"""Metres: the height of the posts at places, since rings far away are flat."""
_MARK: Final = (-6.0, -6.0, 6.0, 6.0)
"""Points around a post that no words cover: left, low, right and high."""
_CASING: Final = 1.4
"""Points by which the casing of a line is wider."""
CASINGS: Final = {OUTCOME_COLORS["missed"]: "black"}
"""Edges around lines that are pale; others have white edges."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraView:
    """A camera's panel, and what lies on the ground in it.

    The ground is flat: z = 0 in a vehicle's ego frame, `POLE_HEIGHT` below the infrastructure's.

    Attributes:
        channel: the camera's.
        sample: token.
        lens: its intrinsics.
        optical_from_ego: of the sample.
        ground: z of the ground in the ego frame, metres.
        ax: in pixels.
    """

    channel: str
    sample: str
    lens: PinholeCamera
    optical_from_ego: SE3
    ground: float
    ax: Axes

    def optical(self, places: FloatArray, height: float = 0.0) -> FloatArray:
        """Points (N, 3) of the optical frame, so many metres above places (N, 2) of the ego frame."""
        return self.optical_from_ego.apply(np.column_stack([places, np.full(len(places), self.ground + height)]))

    def on_ground(self, lines: Sequence[FloatArray]) -> list[FloatArray]:
        """Lines (P, 2) on the ground, metres of the ego frame, as pixels (V, 2) of their parts in front of the camera.

        The ends of a cut are far below the image, and so is the line between two of them.
        """
        if not lines:
            return []
        points, owner = self.optical(np.concatenate(lines)), np.repeat(np.arange(len(lines)), [*map(len, lines)])
        within = owner[1:] == owner[:-1]
        pixels, drawn = segments_in_image(np.stack([points[:-1], points[1:]], axis=1)[within], self.lens)
        rows, starts = np.unique(owner[1:][within][drawn], return_index=True)
        return np.split(pixels.reshape(-1, 2), 2 * starts[1:]) if len(rows) else []

    def draw_lines(self, lines: Sequence[FloatArray], color: str, *, width: float, dashed: bool = False) -> None:
        """Render lines (V, 2) in pixels, on wider ones that set them off from the image."""
        from matplotlib.collections import LineCollection

        casing = CASINGS.get(color, CASING_COLOR)
        below = LineCollection(lines, colors=casing, linewidths=width + _CASING, alpha=0.7)
        above = LineCollection(lines, colors=color, linewidths=width, linestyles=DASHED if dashed else "solid")
        self.ax.add_collection(below, autolim=False)  # the image has set the limits
        self.ax.add_collection(above, autolim=False)

    def posts(self, places: FloatArray) -> FloatArray:
        """Feet and tops (V, 2, 2), pixels, of posts at places (N, 2) of the ego frame; of those in front alone."""
        pixels, _ = segments_in_image(np.stack([self.optical(places), self.optical(places, _POST)], axis=1), self.lens)
        return pixels

    def write(self, words: str, places: FloatArray, color: str) -> None:
        """Write words beside places (N, 2) of the ego frame: between the feet of the posts that the image shows."""
        posts = self.posts(places)
        seen = posts[self.lens.in_image(posts[:, 0])]
        if len(seen):
            u, v = seen[:, 0].mean(axis=0).tolist()
            keep_free(self.ax, seen, margin=_MARK)
            write_beside(self.ax, words, (u, v), color)


def view_of(dataset: Dataset, sample: str, channel: str, ax: Axes) -> CameraView:
    """The panel of a camera of a sample (a token), to be rendered on axes."""
    return CameraView(
        channel=channel,
        sample=sample,
        lens=camera_of(dataset, f"{sample}/{channel}"),
        optical_from_ego=dataset.world_from(sample, channel).inverse() @ dataset.world_from(sample, "ego"),
        ground=-POLE_HEIGHT if dataset.get("sample", sample)["agent"] == INFRASTRUCTURE else 0.0,
        ax=ax,
    )
