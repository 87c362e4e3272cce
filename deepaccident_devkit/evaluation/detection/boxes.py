"""Detected boxes, the true ones of a sample by a protocol, and the columns of both that the metrics read."""

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
# Of all curves together.
_MOST_POINTS: Final = 10_000_000


def _check_classes(classes: tuple[tuple[str, tuple[str, ...]], ...]) -> None:
    taken = [category for _, categories in classes for category in categories]
    if not taken or len(set(taken)) < len(taken) or not set(taken) <= set(CATEGORIES):
        raise ConfigError(
            f"classes: expected names with categories of {', '.join(CATEGORIES)}, each at most once, found {classes}"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectionProtocol:
    """Which boxes count as found, and how numbers are made of them.

    Sources: docs/released_code.md, Detection (released), the paper's text, the nuScenes devkit (eval/detection) and
    OpenCOOD (opencood/utils/eval_utils.py, box_utils.py and data_utils/datasets).

    Attributes:
        classes: what is counted apart: a name and the categories that it takes in.
        frame: the frame of predictions and truth, `lidar` or `ego`.
        truth: which boxes `detection_truth` takes: all of the agent's own `label`, those of them that are `visible` to
            any agent by the released rule, or the `cooperative` union of some agents' labels.
        label_velocity: the truth's velocity is the label's, as it stands there; else the one derived from positions.
        own_box: the recording agent itself is there to be found.
        single_precision: boxes and distances are rounded to single precision, as in the released code's tensors.
        unknown_velocity_is_zero: a true velocity that is not known counts as standing still; else it does not count.
        area: x and y from and to, metres, ends included: boxes beyond it do not exist; None for everywhere.
        area_of: what of a box must be in the area, its `center` or its whole `footprint`.
        ranges: the rings from and to (metres, the end excluded) that are counted apart. With matching `by_truth`, a box
            beyond the ring is there to be matched, a detection by truth of any class, and what it matches does not
            count; with `by_score` it is not there.
        range_from_x_alone: rings are of the distance sqrt(x² + x²), a bug: sqrt(x² + y²) is meant.
        measure: how near a detection is to the truth: distance of the centres of their lower faces, distance of
            centres on the ground, overlap of volumes or of footprints (intersection over union).
        bottom_taken_as_top: in the overlap of volumes, boxes reach from their lower face downwards.
        thresholds: the measure's thresholds that are counted apart: metres, or shares.
        small_thresholds: those of cyclists, motorcycles and pedestrians; None for the same.
        threshold_included: what is exactly at the threshold matches.
        matching: `by_truth`: each true box in the label's order takes the nearest detection (and, to choose the points
            of the curve, the one with the highest score, of equal ones the first); `by_score`: each detection in the
            order of scores takes the nearest true box. Equal scores are then in the order of the samples' tokens, and
            in a sample in that of what is in the boxes, so that the order of the boxes does not count.
        curve: how precision and recall become an average precision: `released`: the mean precision at the scores at
            which recall first exceeds multiples of 1/points (0 where it never does, no envelope); `nuscenes`:
            interpolated at `points` levels of recall from 0 to 1; `voc`: the area under the envelope.
        points: how many points a curve has.
        min_recall: the share of the points that does not count; not for `voc`.
        min_precision: precision below it is 0, and above it spread to [0, 1]; for `nuscenes` alone.
        global_sort: the order of scores is that of all samples together; else of each sample, one after another by
            their tokens (OpenCOOD's default). Only for `voc`.
        error_threshold: which threshold's matches the errors are of; None for no errors.
        error_of_bottoms: the position error is that of the lower faces' centres in 3D; else on the ground.
        scale_by_overlap: the scale error is 1 − overlap of volumes as the boxes stand; else as if centre and
            heading were equal.
        orientation_unwrapped: the heading error is |a mod 6.2831852 − b mod 6.2831852|, up to a full turn; else the
            smaller angle between the two.
        absent_class_is_zero: a class that is nowhere in the truth has average precision 0 and errors 1; else it is left
            out of the means.
    """

    classes: tuple[tuple[str, tuple[str, ...]], ...] = tuple((name, (name,)) for name in CATEGORIES)
    frame: str = "lidar"
    truth: TruthSource
    label_velocity: bool = False
    own_box: bool
    single_precision: bool = False
    unknown_velocity_is_zero: bool = False
    area: tuple[float, float, float, float] | None = None
    area_of: Literal["center", "footprint"] = "center"
    ranges: tuple[tuple[float, float], ...] = ((0.0, math.inf),)
    range_from_x_alone: bool = False
    measure: Measure
    bottom_taken_as_top: bool = False
    thresholds: tuple[float, ...]
    small_thresholds: tuple[float, ...] | None = None
    threshold_included: bool = False
    matching: Matching
    curve: Curve
    points: int = 101
    min_recall: float = 0.0
    min_precision: float = 0.0
    global_sort: bool = True
    error_threshold: float | None = None
    error_of_bottoms: bool = False
    scale_by_overlap: bool = False
    orientation_unwrapped: bool = False
    absent_class_is_zero: bool = False

    def __post_init__(self) -> None:
        """Check the choices; raises ChoiceError for an unknown word and ConfigError for impossible values."""
        for name in ("classes", "area", "ranges", "thresholds", "small_thresholds"):
            object.__setattr__(self, name, as_tuples(getattr(self, name)))
        settle_choices(self, _CHOICES)
        _check_classes(self.classes)
        if self.frame not in ("lidar", "ego"):
            raise ConfigError(
                f"frame: expected 'lidar' or 'ego', found {self.frame!r}: ranges are around the agent"
            )
        if not self.thresholds or not self.ranges:
            raise ConfigError("thresholds and ranges: expected at least one of each")
        if self.small_thresholds is not None and len(self.small_thresholds) != len(self.thresholds):
            raise ConfigError(
                f"small_thresholds: expected as many as thresholds, found {self.small_thresholds}"
            )
        if not (self.points > 1 and 0 <= self.min_recall < 1 and 0 <= self.min_precision < 1):
            raise ConfigError(
                "points, min_recall, min_precision: expected at least 2, and shares from 0 and below 1"
            )
        curves = len(self.classes) * len(self.ranges) * len(self.thresholds)
        if curves * self.points > _MOST_POINTS:
            raise ConfigError(
                f"points: {self.points} for each class, range and threshold ({curves}) are more than {_MOST_POINTS:,} "
                "together; choose fewer"
            )
        if not self.global_sort and self.curve != "voc":
            raise ConfigError(
                f"global_sort: the curve {self.curve!r} is by the order of all scores; choose curve='voc'"
            )
        if self.error_threshold is not None and (
            self.error_threshold not in self.thresholds
            or len(self.ranges) > 1
            or self.curve == "voc"
        ):
            raise ConfigError(
                f"error_threshold: {self.error_threshold} needs to be one of the thresholds {self.thresholds}, a "
                "single range, and another curve than voc; choose None for no errors"
            )

    def limits(self, name: str) -> tuple[float, ...]:
        """The thresholds of a class by its name."""
        small = self.small_thresholds is not None and name in SMALL_CATEGORIES
        return (
            self.small_thresholds
            if small and self.small_thresholds is not None
            else self.thresholds
        )

    def as_dict(self) -> dict[str, Any]:
        """All choices, as JSON holds them."""
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
"""By name: the released code (`distance_mAP`, and its other mode, `iou_mAP`), the paper, and what V2X papers print."""


def detection_protocol(protocol: str | DetectionProtocol, **switches: Any) -> DetectionProtocol:
    """A protocol by its name, or as it is given, with some choices changed.

    Raises:
        ChoiceError: no such protocol or choice.
        ConfigError: choices that cannot be.
    """
    return switched(protocol_of(protocol, DETECTION_PROTOCOLS), switches)


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
        return BoxColumns(
            **{name: getattr(self, name)[which] for name in self.__dataclass_fields__}
        )

    @property
    def surest_first(self) -> IntArray:
        """(N,) rows by falling score, equal ones by what is in the boxes: the same boxes in any order of the rows."""
        return np.lexsort(
            np.column_stack(
                [
                    -self.score,
                    self.category,
                    self.center,
                    self.size,
                    self.yaw,
                    self.velocity,
                    self.own,
                ]
            ).T[::-1]
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
        raise NotAvailableError(
            f"{record['token']}: has no label, so that nothing can be evaluated"
        )
    if rules.truth == "cooperative":
        boxes = cooperative_boxes(dataset, sample, agents=agents, frame=rules.frame)
        own_actor = dataset.get("agent", record["agent_token"])["actor_id"]
        own = boxes.actor_id == (
            OWN_ACTOR_ID if own_actor is None or own_actor == UNTRACKED_ID else own_actor
        )
    elif agents is not None:
        raise ConfigError(
            f"agents: the truth of this protocol is {rules.truth!r}; choose truth='cooperative', or None"
        )
    else:
        boxes = dataset.boxes(sample, rules.frame, "released" if rules.truth == "visible" else None)
        own = boxes.actor_id == OWN_ACTOR_ID
    if rules.label_velocity:
        boxes = _with_label_velocity(dataset, sample, boxes, rules)
    return boxes.select(rules.own_box | ~own)


def _with_label_velocity(
    dataset: Dataset, sample: RowArgument, boxes: Boxes, rules: DetectionProtocol
) -> Boxes:
    """The boxes with the velocities that stand in the label, which the released code takes to be in LiDAR axes."""
    if rules.frame != "lidar" or rules.truth == "cooperative":
        raise ConfigError(
            "label_velocity: the label's velocities are those of one agent's LiDAR frame; choose False"
        )
    written = dataset.columns("annotation")["velocity_label"][dataset.annotation_rows(sample)][
        boxes.row
    ]
    return replace(boxes, velocity=np.column_stack([written, np.zeros(len(written))]))
