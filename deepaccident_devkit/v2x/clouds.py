"""Point clouds of several agents and moments in one coordinate frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.geometry import SE3, Boxes, LidarPointCloud, quaternions
from deepaccident_devkit.geometry.pointcloud import concatenate_clouds
from deepaccident_devkit.release.layout import MissingFiles
from deepaccident_devkit.support.arrays import FloatArray, checked_whole
from deepaccident_devkit.taxonomy import AGENTS, LIDAR, OnError
from deepaccident_devkit.v2x.agents import Agents
from deepaccident_devkit.v2x.messages import Link, Message, messages
from deepaccident_devkit.v2x.tracks import ScenarioTracks, scenario_tracks


def aggregate_point_cloud(
    dataset: Dataset,
    sample: RowArgument,
    *,
    agents: Agents = None,
    sweeps: int = 1,
    frame: str = "world",
    compensate: bool = False,
    link: Link | None = None,
    on_missing: OnError = "raise",
) -> LidarPointCloud:
    """Merge the LiDAR points of several agents at a sample's moment and at the frames before it.

    Args:
        dataset: The release.
        sample: Token or record of a sample; its agent is the ego, its frame the present.
        agents: Names of agents, a configuration or its name relative to the ego, or None for all
            available agents.
        sweeps: Number of frames (0.1 s each), the present included; frames before the recording
            began are left out.
        frame: Coordinate frame of the result, at the sample: `world`, `ego`, `lidar` or a camera
            channel.
        compensate: Whether to move the points in the box of an actor to the position of the actor
            at the present, by the track table (all agents' labels); points of actors that are not
            annotated at both moments stay.
        link: Effects of the link on the partners' data; None for a perfect link. Each sweep is a
            message of its own, with its own loss, pose error and delay. `compensate` corrects
            latency, not wrong poses.
        on_missing: Treatment of point clouds that were not downloaded: `raise`, or `skip`, which
            leaves them out and logs how many.

    Returns:
        The points by frame, the present first and then backwards, and for each frame by agent, the
        ego first; no points if all were lost or left out. Its `agent` is the agent with the LiDAR
        that recorded each point, its `time_lag` the seconds before the sample's moment (a link's
        latency included).

    Raises:
        TokenError: There is no such sample.
        ChoiceError: There is no such agent, configuration, frame or `on_missing`, or `sweeps` is no
            whole number from 1.
        NotAvailableError: An agent is not in this (partial) release.
        ConfigError: `link` is no Link, or its latency is longer than the scenario's past.
        MissingFileError: A point cloud was not downloaded, and `on_missing` is `raise`.
        SensorFileError: A point cloud cannot be read.
    """
    sweeps = checked_whole("sweeps", sweeps, "a whole number of frames from 1", ChoiceError)
    if sweeps < 1:
        raise ChoiceError(f"sweeps: expected a whole number of frames from 1, found {sweeps}")
    frame = dataset.frame_name(frame)
    target_from_world = dataset.world_from(sample, frame).inverse()
    record = dataset.get("sample", sample)
    scenario, _, present = record["token"].rsplit("/", 2)
    tracks = scenario_tracks(dataset, scenario) if compensate else None
    files = MissingFiles(dataset.dataroot, on_missing)
    clouds = []
    for message in messages(dataset, sample, agents, link, sweeps=sweeps):
        cloud_path = dataset.sensor_path(f"{message.sample}/{LIDAR}")
        if not files.has(cloud_path, LIDAR):
            continue
        cloud = dataset.load_point_cloud(message.sample, "lidar")
        if tracks is not None:
            world_from_lidar = dataset.world_from(message.sample, "lidar")
            cloud = _compensated(cloud, world_from_lidar, tracks, message, int(present))
        target_from_lidar = message.target_from(dataset, "lidar", target_from_world)
        cloud = cloud.transform(target_from_lidar, frame)
        lag = record["timestamp"] - dataset.get("sample", message.sample)["timestamp"]
        agent_codes = np.full(len(cloud), AGENTS.index(message.agent), dtype=np.int8)
        lags = np.full(len(cloud), lag, dtype=np.float32)
        clouds.append(replace(cloud, agent=agent_codes, time_lag=lags))
    files.tell()
    return concatenate_clouds(clouds, frame)


def moved_points(points: FloatArray, then: Boxes, now: Boxes) -> FloatArray:
    """Move points along with the actors of the boxes in which they lie.

    Actors that are in only one of the two sets of boxes are ignored. If a point lies in several
    boxes, the last box counts; a point outside all boxes stays.

    Args:
        points: Points (P, 3), metres, in the frame of the boxes.
        then: Boxes of the actors when the points were measured.
        now: Boxes of the actors to which the points move, in the same frame.

    Returns:
        The moved points (P, 3).
    """
    shared_ids, rows_then, rows_now = np.intersect1d(
        then.actor_id, now.actor_id, return_indices=True
    )
    before = then.select(rows_then)
    after = now.select(rows_now)
    shifted = (before.center != after.center).any(axis=1)
    turned = (before.rotation != after.rotation).any(axis=1)
    moving = shifted | turned
    before = before.select(moving)
    after = after.select(moving)
    result = np.array(points)
    if not len(shared_ids):
        return result
    world_from_before = quaternions.to_matrix(before.rotation)
    world_from_after = quaternions.to_matrix(after.rotation)
    for box, in_box in enumerate(before.contains(points)):
        box_points = (points[in_box] - before.center[box]) @ world_from_before[box]
        result[in_box] = box_points @ world_from_after[box].T + after.center[box]
    return result


def _compensated(
    cloud: LidarPointCloud,
    world_from_lidar: SE3,
    tracks: ScenarioTracks,
    message: Message,
    present: int,
) -> LidarPointCloud:
    """Return a cloud in its LiDAR frame with moving actors at their places of frame `present`."""
    recorded = int(message.sample.rsplit("/", 1)[1])
    if recorded == present:
        return cloud
    world_points = world_from_lidar.apply(cloud.xyz)
    moved = moved_points(world_points, tracks.at(recorded), tracks.at(present))
    return replace(cloud, xyz=world_from_lidar.inverse().apply(moved))
