"""Detected boxes, the true boxes of a sample by a protocol, and the columns of both for metrics."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Final, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ConfigError, GeometryError, NotAvailableError
from deepaccident_devkit.evaluation.task import as_tuples, protocol_of, switched
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
from deepaccident_devkit.support.text import settle_choices
from deepaccident_devkit.taxonomy import CATEGORIES, OWN_ACTOR_ID, SMALL_CATEGORIES, UNTRACKED_ID
from deepaccident_devkit.v2x import Agents, cooperative_boxes

TruthSource = Literal["label", "visible", "cooperative"]
Measure = Literal["distance_of_bottoms", "distance_bev", "iou_3d", "iou_bev"]
Matching = Literal["by_truth", "by_score"]
Curve = Literal["released", "nuscenes", "voc"]
_CHOICES: Final = {
    "truth": get_args(TruthSource),
    "measure": get_args(Measure),
    "matching": get_args(Matching),
    "curve": get_args(Curve),
    "area_of": ("center", "footprint"),
}
# Largest number of points of all curves together.
_MAX_POINTS: Final = 10_000_000


def _check_classes(classes: tuple[tuple[str, tuple[str, ...]], ...]) -> None:
    """Check that no category is unknown or in two classes; raises ConfigError."""
    used = [category for _, categories in classes for category in categories]
    if not used or len(set(used)) < len(used) or not set(used) <= set(CATEGORIES):
        raise ConfigError(
            f"classes: expected names with categories of {', '.join(CATEGORIES)}, each at most "
            f"once, found {classes}"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectionProtocol:
    """Rules for which boxes count as found, and how numbers are made of them.

    Sources: docs/released_code.md, Detection (released), the paper's text, the nuScenes devkit
        (eval/detection) and OpenCOOD (opencood/utils/eval_utils.py, box_utils.py and
        data_utils/datasets).

    Attributes:
        classes: Classes that are counted separately: a name and the categories of each.
        frame: Frame of predictions and truth, `lidar` or `ego`.
        truth: Boxes that `detection_truth` returns: all of the agent's own `label`, the ones of
            them that are `visible` to any agent by the released rule, or the `cooperative` union of
            some agents' labels.
        label_velocity: Whether the truth's velocity is the label's as written; otherwise it is the
            one derived from positions.
        own_box: Whether the recording agent's own box must be found.
        single_precision: Whether boxes and distances are rounded to single precision, as in the
            released code's tensors.
        unknown_velocity_is_zero: Whether an unknown true velocity counts as standing still;
            otherwise it does not count.
        area: Start and end along x, then along y, metres, ends included: boxes beyond it do not
            exist; None for no limit.
        area_of: Part of a box that must be in the area, its `center` or its complete `footprint`.
        ranges: Rings that are counted separately, from and to (metres, the end excluded). With
            matching `by_truth`, a box beyond the ring only takes part in matching, a detection with
            truth of any class, and its match does not count; with `by_score` it does not exist.
        range_from_x_alone: Whether rings use the distance sqrt(x² + x²), a bug: sqrt(x² + y²) is
            meant.
        measure: Measure of nearness: distance of the centres of the lower faces, distance of the
            centres on the ground, overlap of volumes or of footprints (intersection over union).
        bottom_taken_as_top: Whether boxes reach downwards from their lower face in the overlap of
            volumes.
        thresholds: Thresholds of the measure that are counted separately: metres, or shares.
        small_thresholds: Thresholds of cyclists, motorcycles and pedestrians; None for the same.
        threshold_included: Whether a pair exactly at the threshold matches.
        matching: `by_truth`: each true box in the label's order takes the nearest detection (and,
            to choose the points of the curve, the one with the highest score, of equal ones the
            first); `by_score`: each detection in the order of scores takes the nearest true box.
            Equal scores are then in the order of the samples' tokens, and within a sample in the
            order of the boxes' values, so that the order of the boxes does not count.
        curve: How precision and recall become an average precision: `released`: the mean precision
            at the scores at which recall first exceeds multiples of 1/points (0 where it never
            does, no envelope); `nuscenes`: interpolated at `points` levels of recall from 0 to 1;
            `voc`: the area under the envelope.
        points: Number of points of a curve.
        min_recall: Share of the points that does not count; not for `voc`.
        min_precision: Precision that counts as 0, with the rest spread to [0, 1]; only for
            `nuscenes`.
        global_sort: Whether scores are ordered over all samples; otherwise within each sample, one
            after another by their tokens (OpenCOOD's default). Only for `voc`.
        error_threshold: Threshold of the matches with errors; None for no errors.
        error_of_bottoms: Whether the position error is that of the lower faces' centres in 3D;
            otherwise it is on the ground.
        scale_by_overlap: Whether the scale error is 1 − overlap of volumes as the boxes stand;
            otherwise as if centre and heading were equal.
        orientation_unwrapped: Whether the heading error is |a mod 6.2831852 − b mod 6.2831852|, up
            to a full turn; otherwise it is the smaller angle between the two.
        absent_class_is_zero: Whether a class without true boxes has average precision 0 and errors
            1; otherwise it is left out of the means.
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
        """Check the choices; raises ChoiceError or ConfigError."""
        for name in ("classes", "area", "ranges", "thresholds", "small_thresholds"):
            object.__setattr__(self, name, as_tuples(getattr(self, name)))
        settle_choices(self, _CHOICES)
        _check_classes(self.classes)
        if self.frame not in ("lidar", "ego"):
            raise ConfigError(
                f"frame: expected 'lidar' or 'ego', found {self.frame!r}: ranges are around the "
                "agent"
            )
        if not self.thresholds or not self.ranges:
            raise ConfigError("thresholds and ranges: expected at least one of each")
        if self.small_thresholds is not None and len(self.small_thresholds) != len(self.thresholds):
            raise ConfigError(
                f"small_thresholds: expected as many as thresholds, found {self.small_thresholds}"
            )
        self._check_curve()

    def _check_curve(self) -> None:
        """Check the choices of the curve and of the errors; raises ConfigError."""
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
                f"global_sort: the curve {self.curve!r} is by the order of all scores; choose "
                "curve='voc'"
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
        """Return the thresholds of a class by its name."""
        if self.small_thresholds is not None and name in SMALL_CATEGORIES:
            return self.small_thresholds
        return self.thresholds

    def as_dict(self) -> dict[str, Any]:
        """Return all choices, as JSON holds them."""
        return dict(json.loads(json.dumps(asdict(self))))


_RELEASED: Final = DetectionProtocol(
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
"""By name: the released code (`distance_mAP`, and its other mode, `iou_mAP`), the paper, and the
numbers that V2X papers print."""


def detection_protocol(protocol: str | DetectionProtocol, **switches: Any) -> DetectionProtocol:
    """Return a protocol by its name, or a protocol itself, with some choices changed.

    Raises:
        ChoiceError: no such protocol or choice.
        ConfigError: choices that exclude each other.
    """
    return switched(protocol_of(protocol, DETECTION_PROTOCOLS), switches)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DetectedBoxes(FrozenArrays):
    """Detections of one sample; arrays are read-only.

    Attributes:
        boxes: N boxes, right-handed, in the frame that they name; velocities NaN where the detector
            has none.
        scores: (N,) float64 confidence of the detector, higher is surer.
    """

    boxes: Boxes
    scores: FloatArray

    def __post_init__(self) -> None:
        """Check and freeze; raises GeometryError."""
        checked_boxes("detected boxes", self.boxes)
        scores = checked("scores", self.scores, (len(self.boxes),)).copy()
        if not np.isfinite(scores).all():
            raise GeometryError(
                "scores: not all numbers are finite; leave out the boxes that have none"
            )
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
        """Return boxes that stand upright in `frame`, right-handed (x forward, y left).

        Args:
            center: (N, 3) metres.
            size: (N, 3) full length, width, height, metres.
            yaw: (N,) radians, counter-clockwise.
            scores: (N,) confidences, higher is surer.
            frame: Frame of all values: `lidar` for an evaluator, `world` for results files.
            category: (N,) indices or names; None for cars.
            velocity: (N, 2) or (N, 3) m/s over the ground; None for unknown.

        Raises:
            GeometryError: an impossible shape or number.
        """
        columns: dict[str, Any] = {}
        if velocity is not None:
            vectors = as_numbers("velocity", velocity)
            if vectors.ndim == 2 and vectors.shape[1] == 2:
                vectors = np.column_stack([vectors, np.zeros(len(vectors))])
            columns["velocity"] = vectors
        boxes = Boxes.from_arrays(center, size, yaw, frame=frame, category=category, **columns)
        return cls(boxes=boxes, scores=scores)  # type: ignore[arg-type]  # checked in __post_init__

    def transform(self, target_from_source: SE3, frame: str) -> DetectedBoxes:
        """Return the detections in another frame, such as `world` for results files."""
        return replace(self, boxes=self.boxes.transform(target_from_source, frame))

    def __len__(self) -> int:
        """Return the number of boxes."""
        return len(self.boxes)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BoxColumns:
    """N upright boxes as the metrics read them, in one right-handed frame around the agent.

    Arrays are float64 or float32.

    Attributes:
        center: (N, 3) metres.
        size: (N, 3) length, width, height, metres.
        yaw: (N,) radians, any number of turns.
        velocity: (N, 2) m/s, NaN where unknown.
        category: (N,) index into `taxonomy.CATEGORIES`.
        score: (N,) float64; any value for true boxes.
        own: (N,) bool, whether it is the recording agent itself.
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
        """Return the boxes of a mask or of an array of rows."""
        columns = {name: getattr(self, name)[rows] for name in self.__dataclass_fields__}
        return BoxColumns(**columns)

    @property
    def surest_first(self) -> IntArray:
        """(N,) rows by falling score, equal ones by the boxes' values, whatever their order."""
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
        """Return the same boxes in single precision; scores stay."""
        names = ("center", "size", "yaw", "velocity")
        return replace(self, **{name: getattr(self, name).astype(np.float32) for name in names})

    @property
    def bottom(self) -> AnyArray:
        """(N,) height of the lower faces, metres, in the boxes' own precision."""
        half_height = self.size[:, 2] / 2
        return np.asarray(self.center[:, 2] - half_height)

    @property
    def footprint(self) -> FloatArray:
        """(N, 5) float64, x, y, length, width, yaw, as geometry.box_arrays takes them."""
        position = self.center[:, :2]
        extent = self.size[:, :2]
        footprint = np.column_stack([position, extent, self.yaw])
        return footprint.astype(np.float64)


def columns_of(boxes: Boxes, scores: FloatArray | None = None) -> BoxColumns:
    """Return the columns of true boxes, or of detected ones with their scores."""
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
    """Return the boxes that a detector should find at a sample, by a protocol.

    They depend on its `truth`, `label_velocity` and `own_box`. Area and ranges are not applied:
    `DetectionEvaluator.update` does that for truth and detections.

    Args:
        dataset: The release.
        sample: Token or record; the evaluation is around its agent.
        protocol: Name of a protocol, or a protocol.
        agents: For `cooperative` truth: the agents that contribute labels (as in
            `v2x.cooperative_boxes`); None for all.

    Returns:
        Boxes in the protocol's frame.

    Raises:
        TokenError: no such sample.
        ChoiceError: no such protocol, agent or configuration.
        ConfigError: `agents` are passed and the truth is not cooperative.
        NotAvailableError: the sample has no label (the test split ships without), or an agent is
            not in this release.
    """
    rules = detection_protocol(protocol)
    record = dataset.get("sample", sample)
    if not record["labelled"]:
        raise NotAvailableError(
            f"{record['token']}: has no label, so that nothing can be evaluated"
        )
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
        boxes = dataset.boxes(sample, rules.frame, "released" if rules.truth == "visible" else None)
        is_own = boxes.actor_id == OWN_ACTOR_ID
    if rules.label_velocity:
        boxes = _with_label_velocity(dataset, sample, boxes, rules)
    return boxes.select(rules.own_box | ~is_own)


def _with_label_velocity(
    dataset: Dataset, sample: RowArgument, boxes: Boxes, rules: DetectionProtocol
) -> Boxes:
    """Return the boxes with the velocities as written in the label.

    The released code assumes that these are in LiDAR axes. Raises ConfigError for another frame.
    """
    if rules.frame != "lidar" or rules.truth == "cooperative":
        raise ConfigError(
            "label_velocity: the label's velocities are those of one agent's LiDAR frame; choose "
            "False"
        )
    rows = dataset.annotation_rows(sample)
    velocity = dataset.columns("annotation")["velocity_label"][rows][boxes.row]
    return replace(boxes, velocity=np.column_stack([velocity, np.zeros(len(velocity))]))
