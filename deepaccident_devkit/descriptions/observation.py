"""Which agent observes which actor at which frame, and when coalitions first observe a pair.

Everything is computed from labels only, by a declared rule. An ego and n partners observe two
colliders. A coalition is the ego with some of the partners. Partner i belongs to coalition number k
if bit i of k is set, so number 0 is the ego only and the last number is all of them.
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

_PAIR_SIZE = 2
ObservationKind = Literal["points", "released", "annotated"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ObservationRule:
    """A rule by which an agent observes an actor; raises ChoiceError or ConfigError when made.

    An agent observes itself at each frame. It does not observe what it does not annotate, whatever
    the rule.

    Attributes:
        kind: `points`: the agent's label counts enough LiDAR points in the actor's box. `released`:
            the released visibility rule, by points, cameras and distance (docs/released_code.md).
            `annotated`: the label has the actor; the real labels have everything nearby, hidden or
            not, so this rule separates little there.
        least_points: Number of LiDAR points that is enough for `points`.
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
        if self.kind == "points":
            return f"at least {self.least_points} LiDAR points"
        return self.kind


def observed_actors(
    dataset: Dataset,
    scenario: RowArgument,
    actor_ids: Sequence[int],
    rule: ObservationRule | None = None,
) -> tuple[tuple[AgentName, ...], BoolArray]:
    """Return whether each agent observes some actors at each frame of a scenario.

    Args:
        dataset: The release.
        scenario: Token or record.
        actor_ids: CARLA ids of N actors.
        rule: Rule by which an actor counts as observed; None for `ObservationRule()`.

    Returns:
        The A agents that have labels, in the order of `taxonomy.AGENTS`; and (A, N, F) bool, from
        the first frame on.

    Raises:
        TokenError: No such scenario.
    """
    rule = rule or ObservationRule()
    row = dataset.getind("scenario", scenario)
    samples, annotations = dataset.columns("sample"), dataset.columns("annotation")
    sample_rows = _rows_of(samples["scenario_row"], row, row + 1)
    frames = dataset.columns("scenario")["num_frames"].item(row)
    codes = samples["agent"][sample_rows]
    agents = np.unique(codes[samples["labelled"][sample_rows]])
    observed = np.zeros((len(agents), len(actor_ids), frames), dtype=bool)
    boxes = _rows_of(annotations["sample_row"], sample_rows.start, sample_rows.stop)
    indices, position = _boxes_of(dataset, boxes, actor_ids)
    sample = annotations["sample_row"][boxes][indices] - sample_rows.start
    by_pole = codes[sample] == AGENTS.index(INFRASTRUCTURE)
    seen = by_rule(dataset, boxes, indices, by_pole, rule)
    first_frame_row = dataset.columns("scenario")["first_frame_row"][row]
    frame = (samples["frame_row"][sample_rows] - first_frame_row)[sample]
    agent = agents.searchsorted(codes[sample[seen]])
    observed[agent, position[seen], frame[seen]] = True
    observed[_themselves(dataset, row, agents, actor_ids)] = True
    return tuple(AGENTS[code] for code in agents.tolist()), observed


def coalition_members(partners: int) -> BoolArray:
    """Return which partners are in each coalition, shape (2^n, n)."""
    coalitions = np.arange(1 << partners)[:, None]
    members = coalitions >> np.arange(partners) & 1
    return np.asarray(members.astype(bool))


def first_together(observed: ArrayLike) -> IntArray:
    """Return the first frame at which the union over a coalition observes both colliders.

    Recordings of several lengths can be one array if they end together, with False before their
    beginnings.

    Args:
        observed: Whether the ego (the first) and each partner observe each collider at each frame,
            shape (…, 1 + n, 2, F).

    Returns:
        Positions of frames, shape (…, 2^n); −1 for never.

    Raises:
        GeometryError: `observed` has another shape.
    """
    seen = as_numbers("observed", observed, "truth values (…, agents, 2, frames)", np.bool_)
    if seen.ndim < 3 or seen.shape[-2] != _PAIR_SIZE or not seen.shape[-3]:
        raise GeometryError(f"observed: expected shape (…, agents, 2, frames), found {seen.shape}")
    coalitions = coalition_members(seen.shape[-3] - 1)
    both = np.zeros((*seen.shape[:-3], len(coalitions), seen.shape[-1]), dtype=bool)
    for number, partners in enumerate(coalitions):
        members = np.concatenate([[True], partners])
        union = np.asarray(seen[..., members, :, :].any(axis=-3))
        both[..., number, :] = union[..., 0, :] & union[..., 1, :]
    first_frames = both.argmax(axis=-1) if both.shape[-1] else 0
    return np.where(both.any(axis=-1), first_frames, -1)


def coalition_leads(observed: ArrayLike) -> FloatArray:
    """Return seconds from a coalition's first observation of both colliders to the impact.

    The impact is at the last frame.

    Args:
        observed: Observations, (…, 1 + n, 2, F) bool, as for `first_together`.

    Returns:
        (…, 2^n) seconds; 0 for a coalition that never observes both.

    Raises:
        GeometryError: `observed` has another shape.
    """
    return leads_from(first_together(observed), np.shape(observed)[-1])


def leads_from(positions: IntArray, frames: int) -> FloatArray:
    """Return seconds from the frames of `first_together` (…) to the last frame; 0 for −1."""
    remaining = frames - 1 - positions
    steps = np.where(positions < 0, 0, remaining)
    return np.asarray(steps * FRAME_PERIOD)


def shapley_values(leads: ArrayLike) -> FloatArray:
    """Return each partner's exact Shapley value of the gain in lead time over the ego only.

    The value is how much a partner adds to the partners that joined before it, as a mean over all
    orders of joining. The values add up to the gain of all partners together.

    Args:
        leads: Lead times of the coalitions, shape (…, 2^n), as `coalition_leads` gives them.

    Returns:
        (…, n) in the unit of `leads`.

    Raises:
        GeometryError: The number of coalitions is no power of two.
    """
    values = as_numbers("leads", leads)
    count = 0
    if values.ndim:
        count = values.shape[-1]
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
        coalitions = np.flatnonzero(~members[:, partner])
        gains = values[..., coalitions + (1 << partner)] - values[..., coalitions]
        result[..., partner] = gains @ weights[sizes[coalitions]]
    return result


def _rows_of(keys: IntArray, start: int, stop: int) -> slice:
    """Return where an ascending column has values from `start` to before `stop`."""
    ends = np.array([start, stop], dtype=keys.dtype)  # with another dtype, all keys would be copied
    return slice(*np.searchsorted(keys, ends).tolist())


def _boxes_of(
    dataset: Dataset, boxes: slice, actor_ids: Sequence[int]
) -> tuple[IntArray, IntArray]:
    """Return which of a scenario's annotations are of some actors, and each one's actor.

    An actor is its position in `actor_ids`.
    """
    instance = dataset.columns("annotation")["instance_row"][boxes]
    tracked = np.flatnonzero(instance >= 0)
    actor = dataset.columns("instance")["actor_id"][instance[tracked]]
    matches, position = np.nonzero(actor[:, None] == np.asarray(actor_ids, dtype=np.int64))
    return tracked[matches], position


def by_rule(
    dataset: Dataset, boxes: slice, indices: IntArray, by_pole: BoolArray, rule: ObservationRule
) -> BoolArray:
    """Return which of a scenario's annotations show an actor that their agent observes.

    Args:
        dataset: The release.
        boxes: Rows of the scenario's annotations.
        indices: Annotations among these rows, shape (N,).
        by_pole: Whether the infrastructure made the annotation, shape (N,).
        rule: Rule by which an actor counts as observed.
    """
    if rule.kind == "annotated":
        return np.ones(len(indices), dtype=bool)
    columns = dataset.columns("annotation")
    points = columns["num_lidar_pts"][boxes][indices]
    if rule.kind == "points":
        return np.asarray(points >= rule.least_points)
    xy = columns["translation"][boxes][indices][:, :2]
    category = columns["category"][boxes][indices]
    camera = columns["camera_visible"][boxes][indices]
    vehicle_mask = visible_mask(xy, category, points, camera, infrastructure=False)
    pole_mask = visible_mask(xy, category, points, camera, infrastructure=True)
    return np.where(by_pole, pole_mask, vehicle_mask)


def _themselves(
    dataset: Dataset, scenario_row: int, agents: IntArray, actor_ids: Sequence[int]
) -> BoolArray:
    """Return which of the actors each agent is, shape (A, N).

    Agents are positions in `taxonomy.AGENTS`.
    """
    columns = dataset.columns("agent")
    rows = _rows_of(columns["scenario_row"], scenario_row, scenario_row + 1)
    own = dict(zip(columns["name"][rows].tolist(), columns["actor_id"][rows].tolist(), strict=True))
    ids = np.array([own[code] for code in agents.tolist()], dtype=np.int64)
    return np.asarray(ids[:, None] == np.asarray(actor_ids, dtype=np.int64))
