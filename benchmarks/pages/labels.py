"""Make a moment with an ego that turns left; count the label cells in which protocols differ.

The counts are stored in labels.json; docs/training.md links them.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.motion import (
    LABEL_PROTOCOLS,
    FrameBoxes,
    LabelProtocol,
    MotionLabelConfig,
    MotionLabels,
    motion_labels_from_boxes,
)
from deepaccident_devkit.plugins.synth import SynthConfig
from deepaccident_devkit.taxonomy import CATEGORIES
from deepaccident_devkit.v2x import future_egomotion

RELEASE = SynthConfig(scenarios=4, frames=40, seed=11, sensors=False, designed=True)
MEASURED = Path(__file__).with_suffix(".json")
MAPS = ("segmentation", "instance", "centerness", "offset", "flow")
RELEASED = MotionLabelConfig(protocol="released")
CLEAN = MotionLabelConfig(protocol="clean")
TOLERANCE = 0.01
"""Difference of centerness, and of offset and flow in cells, up to which values are equal: maps
that are turned by an angle of 0 differ in the last bit.
"""
STEP = 0.5
"""Seconds from one frame to the next."""
YAW_RATE = 0.5
"""Radians per second of the turning ego."""


@dataclass(frozen=True, kw_only=True)
class Actor:
    """An actor that drives straight on; metres, radians, metres per second in the present ego frame
    of the turn.
    """

    actor_id: int
    category: str
    x: float
    y: float
    heading: float = 0.0
    speed: float = 0.0
    size: tuple[float, float, float] = (4.6, 2.0, 1.6)
    seen_from: int | None = 0

    def pose(self, frame: int) -> SE3:
        """Return the pose at a label frame."""
        distance = self.speed * STEP * frame
        x = self.x + distance * np.cos(self.heading)
        y = self.y + distance * np.sin(self.heading)
        return SE3.from_yaw(self.heading, (x, y, 0.0))

    def is_visible(self, frame: int) -> bool:
        return self.seen_from is not None and frame >= self.seen_from


class TurningEgo(Actor):
    """The ego: straight on up to the present, then on a circle to the left."""

    def pose(self, frame: int) -> SE3:
        yaw = max(0.0, YAW_RATE * STEP * frame)
        radius = self.speed / YAW_RATE
        straight = min(0, frame) * self.speed * STEP
        x = straight + radius * np.sin(yaw)
        y = radius * (1 - np.cos(yaw))
        return SE3.from_yaw(yaw, (x, y, 0.0))


EGO = TurningEgo(
    actor_id=-100, category="car", x=0, y=0, speed=4.0, size=(4.9, 2.1, 1.5), seen_from=None
)
ACTORS = (
    EGO,
    Actor(actor_id=21, category="car", x=38.6, y=3.5, heading=np.pi, speed=8.0),
    Actor(actor_id=22, category="car", x=20.3, y=-13.5, heading=np.pi / 2, speed=7.0),
    Actor(
        actor_id=40,
        category="van",
        x=38.0,
        y=-8.0,
        heading=np.pi,
        speed=5.0,
        size=(5.9, 2.2, 2.6),
        seen_from=2,
    ),
    Actor(actor_id=20001, category="car", x=9.3, y=-6.2, heading=0.25),
    Actor(
        actor_id=31,
        category="pedestrian",
        x=4.0,
        y=9.0,
        heading=-0.4,
        speed=1.6,
        size=(0.8, 0.8, 1.8),
    ),
    Actor(actor_id=-1, category="truck", x=-20.0, y=12.0, size=(8.5, 2.6, 3.4), seen_from=None),
    Actor(actor_id=-1, category="car", x=-28.0, y=-9.0, seen_from=None),
)
COLLIDING = (21, 22)


def turn(config: MotionLabelConfig) -> MotionLabels:
    """Return the labels of the moment: a left turn of the ego."""
    moments = [_make_boxes(frame) for frame in range(config.label_frames)]
    numbers = range(1 - config.receptive_field, config.label_frames + 1)
    matrices = np.stack([EGO.pose(number).matrix for number in numbers])
    motion = future_egomotion(matrices, [number < config.label_frames for number in numbers])
    return motion_labels_from_boxes(moments, motion, config)


def _make_boxes(frame: int) -> FrameBoxes:
    """Return the boxes of a frame, with the LiDAR's axes and origin those of the ego frame."""
    ego_from_world = EGO.pose(frame).inverse()
    poses = [ego_from_world @ actor.pose(frame) for actor in ACTORS]
    return FrameBoxes(
        center=np.array([pose.translation for pose in poses]),
        size=np.array([actor.size for actor in ACTORS]),
        yaw=np.array([pose.yaw for pose in poses]),
        actor_id=np.array([actor.actor_id for actor in ACTORS]),
        category=np.array([CATEGORIES.index(actor.category) for actor in ACTORS]),
        visible=np.array([actor.is_visible(frame) for actor in ACTORS]),
        ego_from_lidar=SE3.identity().matrix,
    )


PLAIN_SWITCHES = (
    "half_cell_shift",
    "drawn_when",
    "outside_is_zero",
    "vectors_not_rotated",
    "warp",
)
"""Switches that make a difference in the moment as it is, without a special sensor or recording."""


def main(_release: Path | None = None) -> None:
    """Count, and store the counts."""
    text = json.dumps(count_cells_of_the_turn(), indent=2)
    MEASURED.write_text(f"{text}\n", encoding="utf-8")


def count_cells_of_the_turn() -> dict[str, dict[str, int]]:
    """Return how many of the turn's cells differ in each map, by each plain switch and by all."""
    released = turn(RELEASED)
    counts = {}
    for switch in PLAIN_SWITCHES:
        changed = turn(replace(RELEASED, protocol=without(switch)))
        counts[switch] = cells_that_differ(released, changed)
    counts["clean"] = cells_that_differ(released, turn(CLEAN))
    return counts


def without(switch: str) -> LabelProtocol:
    """Return the released protocol with one switch as the clean one has it."""
    clean_value = getattr(LABEL_PROTOCOLS["clean"], switch)
    return replace(LABEL_PROTOCOLS["released"], **{switch: clean_value})


def cells_that_differ(first: MotionLabels, second: MotionLabels) -> dict[str, int]:
    """Return how many of T × H × W cells at the present differ in each map, as they are evaluated;
    a vector's channels are one cell.
    """
    first_maps = first.to_present("bilinear")
    second_maps = second.to_present("bilinear")
    frames, height, width = first.segmentation.shape
    counts = {}
    for name in MAPS:
        difference = getattr(first_maps, name).astype(float) - getattr(second_maps, name)
        differs = (np.abs(difference) > TOLERANCE).reshape(frames, -1, height, width)
        counts[name] = int(differs.any(axis=1).sum())
    return counts
