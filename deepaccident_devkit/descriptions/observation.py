"""Which agent observes which actor at which frame, by a declared rule, and when sets of agents first observe two.

All is from the labels alone. An ego and n partners observe two colliders. A coalition is the ego with some of the
partners: of coalition number k, partner i is one if bit i of k is set, so that number 0 is the ego alone and the last
one is all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import factorial
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ConfigError, GeometryError
from deepaccident_devkit.support.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    as_numbers,
    checked_whole,
)
from deepaccident_devkit.support.text import settle_choices
from deepaccident_devkit.tables import visible_mask
from deepaccident_devkit.taxonomy import AGENTS, FRAME_PERIOD, INFRASTRUCTURE, AgentName

_PAIR = 2
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
    dataset: Dataset,
    scenario: RowArgument,
    actor_ids: Sequence[int],
    rule: ObservationRule | None = None,
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
    seen = by_rule(dataset, boxes, which, codes[at] == AGENTS.index(INFRASTRUCTURE), rule)
    frame = (
        samples["frame_row"][of_scenario] - dataset.columns("scenario")["first_frame_row"][row]
    )[at]
    observed[there.searchsorted(codes[at[seen]]), position[seen], frame[seen]] = True
    observed[_themselves(dataset, row, there, actor_ids)] = True
    return tuple(AGENTS[code] for code in there.tolist()), observed


def coalition_members(partners: int) -> BoolArray:
    """Which partners are in each coalition: (2^n, n)."""
    return np.asarray((np.arange(1 << partners)[:, None] >> np.arange(partners) & 1).astype(bool))


def first_together(observed: ArrayLike) -> IntArray:
    """(…, 2^n) position of the first frame at which the union over a coalition observes both; −1 for never.

    `observed` (…, 1 + n, 2, F) says whether the ego, the first, and each partner observe each collider at each
    frame. Recordings of several lengths can be one array if they end together, with False before their beginnings.
    Raises GeometryError.
    """
    seen = as_numbers("observed", observed, "truth values (…, agents, 2, frames)", np.bool_)
    if seen.ndim < 3 or seen.shape[-2] != _PAIR or not seen.shape[-3]:
        raise GeometryError(f"observed: expected shape (…, agents, 2, frames), found {seen.shape}")
    coalitions = coalition_members(seen.shape[-3] - 1)
    both = np.zeros((*seen.shape[:-3], len(coalitions), seen.shape[-1]), dtype=bool)
    for number, members in enumerate(coalitions):
        union = np.asarray(seen[..., np.concatenate([[True], members]), :, :].any(axis=-3))
        both[..., number, :] = union[..., 0, :] & union[..., 1, :]
    return np.where(both.any(axis=-1), both.argmax(axis=-1) if both.shape[-1] else 0, -1)


def coalition_leads(observed: ArrayLike) -> FloatArray:
    """Seconds from the first frame at which a coalition observes both colliders to the last frame, the impact.

    Args:
        observed: (…, 1 + n, 2, F) bool, as of `first_together`.

    Returns:
        (…, 2^n) seconds; 0 for a coalition that never does.

    Raises:
        GeometryError: `observed` has another shape.
    """
    return leads_from(first_together(observed), np.shape(observed)[-1])


def leads_from(first: IntArray, frames: int) -> FloatArray:
    """Seconds from the frames that `first_together` gives (…) to the last one of so many; 0 where it gives −1."""
    return np.asarray(np.where(first < 0, 0, frames - 1 - first) * FRAME_PERIOD)


def shapley_values(leads: ArrayLike) -> FloatArray:
    """Each partner's exact Shapley value of the gain in lead time over the ego alone.

    That is how much a partner adds to those who joined before it, as a mean over all orders of joining. The values
    add up to the gain of all partners together.

    Args:
        leads: (…, 2^n) of each coalition, as `coalition_leads` gives them.

    Returns:
        (…, n) in the unit of `leads`.

    Raises:
        GeometryError: the number of coalitions is no power of two.
    """
    values = as_numbers("leads", leads)
    count = values.shape[-1] if values.ndim else 0
    partners = count.bit_length() - 1
    if count != 1 << max(partners, 0):
        raise GeometryError(
            f"leads: expected one for each of 2^n coalitions, found shape {values.shape}"
        )
    members = coalition_members(partners)
    sizes = members.sum(axis=1)
    weights = np.array(
        [
            factorial(size) * factorial(partners - size - 1) / factorial(partners)
            for size in range(partners)
        ]
    )
    result = np.zeros((*values.shape[:-1], partners))
    for partner in range(partners):
        without = np.flatnonzero(~members[:, partner])
        gains = values[..., without + (1 << partner)] - values[..., without]
        result[..., partner] = gains @ weights[sizes[without]]
    return result


def _rows_of(keys: IntArray, first: int, end: int) -> slice:
    """Where an ascending column has values from `first` to before `end`."""
    ends = np.array([first, end], dtype=keys.dtype)  # of another type, all keys would be copied
    return slice(*np.searchsorted(keys, ends).tolist())


def _boxes_of(
    dataset: Dataset, boxes: slice, actor_ids: Sequence[int]
) -> tuple[IntArray, IntArray]:
    """Which of a scenario's annotations are of some actors, and each one's position among the actors."""
    instance = dataset.columns("annotation")["instance_row"][boxes]
    tracked = np.flatnonzero(instance >= 0)
    actor = dataset.columns("instance")["actor_id"][instance[tracked]]
    found, position = np.nonzero(actor[:, None] == np.asarray(actor_ids, dtype=np.int64))
    return tracked[found], position


def by_rule(
    dataset: Dataset, boxes: slice, which: IntArray, by_pole: BoolArray, rule: ObservationRule
) -> BoolArray:
    """Which of some of a scenario's annotations show an actor that their agent observes."""
    if rule.kind == "annotated":
        return np.ones(len(which), dtype=bool)
    columns = dataset.columns("annotation")
    points = columns["num_lidar_pts"][boxes][which]
    if rule.kind == "points":
        return np.asarray(points >= rule.least_points)
    xy, category, camera = (
        columns[name][boxes][which] for name in ("translation", "category", "camera_visible")
    )
    masks = [
        visible_mask(xy[:, :2], category, points, camera, infrastructure=pole)
        for pole in (False, True)
    ]
    return np.where(by_pole, masks[1], masks[0])


def _themselves(
    dataset: Dataset, scenario_row: int, agents: IntArray, actor_ids: Sequence[int]
) -> BoolArray:
    """(A, N) which of the actors each agent is; `agents` by their positions in `taxonomy.AGENTS`."""
    columns = dataset.columns("agent")
    rows = _rows_of(columns["scenario_row"], scenario_row, scenario_row + 1)
    own = dict(zip(columns["name"][rows].tolist(), columns["actor_id"][rows].tolist(), strict=True))
    ids = np.array([own[code] for code in agents.tolist()], dtype=np.int64)
    return np.asarray(ids[:, None] == np.asarray(actor_ids, dtype=np.int64))
