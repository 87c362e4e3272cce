"""Hand-made motions of road users for the tests of interactions."""

import math
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from deepaccident_devkit.geometry import Boxes, quaternions
from deepaccident_devkit.v2x.tracks import ScenarioTracks

CAR, BIKE, PEDESTRIAN = (4.0, 2.0, 1.5), (1.8, 0.6, 1.7), (0.4, 0.4, 1.8)
CATEGORY = {CAR: 0, BIKE: 3, PEDESTRIAN: 5}
Path = list[tuple[float, float, float] | None]
"""x, y, yaw at each frame; None where nobody annotated the actor."""


def straight(frames: int, x: float, y: float, speed: float, degrees: float = 0.0) -> Path:
    yaw = math.radians(degrees)
    ways = [speed * frame / 10 for frame in range(frames)]
    return [(x + way * math.cos(yaw), y + way * math.sin(yaw), yaw) for way in ways]


def tracks_of(
    paths: Mapping[int, Path],
    sizes: Mapping[int, tuple] = MappingProxyType({}),
    unknown: tuple[int, ...] = (),
) -> ScenarioTracks:
    """Tracks of actors by id, cars unless `sizes` says otherwise, at the velocities of their ways.

    Of actors in `unknown` the labels have no velocity.
    """
    rows = []
    for actor, path in paths.items():
        there = [frame for frame, place in enumerate(path) if place is not None]
        for frame in there:
            near = [each for each in (frame - 1, frame + 1) if each in there]
            velocity = np.full(2, np.nan)
            if actor not in unknown:
                ends = [frame, *near][-2:] if near else [frame]
                span = ends[-1] - ends[0]
                velocity = np.zeros(2)
                if span:
                    velocity = (np.array(path[ends[-1]][:2]) - path[ends[0]][:2]) / (span / 10)
            rows.append((frame + 1, actor, *path[frame], *velocity))
    rows.sort()
    table = np.array(rows, dtype=np.float64).reshape(-1, 7)
    actors = table[:, 1].astype(np.int64)
    shapes = [sizes.get(actor, CAR) for actor in actors.tolist()]
    count = len(table)
    boxes = Boxes(
        frame="world",
        center=np.column_stack([table[:, 2:4], np.zeros(count)]),
        size=np.array(shapes, dtype=np.float64).reshape(-1, 3),
        rotation=quaternions.from_yaw(table[:, 4]),
        velocity=np.column_stack([table[:, 5:7], np.zeros(count)]),
        category=np.array([CATEGORY[shape] for shape in shapes], dtype=np.int64),
        actor_id=actors,
        num_lidar_pts=np.zeros(count, dtype=np.int64),
        camera_visible=np.zeros(count, dtype=bool),
        row=np.arange(count),
    )
    return ScenarioTracks(
        boxes=boxes, index=table[:, 0].astype(np.int64), agents=np.ones(count, dtype=np.uint8)
    )
