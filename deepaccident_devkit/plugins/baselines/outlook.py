"""`Outlook`: where an agent and its partners expect the actors that they see now.

The visible actors and their positions come from the labels (`v2x.cooperation`): an oracle. Actors
continue at a constant velocity, optionally with a constant turn rate, or all stand still.
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
# Number of recorded frames that turn rates look back: 0.5 s.
MAX_HISTORY_FRAMES: Final = 5
# Turn below which a path is straight, to all digits.
_MIN_TURN_RAD: Final = 1e-6


def constant_velocity(pose: FloatArray, velocity: FloatArray, times: FloatArray) -> FloatArray:
    """Return poses of actors that move straight on at a constant velocity.

    Args:
        pose: x, y (metres), yaw (radians) at time 0, in any right-handed frame, shape (N, 3).
        velocity: Velocity over the ground in m/s, in the same frame, shape (N, 2); NaN counts as
            standing.
        times: Seconds, shape (T,).

    Returns:
        x, y, yaw, shape (T, N, 3).
    """
    return constant_turn_rate(pose, velocity, np.zeros(len(pose)), times)


def constant_turn_rate(
    pose: FloatArray, velocity: FloatArray, turn_rate: FloatArray, times: FloatArray
) -> FloatArray:
    """Return poses of actors at a constant speed, with velocity and heading turning alike.

    Args:
        pose: As in `constant_velocity`, shape (N, 3).
        velocity: As in `constant_velocity`, shape (N, 2).
        turn_rate: Radians a second, counter-clockwise, shape (N,); 0 goes straight on.
        times: Seconds, shape (T,).

    Returns:
        x, y, yaw, shape (T, N, 3).
    """
    known_velocity = np.where(np.isfinite(velocity), velocity, 0.0)
    turn = times[:, None] * turn_rate
    is_straight = np.abs(turn) < _MIN_TURN_RAD
    divisor = np.where(is_straight, 1.0, turn)
    # ∫ (cos, sin)(rate · s) ds from 0 to t, over t
    forward_factor = np.where(is_straight, 1.0, np.sin(turn) / divisor)
    lateral_factor = np.where(is_straight, turn / 2, (1 - np.cos(turn)) / divisor)
    x = forward_factor * known_velocity[:, 0] - lateral_factor * known_velocity[:, 1]
    y = lateral_factor * known_velocity[:, 0] + forward_factor * known_velocity[:, 1]
    offsets = times[:, None, None] * np.stack([x, y], axis=-1)
    return np.concatenate([pose[:, :2] + offsets, (pose[:, 2] + turn)[..., None]], axis=-1)


def turn_rates(
    dataset: Dataset, sample: RowArgument, *, agents: Agents = "single", link: Link | None = None
) -> FloatArray:
    """Return the turn rates of the actors of `seen_actors`, from headings now and up to 0.5 s ago.

    The earlier heading of an actor is from the earliest of these moments at which the agents saw
    it. Arguments and errors are as in `seen_actors`.

    Returns:
        Radians a second, counter-clockwise, shape (N,); 0 for actors that nobody saw before.
    """
    scenario, agent, number = dataset.get("sample", sample)["token"].rsplit("/", 2)
    present = seen_actors(dataset, sample, agents=agents, link=link, frame="world").boxes
    rates = np.zeros(len(present))
    is_known = np.zeros(len(present), dtype=bool)
    delay = 0 if link is None else link.latency_frames
    for age in range(min(MAX_HISTORY_FRAMES, int(number) - 1 - delay), 0, -1):
        if is_known.all():
            break
        token = sample_token(scenario, agent, int(number) - age)
        past = seen_actors(dataset, token, agents=agents, link=link, frame="world").boxes
        _, present_rows, past_rows = np.intersect1d(
            present.actor_id, past.actor_id, return_indices=True
        )
        turns = present.yaw[present_rows] - past.yaw[past_rows]
        is_matched = np.zeros(len(present), dtype=bool)
        is_matched[present_rows] = True
        matched_rates = np.zeros(len(present))
        wrapped_turns = np.arctan2(np.sin(turns), np.cos(turns))
        matched_rates[present_rows] = wrapped_turns / (age * FRAME_PERIOD)
        is_new = is_matched & ~is_known
        rates[is_new] = matched_rates[is_new]
        is_known |= is_matched
    return rates


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Outlook(FrozenArrays):
    """Actors in the present ego frame, and how they are expected to move; arrays are read-only.

    Attributes:
        seen: The known actors; boxes in the frame `ego`.
        turn_rate: Radians a second, counter-clockwise, shape (N,).
    """

    seen: SeenActors
    turn_rate: FloatArray

    def poses(self, times: FloatArray) -> FloatArray:
        """Return the actors' poses at times (T,) in seconds, shape (T, N, 3).

        Poses are x forward, y left (metres), yaw (radians), in the present ego frame.
        """
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
    """Return the outlook of some agents at a sample.

    Args:
        dataset: The release.
        sample: Token or record; its agent is the ego, its frame the present.
        agents: The cooperating agents.
        model: Motion model of the actors; also at a constant turn rate, an actor that nobody saw
            before goes straight on.
        link: Degradation of the partners' data; None for none.

    Raises:
        ChoiceError: There is no such model.
        DeepAccidentError: As in `seen_actors`.
    """
    model = choice("model", model, MOTION_MODELS)
    actors = seen_actors(dataset, sample, agents=agents, link=link)
    if model == "standing":
        standing = replace(actors.boxes, velocity=np.zeros_like(actors.boxes.velocity))
        actors = replace(actors, boxes=standing)
    if model == "constant_turn_rate":
        rates = turn_rates(dataset, sample, agents=agents, link=link)
    else:
        rates = np.zeros(len(actors.boxes))
    return Outlook(seen=actors, turn_rate=rates)
