"""`V2XConfig`: the contents of a `V2XDataset`'s items."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np

from deepaccident_devkit.arrays import checked_whole
from deepaccident_devkit.dataset import Visible
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.export.images import ImageConfig
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import Augmentation, MotionLabelConfig
from deepaccident_devkit.motion.warps.warping import WarpMode
from deepaccident_devkit.taxonomy import OnError
from deepaccident_devkit.text import settle_choices
from deepaccident_devkit.v2x import Agents, Link
from deepaccident_devkit.v2x.link import checked_link

BoxSource = Literal["sample", "cooperative"]
AugmentationSource = Augmentation | Callable[[np.random.Generator], Augmentation]
"""One for all items, or a draw for each (`RandomAugmentation`; spawned workers cannot receive a lambda)."""
_DEFAULT_STEP: Final = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class V2XConfig:
    """The contents of an item and how it is made; checked when made, raises ConfigError or ChoiceError.

    Attributes:
        agents: who cooperates with the sample's own agent, which is always there and first: a configuration, its name,
            agents' names, or None for all that are there (`v2x.Agents`).
        link: what happens to the partners' sensor data and poses; boxes and labels do not change.
        past: frames of sensor data, the present included.
        step: recorded frames (0.1 s) between them; None for the labels' own step or, without labels, 5 (2 Hz).
        images: None for no images and cameras.
        images_cache: folder that `deepaccident cache` wrote, from which images are taken; None for the release's own.
        points: whether to load point clouds.
        boxes: `sample` for those that the sample's agent annotated, `cooperative` for the union of what the
            cooperating agents annotated (`v2x.cooperative_boxes`: with the sample's own agent, if another one annotated
            it), None for none.
        visible: which of them: `released`, `camera`, or None for all, with own rows (`DeepAccident.boxes`,
            `v2x.cooperative_boxes`).
        labels: the motion labels, or the name of a preset (`motion.PRESETS`); None for none. Their own `agents` says
            whose view counts for them; this configuration's `augmentation` augments them.
        to_present: how to warp the labels to the present ego frame and sample centerness: `nearest` as in the released
            training, `bilinear` as in its evaluation. None: each frame in its own ego frame.
        bev_segmentation: cells of the segmentation targets from the BEV camera; None for none.
        augmentation: A, applied to all that is in an ego frame; None for none.
        seed: seed of the drawn augmentations.
        on_missing: of sensor files that were not downloaded: `raise`, or `skip` takes the agent's data of that frame as
            not arrived, and says so in the item's `files_missing`. The sample's own files of the present cannot be
            skipped.
    """

    agents: Agents = "single"
    link: Link | None = None
    past: int = 1
    step: int | None = None
    images: ImageConfig | None = None
    images_cache: str | os.PathLike[str] | None = None
    points: bool = True
    boxes: BoxSource | None = "sample"
    visible: Visible | None = "released"
    labels: MotionLabelConfig | str | None = None
    to_present: WarpMode | None = "nearest"
    bev_segmentation: BevGrid | None = None
    augmentation: AugmentationSource | None = None
    seed: int = 0
    on_missing: OnError = "raise"

    def __post_init__(self) -> None:
        """Check and complete."""
        self._check_types()
        if isinstance(self.labels, str):
            object.__setattr__(self, "labels", MotionLabelConfig.preset(self.labels))
        if self.step is None:
            labels = self.labels
            object.__setattr__(self, "step", labels.step if isinstance(labels, MotionLabelConfig) else _DEFAULT_STEP)
        for name, least in (("past", 1), ("step", 1), ("seed", 0)):
            object.__setattr__(self, name, _count(name, getattr(self, name), least))
        words = {"boxes": get_args(BoxSource), "visible": get_args(Visible), "to_present": get_args(WarpMode)}
        settle_choices(self, {name: (None, *possible) for name, possible in words.items()})
        settle_choices(self, {"on_missing": get_args(OnError)})
        if self.images_cache is not None and self.images is None:
            raise ConfigError("images_cache: changes nothing without images=ImageConfig(…); give that too")
        if isinstance(self.labels, MotionLabelConfig) and self.labels.augmentation is not None:
            raise ConfigError(
                "labels: their augmentation is that of boxes, points and poses; give V2XConfig(augmentation=…) alone"
            )

    def _check_types(self) -> None:
        checked_link(self.link)
        for name, kind, example in _PARTS:
            value = getattr(self, name)
            if value is not None and not isinstance(value, kind):
                raise ConfigError(f"{name}: expected None or {example}, found {value!r}")
        if not isinstance(self.points, bool):
            raise ConfigError(f"points: expected True or False, found {self.points!r}")
        if not (
            self.augmentation is None or isinstance(self.augmentation, Augmentation) or callable(self.augmentation)
        ):
            raise ConfigError(
                f"augmentation: expected an Augmentation or a function that draws one, found {self.augmentation!r}"
            )

    def augmentation_of(self, epoch: int, index: int) -> Augmentation:
        """The augmentation of an item in an epoch: it depends only on these two and the seed.

        Raises:
            ConfigError: the function that draws it returned something else.
        """
        if self.augmentation is None or isinstance(self.augmentation, Augmentation):
            return self.augmentation or Augmentation()
        drawn = self.augmentation(np.random.default_rng([self.seed, epoch, index]))
        if not isinstance(drawn, Augmentation):
            raise ConfigError(f"augmentation: its function must return an Augmentation, and returned {drawn!r}")
        return drawn


_PARTS: Final = (
    ("images", ImageConfig, "an ImageConfig, such as ImageConfig(resize=(224, 400))"),
    ("labels", (MotionLabelConfig, str), "a MotionLabelConfig, or the name of a preset"),
    ("bev_segmentation", BevGrid, "the BevGrid that it is resampled to, such as BevGrid()"),
)
"""Field, its type or types, and the expected value in words for the error."""


def _count(name: str, value: object, least: int) -> int:
    expected = f"a whole number from {least}"
    whole = checked_whole(name, value, expected, ConfigError)
    if isinstance(value, bool) or whole < least:
        raise ConfigError(f"{name}: expected {expected}, found {value!r}")
    return whole
