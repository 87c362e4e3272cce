"""Rules that all tracking protocols share, and the true boxes of a sample under them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ConfigError, NotAvailableError
from deepaccident_devkit.evaluation.predicted_boxes import check_classes
from deepaccident_devkit.evaluation.task import as_tuples
from deepaccident_devkit.geometry import SE3, Boxes
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, ShortRepr, check_minima
from deepaccident_devkit.support.text import settle_choices
from deepaccident_devkit.taxonomy import CATEGORIES, OWN_ACTOR_ID, UNTRACKED_ID
from deepaccident_devkit.v2x.cooperation import visible_actors

TrackedActors = Literal["visible", "own", "label"]
Shape = Literal["square", "circle"]
SIX_CLASSES = tuple((name, (name,)) for name in CATEGORIES)
# Truth → words for people.
_TRUTH_WORDS = {
    "visible": "actors that any agent sees",
    "own": "actors that the agent itself sees",
    "label": "actors of the agent's label with a LiDAR point",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackingRules:
    """Rules that decide which boxes count, and which pairs are near enough to match.

    The agent's own box and untracked boxes never count.

    Attributes:
        truth: Which boxes of the agent's label are true. `visible`: boxes that any of the five
            agents sees by the released rule; `own`: boxes that the agent itself sees by this rule;
            `label`: boxes with at least one LiDAR point of the agent.
        classes: Classes that are tracked separately: the name and the categories of each class.
        class_of_instance: Whether a true box has the category of its instance; otherwise it has
            that of the label at the moment.
        frame: Frame around which the range lies, `lidar` or `ego`.
        shape: Shape of the range: `square` for |x| and |y| of at most the range in the frame,
            `circle` for a distance in the world's x and y below it.
        ranges: Range of each class, metres; centres of true and tracked boxes beyond it do not
            count. A single number is for all classes.
        distance: Distance between centres on the ground at which two boxes are no longer near,
            metres.
    """

    truth: TrackedActors = "visible"
    classes: tuple[tuple[str, tuple[str, ...]], ...] = SIX_CLASSES
    class_of_instance: bool = False
    frame: Literal["lidar", "ego"] = "lidar"
    shape: Shape = "square"
    ranges: tuple[float, ...] = (51.2,)
    distance: float = 2.0

    def __post_init__(self) -> None:
        """Check the fields.

        Raises:
            ChoiceError: If a choice does not exist.
            ConfigError: If a number is invalid.
        """
        object.__setattr__(self, "classes", as_tuples(self.classes))
        object.__setattr__(self, "ranges", as_tuples(self.ranges))
        choices = {"truth": TrackedActors, "frame": Literal["lidar", "ego"], "shape": Shape}
        settle_choices(self, {name: get_args(words) for name, words in choices.items()})
        check_classes(self.classes)
        if len(self.ranges) not in (1, len(self.classes)) or not min(self.ranges) > 0:
            raise ConfigError(
                f"ranges: expected a positive number, or one for each of {len(self.classes)} "
                f"classes, found {self.ranges}"
            )
        check_minima(self, distance=0)

    def class_index(self, category: AnyArray) -> AnyArray:
        """Return the index of the class of each category (N,), shape (N,); −1 for none."""
        index_by_category = np.full(len(CATEGORIES), -1)
        for index, (_, categories) in enumerate(self.classes):
            for name in categories:
                index_by_category[CATEGORIES.index(name)] = index
        return index_by_category[category]

    def counts(self, boxes: Boxes, truth: TrackingTruth) -> BoolArray:
        """Return which boxes in the world have a class and are in range of the agent, (N,)."""
        classes = self.class_index(boxes.category)
        limits = np.broadcast_to(self.ranges, len(self.classes))[classes]
        pose = truth.world_from_agent
        if self.shape == "square":
            in_frame = np.abs(pose.inverse().apply(boxes.center))
            is_near = in_frame[:, :2].max(axis=1, initial=0) <= limits
        else:
            x, y, _ = (boxes.center - pose.translation).T
            is_near = np.hypot(x, y) < limits
        return np.asarray(is_near & (classes >= 0))

    def words(self) -> str:
        """Describe classes, truth, range and distance for people, to be read with the numbers."""
        shapes = {"square": "±{} m along x and y", "circle": "{} m around the agent"}
        limits = "/".join(f"{limit:g}" for limit in dict.fromkeys(self.ranges))
        names = ", ".join(name for name, _ in self.classes)
        return (
            f"classes {names}; truth: {_TRUTH_WORDS[self.truth]}; "
            f"range: {shapes[self.shape].format(limits)}"
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackingTruth(ShortRepr):
    """What the tracks of a sample are compared with.

    Attributes:
        boxes: True boxes in the world, each with its own `actor_id`.
        world_from_agent: Pose of the frame around which the range lies.
    """

    boxes: Boxes
    world_from_agent: SE3 = field(default_factory=SE3.identity)


def tracking_truth(dataset: Dataset, sample: RowArgument, rules: TrackingRules) -> TrackingTruth:
    """Return the boxes that a tracker should have at a sample.

    The range is not applied here: `TrackingEvaluator.update` applies it to truth and tracks.

    Args:
        dataset: Release with the sample.
        sample: Token or record of the sample.
        rules: Protocol of the evaluation.

    Raises:
        TokenError: If the release does not have the sample.
        NotAvailableError: If the sample has no label (the test split has none).
    """
    record = dataset.get("sample", sample)
    token = record["token"]
    if not record["labelled"]:
        raise NotAvailableError(f"{token}: has no label, so it cannot be evaluated")
    boxes = dataset.boxes(token, "world", "released" if rules.truth == "visible" else None)
    is_true = (boxes.actor_id != OWN_ACTOR_ID) & (boxes.actor_id != UNTRACKED_ID)
    if rules.truth == "own":
        seen_ids = visible_actors(dataset, token, agents="single")
        is_true &= np.isin(boxes.actor_id, seen_ids)
    elif rules.truth == "label":
        is_true &= boxes.num_lidar_pts > 0
    rows = np.flatnonzero(is_true)
    _, first = np.unique(boxes.actor_id[rows], return_index=True)  # a label may repeat an actor
    boxes = boxes.select(rows[first])
    if rules.class_of_instance:
        label_rows = dataset.annotation_rows(token)
        instance_row = dataset.columns("annotation")["instance_row"][label_rows][boxes.row]
        boxes = replace(boxes, category=dataset.columns("instance")["category"][instance_row])
    return TrackingTruth(boxes=boxes, world_from_agent=dataset.world_from(token, rules.frame))
