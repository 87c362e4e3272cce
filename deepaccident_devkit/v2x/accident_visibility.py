"""Whether an agent sees an accident coming: the released rule (docs/released_code.md, Visibility and attributes)."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import GeometryError, TokenError
from deepaccident_devkit.support.arrays import BoolArray, as_numbers
from deepaccident_devkit.tables import visible_ids, visible_mask
from deepaccident_devkit.taxonomy import INFRASTRUCTURE, VEHICLE_AGENTS

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import AgentRecord, ScenarioRecord

SHEER_CURTAINS: Final = (
    "Town05_type001_subtype0002_scenario00035",
    "Town05_type001_subtype0002_scenario00004",
)
"""Names of scenarios whose vehicles a CARLA bug marks invisible: the released code never counts them as unseen."""

VISIBILITIES: Final = ("visible", "partial", "invisible")
_STEP: Final = 5
"""Frames between two observations: the released code works at 2 Hz."""
_OBSERVED: Final = 3
"""Observations that count: the present one and two before it."""
_EVALUATED: Final = 4
"""Steps before the last frame at which the released code evaluates: 0.5, 1, 1.5 and 2 s."""


def accident_visibility(dataset: Dataset, scenario: RowArgument) -> str | None:
    """Whether `ego_vehicle` sees the accident of a scenario at the four moments that the released code evaluates.

    The moments are 0.5, 1, 1.5 and 2 s before the last frame, as far as the recording reaches back.

    Returns:
        `visible` if `accident_visible` holds at all of them, `invisible` if at none, `partial` else; None if meta
        names no collision or is missing, or where one of the moments cannot be judged.

    Raises:
        TokenError: no such scenario.
    """
    record = dataset.scenario[dataset.getind("scenario", scenario)]
    if record["collision"] is None:
        return None
    try:
        agent = dataset.agent.get(f"{record['token']}/{VEHICLE_AGENTS[0]}")
    except TokenError:  # a partial download without ego
        return None
    moments = [record["num_frames"] - _STEP * step for step in range(1, _EVALUATED + 1)]
    seen = {_accident_visible(dataset, record, agent, index) for index in moments if index > 0}
    if None in seen or not seen:
        return None
    if len(seen) == 2:
        return "partial"
    return "visible" if True in seen else "invisible"


def accident_visible(dataset: Dataset, sample: RowArgument) -> bool | None:
    """The released attribute `accident_visibility` of a sample: whether its agent has the accident in view.

    The agent has it in view at a moment if it sees by itself (the released rule without the other agents) the colliding
    pair, itself excepted. The sample counts as unseen if that fails now and at one or two of the moments
    0.5 s and 1 s ago, where a moment before the recording counts as failed. Scenarios without a collision and the two
    of `SHEER_CURTAINS` always count as seen.

    Returns:
        None where it cannot be told: without meta, without labels, or if meta does not say which actor the agent is.

    Raises:
        TokenError: no such sample.
    """
    record = dataset.sample[dataset.getind("sample", sample)]
    scenario = dataset.scenario.get(record["scenario_token"])
    index = dataset.frame.get(record["frame_token"])["index"]
    return _accident_visible(dataset, scenario, dataset.agent.get(record["agent_token"]), index)


def accident_visible_mask(in_view: ArrayLike, *, collision: ArrayLike = True, exempt: ArrayLike = False) -> BoolArray:
    """The released rule by itself: which samples count as seeing the accident.

    See docs/released_code.md, Visibility and attributes. A sample does not if its agent does not have the accident in
    view now and at one or two of the two moments before.

    Args:
        in_view: (…, 3) bool, whether the agent has all of the colliding pair but itself in view (`pair_in_view`) 1 s
            ago, 0.5 s ago and now; False for a moment before the recording.
        collision: (…) whether meta names a collision; without one a sample counts as seeing it.
        exempt: (…) whether the scenario is one of `SHEER_CURTAINS`, which always count as seen.

    Returns:
        (…) bool.

    Raises:
        GeometryError: `in_view` has another shape.
    """
    views = as_numbers("in_view", in_view, f"truth values (…, {_OBSERVED})", np.bool_)
    if views.shape[-1:] != (_OBSERVED,):
        raise GeometryError(f"in_view: expected shape (…, {_OBSERVED}), found {views.shape}")
    unseen = ((~views).sum(axis=-1) > _OBSERVED / 2) & ~views[..., -1]
    counts = np.asarray(collision, dtype=bool) & ~np.asarray(exempt, dtype=bool)
    return np.asarray(~(unseen & counts))


def pair_in_view(mask: ArrayLike, actor_ids: ArrayLike, pair: Collection[int], own_id: int | None = None) -> bool:
    """Whether an agent sees the others of a colliding pair at one moment.

    See docs/released_code.md, Visibility and attributes.

    Args:
        mask: (N,) which boxes of its label the agent sees (`tables.visible_mask`).
        actor_ids: (N,) the label's ids; −1 and −100 are never seen, so that a pair of −1 (no collision) is not.
        pair: actor ids.
        own_id: the agent's; None for one that is no vehicle.
    """
    others = {int(actor) for actor in pair} - {own_id}
    return others <= set(visible_ids([mask], [actor_ids]).tolist())


def _accident_visible(dataset: Dataset, scenario: ScenarioRecord, agent: AgentRecord, index: int) -> bool | None:
    if scenario["weather"] is None:  # there is no meta
        return None
    collision, exempt = scenario["collision"], scenario["name"] in SHEER_CURTAINS
    if collision is None or exempt:  # whatever is in view
        return bool(accident_visible_mask([False] * _OBSERVED, collision=collision is not None, exempt=exempt))
    if agent["actor_id"] is None and agent["name"] != INFRASTRUCTURE:
        return None
    moments = [index - _STEP * back for back in reversed(range(_OBSERVED))]
    views = [_has_in_view(dataset, agent, moment, collision["ids"]) if moment > 0 else False for moment in moments]
    seen = [view for view in views if view is not None]
    return bool(accident_visible_mask(seen)) if len(seen) == _OBSERVED else None


def _has_in_view(dataset: Dataset, agent: AgentRecord, index: int, pair: Sequence[int]) -> bool | None:
    """Whether an agent itself sees the others of a pair at a frame; None without a label."""
    sample = dataset.get_sample(agent["scenario_token"], agent["name"], index)
    if not sample["labelled"]:
        return None
    boxes = dataset.boxes(sample, "lidar")
    mask = visible_mask(
        boxes.center[:, :2],
        boxes.category,
        boxes.num_lidar_pts,
        boxes.camera_visible,
        infrastructure=agent["is_infrastructure"],
    )
    return pair_in_view(mask, boxes.actor_id, pair, agent["actor_id"])
