"""`V2XConfig`: contents of a `V2XDataset`'s items; and the BEV transform A (rotation, scale, flip).

A is applied to boxes, points and poses, and drawn at random for training. All agents' ego frames
are transformed in the same way: a point p becomes A p, a pose W between two ego frames becomes A W
A⁻¹, and transforms from an ego frame to a sensor undo A first, so that points are projected to the
same pixels as before. Images do not change.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

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
from deepaccident_devkit.support.text import PathType, settle_choices
from deepaccident_devkit.taxonomy import OnError
from deepaccident_devkit.v2x import Agents, Link, WindowConfig
from deepaccident_devkit.v2x.messages import checked_link

BoxSource = Literal["sample", "cooperative"]
AugmentationSource = Augmentation | Callable[[np.random.Generator], Augmentation]
"""An augmentation of all items, or a function that draws one for each item (`RandomAugmentation`).

Spawned workers cannot receive a lambda.
"""
# Recorded frames (0.1 s) between frames of sensor data.
_DEFAULT_STEP = 5
# Field, its type or types, and the expected value in words for the error.
_TYPED_FIELDS = (
    ("images", ImageConfig, "an ImageConfig, such as ImageConfig(resize=(224, 400))"),
    ("labels", (MotionLabelConfig, str), "a MotionLabelConfig, or the name of a preset"),
    ("window", WindowConfig, "a WindowConfig, such as WindowConfig(past=2.0, future=3.0)"),
    ("bev_segmentation", BevGrid, "the BevGrid that it is resampled to, such as BevGrid()"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class V2XConfig:
    """The contents of an item.

    Attributes:
        agents: Agents that cooperate with the sample's own agent, which is always present and
            first: a configuration, its name, agents' names, or None for all agents (`v2x.Agents`).
        link: Degradation of the partners' sensor data and poses; boxes and labels do not change.
        past: Number of frames of sensor data, including the present.
        step: Recorded frames (0.1 s) from one frame of sensor data to the next; None for the
            labels' own step or, without labels, 5 (2 Hz).
        images: Preparation of images; None for no images and cameras.
        images_cache: Folder that `deepaccident cache` wrote and that images are read from; None for
            the release's own images.
        points: Whether to load point clouds.
        boxes: `sample` for the boxes that the sample's agent annotated, `cooperative` for the union
            of the cooperating agents' boxes (`v2x.cooperative_boxes`: with the sample's own agent,
            if another one annotated it), None for no boxes.
        visible: Visibility of the boxes: `released`, `camera`, or None for all, with own rows
            (`DeepAccident.boxes`, `v2x.cooperative_boxes`).
        window: Steps and actors of the window of tracks, which has its own `agents` and `visible`;
            None for no window.
        labels: Motion labels, or the name of a preset (`motion.PRESETS`); None for no labels. Their
            own `agents` are the agents that see the labelled actors; this configuration's
            `augmentation` augments them.
        to_present: Warp of the labels to the present ego frame and sampling of centerness:
            `nearest` as in the released training, `bilinear` as in its evaluation; None to leave
            each frame in its own ego frame.
        bev_segmentation: Cells of the segmentation targets from the BEV camera; None for no such
            targets.
        augmentation: Transform A, applied to everything in an ego frame; None for none.
        seed: Seed of the drawn augmentations.
        on_missing: Treatment of sensor files that were not downloaded: `raise`, or `skip` treats
            the agent's data of that frame as not arrived, and counts the files in the item's
            `files_missing`. The sample's own files of the present cannot be skipped.

    Raises:
        ConfigError: If a value has another type or is out of its range, or values exclude each
            other.
        ChoiceError: If a choice does not exist.
    """

    # Agents and frames.
    agents: Agents = "single"
    link: Link | None = None
    past: int = 1
    step: int | None = None
    # Sensor data.
    images: ImageConfig | None = None
    images_cache: PathType | None = None
    points: bool = True
    # Targets.
    boxes: BoxSource | None = "sample"
    visible: Visible | None = "released"
    window: WindowConfig | None = None
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
            preset = MotionLabelConfig.preset(self.labels)
            object.__setattr__(self, "labels", preset)
        if self.step is None:
            step = _DEFAULT_STEP
            if isinstance(self.labels, MotionLabelConfig):
                step = self.labels.step
            object.__setattr__(self, "step", step)
        for name, lowest in (("past", 1), ("step", 1), ("seed", 0)):
            count = _checked_count(name, getattr(self, name), lowest)
            object.__setattr__(self, name, count)
        choices = {
            "boxes": (None, *get_args(BoxSource)),
            "visible": (None, *get_args(Visible)),
            "to_present": (None, *get_args(WarpMode)),
        }
        settle_choices(self, choices)
        settle_choices(self, {"on_missing": get_args(OnError)})
        if self.images_cache is not None:
            if self.images is None:
                raise ConfigError(
                    "images_cache: has no effect without images=ImageConfig(…); also give images"
                )
            if self.images.virtual_camera is not None:
                raise ConfigError(
                    "images_cache: contains images of the real cameras; remove the virtual camera"
                )
        if isinstance(self.labels, MotionLabelConfig) and self.labels.augmentation is not None:
            raise ConfigError(
                "labels: labels have the same augmentation as boxes, points and poses; give "
                "only V2XConfig(augmentation=…)"
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
            ConfigError: If the function that draws it returns something else.
        """
        if self.augmentation is None or isinstance(self.augmentation, Augmentation):
            return self.augmentation or Augmentation()
        generator = np.random.default_rng([self.seed, epoch, index])
        augmentation = self.augmentation(generator)
        if not isinstance(augmentation, Augmentation):
            raise ConfigError(
                "augmentation: the function must return an Augmentation, but returned "
                f"{augmentation!r}"
            )
        return augmentation


def _checked_count(name: str, value: object, lowest: int) -> int:
    """Return a value if it is a whole number that is not too low; raises ConfigError otherwise."""
    expected = f"a whole number from {lowest}"
    number = checked_whole(name, value, expected, ConfigError)
    if isinstance(value, bool) or number < lowest:
        raise ConfigError(f"{name}: expected {expected}, found {value!r}")
    return number


@dataclass(frozen=True, slots=True, kw_only=True)
class RandomAugmentation:
    """A function that draws an `Augmentation` from a generator; the defaults are BEVerse's ranges.

    Attributes:
        rotation: Largest angle in either direction, radians; angles are drawn uniformly.
        scale: Smallest and largest factor; factors are drawn uniformly.
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
    """Return boxes of an ego frame in the augmented frame, (M, 9): x y z l w h yaw vx vy.

    They are right-handed, with z of the centre; metres, radians in (−π, π], m/s; NaN velocities
    stay NaN. As in the released code sizes and velocities scale too. The released flip turns yaw
    into π − yaw, which swaps front and rear; here the heading of a mirrored box is mirrored like
    its velocity.
    """
    rotation = augmentation.matrix[:2, :2]
    headings = np.column_stack([np.cos(boxes.yaw), np.sin(boxes.yaw)]) @ rotation.T
    center = transformed(augmentation.matrix, boxes.center)
    size = boxes.size * augmentation.scale
    yaw = np.arctan2(headings[:, 1], headings[:, 0])
    velocity = boxes.velocity[:, :2] @ rotation.T
    return np.column_stack([center, size, yaw, velocity])


def augmented_points(cloud: LidarPointCloud, augmentation: Augmentation) -> AnyArray:
    """Return the points of an ego frame in the augmented frame, (N, 4) float32.

    The columns are x y z in metres, and the unchanged intensity.
    """
    xyz = transformed(augmentation.matrix, cloud.xyz)
    points = np.column_stack([xyz, cloud.intensity])
    return points.astype(np.float32)


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
    """Return points (N, 3) transformed by an affine matrix (4, 4)."""
    linear_part = matrix[:3, :3]
    translation = matrix[:3, 3]
    return as_floats(points @ linear_part.T + translation)
