"""The baselines' predictions of one sample, for each task."""

from __future__ import annotations

import math

import numpy as np

from deepaccident_devkit.baselines.collisions import DANGER_DISTANCE, accidents_ahead
from deepaccident_devkit.baselines.drawing import label_times, motion_of
from deepaccident_devkit.baselines.motion_models import MotionModel
from deepaccident_devkit.baselines.oracle import SeenActors, seen_actors
from deepaccident_devkit.baselines.outlook import outlook
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.evaluation import Accident, DetectedBoxes, MotionOutput
from deepaccident_devkit.motion import MotionLabelConfig
from deepaccident_devkit.taxonomy import AGENTS, LIDAR, OWN_ACTOR_ID
from deepaccident_devkit.v2x import Agents, Link

_ENOUGH_POINTS = 10.0
"""LiDAR points that add to a score half of what any number of them can add."""


def predict_motion(
    dataset: Dataset,
    sample: RowArgument,
    *,
    agents: Agents = "single",
    model: MotionModel = "constant_velocity",
    link: Link | None = None,
    config: MotionLabelConfig | None = None,
) -> MotionOutput:
    """The instance maps that some agents expect, one prediction, rasterised as the labels that `config` describes.

    Args:
        dataset: the release.
        sample: token or record: its agent is the ego, its frame the present.
        agents: who cooperates, as of `v2x.cooperating_agents`.
        model: how actors go on.
        link: what happens to the partners' data; None for nothing.
        config: of the labels; None for the released ones. Its `agents` and `filter_invisible` have no effect.

    Raises:
        DeepAccidentError: as of `oracle.seen_actors`; no such model.
    """
    chosen = config or MotionLabelConfig()
    ahead = outlook(dataset, sample, agents=agents, model=model, link=link)
    return motion_of(ahead.seen, ahead.poses(label_times(chosen)), dataset.ego_from(sample, LIDAR), chosen)


def predict_accidents(
    dataset: Dataset,
    sample: RowArgument,
    *,
    agents: Agents = "single",
    model: MotionModel = "constant_velocity",
    link: Link | None = None,
    horizon: float = 2.0,
    danger_distance: float = DANGER_DISTANCE,
) -> list[Accident]:
    """The accidents that some agents expect, the surest first; `collisions.accidents_ahead` says how.

    Args:
        dataset: the release.
        sample: as of `predict_motion`, and so are `agents`, `model` and `link`.
        agents: who cooperates.
        model: how actors go on.
        link: what happens to the partners' data.
        horizon: seconds to look ahead.
        danger_distance: metres; whose boxes come nearer to each other collide.

    Raises:
        ConfigError: an impossible horizon or distance.
        DeepAccidentError: as of `predict_motion`.
    """
    for name, value in (("horizon", horizon), ("danger_distance", danger_distance)):
        if not 0 < value < math.inf:
            raise ConfigError(f"{name}: expected a number above 0, found {value!r}")
    ahead = outlook(dataset, sample, agents=agents, model=model, link=link)
    return accidents_ahead(ahead, horizon, danger_distance)


def predict_detections(
    dataset: Dataset, sample: RowArgument, *, agents: Agents = "single", link: Link | None = None
) -> DetectedBoxes:
    """The boxes that some agents see, in world, and the ego's own.

    The score is (agents that see it + p / (p + 10)) / 6 with p the LiDAR points that they have on it: in (0, 1), and 0
    for the ego itself, which no detector sees and only the released protocol counts.

    Args:
        dataset: the release.
        sample: as of `predict_motion`, and so are `agents` and `link`.
        agents: who cooperates.
        link: what happens to the partners' data.

    Raises:
        DeepAccidentError: as of `oracle.seen_actors`.
    """
    return detections_of(seen_actors(dataset, sample, agents=agents, link=link, frame="world"))


def detections_of(seen: SeenActors) -> DetectedBoxes:
    """The detections of `predict_detections`, in the frame in which actors are seen."""
    watchers = np.unpackbits(seen.seen_by[:, None], axis=1).sum(axis=1)
    points = seen.boxes.num_lidar_pts
    scores = (watchers + points / (points + _ENOUGH_POINTS)) / (len(AGENTS) + 1)
    return DetectedBoxes(boxes=seen.boxes, scores=np.where(seen.boxes.actor_id == OWN_ACTOR_ID, 0.0, scores))
