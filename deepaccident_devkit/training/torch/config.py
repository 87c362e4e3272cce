"""`V2XConfig`: the contents of a `V2XDataset`'s items; and the bird's-eye-view transform A (rotation, scale, flip).

A is applied to boxes, points and poses, and drawn at random for training. All agents' ego frames are transformed in the
same way: a point p becomes A p, a pose W between two ego frames becomes A W A⁻¹, and transforms from an ego frame to a
sensor undo A first, so that points fall on the same pixels as before. Images do not change.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.dataset import Visible
from deepaccident_devkit.errors import ConfigError, GeometryError
from deepaccident_devkit.export.images import ImageConfig
from deepaccident_devkit.geometry import BevGrid, Boxes, LidarPointCloud, conventions
from deepaccident_devkit.motion import Augmentation, MotionLabelConfig
from deepaccident_devkit.motion.warping import WarpMode
from deepaccident_devkit.support.arrays import (
    AnyArray,
    FloatArray,
    as_floats,
    checked,
    checked_number,
    checked_whole,
)
from deepaccident_devkit.support.text import settle_choices
from deepaccident_devkit.taxonomy import OnError
from deepaccident_devkit.v2x import Agents, Link
from deepaccident_devkit.v2x.messages import checked_link

BoxSource = Literal["sample", "cooperative"]
AugmentationSource = Augmentation | Callable[[np.random.Generator], Augmentation]
"""One for all items, or a draw for each (`RandomAugmentation`; spawned workers cannot receive a lambda)."""
_DEFAULT_STEP: Final = 5
# Field, its type or types, and the expected value in words for the error.
_PARTS: Final = (
    ("images", ImageConfig, "an ImageConfig, such as ImageConfig(resize=(224, 400))"),
    ("labels", (MotionLabelConfig, str), "a MotionLabelConfig, or the name of a preset"),
    ("bev_segmentation", BevGrid, "the BevGrid that it is resampled to, such as BevGrid()"),
)


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
            object.__setattr__(
                self,
                "step",
                labels.step if isinstance(labels, MotionLabelConfig) else _DEFAULT_STEP,
            )
        for name, least in (("past", 1), ("step", 1), ("seed", 0)):
            object.__setattr__(self, name, _count(name, getattr(self, name), least))
        words = {
            "boxes": get_args(BoxSource),
            "visible": get_args(Visible),
            "to_present": get_args(WarpMode),
        }
        settle_choices(self, {name: (None, *possible) for name, possible in words.items()})
        settle_choices(self, {"on_missing": get_args(OnError)})
        if self.images_cache is not None and self.images is None:
            raise ConfigError(
                "images_cache: changes nothing without images=ImageConfig(…); give that too"
            )
        if (
            self.images_cache is not None
            and self.images is not None
            and self.images.virtual_camera is not None
        ):
            raise ConfigError(
                "images_cache: has images as their own cameras took them; leave out the virtual camera"
            )
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
            self.augmentation is None
            or isinstance(self.augmentation, Augmentation)
            or callable(self.augmentation)
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
            raise ConfigError(
                f"augmentation: its function must return an Augmentation, and returned {drawn!r}"
            )
        return drawn


def _count(name: str, value: object, least: int) -> int:
    expected = f"a whole number from {least}"
    whole = checked_whole(name, value, expected, ConfigError)
    if isinstance(value, bool) or whole < least:
        raise ConfigError(f"{name}: expected {expected}, found {value!r}")
    return whole


@dataclass(frozen=True, slots=True, kw_only=True)
class RandomAugmentation:
    """Draws an `Augmentation` from a generator; the defaults are BEVerse's ranges.

    Attributes:
        rotation: the largest angle in either direction, radians; uniform.
        scale: the smallest and the largest factor; uniform.
        flip: the probability of mirroring left and right.
    """

    rotation: float = math.radians(22.5)
    scale: tuple[float, float] = (0.95, 1.05)
    flip: float = 0.5

    def __post_init__(self) -> None:
        """Check the ranges; raises ConfigError."""
        name = "random augmentation: "
        rotation = checked_number(f"{name}rotation", self.rotation, "radians", ConfigError)
        if not 0 <= rotation < math.inf:
            raise ConfigError(f"{name}rotation is {self.rotation}; choose finite radians from 0")
        try:
            scale = tuple(checked("scale", self.scale, (2,)).tolist())
        except GeometryError:
            scale = (math.nan, math.nan)
        if not 0 < scale[0] <= scale[1] < math.inf:
            raise ConfigError(f"{name}scale is {self.scale!r}; choose (smallest, largest) above 0")
        flip = checked_number(f"{name}flip", self.flip, "a probability", ConfigError)
        if not 0 <= flip <= 1:
            raise ConfigError(f"{name}flip is {self.flip}; choose a probability from 0 to 1")
        for field, value in (("rotation", rotation), ("scale", scale), ("flip", flip)):
            object.__setattr__(self, field, value)

    def __call__(self, generator: np.random.Generator) -> Augmentation:
        """One draw."""
        return Augmentation(
            rotation=float(generator.uniform(-self.rotation, self.rotation)),
            scale=float(generator.uniform(*self.scale)),
            flip=bool(generator.random() < self.flip),
        )


def augmented_boxes(boxes: Boxes, augmentation: Augmentation) -> FloatArray:
    """Boxes of an ego frame in the augmented one, (M, 9): x y z l w h yaw vx vy.

    Right-handed, z of the centre; metres, radians in (−π, π], m/s; NaN velocities stay NaN. As in the released code
    sizes and velocities scale too. The released flip turns yaw into π − yaw, which swaps front and rear; here the
    heading of a mirrored box is mirrored like its velocity.
    """
    turn = augmentation.matrix[:2, :2]
    heading = np.column_stack([np.cos(boxes.yaw), np.sin(boxes.yaw)]) @ turn.T
    return np.column_stack(
        [
            transformed(augmentation.matrix, boxes.center),
            boxes.size * augmentation.scale,
            np.arctan2(heading[:, 1], heading[:, 0]),
            boxes.velocity[:, :2] @ turn.T,
        ]
    )


def augmented_points(cloud: LidarPointCloud, augmentation: Augmentation) -> AnyArray:
    """A cloud of an ego frame in the augmented one, (N, 4) float32: x y z in metres, and the unchanged intensity."""
    return np.column_stack([transformed(augmentation.matrix, cloud.xyz), cloud.intensity]).astype(
        np.float32
    )


def augmented_pose(pose: ArrayLike, augmentation: Augmentation) -> FloatArray:
    """Poses (…, 4, 4) between two ego frames as poses between the two augmented ones: A W A⁻¹."""
    matrix = augmentation.matrix
    return as_floats(matrix @ as_floats(pose) @ np.linalg.inv(matrix))


def augmented_six_vectors(six: ArrayLike, augmentation: Augmentation) -> FloatArray:
    """The same for 6-vectors (…, 6): translations are scaled; rotations stay rotations, even with a flip."""
    return conventions.six_vectors_of(
        augmented_pose(conventions.matrices_of_six(six), augmentation)
    )


def transformed(matrix: FloatArray, points: FloatArray) -> FloatArray:
    """Points (N, 3) moved by an affine matrix (4, 4)."""
    return as_floats(points @ matrix[:3, :3].T + matrix[:3, 3])
