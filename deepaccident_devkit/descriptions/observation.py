"""Which actors each agent observes in each frame, and when coalitions first observe a pair.

Everything is computed from labels, by an explicit rule. There are an ego, n partners and two
colliders. A coalition is the ego with some of the partners. Partner i belongs to coalition k if bit
i of k is set; coalition 0 is thus the ego without partners, and the last one contains everyone.
"""

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
"""The kinds of rules; see `ObservationRule`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ObservationRule:
    """A rule that decides whether an agent observes an actor.

    An agent observes itself in every frame. Under every rule, it only observes actors that it
    annotates.

    Attributes:
        kind: `points`: the agent's label counts enough LiDAR points in the actor's box. `released`:
            the released code's visibility rule, by points, cameras and distance
            (docs/released_code.md). `annotated`: the label contains the actor; real labels contain
            everything nearby, hidden or not, so this rule hardly discriminates there.
        least_points: Number of LiDAR points that suffices for `points`.
    """

    kind: ObservationKind = "points"
    least_points: int = 5

    def __post_init__(self) -> None:
        """Raise a ChoiceError or ConfigError if a value is not allowed."""
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
    """Return which actors each agent observes in each frame of a scenario.

    Args:
        dataset: The release.
        scenario: Token or record of the scenario.
        actor_ids: CARLA ids of N actors.
        rule: Rule for when an actor counts as observed; None for `ObservationRule()`.

    Returns:
        The A agents with labels, in the order of `taxonomy.AGENTS`; and whether each observes each
        actor in each frame, shape (A, N, F), bool.

    Raises:
        TokenError: If the release has no such scenario.
    """
    if rule is None:
        rule = ObservationRule()
    row = dataset.getind("scenario", scenario)
    scenarios = dataset.columns("scenario")
    samples = dataset.columns("sample")
    annotations = dataset.columns("annotation")
    num_frames = scenarios["num_frames"].item(row)
    sample_rows = _find_rows(samples["scenario_row"], row, row + 1)
    agent_codes = samples["agent"][sample_rows]
    frames = samples["frame_row"][sample_rows] - scenarios["first_frame_row"][row]
    agents = np.unique(agent_codes[samples["labelled"][sample_rows]])
    boxes = _find_rows(annotations["sample_row"], sample_rows.start, sample_rows.stop)
    indices, positions = _find_boxes(dataset, boxes, actor_ids)
    sample = annotations["sample_row"][boxes][indices] - sample_rows.start
    by_pole = agent_codes[sample] == AGENTS.index(INFRASTRUCTURE)
    is_seen = by_rule(dataset, boxes, indices, by_pole, rule)
    seen_sample = sample[is_seen]
    agent = agents.searchsorted(agent_codes[seen_sample])
    observed = np.zeros((len(agents), len(actor_ids), num_frames), dtype=bool)
    observed[agent, positions[is_seen], frames[seen_sample]] = True
    observed[_match_own_actors(dataset, row, agents, actor_ids)] = True
    return tuple(AGENTS[code] for code in agents.tolist()), observed


def coalition_members(partners: int) -> BoolArray:
    """Return which partners belong to each coalition, shape (2^n, n)."""
    coalitions = np.arange(1 << partners)
    bits = coalitions[:, None] >> np.arange(partners) & 1
    return bits.astype(bool)


def first_together(observed: ArrayLike) -> IntArray:
    """Return the first frame in which the members of a coalition together observe both colliders.

    Recordings of different lengths can share an array if they are aligned at the end, with False
    before their starts.

    Args:
        observed: Whether the ego (index 0) and each partner observe each collider in each frame,
            shape (…, 1 + n, 2, F).

    Returns:
        Indices of frames, shape (…, 2^n); −1 for coalitions that never do.

    Raises:
        GeometryError: If `observed` has another shape.
    """
    seen = as_numbers("observed", observed, "truth values (…, agents, 2, frames)", np.bool_)
    if seen.ndim < 3 or seen.shape[-2] != _PAIR_SIZE or not seen.shape[-3]:
        raise GeometryError(f"observed: expected shape (…, agents, 2, frames), found {seen.shape}")
    *leading_shape, num_agents, _, num_frames = seen.shape
    coalitions = coalition_members(num_agents - 1)
    is_pair_seen = np.zeros((*leading_shape, len(coalitions), num_frames), dtype=bool)
    for number, partners in enumerate(coalitions):
        members = np.concatenate([[True], partners])
        seen_by_members = seen[..., members, :, :].any(axis=-3)
        is_pair_seen[..., number, :] = np.all(seen_by_members, axis=-2)
    first_frames = is_pair_seen.argmax(axis=-1) if num_frames else 0
    return np.where(is_pair_seen.any(axis=-1), first_frames, -1)


def coalition_leads(observed: ArrayLike) -> FloatArray:
    """Return the seconds from each coalition's first observation of both colliders to the impact.

    The impact is taken to be in the last frame.

    Args:
        observed: Observations as for `first_together`, shape (…, 1 + n, 2, F), bool.

    Returns:
        Times in seconds, shape (…, 2^n); 0 for coalitions that never observe both.

    Raises:
        GeometryError: If `observed` has another shape.
    """
    num_frames = np.shape(observed)[-1]
    return leads_from(first_together(observed), num_frames)


def leads_from(positions: IntArray, frames: int) -> FloatArray:
    """Convert the indices of `first_together` to seconds before the last frame; 0 for −1."""
    remaining = frames - 1 - positions
    steps = np.where(positions < 0, 0, remaining)
    return steps * FRAME_PERIOD


def shapley_values(leads: ArrayLike) -> FloatArray:
    """Return each partner's exact Shapley value of the lead time gained over the ego without any.

    It is the mean, over all orders of joining, of what a partner adds to those that joined before
    it. The values add up to the gain of all partners together.

    Args:
        leads: Lead times of the coalitions, as returned by `coalition_leads`, shape (…, 2^n).

    Returns:
        Values in the unit of `leads`, shape (…, n).

    Raises:
        GeometryError: If the number of coalitions is not a power of two.
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
    weights = np.zeros(partners)
    for size in range(partners):
        num_orders = factorial(size) * factorial(partners - size - 1)
        weights[size] = num_orders / factorial(partners)
    result = np.zeros((*values.shape[:-1], partners))
    for partner in range(partners):
        coalitions = np.flatnonzero(~members[:, partner])
        joined_coalitions = coalitions + (1 << partner)
        gains = values[..., joined_coalitions] - values[..., coalitions]
        result[..., partner] = gains @ weights[sizes[coalitions]]
    return result


def _find_rows(keys: IntArray, start: int, stop: int) -> slice:
    """Return the rows of an ascending column whose values are in [`start`, `stop`)."""
    bounds = np.array([start, stop], dtype=keys.dtype)  # another dtype would copy `keys`
    rows = np.searchsorted(keys, bounds).tolist()
    return slice(*rows)


def _find_boxes(
    dataset: Dataset, boxes: slice, actor_ids: Sequence[int]
) -> tuple[IntArray, IntArray]:
    """Find a scenario's annotations of some actors, and the actor that each shows.

    Annotations are indices into the rows `boxes`; actors are indices into `actor_ids`.
    """
    instances = dataset.columns("annotation")["instance_row"][boxes]
    tracked = np.flatnonzero(instances >= 0)
    ids = dataset.columns("instance")["actor_id"][instances[tracked]]
    wanted_ids = np.asarray(actor_ids, dtype=np.int64)
    matches, positions = np.nonzero(ids[:, None] == wanted_ids)
    return tracked[matches], positions


def by_rule(
    dataset: Dataset, boxes: slice, indices: IntArray, by_pole: BoolArray, rule: ObservationRule
) -> BoolArray:
    """Return which annotations of a scenario show an actor that the agent observes, shape (N,).

    Args:
        dataset: The release.
        boxes: Rows of the scenario's annotations in the table.
        indices: Annotations as indices into `boxes`, shape (N,).
        by_pole: Whether the infrastructure agent made the annotation, shape (N,).
        rule: Rule for when an actor counts as observed.
    """
    if rule.kind == "annotated":
        return np.ones(len(indices), dtype=bool)
    columns = dataset.columns("annotation")
    points = columns["num_lidar_pts"][boxes][indices]
    if rule.kind == "points":
        has_points: BoolArray = points >= rule.least_points
        return has_points
    xy = columns["translation"][boxes][indices][:, :2]
    category = columns["category"][boxes][indices]
    camera = columns["camera_visible"][boxes][indices]
    vehicle_mask = visible_mask(xy, category, points, camera, infrastructure=False)
    pole_mask = visible_mask(xy, category, points, camera, infrastructure=True)
    return np.where(by_pole, pole_mask, vehicle_mask)


def _match_own_actors(
    dataset: Dataset, scenario_row: int, agents: IntArray, actor_ids: Sequence[int]
) -> BoolArray:
    """Return which of the actors is the agent itself, shape (A, N).

    Agents are indices into `taxonomy.AGENTS`.
    """
    columns = dataset.columns("agent")
    rows = _find_rows(columns["scenario_row"], scenario_row, scenario_row + 1)
    codes = columns["name"][rows].tolist()
    ids = columns["actor_id"][rows].tolist()
    ids_by_code = dict(zip(codes, ids, strict=True))
    own_ids = np.array([ids_by_code[code] for code in agents.tolist()], dtype=np.int64)
    matches: BoolArray = own_ids[:, None] == np.asarray(actor_ids, dtype=np.int64)
    return matches
