"""`Outlook`: how an agent and its partners expect the actors that they see to move.

The visible actors and their positions are taken from the labels (`v2x.cooperation`), as if by a
perfect detector. Actors continue at a constant velocity, optionally with a constant turn rate; or
all of them stand still.
"""

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
# Largest number of recorded frames that turn rates look back (0.5 s).
MAX_HISTORY_FRAMES: Final = 5
# A path that turns less than this is straight to all digits.
_MIN_TURN_RAD = 1e-6


def constant_velocity(pose: FloatArray, velocity: FloatArray, times: FloatArray) -> FloatArray:
    """Return the poses of actors that move straight ahead at a constant velocity.

    Args:
        pose: x, y (metres), yaw (radians) at time 0, in any right-handed frame, shape (N, 3).
        velocity: Velocity over the ground in m/s, in the same frame, shape (N, 2); NaN means that
            the actor stands still.
        times: Seconds after time 0, shape (T,).

    Returns:
        x, y, yaw, shape (T, N, 3).
    """
    turn_rate = np.zeros(len(pose))
    return constant_turn_rate(pose, velocity, turn_rate, times)


def constant_turn_rate(
    pose: FloatArray, velocity: FloatArray, turn_rate: FloatArray, times: FloatArray
) -> FloatArray:
    """Return the poses of actors with a constant speed and a constant turn rate.

    Velocity and heading turn at the same rate.

    Args:
        pose: x, y (metres), yaw (radians) at time 0, shape (N, 3).
        velocity: Velocity over the ground in m/s, shape (N, 2); NaN means standing still.
        turn_rate: Radians per second, counter-clockwise, shape (N,); 0 for straight ahead.
        times: Seconds after time 0, shape (T,).

    Returns:
        x, y, yaw, shape (T, N, 3).
    """
    velocity = np.where(np.isfinite(velocity), velocity, 0.0)
    velocity_x, velocity_y = velocity.T
    turn = times[:, None] * turn_rate
    is_straight = np.abs(turn) < _MIN_TURN_RAD
    divisor = np.where(is_straight, 1.0, turn)
    # ∫ (cos, sin)(rate · s) ds from 0 to t, over t
    forward_factor = np.where(is_straight, 1.0, np.sin(turn) / divisor)
    lateral_factor = np.where(is_straight, turn / 2, (1 - np.cos(turn)) / divisor)
    mean_velocity_x = forward_factor * velocity_x - lateral_factor * velocity_y
    mean_velocity_y = lateral_factor * velocity_x + forward_factor * velocity_y
    x = pose[:, 0] + times[:, None] * mean_velocity_x
    y = pose[:, 1] + times[:, None] * mean_velocity_y
    yaw = pose[:, 2] + turn
    return np.stack([x, y, yaw], axis=-1)


def turn_rates(
    dataset: Dataset, sample: RowArgument, *, agents: Agents = "single", link: Link | None = None
) -> FloatArray:
    """Return the turn rates of the actors that `seen_actors` returns.

    A turn rate is computed from the heading at t = 0 and an earlier heading: the first one within
    the last 0.5 s at which the agents saw the actor. Arguments and errors are as in `seen_actors`.

    Returns:
        Radians per second, counter-clockwise, shape (N,); 0 for actors that no agent saw before.
    """
    scenario, agent, number = dataset.get("sample", sample)["token"].rsplit("/", 2)
    boxes = seen_actors(dataset, sample, agents=agents, link=link, frame="world").boxes
    rates = np.zeros(len(boxes))
    is_known = np.zeros(len(boxes), dtype=bool)
    latency = 0 if link is None else link.latency_frames
    history_frames = min(MAX_HISTORY_FRAMES, int(number) - 1 - latency)
    for age in range(history_frames, 0, -1):
        if is_known.all():
            break
        token = sample_token(scenario, agent, int(number) - age)
        past_boxes = seen_actors(dataset, token, agents=agents, link=link, frame="world").boxes
        _, rows, past_rows = np.intersect1d(
            boxes.actor_id, past_boxes.actor_id, return_indices=True
        )
        is_new = ~is_known[rows]
        new_rows = rows[is_new]
        turns = boxes.yaw[new_rows] - past_boxes.yaw[past_rows[is_new]]
        wrapped_turns = np.arctan2(np.sin(turns), np.cos(turns))
        rates[new_rows] = wrapped_turns / (age * FRAME_PERIOD)
        is_known[new_rows] = True
    return rates


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Outlook(FrozenArrays):
    """Actors in the ego frame at t = 0, and their expected motion; arrays are read-only.

    Attributes:
        seen: The N actors that the agents see; their boxes are in the frame `ego`.
        turn_rate: Radians per second, counter-clockwise, shape (N,).
    """

    seen: SeenActors
    turn_rate: FloatArray

    def poses(self, times: FloatArray) -> FloatArray:
        """Return the actors' poses at times (T,) in seconds, shape (T, N, 3).

        A pose is x forward, y left (metres), yaw (radians), in the ego frame at t = 0.
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
    """Return the actors that some agents see in a sample, with their expected motion.

    Args:
        dataset: The release.
        sample: Token or record of the sample; its agent is the ego, its frame is t = 0.
        agents: Agents that cooperate.
        model: Motion model of the actors; in all models, actors that no agent saw before do not
            turn.
        link: Degradation of the partners' data; None for none.

    Raises:
        ChoiceError: If `model` is not a motion model.
        DeepAccidentError: For the reasons in `seen_actors`.
    """
    model = choice("model", model, MOTION_MODELS)
    actors = seen_actors(dataset, sample, agents=agents, link=link)
    rates = np.zeros(len(actors.boxes))
    if model == "standing":
        no_velocity = np.zeros_like(actors.boxes.velocity)
        standing_boxes = replace(actors.boxes, velocity=no_velocity)
        actors = replace(actors, boxes=standing_boxes)
    elif model == "constant_turn_rate":
        rates = turn_rates(dataset, sample, agents=agents, link=link)
    return Outlook(seen=actors, turn_rate=rates)
