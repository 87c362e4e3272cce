"""`Outlook`: where an agent and its partners expect the actors that they see now.

Who is seen, and where, is by the labels (`v2x.cooperation`): an oracle. Actors go on at a constant velocity, or at a
constant turn rate besides, or all stand still from now on.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Literal, get_args

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.support.arrays import FloatArray, FrozenArrays
from deepaccident_devkit.support.text import choice
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import FRAME_PERIOD
from deepaccident_devkit.v2x import Agents, Link
from deepaccident_devkit.v2x.cooperation import SeenActors, seen_actors

MotionModel = Literal["constant_velocity", "constant_turn_rate", "standing"]
MOTION_MODELS: Final[tuple[MotionModel, ...]] = get_args(MotionModel)
# Recorded frames that turn rates look back, at most: 0.5 s.
HISTORY: Final = 5
# Radians of turn below which a path is straight to all digits.
_STRAIGHT: Final = 1e-6


def constant_velocity(pose: FloatArray, velocity: FloatArray, times: FloatArray) -> FloatArray:
    """Straight on.

    Args:
        pose: (N, 3) x, y (metres), yaw (radians) at time 0, in any right-handed frame.
        velocity: (N, 2) m/s over the ground, in the same frame; NaN counts as standing.
        times: (T,) seconds.

    Returns:
        (T, N, 3) x, y, yaw.
    """
    return constant_turn_rate(pose, velocity, np.zeros(len(pose)), times)


def constant_turn_rate(
    pose: FloatArray, velocity: FloatArray, turn_rate: FloatArray, times: FloatArray
) -> FloatArray:
    """At a constant speed, while velocity and heading turn alike.

    Args:
        pose: as of `constant_velocity`.
        velocity: as of `constant_velocity`.
        turn_rate: (N,) radians a second, counter-clockwise; 0 goes straight on.
        times: (T,) seconds.

    Returns:
        (T, N, 3) x, y, yaw.
    """
    moving = np.where(np.isfinite(velocity), velocity, 0.0)
    turn = times[:, None] * turn_rate
    straight = np.abs(turn) < _STRAIGHT
    divisor = np.where(straight, 1.0, turn)
    # ∫ (cos, sin)(rate · s) ds from 0 to t, over t
    ahead = np.where(straight, 1.0, np.sin(turn) / divisor)
    aside = np.where(straight, turn / 2, (1 - np.cos(turn)) / divisor)
    x = ahead * moving[:, 0] - aside * moving[:, 1]
    y = aside * moving[:, 0] + ahead * moving[:, 1]
    way = times[:, None, None] * np.stack([x, y], axis=-1)
    return np.concatenate([pose[:, :2] + way, (pose[:, 2] + turn)[..., None]], axis=-1)


def turn_rates(
    dataset: Dataset, sample: RowArgument, *, agents: Agents = "single", link: Link | None = None
) -> FloatArray:
    """The turn rates of the actors of `seen_actors`, by their headings at the present and up to 0.5 s before it.

    For each actor the earliest of these moments counts at which the agents saw it. Arguments and errors as of
    `seen_actors`.

    Returns:
        (N,) radians a second, counter-clockwise; 0 for actors not seen before.
    """
    scenario, agent, number = dataset.get("sample", sample)["token"].rsplit("/", 2)
    present = seen_actors(dataset, sample, agents=agents, link=link, frame="world").boxes
    rate, known = np.zeros(len(present)), np.zeros(len(present), dtype=bool)
    delay = 0 if link is None else link.latency_frames
    for back in range(min(HISTORY, int(number) - 1 - delay), 0, -1):
        if known.all():
            break
        token = sample_token(scenario, agent, int(number) - back)
        before = seen_actors(dataset, token, agents=agents, link=link, frame="world").boxes
        _, now, then = np.intersect1d(present.actor_id, before.actor_id, return_indices=True)
        turned = present.yaw[now] - before.yaw[then]
        found = np.zeros(len(present), dtype=bool)
        found[now] = True
        values = np.zeros(len(present))
        values[now] = np.arctan2(np.sin(turned), np.cos(turned)) / (back * FRAME_PERIOD)
        fresh = found & ~known
        rate[fresh], known = values[fresh], known | found
    return rate


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
        model: how actors go on; one that nobody saw before goes straight on at a constant turn rate, too.
        link: what happens to the partners' data; None for nothing.

    Raises:
        ChoiceError: no such model.
        DeepAccidentError: as of `seen_actors`.
    """
    model = choice("model", model, MOTION_MODELS)
    seen = seen_actors(dataset, sample, agents=agents, link=link)
    if model == "standing":
        seen = replace(seen, boxes=replace(seen.boxes, velocity=np.zeros_like(seen.boxes.velocity)))
    turns = model == "constant_turn_rate"
    rate = (
        turn_rates(dataset, sample, agents=agents, link=link)
        if turns
        else np.zeros(len(seen.boxes))
    )
    return Outlook(seen=seen, turn_rate=rate)
