"""Whether an agent sees an accident coming: the released rule (evaluation.md f, `accident_visibility`)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import TokenError
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

    The agent has it in view at a moment if it sees by itself (the released rule without the other agents) everyone of
    the colliding pair but itself. The sample counts as unseen if that fails now and at one or two of the moments
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


def _accident_visible(dataset: Dataset, scenario: ScenarioRecord, agent: AgentRecord, index: int) -> bool | None:
    if scenario["weather"] is None:  # there is no meta
        return None
    if scenario["collision"] is None or scenario["name"] in SHEER_CURTAINS:
        return True
    if agent["actor_id"] is None and agent["name"] != INFRASTRUCTURE:
        return None
    others = set(scenario["collision"]["ids"]) - {agent["actor_id"]}
    moments = [index - _STEP * back for back in reversed(range(_OBSERVED))]
    views = [_has_in_view(dataset, agent, moment, others) if moment > 0 else False for moment in moments]
    if None in views:
        return None
    return not (views.count(False) > _OBSERVED / 2 and not views[-1])


def _has_in_view(dataset: Dataset, agent: AgentRecord, index: int, actors: set[int]) -> bool | None:
    """Whether an agent itself sees all of some actors at a frame; None without a label."""
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
    return actors <= set(visible_ids([mask], [boxes.actor_id]).tolist())
