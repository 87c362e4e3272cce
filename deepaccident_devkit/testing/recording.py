"""The files of one agent at one frame of a small release."""

from dataclasses import replace

import numpy as np

from deepaccident_devkit.arrays import BoolArray, ByteArray
from deepaccident_devkit.geometry import BoxVisibility
from deepaccident_devkit.release import (
    Labels,
    ScenarioFolder,
    label_from_world_velocity,
    write_bev,
    write_calib,
    write_image,
    write_label,
    write_lidar,
)
from deepaccident_devkit.release.store import real_path
from deepaccident_devkit.taxonomy import (
    AGENTS,
    BEV_CAMERA,
    CAMERAS,
    LIDAR,
    OWN_ACTOR_ID,
    UNTRACKED_ID,
    VEHICLE_AGENTS,
    AgentName,
)
from deepaccident_devkit.testing.rig import calib_of, cameras
from deepaccident_devkit.testing.scene import FAR_ACTOR_ID, POLE_HEIGHT, SmallScene
from deepaccident_devkit.testing.sensors import cloud_of, picture_of, top_view_of

_BEV_COMPRESSION = 6
"""It gives a quarter of the bytes of the writer's default, which is faster."""


class Recorder:
    """Writes what one agent recorded at one frame, file by file.

    Args:
        folder: the scenario's folder.
        scene: what happens in the scenario.
        agent: the agent that records.
        frame: number of the frame, counted from 1.
        image_size: width and height, pixels.
    """

    def __init__(
        self, folder: ScenarioFolder, scene: SmallScene, agent: AgentName, frame: int, image_size: tuple[int, int]
    ) -> None:
        self._folder, self._agent, self._frame = folder, agent, frame
        self._cameras = cameras(image_size)
        self._calib = calib_of(agent, scene.world_from_ego(agent, frame), image_size)
        world = scene.boxes(frame)
        self._own = np.arange(len(world)) < (agent in VEHICLE_AGENTS)  # the own row, if any, comes first
        if agent in VEHICLE_AGENTS:
            own = VEHICLE_AGENTS.index(agent)
            world = world.select([own, *(row for row in range(len(world)) if row != own)])
        self._velocity = world.velocity[:, :2]
        lidar_from_world = (self._calib.world_from_ego @ self._calib.ego_from_lidar).inverse()
        self._boxes = world.transform(lidar_from_world, "lidar")
        height = self._calib.ego_from_lidar.translation[2] if self._own.any() else POLE_HEIGHT
        self._cloud = cloud_of(self._boxes.select(~self._own), float(height))

    def write_calib(self) -> None:
        """The poses and cameras."""
        write_calib(real_path(self._folder.calib_path(self._agent, self._frame)), self._calib)

    def write_label(self) -> None:
        """The boxes: the own row is first; the pedestrian who is far away is not tracked."""
        labels = self._labels()
        points = labels.boxes().count_points(self._cloud)
        write_label(real_path(self._folder.label_path(self._agent, self._frame)), replace(labels, num_lidar_pts=points))

    def write_channel(self, channel: str) -> None:
        """The file of one sensor."""
        path = real_path(self._folder.channel_path(self._agent, channel, self._frame))
        if channel == LIDAR:
            write_lidar(path, self._cloud, np.linspace(0.0, 1.0, len(self._cloud)))
        elif channel == BEV_CAMERA:
            object_ids = np.arange(1, len(self._boxes) + 1, dtype=np.uint16)
            write_bev(path, *top_view_of(self._boxes, object_ids), level=_BEV_COMPRESSION)
        else:
            write_image(path, self._picture(channel))

    def _picture(self, channel: str) -> ByteArray:
        boxes = self._boxes.select(~self._own).transform(self._calib.camera_from_lidar[channel], channel)
        sky = (120 + 12 * AGENTS.index(self._agent), 130 + 12 * CAMERAS.index(channel), 200)
        road = (40 + self._frame, 40 + self._frame, 45 + self._frame)
        return picture_of(boxes, self._cameras[channel], sky=sky, road=road)

    def _labels(self) -> Labels:
        """The contents of the label, without the numbers of points."""
        boxes = self._boxes
        yaw = np.where(self._own, 0.0, boxes.yaw)
        return Labels(
            raw=False,
            num_boxes=np.array([len(boxes)]),
            agent_velocity=self._velocity[self._own] if self._own.any() else np.zeros((1, 2)),
            category=boxes.category,
            center=boxes.center,
            size=boxes.size,
            yaw=yaw,
            velocity=label_from_world_velocity(self._velocity, yaw),
            actor_id=np.select(
                [self._own, boxes.actor_id == FAR_ACTOR_ID], [OWN_ACTOR_ID, UNTRACKED_ID], boxes.actor_id
            ),
            num_lidar_pts=np.zeros(len(boxes), dtype=np.int64),
            camera_visible=self._visible(),
        )

    def _visible(self) -> BoolArray:
        """(N,) whether a corner of the box is in any of the pictures; no actor hides another."""
        seen = np.zeros(len(self._boxes), dtype=bool)
        for channel, camera in self._cameras.items():
            boxes = self._boxes.transform(self._calib.camera_from_lidar[channel], channel)
            seen |= camera.boxes_in_image(boxes, BoxVisibility.ANY)
        return seen & ~self._own
