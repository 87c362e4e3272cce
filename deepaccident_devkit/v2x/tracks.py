"""Past and future positions of actors, from the labels of all agents."""

from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.geometry import SE3, Boxes, quaternions, time_to_collision
from deepaccident_devkit.geometry.box_arrays import gaps_of_pairs
from deepaccident_devkit.geometry.boxes import trusted_boxes
from deepaccident_devkit.support.arrays import AnyArray, FloatArray, FrozenArrays, IntArray
from deepaccident_devkit.tables.tables import token_of


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trajectory(FrozenArrays):
    """An actor in the T frames that label it, in one coordinate frame; arrays are read-only.

    Attributes:
        instance: Token of the actor.
        frame: `world`, or a coordinate frame of the sample passed to `trajectory`.
        index: Frame numbers from 1, shape (T,), int64, ascending; frames in which no agent
            annotated the actor are missing.
        timestamp: Seconds since the scenario's first frame, shape (T,), float64.
        center: Centres, shape (T, 3), float64, metres.
        rotation: Unit quaternions w, x, y, z, shape (T, 4), float64.
        size: Length, width, height, shape (T, 3), float64, metres.
        velocity: Velocities over the ground, shape (T, 3), float64, m/s; NaN if unknown.
        agents: Bit masks over `taxonomy.AGENTS`, shape (T,), uint8: the agents that annotated the
            actor.
        present: Frame number of the sample passed to `trajectory`, which separates past and future;
            None without one.
    """

    instance: str
    frame: str
    index: IntArray
    timestamp: FloatArray
    center: FloatArray
    rotation: FloatArray
    size: FloatArray
    velocity: FloatArray
    agents: AnyArray
    present: int | None = None

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.index)

    @property
    def yaw(self) -> FloatArray:
        """Headings about z of `frame`, shape (T,), radians in (−π, π]."""
        return quaternions.yaw_of(self.rotation)


def trajectory(
    dataset: Dataset, instance: RowArgument, sample: RowArgument | None = None, frame: str = "world"
) -> Trajectory:
    """Return an actor's past and future from the track table, which merges all agents' labels.

    Args:
        dataset: The release.
        instance: Token or record of the actor.
        sample: Token or record of the sample whose coordinate frame `frame` is, and whose frame
            number becomes `present`; None if `frame` is `world`.
        frame: `world`, or `ego`, `lidar` or a channel of `sample`; the frame does not move with the
            agent.

    Raises:
        TokenError: The instance or the sample is unknown.
        ChoiceError: The frame is unknown, needs a sample and none was passed, or the sample is from
            another scenario.
    """
    record = dataset.get("instance", instance)
    scenario = record["scenario_token"]
    tracks = scenario_tracks(dataset, scenario)
    rows = np.flatnonzero(tracks.actor_id == record["actor_id"])
    frame = dataset.frame_name(frame)
    frame_from_world = SE3.identity()
    present = None
    if sample is not None:
        present_sample = dataset.get("sample", sample)
        if present_sample["scenario_token"] != scenario:
            raise ChoiceError(
                f"trajectory: expected a sample of {scenario}, found {present_sample['token']}; "
                "scenarios take place in different worlds"
            )
        frame_from_world = dataset.world_from(present_sample, frame).inverse()
        present = int(present_sample["token"].rsplit("/", 1)[1])
    elif frame != "world":
        raise ChoiceError(
            f"trajectory: frame {frame!r} belongs to one agent; name the sample with sample="
        )
    boxes = tracks.boxes.select(rows).transform(frame_from_world, frame)
    first_frame = dataset.get("scenario", scenario)["first_frame_token"]
    frame_rows = dataset.getind("frame", first_frame) + tracks.index[rows] - 1
    return Trajectory(
        instance=record["token"],
        frame=frame,
        index=tracks.index[rows],
        timestamp=dataset.columns("frame")["timestamp"][frame_rows],
        agents=tracks.agents[rows],
        center=boxes.center,
        rotation=boxes.rotation,
        size=boxes.size,
        velocity=boxes.velocity,
        present=present,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScenarioTracks(FrozenArrays):
    """All actors of a scenario in all frames, in world coordinates; arrays are read-only.

    There is one row for each actor and frame, sorted by frame, then by actor.

    Attributes:
        boxes: M boxes in world; the columns for LiDAR points and cameras are unknown (0, False).
        index: Frame numbers from 1, shape (M,), int64.
        agents: Bit masks over `taxonomy.AGENTS`, shape (M,), uint8: the agents that annotated the
            actor.
    """

    boxes: Boxes
    index: IntArray
    agents: AnyArray

    @property
    def actor_id(self) -> IntArray:
        """CARLA ids, shape (M,)."""
        return self.boxes.actor_id

    def at(self, index: int) -> Boxes:
        """Return the boxes of the actors in frame number `index`, by ascending actor id."""
        bounds = (index, index + 1)
        start, stop = self.index.searchsorted(bounds)
        rows = np.arange(start, stop)
        return self.boxes.select(rows)


def scenario_tracks(dataset: Dataset, scenario: RowArgument) -> ScenarioTracks:
    """Return a scenario's rows of the track table; raise TokenError if it is unknown."""
    tracks = dataset.columns("track")
    scenario_row = dataset.getind("scenario", scenario)
    scenarios = dataset.columns("scenario")
    first_frame = scenarios["first_frame_row"].item(scenario_row)
    num_frames = scenarios["num_frames"].item(scenario_row)
    frame_rows = tracks["frame_row"]
    # With bounds of another type, searchsorted would copy all rows.
    bounds = np.array([first_frame, first_frame + num_frames], dtype=frame_rows.dtype)
    start, stop = frame_rows.searchsorted(bounds).tolist()
    rows = slice(start, stop)
    count = stop - start
    columns = {name: tracks[name][rows] for name in ("rotation", "size", "velocity", "category")}
    boxes = trusted_boxes(
        "world",
        {
            "center": tracks["translation"][rows],
            **columns,
            "actor_id": dataset.columns("instance")["actor_id"][tracks["instance_row"][rows]],
            "num_lidar_pts": np.zeros(count, dtype=np.int64),
            "camera_visible": np.zeros(count, dtype=bool),
            "row": np.arange(count),
        },
        scenario=token_of(scenario),
    )
    index = frame_rows[rows].astype(np.int64) - first_frame + 1
    agents = tracks["agents"][rows]
    return ScenarioTracks(boxes=boxes, index=index, agents=agents)


def pair_approach(
    tracks: ScenarioTracks, pair: tuple[int, int], num_frames: int
) -> tuple[FloatArray, FloatArray]:
    """Return how close two actors are in each of T frames, from above, as by `interactions`.

    Args:
        tracks: A scenario's tracks.
        pair: Ids of the two actors.
        num_frames: The scenario's number of frames T.

    Returns:
        Gap between the two in metres, and time to collision in seconds; shape (T,) each. NaN where
            one of the two is not annotated or its velocity is unknown; the time is infinite where
            they would never touch.
    """
    boxes = np.full((2, num_frames, 5), np.nan)
    velocity = np.full((2, num_frames, 2), np.nan)
    for member, actor in enumerate(pair):
        rows = np.flatnonzero(tracks.actor_id == actor)
        track = tracks.boxes.select(rows)
        frame = tracks.index[rows] - 1
        columns = [track.center[:, :2], track.size[:, :2], track.yaw]
        boxes[member, frame] = np.column_stack(columns)
        velocity[member, frame] = track.velocity[:, :2]
    return gaps_of_pairs(*boxes), time_to_collision(*boxes, *velocity)
