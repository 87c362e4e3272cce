"""Which agent observes which actor at which frame, by a declared rule, from the labels alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.support.arrays import BoolArray, IntArray, checked_whole
from deepaccident_devkit.support.text import settle_choices
from deepaccident_devkit.tables import visible_mask
from deepaccident_devkit.taxonomy import AGENTS, INFRASTRUCTURE, AgentName

ObservationKind = Literal["points", "released", "annotated"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ObservationRule:
    """When an agent counts as observing an actor. Checked when made; raises ChoiceError or ConfigError.

    An agent observes itself at each frame. What it does not annotate it does not observe, whatever the rule.

    Attributes:
        kind: `points`: the agent's label counts enough LiDAR points in the actor's box. `released`: the released
            visibility rule, by points, cameras and distance (docs/released_code.md). `annotated`: the label has the
            actor; the real labels have all that is near, hidden or not, so that this says little there.
        least_points: LiDAR points that are enough for `points`.
    """

    kind: ObservationKind = "points"
    least_points: int = 5

    def __post_init__(self) -> None:
        """Check the values."""
        settle_choices(self, {"kind": get_args(ObservationKind)})
        number = checked_whole("least_points", self.least_points, error=ConfigError)
        if number < 1:
            raise ConfigError(f"least_points: expected a whole number from 1, found {number}")
        object.__setattr__(self, "least_points", number)

    @property
    def text(self) -> str:
        """The rule in words, such as `at least 5 LiDAR points`."""
        return f"at least {self.least_points} LiDAR points" if self.kind == "points" else self.kind


def observed_actors(
    dataset: Dataset, scenario: RowArgument, actor_ids: Sequence[int], rule: ObservationRule | None = None
) -> tuple[tuple[AgentName, ...], BoolArray]:
    """Whether each agent observes some actors at each frame of a scenario.

    Args:
        dataset: the release.
        scenario: token or record.
        actor_ids: CARLA ids of N actors.
        rule: when an actor counts as observed; None for `ObservationRule()`.

    Returns:
        The A agents that have labels, in the order of `taxonomy.AGENTS`; and (A, N, F) bool, from the first frame on.

    Raises:
        TokenError: no such scenario.
    """
    rule = rule or ObservationRule()
    row = dataset.getind("scenario", scenario)
    samples, annotations = dataset.columns("sample"), dataset.columns("annotation")
    of_scenario = _rows_of(samples["scenario_row"], row, row + 1)
    frames = dataset.columns("scenario")["num_frames"].item(row)
    codes = samples["agent"][of_scenario]
    there = np.unique(codes[samples["labelled"][of_scenario]])
    observed = np.zeros((len(there), len(actor_ids), frames), dtype=bool)
    boxes = _rows_of(annotations["sample_row"], of_scenario.start, of_scenario.stop)
    which, position = _boxes_of(dataset, boxes, actor_ids)
    at = annotations["sample_row"][boxes][which] - of_scenario.start
    seen = _seen(dataset, boxes, which, codes[at] == AGENTS.index(INFRASTRUCTURE), rule)
    frame = (samples["frame_row"][of_scenario] - dataset.columns("scenario")["first_frame_row"][row])[at]
    observed[there.searchsorted(codes[at[seen]]), position[seen], frame[seen]] = True
    observed[_themselves(dataset, row, there, actor_ids)] = True
    return tuple(AGENTS[code] for code in there.tolist()), observed


def _rows_of(keys: IntArray, first: int, end: int) -> slice:
    """Where an ascending column has values from `first` to before `end`."""
    ends = np.array([first, end], dtype=keys.dtype)  # of another type, all keys would be copied
    return slice(*np.searchsorted(keys, ends).tolist())


def _boxes_of(dataset: Dataset, boxes: slice, actor_ids: Sequence[int]) -> tuple[IntArray, IntArray]:
    """Which of a scenario's annotations are of some actors, and each one's position among the actors."""
    instance = dataset.columns("annotation")["instance_row"][boxes]
    tracked = np.flatnonzero(instance >= 0)
    actor = dataset.columns("instance")["actor_id"][instance[tracked]]
    found, position = np.nonzero(actor[:, None] == np.asarray(actor_ids, dtype=np.int64))
    return tracked[found], position


def _seen(dataset: Dataset, boxes: slice, which: IntArray, by_pole: BoolArray, rule: ObservationRule) -> BoolArray:
    """Which of some of a scenario's annotations show an actor that their agent observes."""
    if rule.kind == "annotated":
        return np.ones(len(which), dtype=bool)
    columns = dataset.columns("annotation")
    points = columns["num_lidar_pts"][boxes][which]
    if rule.kind == "points":
        return np.asarray(points >= rule.least_points)
    xy, category, camera = (columns[name][boxes][which] for name in ("translation", "category", "camera_visible"))
    masks = [visible_mask(xy[:, :2], category, points, camera, infrastructure=pole) for pole in (False, True)]
    return np.where(by_pole, masks[1], masks[0])


def _themselves(dataset: Dataset, scenario_row: int, agents: IntArray, actor_ids: Sequence[int]) -> BoolArray:
    """(A, N) which of the actors each agent is; `agents` by their positions in `taxonomy.AGENTS`."""
    columns = dataset.columns("agent")
    rows = _rows_of(columns["scenario_row"], scenario_row, scenario_row + 1)
    own = dict(zip(columns["name"][rows].tolist(), columns["actor_id"][rows].tolist(), strict=True))
    ids = np.array([own[code] for code in agents.tolist()], dtype=np.int64)
    return np.asarray(ids[:, None] == np.asarray(actor_ids, dtype=np.int64))
