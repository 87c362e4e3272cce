"""The labels that the motion head learns from, as tensors."""

from __future__ import annotations

from typing import Final, Literal, NamedTuple

import torch
from torch import Tensor


IGNORE_INDEX: Final = 255
"""What offset and flow have outside instances (`motion.MotionLabelConfig.ignore_index`)."""
LABEL_CHANNELS: Final = 6
"""Of a frame's maps as the posterior sees them: segmentation, centerness, offset and flow."""
PosteriorIgnore = Literal["keep", "zero"]
POSTERIOR_IGNORES: Final[tuple[PosteriorIgnore, ...]] = ("keep", "zero")


class MotionTargets(NamedTuple):
    """A batch's motion labels, all frames warped to the present (`TorchConfig(to_present="nearest")`).

    Attributes:
        segmentation: (N, T, H, W) int64, 1 on instances.
        centerness: (N, T, 1, H, W) 1 at the instances' centres, less around them.
        offset: (N, T, 2, H, W) cells to the centre, down the rows and along the columns; 255 = ignored.
        flow: (N, T, 2, H, W) cells to the centre in the next frame, likewise.
        frame_mask: (N, T) bool, the frames that losses count (`frame_mask`).
    """

    segmentation: Tensor
    centerness: Tensor
    offset: Tensor
    flow: Tensor
    frame_mask: Tensor

    def posterior_input(self, *, stride: int, ignore: PosteriorIgnore, ignore_index: int) -> Tensor:
        """The maps of the future frames as channels beside the features.

        Args:
            stride: take every such row and column, the first included.
            ignore: what ignored cells of offset and flow show: `keep` the mark (as released), or `zero`.
            ignore_index: the mark.

        Returns:
            (N, (T − 1) · 6, H / stride, W / stride): frame after frame segmentation, centerness, offset, flow.
        """
        centerness, offset, flow = (
            maps[:, 1:, :, ::stride, ::stride] for maps in (self.centerness, self.offset, self.flow)
        )
        segmentation = self.segmentation[:, 1:, None, ::stride, ::stride].to(centerness.dtype)
        if ignore == "zero":
            offset, flow = (maps.masked_fill(maps == ignore_index, 0) for maps in (offset, flow))
        return torch.cat([segmentation, centerness, offset, flow], dim=2).flatten(1, 2)


def frame_mask(label_valid: Tensor, past_valid: Tensor) -> Tensor:
    """Which label frames losses count: those in the recording, of samples whose past frames all are in it.

    The released rule (`sample_ignore_mode = "past_valid"`).

    Args:
        label_valid: (N, T) bool, the label frames in the recording, from the present on.
        past_valid: (N, P − 1) bool, the frames before the present.

    Returns:
        (N, T) bool.
    """
    return label_valid & past_valid.all(dim=1, keepdim=True)
