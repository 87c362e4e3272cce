"""`V2XConfig`: contents of a `V2XDataset`'s items; and the BEV transform A (rotation, scale, flip).

A is applied to boxes, points and poses, and drawn at random for training. All agents' ego frames
are transformed in the same way: a point p becomes A p, a pose W between two ego frames becomes A W
A⁻¹, and transforms from an ego frame to a sensor undo A first, so that points fall on the same
pixels as before. Images do not change.
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
"""An augmentation of all items, or a function that draws one for each item (`RandomAugmentation`).

Spawned workers cannot receive a lambda.
"""
_DEFAULT_STEP: Final = 5
# Field, its type or types, and the expected value in words for the error.
_TYPED_FIELDS: Final = (
    ("images", ImageConfig, "an ImageConfig, such as ImageConfig(resize=(224, 400))"),
    ("labels", (MotionLabelConfig, str), "a MotionLabelConfig, or the name of a preset"),
    ("bev_segmentation", BevGrid, "the BevGrid that it is resampled to, such as BevGrid()"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class V2XConfig:
    """The contents of an item; checked on construction, raises ConfigError or ChoiceError.

    Attributes:
        agents: Agents that cooperate with the sample's own agent, which is always present and
            first: a configuration, its name, agents' names, or None for all agents (`v2x.Agents`).
        link: Degradation of the partners' sensor data and poses; boxes and labels do not change.
        past: Number of frames of sensor data, including the present.
        step: Recorded frames (0.1 s) between them; None for the labels' own step or, without
            labels, 5 (2 Hz).
        images: Preparation of images; None for no images and cameras.
        images_cache: Folder that `deepaccident cache` wrote and that images are read from; None for
            the release's own images.
        points: Whether to load point clouds.
        boxes: `sample` for the boxes that the sample's agent annotated, `cooperative` for the union
            of the cooperating agents' boxes (`v2x.cooperative_boxes`: with the sample's own agent,
            if another one annotated it), None for none.
        visible: Visibility of the boxes: `released`, `camera`, or None for all, with own rows
            (`DeepAccident.boxes`, `v2x.cooperative_boxes`).
        labels: Motion labels, or the name of a preset (`motion.PRESETS`); None for none. Their own
            `agents` are the agents that see the labelled actors; this configuration's
            `augmentation` augments them.
        to_present: Warp of the labels to the present ego frame and sampling of centerness:
            `nearest` as in the released training, `bilinear` as in its evaluation. None: each frame
            in its own ego frame.
        bev_segmentation: Cells of the segmentation targets from the BEV camera; None for none.
        augmentation: A, applied to everything in an ego frame; None for none.
        seed: Seed of the drawn augmentations.
        on_missing: Treatment of sensor files that were not downloaded: `raise`, or `skip` treats
            the agent's data of that frame as not arrived, and counts them in the item's
            `files_missing`. The sample's own files of the present cannot be skipped.
    """

    # Agents and frames.
    agents: Agents = "single"
    link: Link | None = None
    past: int = 1
    step: int | None = None
    # Sensor data.
    images: ImageConfig | None = None
    images_cache: str | os.PathLike[str] | None = None
    points: bool = True
    # Targets.
    boxes: BoxSource | None = "sample"
    visible: Visible | None = "released"
    labels: MotionLabelConfig | str | None = None
    to_present: WarpMode | None = "nearest"
    bev_segmentation: BevGrid | None = None
    # Augmentation and missing files.
    augmentation: AugmentationSource | None = None
    seed: int = 0
    on_missing: OnError = "raise"

    def __post_init__(self) -> None:
        """Check and complete the fields."""
        self._check_types()
        if isinstance(self.labels, str):
            object.__setattr__(self, "labels", MotionLabelConfig.preset(self.labels))
        if self.step is None:
            step = _DEFAULT_STEP
            if isinstance(self.labels, MotionLabelConfig):
                step = self.labels.step
            object.__setattr__(self, "step", step)
        for name, lowest in (("past", 1), ("step", 1), ("seed", 0)):
            object.__setattr__(self, name, _checked_count(name, getattr(self, name), lowest))
        words = {
            "boxes": (None, *get_args(BoxSource)),
            "visible": (None, *get_args(Visible)),
            "to_present": (None, *get_args(WarpMode)),
        }
        settle_choices(self, words)
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
                "images_cache: has images as their own cameras took them; leave out the virtual "
                "camera"
            )
        if isinstance(self.labels, MotionLabelConfig) and self.labels.augmentation is not None:
            raise ConfigError(
                "labels: their augmentation is that of boxes, points and poses; give "
                "V2XConfig(augmentation=…) alone"
            )

    def _check_types(self) -> None:
        checked_link(self.link)
        for name, kind, example in _TYPED_FIELDS:
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
                "augmentation: expected an Augmentation or a function that draws one, found "
                f"{self.augmentation!r}"
            )

    def augmentation_of(self, epoch: int, index: int) -> Augmentation:
        """Return the augmentation of an item in an epoch, which only depends on these and the seed.

        Raises:
            ConfigError: The function that draws it returned something else.
        """
        if self.augmentation is None or isinstance(self.augmentation, Augmentation):
            return self.augmentation or Augmentation()
        augmentation = self.augmentation(np.random.default_rng([self.seed, epoch, index]))
        if not isinstance(augmentation, Augmentation):
            raise ConfigError(
                "augmentation: its function must return an Augmentation, and returned "
                f"{augmentation!r}"
            )
        return augmentation


def _checked_count(name: str, value: object, lowest: int) -> int:
    """Return an integer that is not below the lowest value; raises ConfigError."""
    expected = f"a whole number from {lowest}"
    number = checked_whole(name, value, expected, ConfigError)
    if isinstance(value, bool) or number < lowest:
        raise ConfigError(f"{name}: expected {expected}, found {value!r}")
    return number


@dataclass(frozen=True, slots=True, kw_only=True)
class RandomAugmentation:
    """Draws an `Augmentation` from a generator; the defaults are BEVerse's ranges.

    Attributes:
        rotation: The largest angle in either direction, radians; uniform.
        scale: The smallest and the largest factor; uniform.
        flip: Probability of mirroring left and right.
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
        """Draw an augmentation."""
        return Augmentation(
            rotation=float(generator.uniform(-self.rotation, self.rotation)),
            scale=float(generator.uniform(*self.scale)),
            flip=bool(generator.random() < self.flip),
        )


def augmented_boxes(boxes: Boxes, augmentation: Augmentation) -> FloatArray:
    """Return boxes of an ego frame in the augmented one, (M, 9): x y z l w h yaw vx vy.

    Right-handed, z of the centre; metres, radians in (−π, π], m/s; NaN velocities stay NaN. As in
    the released code sizes and velocities scale too. The released flip turns yaw into π − yaw,
    which swaps front and rear; here the heading of a mirrored box is mirrored like its velocity.
    """
    rotation = augmentation.matrix[:2, :2]
    headings = np.column_stack([np.cos(boxes.yaw), np.sin(boxes.yaw)]) @ rotation.T
    return np.column_stack(
        [
            transformed(augmentation.matrix, boxes.center),
            boxes.size * augmentation.scale,
            np.arctan2(headings[:, 1], headings[:, 0]),
            boxes.velocity[:, :2] @ rotation.T,
        ]
    )


def augmented_points(cloud: LidarPointCloud, augmentation: Augmentation) -> AnyArray:
    """Return a cloud of an ego frame in the augmented one, (N, 4) float32.

    The columns are x y z in metres, and the unchanged intensity.
    """
    xyz = transformed(augmentation.matrix, cloud.xyz)
    return np.column_stack([xyz, cloud.intensity]).astype(np.float32)


def augmented_pose(pose: ArrayLike, augmentation: Augmentation) -> FloatArray:
    """Return poses (…, 4, 4) between two ego frames, for the augmented frames: A W A⁻¹."""
    matrix = augmentation.matrix
    return as_floats(matrix @ as_floats(pose) @ np.linalg.inv(matrix))


def augmented_six_vectors(six: ArrayLike, augmentation: Augmentation) -> FloatArray:
    """Return 6-vectors (…, 6) between two ego frames as 6-vectors between the augmented ones.

    Translations are scaled; rotations stay rotations, even with a flip.
    """
    poses = augmented_pose(conventions.matrices_of_six(six), augmentation)
    return conventions.six_vectors_of(poses)


def transformed(matrix: FloatArray, points: FloatArray) -> FloatArray:
    """Return points (N, 3) moved by an affine matrix (4, 4)."""
    return as_floats(points @ matrix[:3, :3].T + matrix[:3, 3])
