"""Which cameras follow the colliding pair."""

import itertools

import numpy as np
import pytest
from replay_page import accident, normal

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.geometry.camera import IN_FRONT_DEPTH
from deepaccident_devkit.render.replay.entries import Recording, actor_entries, recording_of
from deepaccident_devkit.render.replay.sensors import Followed, _steady, follow_pair
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS
from deepaccident_devkit.v2x.tracks import scenario_tracks


def followed(recording: Recording, missing: tuple[str, str] = ("", "")) -> Followed:
    seen = {actor["id"]: actor["seen"] for actor in actor_entries(recording)}
    keys = itertools.product(recording.agents, CAMERAS)
    return follow_pair(recording, seen, {key: [key != missing] * len(recording.frames) for key in keys})


def changes(names: tuple[str, ...]) -> int:
    return sum(one != other for one, other in itertools.pairwise(names))


def test_the_pair_is_in_the_picture_at_the_impact(da_motion: DeepAccident) -> None:
    recording = recording_of(da_motion, accident(da_motion), None)
    found = followed(recording)
    assert {agent: len(channels) for agent, channels in found.channels.items()} == dict.fromkeys(AGENTS, 35)
    assert max(map(changes, [*found.channels.values(), found.agents])) <= 3  # in 3.5 s: it does not flicker
    for frame in range(26, 36):
        agent = found.agents[frame - 1]
        sample, channel = recording.sample(agent, frame), found.channels[agent][frame - 1]
        boxes = scenario_tracks(da_motion, recording.scenario).at(frame)
        pair = boxes.select(np.isin(boxes.actor_id, recording.pair))
        centers = pair.transform(da_motion.world_from(sample, channel).inverse(), channel).center
        lens = da_motion.camera(sample, channel)
        shown = lens.in_image(*lens.project(centers), min_depth=IN_FRONT_DEPTH)
        assert shown.any(), (frame, agent, channel)


def test_a_camera_without_pictures_is_not_chosen(da_motion: DeepAccident) -> None:
    recording = recording_of(da_motion, accident(da_motion), None)
    before = followed(recording)
    agent, channel = before.agents[-1], before.channels[before.agents[-1]][-1]
    after = followed(recording, missing=(agent, channel))
    assert channel not in after.channels[agent]
    assert [name for name in AGENTS if after.channels[name] != before.channels[name]] == [agent]


def test_where_nobody_collides_the_front_cameras_are_shown(da_motion: DeepAccident) -> None:
    found = followed(recording_of(da_motion, normal(da_motion), None))
    assert set(found.agents) == {"ego_vehicle"}
    assert {channel for channels in found.channels.values() for channel in channels} == {"Camera_Front"}


@pytest.mark.parametrize(
    ("scores", "chosen"),
    [
        ([[0.9, 0.1], [0.0, 0.8], [0.9, 0.1], [0.9, 0.1]], [0, 0, 0, 0]),  # a change and back would cost more
        ([[0.5, 0.4], *[[0.1, 0.9]] * 3], [1, 1, 1, 1]),  # as good from the beginning on
        ([*[[0.9, 0.1]] * 3, *[[0.1, 0.9]] * 3], [0, 0, 0, 1, 1, 1]),
        ([[0.2, 0.2, 0.7]], [2]),
    ],
)
def test_changes_are_worth_their_cost(scores: list[list[float]], chosen: list[int]) -> None:
    assert _steady(np.array(scores)) == chosen
