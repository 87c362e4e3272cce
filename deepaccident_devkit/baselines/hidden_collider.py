"""One accident, seen by a single vehicle and by all five agents: the demo's table."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import takewhile
from typing import TYPE_CHECKING, Final

from deepaccident_devkit.arrays import ShortRepr
from deepaccident_devkit.baselines.conditions import Condition
from deepaccident_devkit.baselines.counting import Counting, counted
from deepaccident_devkit.baselines.predict import predict_accidents
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.evaluation.metrics.evaluator import ratio
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import FRAME_PERIOD, VEHICLE_AGENTS
from deepaccident_devkit.text import columns_text
from deepaccident_devkit.v2x.collisions import labelled_pair
from deepaccident_devkit.v2x.tracks import scenario_tracks

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import ScenarioRecord

_WARNING_HORIZON: Final = 4.0
"""Seconds that alarms look ahead."""
_KEY_FRAMES: Final = (5, 10, 15, 20)
"""Recorded frames before the last one at which maps and alarms are evaluated, as the released code does."""
_AGENTS: Final = {"single": "single vehicle", "all": "five agents"}


@dataclass(frozen=True, slots=True, kw_only=True)
class HiddenCollider(ShortRepr):
    """How well the ego vehicle foresees one accident with some agents.

    Attributes:
        agents: name of the configuration.
        iou: percent, of the maps within 100 m × 100 m, 2 s ahead.
        vpq: percent, likewise.
        apa: accident prediction accuracy by the protocol `boxes`, in [0, 1].
        warning: seconds before the impact from which on every moment (each 0.1 s) has an alarm that names the pair;
            0 if the last one has none.
        precision: share of the alarms of the last 4 s that name the pair; NaN without any.
        false_time: share of these moments with an alarm that names others.
    """

    agents: str
    iou: float
    vpq: float
    apa: float
    warning: float
    precision: float
    false_time: float


def demo_table(dataset: Dataset, scenario: RowArgument | None = None) -> tuple[tuple[HiddenCollider, ...], str]:
    """Compare a single vehicle with five agents on an accident; constant velocity, a perfect link.

    Args:
        dataset: the release.
        scenario: token or record; None for the release's first accident.

    Returns:
        The numbers of the single vehicle and of the five agents, and the table as text.

    Raises:
        TokenError: no such scenario.
        NotAvailableError: it has no accident, is not longer than 0.5 s, or an agent is not in this release.
    """
    record, pair = _accident(dataset, scenario)
    token, length = record["token"], record["num_frames"]
    ego = VEHICLE_AGENTS[0]
    keys = [sample_token(token, ego, length - back) for back in _KEY_FRAMES if back < length]
    if not keys:
        raise NotAvailableError(f"{token}: has {length} frames; choose a scenario of more than 0.5 s")
    conditions = [Condition(agents=name) for name in _AGENTS]
    counting = Counting(dataset=dataset, model="constant_velocity", protocol="paper", seeds=(0,))
    evaluators = counted(counting, dict.fromkeys(keys, conditions), workers=1)
    rows = []
    for condition in conditions:
        far = evaluators[condition].motion.compute().ranges["100x100"]
        apa = evaluators[condition].boxes.compute().apa
        alarms = _alarms(dataset, record, pair, condition.agents)
        rows.append(HiddenCollider(agents=condition.agents, iou=far.iou, vpq=far.pq, apa=apa, **alarms))
    return tuple(rows), columns_text(table_rows(rows))


def _accident(dataset: Dataset, scenario: RowArgument | None) -> tuple[ScenarioRecord, set[int]]:
    """A scenario and the actor ids of its colliding pair."""
    given = dataset.scenario if scenario is None else [dataset.scenario[dataset.getind("scenario", scenario)]]
    for record in given:
        pair = labelled_pair(record["collision"], scenario_tracks(dataset, record).actor_id)
        if pair is not None:
            return record, set(pair)
    place = dataset.dataroot if scenario is None else given[0]["token"]
    raise NotAvailableError(f"{place}: no label shows a colliding pair; choose a scenario with an accident")


def _alarms(dataset: Dataset, record: ScenarioRecord, pair: set[int], agents: str) -> dict[str, float]:
    """The numbers of `HiddenCollider` on alarms."""
    right, false = [], []
    for back in range(1, min(record["num_frames"], round(_WARNING_HORIZON / FRAME_PERIOD) + 1)):
        token = sample_token(record["token"], VEHICLE_AGENTS[0], record["num_frames"] - back)
        named = [
            alarm.ids is not None and set(alarm.ids) == pair
            for alarm in predict_accidents(dataset, token, agents=agents, horizon=_WARNING_HORIZON)
        ]
        right.append(sum(named))
        false.append(len(named) - sum(named))
    return {
        "warning": sum(1 for _ in takewhile(bool, right)) * FRAME_PERIOD,
        "precision": ratio(sum(right), sum(right) + sum(false)),
        "false_time": ratio(sum(map(bool, false)), len(false)),
    }


def table_rows(rows: Sequence[HiddenCollider]) -> list[list[str]]:
    """The cells of the table as text: the heading, then a line for each configuration of agents."""
    heading = ["", "IoU (%)", "VPQ (%)", "APA (boxes)", "warning (s)", "precision", "false alarm (% of 4 s)"]
    lines = [
        [
            *(_AGENTS[row.agents], f"{row.iou:.1f}", f"{row.vpq:.1f}", _number(row.apa), f"{row.warning:.1f}"),
            *(_number(row.precision), f"{100 * row.false_time:.0f}"),
        ]
        for row in rows
    ]
    return [heading, *lines]


def _number(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.2f}"
