"""Who drives where in a small release: a junction at the ground frame's origin, all with constant velocities."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from deepaccident_devkit.geometry import SE3, Boxes
from deepaccident_devkit.taxonomy import FRAME_PERIOD, VEHICLE_AGENTS, AgentName

AGENT_IDS = (1223, 1236, 1212, 1237)
"""Actor ids of `taxonomy.VEHICLE_AGENTS`."""
FAR_ACTOR_ID = 1399
"""The pedestrian that is untracked (−1) in every label."""
PAIR: tuple[AgentName, AgentName] = ("ego_vehicle", "other_vehicle")
"""The two that collide."""
_DELAY = 15.0
"""How many metres the other vehicle and its follower are farther back in a normal scenario."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RoadUser:
    """A box on the ground that moves straight ahead; ground frame, right-handed, metres.

    Attributes:
        actor_id: CARLA's id.
        category: class name.
        size: length, width, height.
        end: x, y of its centre at the last frame.
        yaw: radians counter-clockwise.
        speed: m/s.
    """

    actor_id: int
    category: str
    size: tuple[float, float, float]
    end: tuple[float, float]
    yaw: float
    speed: float


_SOUTH_TO_NORTH, _EAST_TO_WEST = np.pi / 2, np.pi
_CAR, _VAN = (4.6, 1.9, 1.5), (4.5, 2.0, 2.0)
_AGENTS = (
    RoadUser(actor_id=1223, category="car", size=_CAR, end=(-1.4, -1.75), yaw=0.0, speed=9.0),
    RoadUser(actor_id=1236, category="van", size=_VAN, end=(-11.4, -1.75), yaw=0.0, speed=9.0),
    RoadUser(actor_id=1212, category="car", size=_CAR, end=(1.75, -1.75), yaw=_SOUTH_TO_NORTH, speed=7.0),
    RoadUser(actor_id=1237, category="car", size=_CAR, end=(1.75, -12.0), yaw=_SOUTH_TO_NORTH, speed=7.0),
)
"""At the last frame the ego's front touches the left side of the other vehicle: the boxes overlap by 0.1 m."""
_TRAFFIC = (
    RoadUser(actor_id=1301, category="truck", size=(8.4, 2.6, 3.6), end=(18.0, 1.75), yaw=_EAST_TO_WEST, speed=6.0),
    RoadUser(actor_id=1302, category="cyclist", size=(1.64, 0.5, 1.77), end=(5.5, 12.0), yaw=np.pi / 2, speed=4.0),
    RoadUser(actor_id=1303, category="motorcycle", size=(2.2, 0.86, 1.5), end=(-1.75, 20.0), yaw=-np.pi / 2, speed=7.0),
    RoadUser(actor_id=1304, category="pedestrian", size=(0.4, 0.4, 1.86), end=(-8.0, 6.0), yaw=0.0, speed=1.2),
    RoadUser(actor_id=20001, category="car", size=_CAR, end=(-24.0, -5.5), yaw=0.0, speed=0.0),
    RoadUser(actor_id=FAR_ACTOR_ID, category="pedestrian", size=(0.4, 0.4, 1.86), end=(70, 8), yaw=2.2, speed=0.0),
)
POLE_HEIGHT = 4.0
"""Height of the infrastructure's LiDAR above the ground, metres."""
_POLE = (8.0, 8.0, POLE_HEIGHT)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SmallScene:
    """What happens in one scenario.

    Attributes:
        world_from_ground: where the junction lies in its town.
        users: all road users, the four vehicle agents first.
        frames: how many are recorded.
    """

    world_from_ground: SE3
    users: Sequence[RoadUser]
    frames: int

    def boxes(self, frame: int) -> Boxes:
        """The boxes of all at a frame (counted from 1), world frame; points and visibility are not known yet."""
        seconds = (self.frames - frame) * FRAME_PERIOD
        yaw = np.array([user.yaw for user in self.users])
        size = np.array([user.size for user in self.users])
        speed = np.array([user.speed for user in self.users])
        velocity = speed[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))])
        ends = np.column_stack([np.array([user.end for user in self.users]), size[:, 2] / 2])
        return Boxes.from_arrays(
            self.world_from_ground.apply(ends - velocity * seconds),
            size,
            yaw + self.world_from_ground.yaw,
            frame="world",
            category=[user.category for user in self.users],
            velocity=velocity @ self.world_from_ground.rotation.T,
            actor_id=[user.actor_id for user in self.users],
        )

    def world_from_ego(self, agent: AgentName, frame: int) -> SE3:
        """An agent's pose at a frame: on the road below the middle of its box; for the pole, where its LiDAR is."""
        if agent not in VEHICLE_AGENTS:
            return self.world_from_ground @ SE3.from_yaw(0.0, _POLE)
        boxes, row = self.boxes(frame), VEHICLE_AGENTS.index(agent)
        return SE3.from_yaw(float(boxes.yaw[row]), boxes.center[row] - (0.0, 0.0, boxes.size[row, 2] / 2))


def small_scene(rng: np.random.Generator, *, frames: int, accident: bool) -> SmallScene:
    """A scene with a random place in its town and random speeds; they are the same with and without the accident."""
    x, y, yaw = rng.uniform(-200.0, 200.0), rng.uniform(-200.0, 200.0), rng.uniform(-np.pi, np.pi)
    ego_speed, other_speed = rng.uniform(0.8, 1.2, 2).tolist()
    factors = (ego_speed, ego_speed, other_speed, other_speed)
    agents = [replace(user, speed=user.speed * factor) for user, factor in zip(_AGENTS, factors, strict=True)]
    if not accident:
        agents[2:] = [replace(user, end=(user.end[0], user.end[1] - _DELAY)) for user in agents[2:]]
    return SmallScene(world_from_ground=SE3.from_yaw(yaw, (x, y, 0.3)), users=(*agents, *_TRAFFIC), frames=frames)
