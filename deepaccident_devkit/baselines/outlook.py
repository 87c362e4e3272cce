"""`Outlook`: where an agent and its partners expect the actors that they see now."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray, FrozenArrays
from deepaccident_devkit.baselines.motion_models import MotionModel, constant_turn_rate
from deepaccident_devkit.baselines.oracle import SeenActors, seen_actors, turn_rates
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.text import choice
from deepaccident_devkit.v2x import Agents, Link

_Rates = Callable[[Dataset, RowArgument, Agents, Link | None, int], FloatArray]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Outlook(FrozenArrays):
    """Actors, in the present ego frame, and how they go on; arrays are read-only.

    Attributes:
        seen: who is known; boxes in the frame `ego`.
        turn_rate: (N,) radians a second, counter-clockwise.
    """

    seen: SeenActors
    turn_rate: FloatArray

    def poses(self, times: FloatArray) -> FloatArray:
        """(T, N, 3) x forward, y left (metres), yaw (radians), in the present ego frame, at times (T,) in seconds."""
        boxes = self.seen.boxes
        pose = np.column_stack([boxes.center[:, :2], boxes.yaw])
        return constant_turn_rate(pose, boxes.velocity[:, :2], self.turn_rate, times)


def outlook(
    dataset: Dataset,
    sample: RowArgument,
    *,
    agents: Agents = "single",
    model: MotionModel = "constant_velocity",
    link: Link | None = None,
) -> Outlook:
    """The outlook of some agents at a sample.

    Args:
        dataset: the release.
        sample: token or record: its agent is the ego, its frame the present.
        agents: who cooperates.
        model: how actors go on; one that nobody saw before goes straight on by either model.
        link: what happens to the partners' data; None for nothing.

    Raises:
        ChoiceError: no such model.
        DeepAccidentError: as of `seen_actors`.
    """
    model = choice("model", model, MOTION_MODELS)
    seen = seen_actors(dataset, sample, agents=agents, link=link)
    return Outlook(seen=seen, turn_rate=MOTION_MODELS[model](dataset, sample, agents, link, len(seen.boxes)))


def _straight(_dataset: Dataset, _sample: RowArgument, _agents: Agents, _link: Link | None, count: int) -> FloatArray:
    return np.zeros(count)


def _turning(dataset: Dataset, sample: RowArgument, agents: Agents, link: Link | None, _count: int) -> FloatArray:
    return turn_rates(dataset, sample, agents=agents, link=link)


MOTION_MODELS: Final[Mapping[MotionModel, _Rates]] = {
    "constant_velocity": _straight,
    "constant_turn_rate": _turning,
}
"""Turn rates, by model."""
