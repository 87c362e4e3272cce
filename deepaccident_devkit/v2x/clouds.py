"""Point clouds of several agents and moments in one frame."""

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
    """The LiDAR points of some agents at a sample's moment and the frames before it, in one coordinate frame.

    Args:
        dataset: the release.
        sample: token or record: its agent is the ego, its frame the present.
        agents: names of agents, a configuration or its name as seen from the ego, or None for all that are there.
        sweeps: how many frames (0.1 s), the present included; those before the recording began are left out.
        frame: coordinate frame of the result, at the sample: `world`, `ego`, `lidar` or a camera channel.
        compensate: whether to move the points in the box of an actor to where the actor is at the present, by the
            track table (all agents' labels); points of actors that are not annotated at both moments stay.
        link: what happens to the partners' data; None for nothing. Each sweep is a message of its own, with its own
            loss, pose error and delay. `compensate` corrects latency, not wrong poses.
        on_missing: of point clouds that were not downloaded: `raise`, or `skip` leaves them out and logs how many.

    Returns:
        The points by frame, the present first and then backwards, and for each frame by agent, the ego first; no
        points if all were lost or left out. Its `agent` says whose LiDAR recorded each point, its `time_lag` how many
        seconds before the sample's moment (a link's latency included).

    Raises:
        TokenError: no such sample.
        ChoiceError: no such agent, configuration, frame or `on_missing`, or `sweeps` is no whole number from 1.
        NotAvailableError: an agent is not in this (partial) release.
        ConfigError: `link` is no Link, or its latency is longer than the scenario's past.
        MissingFileError: a point cloud was not downloaded, and `on_missing` is `raise`.
        SensorFileError: a point cloud cannot be read.
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
    parts = []
    for message in messages(dataset, sample, agents, link, sweeps=sweeps):
        if not files.has(dataset.sensor_path(f"{message.sample}/{LIDAR}"), LIDAR):
            continue
        cloud = dataset.load_point_cloud(message.sample, "lidar")
        if tracks is not None:
            cloud = _compensated(
                cloud, dataset.world_from(message.sample, "lidar"), tracks, message, int(present)
            )
        cloud = cloud.transform(message.target_from(dataset, "lidar", target_from_world), frame)
        lag = record["timestamp"] - dataset.get("sample", message.sample)["timestamp"]
        agent = np.full(len(cloud), AGENTS.index(message.agent), dtype=np.int8)
        parts.append(
            replace(cloud, agent=agent, time_lag=np.full(len(cloud), lag, dtype=np.float32))
        )
    files.tell()
    return concatenate_clouds(parts, frame)


def moved_points(points: FloatArray, then: Boxes, now: Boxes) -> FloatArray:
    """Points (P, 3), each moved with the box of `then` that it lies in to the same actor's box of `now`, in one frame.

    Actors that are not in both are ignored. If a point lies in several boxes, the last one counts; outside all it
    stays.
    """
    both, row_then, row_now = np.intersect1d(then.actor_id, now.actor_id, return_indices=True)
    before, after = then.select(row_then), now.select(row_now)
    moves = (before.center != after.center).any(axis=1) | (before.rotation != after.rotation).any(
        axis=1
    )
    before, after = before.select(moves), after.select(moves)
    result = np.array(points)
    turns_then, turns_now = (
        quaternions.to_matrix(before.rotation),
        quaternions.to_matrix(after.rotation),
    )
    for box, inside in enumerate(before.contains(points) if len(both) else ()):
        local = (points[inside] - before.center[box]) @ turns_then[box]
        result[inside] = local @ turns_now[box].T + after.center[box]
    return result


def _compensated(
    cloud: LidarPointCloud,
    world_from_lidar: SE3,
    tracks: ScenarioTracks,
    message: Message,
    present: int,
) -> LidarPointCloud:
    """A cloud in its LiDAR frame with moving actors where they are at frame `present`."""
    taken = int(message.sample.rsplit("/", 1)[1])
    if taken == present:
        return cloud
    moved = moved_points(world_from_lidar.apply(cloud.xyz), tracks.at(taken), tracks.at(present))
    return replace(cloud, xyz=world_from_lidar.inverse().apply(moved))
