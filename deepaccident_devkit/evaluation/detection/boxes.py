"""A sample's true boxes under a detection protocol, and the columns that metrics read."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Final, Literal, get_args

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument, Visible
from deepaccident_devkit.errors import ConfigError, NotAvailableError
from deepaccident_devkit.evaluation.predicted_boxes import check_classes
from deepaccident_devkit.evaluation.task import as_tuples, protocol_of, switched
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.support.arrays import (
    AnyArray,
    BoolArray,
    FloatArray,
    IntArray,
)
from deepaccident_devkit.support.text import settle_choices
from deepaccident_devkit.taxonomy import CATEGORIES, OWN_ACTOR_ID, SMALL_CATEGORIES, UNTRACKED_ID
from deepaccident_devkit.v2x import Agents, cooperative_boxes

TruthSource = Literal["label", "visible", "cooperative"]
Measure = Literal["distance_of_bottoms", "distance_bev", "iou_3d", "iou_bev"]
Matching = Literal["by_truth", "by_score"]
Curve = Literal["released", "nuscenes", "voc"]
_CHOICES = {
    "truth": get_args(TruthSource),
    "measure": get_args(Measure),
    "matching": get_args(Matching),
    "curve": get_args(Curve),
    "area_of": ("center", "footprint"),
}
# Largest total number of points of all curves.
_MAX_POINTS = 10_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectionProtocol:
    """Rules that decide which boxes count as found, and how metrics are computed from them.

    Sources: the section "Detection" of docs/released_code.md (released), the paper's text, the
        nuScenes devkit (eval/detection) and OpenCOOD (opencood/utils/eval_utils.py, box_utils.py
        and data_utils/datasets).

    Attributes:
        classes: Classes that are counted separately: the name and the categories of each class.
        frame: Frame of predictions and truth, `lidar` or `ego`.
        truth: Which boxes `detection_truth` returns. `label`: all boxes of the agent's own label;
            `visible`: only boxes that any agent sees by the released rule; `cooperative`: the union
            of the labels of several agents.
        label_velocity: Whether true velocities are read from the label; otherwise they are derived
            from positions.
        own_box: Whether the recording agent's own box must be found.
        single_precision: Whether boxes and distances are rounded to single precision, as in the
            released code's tensors.
        unknown_velocity_is_zero: Whether an unknown true velocity counts as 0; otherwise it does
            not count.
        area: Start and end along x, then along y, metres, ends included. Boxes outside the area are
            ignored; None for no limit.
        area_of: Part of a box that must be in the area: its `center` or its complete `footprint`.
        ranges: Start and end of each distance range that is counted separately, metres, end
            excluded. With `by_score`, boxes outside a range are ignored. With `by_truth`, they take
            part in matching (detections outside it with true boxes of any class), but their matches
            do not count.
        range_from_x_alone: Whether ranges use the distance sqrt(x² + x²) instead of sqrt(x² + y²),
            a bug.
        measure: How near two boxes are: distance between the centres of their lower faces, distance
            between their centres on the ground, or intersection over union of their volumes or
            footprints.
        bottom_taken_as_top: Whether, for the overlap of volumes, boxes extend downwards from their
            lower face, a bug.
        thresholds: Thresholds of the measure that are counted separately: metres, or shares.
        small_thresholds: Thresholds for cyclists, motorcycles and pedestrians; None for the same
            thresholds.
        threshold_included: Whether a pair that is exactly at the threshold matches.
        matching: How boxes are matched. `by_truth`: true boxes, in the label's order, take the
            nearest free detection; to choose the points of the curve, they take the free detection
            with the highest score (ties: the first). `by_score`: detections, in descending order of
            score, take the nearest free true box. Equal scores are ordered by the samples' tokens,
            then by the boxes' values, so the order of the boxes does not matter.
        curve: How the average precision is computed. `released`: mean precision at the scores at
            which recall first exceeds multiples of 1/points (0 if it never does), without an
            envelope; `nuscenes`: precision interpolated at `points` levels of recall from 0 to 1;
            `voc`: area under the envelope.
        points: Number of points of a curve.
        min_recall: Share of the points, from the lowest recall on, that is left out; not used by
            `voc`.
        min_precision: Precision that counts as 0; higher values are rescaled to [0, 1]. Only used
            by `nuscenes`.
        global_sort: Whether detections are sorted by score over all samples; otherwise they are
            sorted within each sample, and samples by token (OpenCOOD's default). Only used by
            `voc`.
        error_threshold: Threshold at which the errors of matches are computed; None for no errors.
        error_of_bottoms: Whether the position error is the 3D distance between the centres of the
            lower faces; otherwise it is the distance on the ground.
        scale_by_overlap: Whether the scale error is 1 − the overlap of volumes of the boxes as they
            are; otherwise the boxes are first aligned in centre and heading.
        orientation_unwrapped: Whether the heading error is |a mod 6.2831852 − b mod 6.2831852|, up
            to a full turn; otherwise it is the smaller angle between the two headings.
        absent_class_is_zero: Whether a class without true boxes has an average precision of 0 and
            errors of 1; otherwise it is left out of the means.
    """

    # what must be found
    classes: tuple[tuple[str, tuple[str, ...]], ...] = tuple((name, (name,)) for name in CATEGORIES)
    frame: str = "lidar"
    truth: TruthSource
    label_velocity: bool = False
    own_box: bool
    single_precision: bool = False
    unknown_velocity_is_zero: bool = False
    # where boxes count
    area: tuple[float, float, float, float] | None = None
    area_of: Literal["center", "footprint"] = "center"
    ranges: tuple[tuple[float, float], ...] = ((0.0, math.inf),)
    range_from_x_alone: bool = False
    # which pairs match
    measure: Measure
    bottom_taken_as_top: bool = False
    thresholds: tuple[float, ...]
    small_thresholds: tuple[float, ...] | None = None
    threshold_included: bool = False
    matching: Matching
    # the curve and its average precision
    curve: Curve
    points: int = 101
    min_recall: float = 0.0
    min_precision: float = 0.0
    global_sort: bool = True
    # the errors of the matches
    error_threshold: float | None = None
    error_of_bottoms: bool = False
    scale_by_overlap: bool = False
    orientation_unwrapped: bool = False
    # the means over classes
    absent_class_is_zero: bool = False

    def __post_init__(self) -> None:
        """Check the choices.

        Raises:
            ChoiceError: If a choice does not exist.
            ConfigError: If choices exclude each other, or a number is invalid.
        """
        for name in ("classes", "area", "ranges", "thresholds", "small_thresholds"):
            object.__setattr__(self, name, as_tuples(getattr(self, name)))
        settle_choices(self, _CHOICES)
        check_classes(self.classes)
        if self.frame not in ("lidar", "ego"):
            raise ConfigError(
                f"frame: expected 'lidar' or 'ego', found {self.frame!r}, as ranges are "
                "distances from the agent"
            )
        if not self.thresholds or not self.ranges:
            raise ConfigError("thresholds and ranges: expected at least one of each")
        if self.small_thresholds is not None and len(self.small_thresholds) != len(self.thresholds):
            raise ConfigError(
                f"small_thresholds: expected as many as thresholds, found {self.small_thresholds}"
            )
        self._check_curve()

    def _check_curve(self) -> None:
        """Raise ConfigError if the choices for the curve or for the errors are invalid."""
        if not (self.points > 1 and 0 <= self.min_recall < 1 and 0 <= self.min_precision < 1):
            raise ConfigError(
                "points, min_recall, min_precision: expected at least 2, and shares from 0 and "
                "below 1"
            )
        curves = len(self.classes) * len(self.ranges) * len(self.thresholds)
        if curves * self.points > _MAX_POINTS:
            raise ConfigError(
                f"points: {self.points} for each class, range and threshold ({curves}) are more "
                f"than {_MAX_POINTS:,} together; choose fewer"
            )
        if not self.global_sort and self.curve != "voc":
            raise ConfigError(
                f"global_sort: the curve {self.curve!r} depends on the order of all scores; "
                "choose curve='voc'"
            )
        if self.error_threshold is None:
            return
        is_threshold = self.error_threshold in self.thresholds
        if not is_threshold or len(self.ranges) > 1 or self.curve == "voc":
            raise ConfigError(
                f"error_threshold: {self.error_threshold} needs to be one of the thresholds "
                f"{self.thresholds}, a single range, and another curve than voc; choose None for "
                "no errors"
            )

    def limits(self, name: str) -> tuple[float, ...]:
        """Return the thresholds of the class with a name."""
        if self.small_thresholds is not None and name in SMALL_CATEGORIES:
            return self.small_thresholds
        return self.thresholds

    def as_dict(self) -> dict[str, Any]:
        """Convert all fields to JSON-compatible values."""
        return dict(json.loads(json.dumps(asdict(self))))


_RELEASED = DetectionProtocol(
    truth="label",
    label_velocity=True,
    own_box=True,
    single_precision=True,
    unknown_velocity_is_zero=True,
    ranges=((0.0, 120.0),),
    range_from_x_alone=True,
    measure="distance_of_bottoms",
    bottom_taken_as_top=True,
    thresholds=(0.5, 1.0, 2.0, 4.0),
    matching="by_truth",
    curve="released",
    points=40,
    min_recall=0.1,
    error_threshold=2.0,
    error_of_bottoms=True,
    scale_by_overlap=True,
    orientation_unwrapped=True,
    absent_class_is_zero=True,
)
DETECTION_PROTOCOLS: Final[Mapping[str, DetectionProtocol]] = {
    "released": _RELEASED,
    "released_iou": replace(
        _RELEASED,
        ranges=((0.0, 30.0), (30.0, 50.0), (50.0, 120.0)),
        measure="iou_3d",
        thresholds=(0.3, 0.15),
        small_thresholds=(0.2, 0.1),
        error_threshold=None,
    ),
    "paper": DetectionProtocol(
        truth="visible",
        own_box=False,
        area=(-51.2, 51.2, -51.2, 51.2),
        measure="distance_bev",
        thresholds=(1.0, 2.0, 4.0),
        matching="by_score",
        curve="nuscenes",
        min_recall=0.1,
        min_precision=0.1,
        error_threshold=2.0,
    ),
    "opencood": DetectionProtocol(
        classes=(("vehicle", ("car", "truck", "van")),),
        truth="cooperative",
        own_box=False,
        area=(-140.0, 140.0, -40.0, 40.0),
        area_of="footprint",
        measure="iou_bev",
        thresholds=(0.3, 0.5, 0.7),
        threshold_included=True,
        matching="by_score",
        curve="voc",
    ),
}
"""Name → protocol: the released code (with `distance_mAP`, or its other mode `iou_mAP`), the paper,
and OpenCOOD, whose numbers V2X papers report."""


def detection_protocol(protocol: str | DetectionProtocol, **switches: Any) -> DetectionProtocol:
    """Return a protocol, which may be passed by name, with some fields changed.

    Raises:
        ChoiceError: If the protocol or a choice does not exist.
        ConfigError: If choices exclude each other.
    """
    base_protocol = protocol_of(protocol, DETECTION_PROTOCOLS)
    return switched(base_protocol, switches)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BoxColumns:
    """Columns of N upright boxes that the metrics read, in a right-handed frame around the agent.

    Arrays are float64 or float32.

    Attributes:
        center: (N, 3) centres, metres.
        size: (N, 3) length, width, height, metres.
        yaw: (N,) headings, radians; not wrapped to one turn.
        velocity: (N, 2) velocities, m/s; NaN if unknown.
        category: (N,) index into `taxonomy.CATEGORIES`.
        score: (N,) float64 confidences; without meaning for true boxes.
        own: (N,) bool, True for the box of the recording agent itself.
    """

    center: AnyArray
    size: AnyArray
    yaw: AnyArray
    velocity: AnyArray
    category: AnyArray
    score: FloatArray
    own: BoolArray

    def __len__(self) -> int:
        """Return the number of boxes."""
        return len(self.center)

    def select(self, rows: AnyArray) -> BoxColumns:
        """Return the boxes that a mask or an array of indices selects."""
        columns = {name: getattr(self, name)[rows] for name in self.__dataclass_fields__}
        return BoxColumns(**columns)

    @property
    def surest_first(self) -> IntArray:
        """(N,) indices in descending order of score; ties are ordered by the boxes' values."""
        columns = [
            -self.score,
            self.category,
            self.center,
            self.size,
            self.yaw,
            self.velocity,
            self.own,
        ]
        return np.lexsort(np.column_stack(columns).T[::-1])

    def rounded(self) -> BoxColumns:
        """Round the boxes to single precision; scores do not change."""
        columns = {}
        for name in ("center", "size", "yaw", "velocity"):
            columns[name] = getattr(self, name).astype(np.float32)
        return replace(self, **columns)

    @property
    def bottom(self) -> AnyArray:
        """(N,) z of the lower faces, metres, in the boxes' own precision."""
        z = self.center[:, 2]
        height = self.size[:, 2]
        return np.asarray(z - height / 2)

    @property
    def footprint(self) -> FloatArray:
        """(N, 5) float64 x, y, length, width, yaw, as `geometry.box_arrays` expects them."""
        position = self.center[:, :2]
        extent = self.size[:, :2]
        footprint = np.column_stack([position, extent, self.yaw])
        return footprint.astype(np.float64)


def columns_of(boxes: Boxes, scores: FloatArray | None = None) -> BoxColumns:
    """Extract the columns of true boxes, or of detected boxes with their scores."""
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
    """Return the boxes that a detector should find in a sample, under a protocol.

    They depend on the protocol's `truth`, `label_velocity` and `own_box`. Area and ranges are not
    applied here: `DetectionEvaluator.update` applies them to truth and detections.

    Args:
        dataset: Release with the sample.
        sample: Token or record of the sample; the evaluated area is around its agent.
        protocol: Name of a protocol, or a protocol.
        agents: For `cooperative` truth, the agents that contribute labels (as in
            `v2x.cooperative_boxes`); None for all agents.

    Returns:
        Boxes in the protocol's frame.

    Raises:
        TokenError: If the release does not have the sample.
        ChoiceError: If the protocol, an agent or the configuration does not exist.
        ConfigError: If `agents` are passed although the truth is not cooperative.
        NotAvailableError: If the sample has no label (the test split has none), or an agent is not
            in this release.
    """
    rules = detection_protocol(protocol)
    record = dataset.get("sample", sample)
    if not record["labelled"]:
        raise NotAvailableError(f"{record['token']}: has no label, so it cannot be evaluated")
    if rules.truth == "cooperative":
        boxes = cooperative_boxes(dataset, sample, agents=agents, frame=rules.frame)
        own_id = dataset.get("agent", record["agent_token"])["actor_id"]
        if own_id is None or own_id == UNTRACKED_ID:
            own_id = OWN_ACTOR_ID
        is_own = boxes.actor_id == own_id
    elif agents is not None:
        raise ConfigError(
            f"agents: the truth of this protocol is {rules.truth!r}; choose truth='cooperative', "
            "or None"
        )
    else:
        visible: Visible | None = "released" if rules.truth == "visible" else None
        boxes = dataset.boxes(sample, rules.frame, visible)
        is_own = boxes.actor_id == OWN_ACTOR_ID
    if rules.label_velocity:
        boxes = _with_label_velocity(dataset, sample, boxes, rules)
    return boxes.select(rules.own_box | ~is_own)


def _with_label_velocity(
    dataset: Dataset, sample: RowArgument, boxes: Boxes, rules: DetectionProtocol
) -> Boxes:
    """Replace the boxes' velocities by the ones that the label states.

    The released code assumes that these are along the axes of the LiDAR frame.

    Raises:
        ConfigError: If the boxes are in another frame, or come from the labels of several agents.
    """
    if rules.frame != "lidar" or rules.truth == "cooperative":
        raise ConfigError(
            "label_velocity: the label's velocities are in the LiDAR frame of one agent, but "
            "this truth merges several agents; choose False"
        )
    rows = dataset.annotation_rows(sample)
    label_velocity = dataset.columns("annotation")["velocity_label"][rows][boxes.row]
    velocity = np.column_stack([label_velocity, np.zeros(len(label_velocity))])
    return replace(boxes, velocity=velocity)
