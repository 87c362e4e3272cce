"""Detected boxes, the true ones of a sample, and the columns of both that the metrics read."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ConfigError, GeometryError, NotAvailableError
from deepaccident_devkit.evaluation.detection.protocols import DetectionProtocol, detection_protocol
from deepaccident_devkit.geometry import SE3, Boxes
from deepaccident_devkit.geometry.boxes import checked_boxes
from deepaccident_devkit.support.arrays import (
    AnyArray,
    BoolArray,
    FloatArray,
    FrozenArrays,
    IntArray,
    as_numbers,
    checked,
)
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID, UNTRACKED_ID
from deepaccident_devkit.v2x import Agents, cooperative_boxes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DetectedBoxes(FrozenArrays):
    """What a detector says of one sample; arrays are read-only.

    Attributes:
        boxes: N boxes, right-handed, in the frame that they name; velocities NaN where the detector has none.
        scores: (N,) float64, how sure the detector is, the more the higher.
    """

    boxes: Boxes
    scores: FloatArray

    def __post_init__(self) -> None:
        """Check and freeze; raises GeometryError."""
        checked_boxes("detected boxes", self.boxes)
        scores = checked("scores", self.scores, (len(self.boxes),)).copy()
        if not np.isfinite(scores).all():
            raise GeometryError("scores: not all numbers are finite; leave out the boxes that have none")
        object.__setattr__(self, "scores", scores)
        FrozenArrays.__post_init__(self)

    @classmethod
    def from_arrays(
        cls,
        center: ArrayLike,
        size: ArrayLike,
        yaw: ArrayLike,
        scores: ArrayLike,
        *,
        frame: str,
        category: ArrayLike | None = None,
        velocity: ArrayLike | None = None,
    ) -> DetectedBoxes:
        """Boxes that stand upright in `frame`, right-handed (x forward, y left).

        Args:
            center: (N, 3) metres.
            size: (N, 3) full length, width, height, metres.
            yaw: (N,) radians, counter-clockwise.
            scores: (N,).
            frame: what all of it is in: `lidar` for an evaluator, `world` for results files.
            category: (N,) indices or names; None for cars.
            velocity: (N, 2) or (N, 3) m/s over the ground; None for unknown.

        Raises:
            GeometryError: a shape or a number that cannot be.
        """
        columns: dict[str, Any] = {}
        if velocity is not None:
            given = as_numbers("velocity", velocity)
            flat = given.ndim == 2 and given.shape[1] == 2
            columns["velocity"] = np.column_stack([given, np.zeros(len(given))]) if flat else given
        boxes = Boxes.from_arrays(center, size, yaw, frame=frame, category=category, **columns)
        return cls(boxes=boxes, scores=scores)  # type: ignore[arg-type]  # checked in __post_init__

    def transform(self, target_from_source: SE3, frame: str) -> DetectedBoxes:
        """The same detections in another frame, such as `world` for results files. Raises GeometryError."""
        return replace(self, boxes=self.boxes.transform(target_from_source, frame))

    def __len__(self) -> int:
        """Number of boxes."""
        return len(self.boxes)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BoxColumns:
    """N upright boxes as the metrics read them, in one right-handed frame around the agent; float64 or float32.

    Attributes:
        center: (N, 3) metres.
        size: (N, 3) length, width, height, metres.
        yaw: (N,) radians, any number of turns.
        velocity: (N, 2) m/s, NaN where unknown.
        category: (N,) index into `taxonomy.CATEGORIES`.
        score: (N,) float64; of true boxes anything.
        own: (N,) bool, the recording agent itself.
    """

    center: AnyArray
    size: AnyArray
    yaw: AnyArray
    velocity: AnyArray
    category: AnyArray
    score: FloatArray
    own: BoolArray

    def __len__(self) -> int:
        """Number of boxes."""
        return len(self.center)

    def select(self, which: AnyArray) -> BoxColumns:
        """The boxes that a mask or an array of rows picks."""
        return BoxColumns(**{name: getattr(self, name)[which] for name in self.__dataclass_fields__})

    @property
    def surest_first(self) -> IntArray:
        """(N,) rows by falling score, equal ones by what is in the boxes: the same boxes in any order of the rows."""
        return np.lexsort(
            np.column_stack([-self.score, self.category, self.center, self.size, self.yaw, self.velocity, self.own]).T[
                ::-1
            ]
        )

    def rounded(self) -> BoxColumns:
        """The same boxes in single precision; scores stay."""
        names = ("center", "size", "yaw", "velocity")
        return replace(self, **{name: getattr(self, name).astype(np.float32) for name in names})

    @property
    def bottom(self) -> AnyArray:
        """(N,) height of the lower faces, metres, of the boxes' own precision."""
        return np.asarray(self.center[:, 2] - self.size[:, 2] / 2)

    @property
    def footprint(self) -> FloatArray:
        """(N, 5) float64, x, y, length, width, yaw, as geometry.box_arrays takes them."""
        return np.column_stack([self.center[:, :2], self.size[:, :2], self.yaw]).astype(np.float64)


def columns_of(boxes: Boxes, scores: FloatArray | None = None) -> BoxColumns:
    """The columns of true boxes, or of detected ones with their scores."""
    return BoxColumns(
        center=boxes.center,
        size=boxes.size,
        yaw=boxes.yaw,
        velocity=boxes.velocity[:, :2],
        category=boxes.category,
        score=np.zeros(len(boxes)) if scores is None else scores,
        own=boxes.actor_id == OWN_ACTOR_ID,
    )


def detection_truth(
    dataset: Dataset,
    sample: RowArgument,
    protocol: str | DetectionProtocol = "released",
    *,
    agents: Agents = None,
) -> Boxes:
    """What a detector should have found at a sample, by a protocol: its `truth`, `label_velocity` and `own_box`.

    Area and ranges are not applied: `DetectionEvaluator.update` does that for truth and detections.

    Args:
        dataset: the release.
        sample: token or record; the evaluation is around its agent.
        protocol: name, or a protocol.
        agents: for `cooperative` truth: the agents whose labels are united (as `v2x.cooperative_boxes`); None for all.

    Returns:
        Boxes in the protocol's frame.

    Raises:
        TokenError: no such sample.
        ChoiceError: no such protocol, agent or configuration.
        ConfigError: `agents` are given and the truth is not cooperative.
        NotAvailableError: the sample has no label (the test split ships without), or an agent is not in this release.
    """
    rules = detection_protocol(protocol)
    record = dataset.get("sample", sample)
    if not record["labelled"]:
        raise NotAvailableError(f"{record['token']}: has no label, so that nothing can be evaluated")
    if rules.truth == "cooperative":
        boxes = cooperative_boxes(dataset, sample, agents=agents, frame=rules.frame)
        own_actor = dataset.get("agent", record["agent_token"])["actor_id"]
        own = boxes.actor_id == (OWN_ACTOR_ID if own_actor is None or own_actor == UNTRACKED_ID else own_actor)
    elif agents is not None:
        raise ConfigError(f"agents: the truth of this protocol is {rules.truth!r}; choose truth='cooperative', or None")
    else:
        boxes = dataset.boxes(sample, rules.frame, "released" if rules.truth == "visible" else None)
        own = boxes.actor_id == OWN_ACTOR_ID
    if rules.label_velocity:
        boxes = _with_label_velocity(dataset, sample, boxes, rules)
    return boxes if rules.own_box else boxes.select(~own)


def _with_label_velocity(dataset: Dataset, sample: RowArgument, boxes: Boxes, rules: DetectionProtocol) -> Boxes:
    """The boxes with the velocities that stand in the label, which the released code takes to be in LiDAR axes."""
    if rules.frame != "lidar" or rules.truth == "cooperative":
        raise ConfigError("label_velocity: the label's velocities are those of one agent's LiDAR frame; choose False")
    written = dataset.columns("annotation")["velocity_label"][dataset.annotation_rows(sample)][boxes.row]
    return replace(boxes, velocity=np.column_stack([written, np.zeros(len(written))]))
