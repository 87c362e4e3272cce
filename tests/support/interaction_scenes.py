"""Hand-made motions of road users for the tests of interactions."""

import math
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from deepaccident_devkit.geometry import Boxes, quaternions
from deepaccident_devkit.v2x.tracks import ScenarioTracks

CAR_SIZE, BIKE_SIZE, PEDESTRIAN_SIZE = (4.0, 2.0, 1.5), (1.8, 0.6, 1.7), (0.4, 0.4, 1.8)
"""Lengths, widths and heights, metres."""
CATEGORY_OF_SIZE = {CAR_SIZE: 0, BIKE_SIZE: 3, PEDESTRIAN_SIZE: 5}
ActorPath = list[tuple[float, float, float] | None]
"""x, y and yaw at each frame; None where the actor is not annotated."""


def straight_path(frames: int, x: float, y: float, speed: float, degrees: float = 0.0) -> ActorPath:
    yaw = math.radians(degrees)
    distances = [speed * frame / 10 for frame in range(frames)]

    return [
        (x + distance * math.cos(yaw), y + distance * math.sin(yaw), yaw) for distance in distances
    ]


def make_tracks(
    paths: Mapping[int, ActorPath],
    sizes: Mapping[int, tuple] = MappingProxyType({}),
    unknown: tuple[int, ...] = (),
) -> ScenarioTracks:
    """Make the tracks of actors from their paths by id, with the velocities of these paths.

    An actor is a car unless `sizes` has its size. The labels of actors in `unknown` have no
    velocity.
    """
    rows = []
    for actor, path in paths.items():
        frames = [frame for frame, pose in enumerate(path) if pose is not None]
        for frame in frames:
            if actor in unknown:
                velocity = np.full(2, np.nan)
            else:
                velocity = _velocity_at(path, frames, frame)
            rows.append((frame + 1, actor, *path[frame], *velocity))
    rows.sort()

    table = np.array(rows, dtype=np.float64).reshape(-1, 7)
    actors = table[:, 1].astype(np.int64)
    shapes = [sizes.get(actor, CAR_SIZE) for actor in actors.tolist()]
    count = len(table)
    boxes = Boxes(
        frame="world",
        center=np.column_stack([table[:, 2:4], np.zeros(count)]),
        size=np.array(shapes, dtype=np.float64).reshape(-1, 3),
        rotation=quaternions.from_yaw(table[:, 4]),
        velocity=np.column_stack([table[:, 5:7], np.zeros(count)]),
        category=np.array([CATEGORY_OF_SIZE[shape] for shape in shapes], dtype=np.int64),
        actor_id=actors,
        num_lidar_pts=np.zeros(count, dtype=np.int64),
        camera_visible=np.zeros(count, dtype=bool),
        row=np.arange(count),
    )
    return ScenarioTracks(
        boxes=boxes, index=table[:, 0].astype(np.int64), agents=np.ones(count, dtype=np.uint8)
    )


def _velocity_at(path: ActorPath, frames: list[int], frame: int) -> np.ndarray:
    """Return the velocity (2,) between a frame and its neighbours, m/s; 0 if it has none."""
    neighbours = [number for number in (frame - 1, frame + 1) if number in frames]
    if not neighbours:
        return np.zeros(2)
    first, last = [frame, *neighbours][-2:]
    seconds = (last - first) / 10

    return (np.array(path[last][:2]) - path[first][:2]) / seconds
