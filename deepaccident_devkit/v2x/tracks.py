"""Where actors were and will be, from the labels of all agents."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.geometry import SE3, Boxes, quaternions
from deepaccident_devkit.geometry.boxes import trusted_boxes
from deepaccident_devkit.support.arrays import AnyArray, FloatArray, FrozenArrays, IntArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trajectory(FrozenArrays):
    """An actor at the T moments at which a label has it, in one right-handed coordinate frame; arrays are read-only.

    Attributes:
        instance: token of the actor.
        frame: `world`, or a coordinate frame of the given sample.
        index: (T,) int64, frame numbers from 1, ascending; gaps where nobody annotated the actor.
        timestamp: (T,) float64, seconds since the scenario's first frame.
        center: (T, 3) float64, metres.
        rotation: (T, 4) float64, unit quaternions w, x, y, z.
        size: (T, 3) float64, length, width, height, metres.
        velocity: (T, 3) float64, m/s over the ground, NaN if unknown.
        agents: (T,) uint8, bit masks over `taxonomy.AGENTS`: who annotated it.
        present: frame number of the given sample, before which is the past; None without one.
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
        """Number of moments."""
        return len(self.index)

    @property
    def yaw(self) -> FloatArray:
        """(T,) heading about z of `frame`, radians in (−π, π]."""
        return quaternions.yaw_of(self.rotation)


def trajectory(
    dataset: Dataset, instance: RowArgument, sample: RowArgument | None = None, frame: str = "world"
) -> Trajectory:
    """An actor's past and future from the labels of all agents: the rows of the track table.

    Args:
        dataset: the release.
        instance: token or record.
        sample: token or record of the present; `frame` is one of its coordinate frames.
        frame: `world`, or `ego`, `lidar` or a channel of `sample`, always as it is at that sample.

    Raises:
        TokenError: no such instance or sample.
        ChoiceError: no such frame, another frame than `world` without a sample, or a sample of another scenario.
    """
    record = dataset.get("instance", instance)
    scenario = record["scenario_token"]
    tracks = scenario_tracks(dataset, scenario)
    rows = np.flatnonzero(tracks.actor_id == record["actor_id"])
    frame, frame_from_world, present = dataset.frame_name(frame), SE3.identity(), None
    if sample is not None:
        there = dataset.get("sample", sample)
        if there["scenario_token"] != scenario:
            raise ChoiceError(
                f"trajectory: expected a sample of {scenario}, found {there['token']}; "
                "scenarios take place in different worlds"
            )
        frame_from_world = dataset.world_from(there, frame).inverse()
        present = int(there["token"].rsplit("/", 1)[1])
    elif frame != "world":
        raise ChoiceError(f"trajectory: frame {frame!r} is one of a sample; name it with sample=")
    moved = tracks.boxes.select(rows).transform(frame_from_world, frame)
    first_frame = dataset.get("scenario", scenario)["first_frame_token"]
    frames = dataset.getind("frame", first_frame) + tracks.index[rows] - 1
    return Trajectory(
        instance=record["token"],
        frame=frame,
        index=tracks.index[rows],
        timestamp=dataset.columns("frame")["timestamp"][frames],
        agents=tracks.agents[rows],
        center=moved.center,
        rotation=moved.rotation,
        size=moved.size,
        velocity=moved.velocity,
        present=present,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScenarioTracks(FrozenArrays):
    """All actors of a scenario at all moments, in world; one row for each actor and moment, ordered by frame and actor.

    Attributes:
        boxes: M boxes in world; points and cameras are not known (0, False).
        index: (M,) int64, frame numbers from 1.
        agents: (M,) uint8, bit masks over `taxonomy.AGENTS`: who annotated it.
    """

    boxes: Boxes
    index: IntArray
    agents: AnyArray

    @property
    def actor_id(self) -> IntArray:
        """(M,) CARLA ids."""
        return self.boxes.actor_id

    def at(self, index: int) -> Boxes:
        """The actors at frame number `index`, by ascending id."""
        first, last = self.index.searchsorted((index, index + 1))
        return self.boxes.select(np.arange(first, last))


def scenario_tracks(dataset: Dataset, scenario: RowArgument) -> ScenarioTracks:
    """A scenario's rows of the track table as arrays; raises TokenError."""
    columns, scenario_row = dataset.columns("track"), dataset.getind("scenario", scenario)
    scenarios = dataset.columns("scenario")
    first_frame, frames = (
        scenarios["first_frame_row"].item(scenario_row),
        scenarios["num_frames"].item(scenario_row),
    )
    ends = np.array([first_frame, first_frame + frames], dtype=columns["frame_row"].dtype)
    rows = slice(
        *columns["frame_row"].searchsorted(ends).tolist()
    )  # of another type, all rows would be copied
    count = rows.stop - rows.start
    boxes = trusted_boxes(
        "world",
        {
            "center": columns["translation"][rows],
            **{name: columns[name][rows] for name in ("rotation", "size", "velocity", "category")},
            "actor_id": dataset.columns("instance")["actor_id"][columns["instance_row"][rows]],
            "num_lidar_pts": np.zeros(count, dtype=np.int64),
            "camera_visible": np.zeros(count, dtype=bool),
            "row": np.arange(count),
        },
    )
    index = columns["frame_row"][rows].astype(np.int64) - first_frame + 1
    return ScenarioTracks(boxes=boxes, index=index, agents=columns["agents"][rows])
