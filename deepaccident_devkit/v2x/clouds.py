"""Point clouds of several agents and frames, merged into one coordinate frame."""

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
    """Merge the LiDAR points of several agents at a sample's time and in the frames before it.

    Args:
        dataset: The release.
        sample: Token or record of a sample; its agent is the ego, its frame the current one.
        agents: Names of agents, a configuration or its name relative to the ego, or None for all
            available agents.
        sweeps: Number of frames (0.1 s each), including the current one; frames before the
            recording began are left out.
        frame: Coordinate frame of the result, at the sample's time: `world`, `ego`, `lidar` or a
            camera channel.
        compensate: Whether to move the points in an actor's box to where the actor is in the
            current frame, according to the track table (all agents' labels). Points of actors that
            are not annotated in both frames stay where they are.
        link: Effects of the link on the partners' data; None for a perfect link. Each sweep is a
            separate message, with its own loss, pose error and delay. `compensate` corrects
            latency, not wrong poses.
        on_missing: What to do about point clouds that were not downloaded: `raise`, or `skip` them
            and log how many.

    Returns:
        The points, sorted by frame, the current one first and then backwards; within a frame by
            agent, the ego first. The cloud is empty if all points were lost or left out. `agent` is
            the agent whose LiDAR recorded each point; `time_lag` is its age in seconds at the
            sample's time, including the link's latency.

    Raises:
        TokenError: The sample is unknown.
        ChoiceError: An agent, the configuration, the frame or `on_missing` is unknown, or `sweeps`
            is not a whole number from 1.
        NotAvailableError: An agent is not in this (partial) release.
        ConfigError: `link` is not a Link, or its latency reaches back before the recording.
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
    tracks = None
    if compensate:
        tracks = scenario_tracks(dataset, scenario)
    files = MissingFiles(dataset.dataroot, on_missing)
    clouds = []
    for message in messages(dataset, sample, agents, link, sweeps=sweeps):
        cloud_path = dataset.sensor_path(f"{message.sample}/{LIDAR}")
        if not files.has(cloud_path, LIDAR):
            continue
        cloud = dataset.load_point_cloud(message.sample, "lidar")
        if tracks is not None:
            world_from_lidar = dataset.world_from(message.sample, "lidar")
            cloud = _move_actors(cloud, world_from_lidar, tracks, message, int(present))
        target_from_lidar = message.target_from(dataset, "lidar", target_from_world)
        cloud = cloud.transform(target_from_lidar, frame)
        lag = record["timestamp"] - dataset.get("sample", message.sample)["timestamp"]
        agent_codes = np.full(len(cloud), AGENTS.index(message.agent), dtype=np.int8)
        lags = np.full(len(cloud), lag, dtype=np.float32)
        clouds.append(replace(cloud, agent=agent_codes, time_lag=lags))
    files.tell()
    return concatenate_clouds(clouds, frame)


def moved_points(points: FloatArray, then: Boxes, now: Boxes) -> FloatArray:
    """Move points that lie in boxes of actors along with these actors.

    Actors in only one of the two sets of boxes are ignored. If a point lies in several boxes, it
    moves with the last one; a point outside all boxes stays.

    Args:
        points: Points (P, 3), metres, in the frame of the boxes.
        then: Boxes of the actors when the points were measured.
        now: Boxes of the actors at the time to which the points move, in the same frame.

    Returns:
        The moved points (P, 3).
    """
    shared_ids, rows_then, rows_now = np.intersect1d(
        then.actor_id, now.actor_id, return_indices=True
    )
    before = then.select(rows_then)
    after = now.select(rows_now)
    is_shifted = (before.center != after.center).any(axis=1)
    is_turned = (before.rotation != after.rotation).any(axis=1)
    is_moved = is_shifted | is_turned
    before = before.select(is_moved)
    after = after.select(is_moved)
    result = np.array(points)
    if not len(shared_ids):
        return result
    world_from_before = quaternions.to_matrix(before.rotation)
    world_from_after = quaternions.to_matrix(after.rotation)
    for box, in_box in enumerate(before.contains(points)):
        offsets = points[in_box] - before.center[box]
        box_points = offsets @ world_from_before[box]
        result[in_box] = box_points @ world_from_after[box].T + after.center[box]
    return result


def _move_actors(
    cloud: LidarPointCloud,
    world_from_lidar: SE3,
    tracks: ScenarioTracks,
    message: Message,
    present: int,
) -> LidarPointCloud:
    """Move the points of actors in a cloud to where the actors are in the frame `present`.

    Args:
        cloud: Points in the LiDAR frame of the message.
        world_from_lidar: Pose of the LiDAR.
        tracks: Tracks of the scenario.
        message: Message of the cloud.
        present: Number of the frame to which the actors are moved.
    """
    recorded = int(message.sample.rsplit("/", 1)[1])
    if recorded == present:
        return cloud
    world_points = world_from_lidar.apply(cloud.xyz)
    moved_world_points = moved_points(world_points, tracks.at(recorded), tracks.at(present))
    xyz = world_from_lidar.inverse().apply(moved_world_points)
    return replace(cloud, xyz=xyz)
