"""The cameras that show the colliding pair best, moment by moment, without flicker."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.arrays import AnyArray, FloatArray, as_floats
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.geometry.camera import IN_FRONT_DEPTH
from deepaccident_devkit.render.replay.recording import Recording
from deepaccident_devkit.taxonomy import CAMERAS, AgentName
from deepaccident_devkit.v2x.tracks import scenario_tracks

_SWITCH: Final = 1.0
"""What a change of the camera costs: as much as the pair's whole loss from a picture for about ten frames."""
_END: Final = 5.0
"""How many moments the last one counts for: it is the impact."""
_HIDDEN: Final = 0.2
"""What an actor counts for that the agent does not see: something stands before it."""
_LARGE: Final = 0.1
"""Share of the image's width from which on the size of an actor matters less."""
_LAYERS: Final = as_floats([1, 2, 3]) / 3
"""Sizes of the nested boxes at whose corners an actor is looked for; 1 is the actor's own."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Followed:
    """What is shown of the colliding pair; if nobody collides, the front cameras and the first agent.

    Attributes:
        channels: agent → the camera that shows the pair best, for each frame.
        agents: the agent whose camera shows the pair best, for each frame.
    """

    channels: Mapping[str, tuple[str, ...]]
    agents: tuple[AgentName, ...]


def follow_pair(
    recording: Recording, seen: Mapping[int, Sequence[int]], there: Mapping[tuple[str, str], Sequence[bool]]
) -> Followed:
    """Choose cameras so that most of the pair is in the picture, large and not hidden, and changes are few.

    Args:
        recording: the scenario and the agents.
        seen: actor id → for each frame a bit mask over the recording's agents: who sees it.
        there: agent and camera → for each frame whether there is a picture.
    """
    scores = {agent: _scores(recording, bit, seen, there) for bit, agent in enumerate(recording.agents)}
    chosen = {agent: _steady(each) for agent, each in scores.items()}
    best = [each[np.arange(len(each)), chosen[agent]] for agent, each in scores.items()]
    return Followed(
        channels={agent: tuple(CAMERAS[channel] for channel in channels) for agent, channels in chosen.items()},
        agents=tuple(recording.agents[number] for number in _steady(np.stack(best, axis=1))),
    )


def _scores(
    recording: Recording, bit: int, seen: Mapping[int, Sequence[int]], there: Mapping[tuple[str, str], Sequence[bool]]
) -> FloatArray:
    """(frames, cameras) how well an agent's cameras show the pair, without itself; −1 where there is no picture."""
    agent = recording.agents[bit]
    tracks = scenario_tracks(recording.dataset, recording.scenario)
    others = set(recording.pair) - {recording.actor_of(agent)}
    scores = np.zeros((len(recording.frames), len(CAMERAS)))
    for row, frame in enumerate(recording.frames):
        boxes = tracks.at(frame)
        boxes = boxes.select(np.isin(boxes.actor_id, [*others]))
        weight = [1.0 if seen[actor][row] >> bit & 1 else _HIDDEN for actor in boxes.actor_id.tolist()]
        for column, channel in enumerate(CAMERAS):
            if not there[agent, channel][row]:
                scores[row, column] = -1.0
            elif weight:
                shown = _shown(recording, recording.sample(agent, frame), channel, boxes)
                scores[row, column] = float(shown @ weight)
    scores[-1] *= _END
    return scores


def _shown(recording: Recording, sample: str, channel: str, boxes: Boxes) -> FloatArray:
    """(N,) from 0 to 1: the share of boxes, in world, that a camera's picture has, less if they are small."""
    lens = recording.dataset.camera(sample, channel)
    optical = boxes.transform(recording.dataset.world_from(sample, channel).inverse(), channel)
    corners, center = optical.corners(), optical.center[:, None]
    places = (center[:, None] + _LAYERS[:, None, None] * (corners - center)[:, None]).reshape(-1, 3)
    inside = lens.in_image(*lens.project(places), min_depth=IN_FRONT_DEPTH).reshape(len(boxes), -1).mean(axis=1)
    away = np.linalg.norm(optical.center, axis=1).clip(1.0)
    size = lens.intrinsic[0, 0] / lens.width * optical.size[:, 0] / away
    return as_floats(inside * size / (size + _LARGE))


def _steady(scores: AnyArray) -> list[int]:
    """The choice of columns, one for each row, with the largest sum of scores less the cost of changes."""
    total, before = scores[0], []
    for each in scores[1:]:
        best = int(total.argmax())
        stays = total >= total[best] - _SWITCH
        before.append(np.where(stays, np.arange(len(total)), best))
        total = np.where(stays, total, total[best] - _SWITCH) + each
    path = [int(total.argmax())]
    for columns in reversed(before):
        path.append(int(columns[path[-1]]))
    return path[::-1]
