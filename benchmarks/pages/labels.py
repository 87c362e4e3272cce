"""A made moment, the left turn of an ego, and the cells of its labels and of a release's in which
protocols differ.
"""

import tempfile
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.pages.marks import put
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.motion import (
    LABEL_PROTOCOLS,
    Augmentation,
    FrameBoxes,
    LabelProtocol,
    MotionLabelConfig,
    MotionLabels,
    motion_labels_from_boxes,
)
from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.taxonomy import CATEGORIES
from deepaccident_devkit.v2x import future_egomotion

RELEASE = SynthConfig(scenarios=4, frames=40, seed=11, sensors=False, designed=True)
MAPS = ("segmentation", "instance", "centerness", "offset", "flow")
SPLIT = "train"
RELEASED, CLEAN = (MotionLabelConfig(protocol=name) for name in ("released", "clean"))
CLOSE = 0.01
"""Centerness, and cells of offset and flow, that are taken for equal: turned by nothing they differ
in the last bit.
"""
STEP = 0.5


@dataclass(frozen=True, kw_only=True)
class Actor:
    """One that drives straight on; metres, radians, metres a second in the present ego frame of the
    turn.
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
        """Where it is at a label frame."""
        way = self.speed * STEP * frame
        return SE3.from_yaw(
            self.heading,
            (self.x + way * np.cos(self.heading), self.y + way * np.sin(self.heading), 0.0),
        )


class TurningEgo(Actor):
    """The ego: straight on up to the present, then on a circle to the left, half a radian a
    second.
    """

    def pose(self, frame: int) -> SE3:
        turned = max(0.0, 0.5 * STEP * frame)
        radius = self.speed / 0.5
        straight = min(0, frame) * self.speed * STEP
        return SE3.from_yaw(
            turned, (straight + radius * np.sin(turned), radius * (1 - np.cos(turned)), 0.0)
        )


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


def turn(
    config: MotionLabelConfig,
    *,
    ego_from_lidar: SE3 | None = None,
    own_row: bool = True,
    frames: int | None = None,
    earlier_ids: bool = False,
) -> MotionLabels:
    """Labels of the made moment: a left turn of the ego.

    Args:
        config: what they show.
        ego_from_lidar: where the LiDAR is; above the ego frame's origin, along its axes, if None.
        own_row: whether the label files have the agent's own row.
        frames: label frames until the recording ends; all if None.
        earlier_ids: whether a sample before this one has numbered the colliding pair, where the
            protocol keeps ids.
    """
    mount = ego_from_lidar or SE3.identity()
    actors = [actor for actor in ACTORS if own_row or actor is not EGO]
    recorded = config.label_frames if frames is None else frames
    moments = [
        _boxes(actors, frame, mount) if frame < recorded else None
        for frame in range(config.label_frames)
    ]
    past = config.receptive_field - 1
    numbers = range(-past, config.label_frames + 1)
    motion = future_egomotion(
        np.stack([EGO.pose(number).matrix for number in numbers]),
        [number < recorded for number in numbers],
    )
    kept = dict(zip(reversed(COLLIDING), (1, 2), strict=True)) if earlier_ids else None
    id_map = kept if config.rules.ids_kept_between_samples else None
    return motion_labels_from_boxes(moments, motion, config, id_map=id_map)


def _boxes(actors: list[Actor], frame: int, ego_from_lidar: SE3) -> FrameBoxes:
    lidar_from_world = (EGO.pose(frame) @ ego_from_lidar).inverse()
    poses = [lidar_from_world @ actor.pose(frame) for actor in actors]
    return FrameBoxes(
        center=np.array([pose.translation for pose in poses]),
        size=np.array([actor.size for actor in actors]),
        yaw=np.array([pose.yaw for pose in poses]),
        actor_id=np.array([actor.actor_id for actor in actors]),
        category=np.array([CATEGORIES.index(actor.category) for actor in actors]),
        visible=np.array(
            [actor.seen_from is not None and frame >= actor.seen_from for actor in actors]
        ),
        ego_from_lidar=ego_from_lidar.matrix,
    )


@dataclass(frozen=True)
class Circumstance:
    """What must be so for a switch to make a difference in the made moment."""

    words: str = "as it is"
    config: dict[str, Any] = field(default_factory=dict)
    moment: dict[str, Any] = field(default_factory=dict)


CIRCUMSTANCES = {
    "own_box_moved_twice": Circumstance(
        "the LiDAR 1 m ahead of the ego frame, turned by 0.1 rad",
        moment={"ego_from_lidar": SE3.from_yaw(0.1, (1.0, 0.0, 1.9))},
    ),
    "own_box_default": Circumstance("no own row in the label files", moment={"own_row": False}),
    "own_box_not_augmented": Circumstance(
        "an augmentation: turned by 0.3 rad", config={"augmentation": Augmentation(rotation=0.3)}
    ),
    "untracked_share_an_id": Circumstance(
        "`filter_invisible=False`, so that untracked actors are rasterised",
        config={"filter_invisible": False},
    ),
    "missing_frames_are_empty": Circumstance(
        "the recording ends 1 s after the present", moment={"frames": 3}
    ),
    "ids_kept_between_samples": Circumstance(
        "an earlier sample's `id_map` with the colliding pair", moment={"earlier_ids": True}
    ),
    "outside_is_zero": Circumstance(),
    "half_cell_shift": Circumstance(),
    "drawn_when": Circumstance(),
    "vectors_not_rotated": Circumstance(),
    "warp": Circumstance(),
}


def main(_release: Path | None = None) -> None:
    """Write the tables."""
    with tempfile.TemporaryDirectory() as folder:
        release = DeepAccident(
            dataroot=make_release(Path(folder) / "release", RELEASE), verbose=False
        )
        put("label-cells", f"\n{table_of_the_turn()}\n{table_of_the_release(release)}\n")


def table_of_the_turn() -> str:
    """How many of the turn's cells differ by each switch, where it makes a difference."""
    rows = []
    for switch in switches():
        how = CIRCUMSTANCES[switch]
        kept = replace(RELEASED, **how.config)
        counts = cells_that_differ(
            *(turn(one, **how.moment) for one in (kept, replace(kept, protocol=without(switch))))
        )
        rows.append([f"`{switch}`", how.words, *(f"{count:,}" for count in counts)])
    rows.append(
        [
            "all: `clean`",
            "as it is",
            *(f"{n:,}" for n in cells_that_differ(turn(RELEASED), turn(CLEAN))),
        ]
    )
    return _table(["the left turn: switch", "what is so", *MAPS], rows)


def table_of_the_release(release: DeepAccident) -> str:
    """How many cells of a sample differ by each switch, on average over a synthetic release."""
    tokens = release.samples(SPLIT, "all")
    changed = {f"`{switch}`": replace(RELEASED, protocol=without(switch)) for switch in switches()}
    sums = {name: np.zeros(len(MAPS)) for name in [*changed, "all: `clean`"]}
    for token in tokens:
        kept = release.motion_labels(token)
        for name, config in [*changed.items(), ("all: `clean`", CLEAN)]:
            sums[name] += cells_that_differ(kept, release.motion_labels(token, config))
    rows = [
        [name, *(f"{count / len(tokens):,.1f}" for count in counts)]
        for name, counts in sums.items()
    ]
    return _table([f"a synthetic release, mean of {len(tokens)} samples: switch", *MAPS], rows)


def switches() -> list[str]:
    """The names of the switches in which the two protocols differ."""
    one, other = LABEL_PROTOCOLS["released"], LABEL_PROTOCOLS["clean"]
    return [
        item.name
        for item in fields(LabelProtocol)
        if getattr(one, item.name) != getattr(other, item.name)
    ]


def without(switch: str) -> LabelProtocol:
    """The released protocol with one switch as the clean one has it."""
    return replace(
        LABEL_PROTOCOLS["released"], **{switch: getattr(LABEL_PROTOCOLS["clean"], switch)}
    )


def cells_that_differ(one: MotionLabels, other: MotionLabels) -> list[int]:
    """Of T × H × W cells at the present, as they are evaluated, map by map; a vector's channels are
    one cell.
    """
    maps = [labels.to_present("bilinear") for labels in (one, other)]
    shape = one.segmentation.shape
    counts = []
    for name in MAPS:
        differs = np.abs(getattr(maps[0], name).astype(float) - getattr(maps[1], name)) > CLOSE
        counts.append(int(differs.reshape(shape[0], -1, *shape[1:]).any(axis=1).sum()))
    return counts


def _table(head: list[str], rows: list[list[str]]) -> str:
    numbers = len(MAPS)
    rule = ["---"] * (len(head) - numbers) + ["--:"] * numbers
    return "".join(f"| {' | '.join(row)} |\n" for row in [head, rule, *rows])
