"""`Subject`: the small files of one scenario in memory, with the arrays that all checks share."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from deepaccident_devkit.geometry import Boxes, quaternions
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray, IntArray
from deepaccident_devkit.tables import Finding, displacement_velocities
from deepaccident_devkit.tables import boxes as box_rules
from deepaccident_devkit.tables.boxes import ScenarioBoxes
from deepaccident_devkit.tables.build import scenario_boxes
from deepaccident_devkit.tables.scan import ScenarioFiles, frame_ranges
from deepaccident_devkit.taxonomy import (
    CATEGORIES,
    INFRASTRUCTURE,
    OWN_ACTOR_ID,
    UNTRACKED_ID,
    AgentName,
)
from deepaccident_devkit.validation.codes import CODES

# Distance within which a label may be complete.
_MAX_REACH_M = 35.0
# Fraction of the farthest box's distance within which a label counts as complete.
_REACH_SHARE = 0.8
# Coordinates beyond this are taken to be nonsense.
_COORDINATE_LIMIT_M = 1e7
MAX_LABEL_BOXES = 500
"""Largest number of boxes in a label; real labels have fewer than a hundred."""
# Largest number of boxes in one cell at one time that are compared pair by pair.
_MAX_CELL_BOXES = 32
# Distance of an untracked row from where the actor should be.
_UNTRACKED_RADIUS_M = 2.0
CAR_CODES = [CATEGORIES.index(name) for name in ("car", "truck", "van")]
"""Category codes of four-wheeled vehicles."""
# The findings that a check yields.
Findings = Iterator[Finding]


@dataclass(frozen=True, kw_only=True, eq=False)
class Subject:
    """One scenario: A agents, F frames, S = A·F samples (agent by agent), and N boxes.

    All coordinates are in the right-handed world frame.

    Attributes:
        files: Parsed contents of the files.
        boxes: The boxes, and where each was recorded.
        centers: Box centres in metres, shape (N, 3).
    """

    files: ScenarioFiles
    boxes: ScenarioBoxes
    centers: FloatArray

    @property
    def token(self) -> str:
        """Token of the scenario."""
        return self.files.scenario.token

    @property
    def agents(self) -> Sequence[AgentName]:
        """The A agents that the scenario has."""
        return self.files.scan.agents

    @property
    def labelled(self) -> Sequence[AgentName]:
        """The agents that have labels."""
        return self.files.scan.labelled

    @property
    def num_frames(self) -> int:
        """Number of frames, F."""
        return self.files.scan.num_frames

    @property
    def label_id(self) -> IntArray:
        """Actor id of each box, from the labels, shape (N,)."""
        return self.boxes.labels.actor_id

    @cached_property
    def tracked(self) -> BoolArray:
        """Which boxes are tracked and show other actors, shape (N,)."""
        is_other = self.label_id != OWN_ACTOR_ID
        is_tracked: BoolArray = is_other & (self.label_id != UNTRACKED_ID)
        return is_tracked

    @cached_property
    def own(self) -> BoolArray:
        """Which boxes are the recording agent's own row, shape (N,)."""
        is_own: BoolArray = self.label_id == OWN_ACTOR_ID
        return is_own

    @cached_property
    def in_collision(self) -> BoolArray:
        """Which boxes show the colliders that meta names, shape (N,); all if there is no meta."""
        meta = self.files.meta
        if meta is None:
            return np.ones(len(self.boxes), dtype=bool)
        pair = meta.collision.ids if meta.collision else ()
        return np.isin(self.boxes.actor, pair)

    @cached_property
    def yaw(self) -> FloatArray:
        """Heading of each box in the world frame in radians, shape (N,)."""
        rotations = box_rules.world_rotations(self.boxes)
        return quaternions.yaw_of(rotations)

    @cached_property
    def reach(self) -> FloatArray:
        """Distance in metres up to which each agent's labels are complete, shape (A,).

        Labels are taken to be complete if some label of the scenario contains a hidden actor, which
        neither the LiDAR nor a camera of its agent sees. The distance is then a share of the
        distance to the agent's farthest box, up to a limit; otherwise it is 0.
        """
        labels = self.boxes.labels
        agent = self.boxes.agent
        distances = np.linalg.norm(labels.center[:, :2], axis=1)
        is_unseen = (labels.num_lidar_pts == 0) & ~labels.camera_visible
        is_hidden = self.tracked & is_unseen & (distances < _MAX_REACH_M)
        max_distances = np.zeros(len(self.agents))
        np.maximum.at(max_distances, agent, distances)
        possible_reach = np.minimum(_MAX_REACH_M, _REACH_SHARE * max_distances)
        reach: FloatArray = possible_reach * is_hidden.any()
        return reach

    def has_untracked(self, agent: int, frames: IntArray, positions: FloatArray) -> BoolArray:
        """Return at which positions the agent has an untracked row (id −1), shape (M,).

        Args:
            agent: Index of the agent.
            frames: Frame numbers, shape (M,).
            positions: Positions in these frames, world frame, in metres, shape (M, 3).
        """
        is_untracked = (self.label_id == UNTRACKED_ID) & (self.boxes.agent == agent)
        rows = np.flatnonzero(is_untracked)
        if not len(rows) or not len(frames):
            return np.zeros(len(frames), dtype=bool)
        from scipy.spatial import cKDTree

        points = tree_points(self.centers[rows], self.boxes.frame[rows], _UNTRACKED_RADIUS_M)
        tree = cKDTree(np.unique(points, axis=0))
        queries = tree_points(positions, frames, _UNTRACKED_RADIUS_M)
        distance, _ = tree.query(queries, distance_upper_bound=_UNTRACKED_RADIUS_M)
        return np.isfinite(distance)

    @cached_property
    def lidar_boxes(self) -> Boxes:
        """All N boxes, each in the LiDAR frame of its sample."""
        return self.boxes.labels.boxes()

    @cached_property
    def velocity(self) -> FloatArray:
        """Velocities computed from displacements in m/s, shape (N, 3); NaN where unknown."""
        return displacement_velocities(
            self.centers, self.boxes.agent, self.label_id, self.boxes.frame
        )

    @cached_property
    def positions(self) -> FloatArray:
        """Positions of the agents in metres, shape (A, F, 3)."""
        positions = self.files.calibs.world_from_ego[:, :3, 3]
        return positions.reshape(len(self.agents), self.num_frames, 3)

    def is_pole(self, agent: int) -> bool:
        """Return whether the agent at this index is the roadside infrastructure."""
        return self.agents[agent] == INFRASTRUCTURE

    def finding(self, code: str, location: str, message: str) -> Finding:
        """Make a finding about this scenario; severity and remedy are taken from `CODES`."""
        return make_finding(code, self.token, location, message)

    def label_finding(self, code: str, agent: int, message: str) -> Finding:
        """Make a finding about the folder of an agent's labels."""
        return self.finding(code, self.kind_folder(agent, "label"), message)

    def kind_folder(self, agent: int, kind: str) -> str:
        """Return the folder of an agent's files of one kind: `label`, `calib` or a channel."""
        name = self.agents[agent]
        return str(self.files.scenario.kind_folder(name, kind))

    def rows_by_agent(self, mask: BoolArray) -> Iterable[tuple[int, IntArray]]:
        """Yield each agent that has boxes in the mask (N,), with their indices (M,)."""
        for agent in range(len(self.agents)):
            is_selected = mask & (self.boxes.agent == agent)
            rows = np.flatnonzero(is_selected)
            if len(rows):
                yield agent, rows

    def mask(self, rows: AnyArray) -> BoolArray:
        """Return a mask (N,) that is true at indices (M,)."""
        mask = np.zeros(len(self.boxes), dtype=bool)
        mask[rows] = True
        return mask

    def box_findings(self, code: str, mask: BoolArray, message: str) -> Findings:
        """Yield a finding for each agent with boxes in a mask; it lists their actors and frames.

        Args:
            code: Kind of the finding.
            mask: Which boxes are wrong, shape (N,).
            message: What is wrong with them.
        """
        for agent, rows in self.rows_by_agent(mask):
            frames = frames_text(self.boxes.frame[rows])
            actors = actors_text(self.label_id[rows])
            yield self.label_finding(code, agent, f"{message}: {actors}, {frames}")


def subject_of(files: ScenarioFiles) -> Subject:
    """Prepare the files of a scenario for all checks."""
    boxes = scenario_boxes(files)
    centers = box_rules.world_centers(boxes)
    return Subject(files=files, boxes=boxes, centers=centers)


def near_pairs(
    positions: FloatArray, moments: AnyArray, radius: float
) -> tuple[IntArray, BoolArray]:
    """Return pairs of positions at the same time that are within a radius, without crowds.

    A crowd has many positions in one cell, and would form too many pairs.

    Args:
        positions: Positions in metres, shape (M, 3).
        moments: Time index of each position, shape (M,).
        radius: Largest distance of a pair in metres.

    Returns:
        Index pairs, shape (P, 2), and a mask (M,) of positions in crowds, which are in no pair.
    """
    from scipy.spatial import cKDTree

    points = tree_points(positions, moments, radius)
    cells = np.floor(points / radius)
    _, cell, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    crowded: BoolArray = count[cell.reshape(-1)] > _MAX_CELL_BOXES
    rows = np.flatnonzero(~crowded)
    tree_pairs = cKDTree(points[rows]).query_pairs(radius, output_type="ndarray")
    pairs: IntArray = rows[tree_pairs].reshape(-1, 2)
    return pairs, crowded


def tree_points(positions: FloatArray, moments: AnyArray, radius: float) -> FloatArray:
    """Return points for a k-d tree, shape (M, 4): position, and a far-apart value per time.

    Nonsensical positions are clipped because they would overflow.
    """
    clipped = np.clip(positions, -_COORDINATE_LIMIT_M, _COORDINATE_LIMIT_M)
    separations = moments * (10 * radius)
    return np.column_stack([clipped, separations])


def make_finding(code: str, scenario: str | None, location: str, message: str) -> Finding:
    """Make a finding of a kind in `CODES`, with its severity and remedy."""
    kind = CODES[code]
    return Finding(
        code=code,
        severity=kind.severity,
        scenario=scenario,
        where=location,
        what=message,
        remedy=kind.remedy,
        known=bool(kind.known),
    )


def frames_text(frames: Iterable[int]) -> str:
    """Format frame numbers as `frame 7`, or `frames 3–5, 9`."""
    numbers = sorted({int(frame) for frame in frames})
    if len(numbers) == 1:
        noun = "frame"
    else:
        noun = "frames"
    return f"{noun} {frame_ranges(numbers)}"


def actors_text(ids: Iterable[int], max_listed: int = 4) -> str:
    """Format actor ids as `actor 1236`, or `actors 12, 17, 20, 31 and 5 more`."""
    numbers = sorted({int(actor) for actor in ids})
    listed_ids = ", ".join(map(str, numbers[:max_listed]))
    if len(numbers) > max_listed:
        listed_ids += f" and {len(numbers) - max_listed} more"
    noun = "actor" if len(numbers) == 1 else "actors"
    return f"{noun} {listed_ids}"
