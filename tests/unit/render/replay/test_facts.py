"""What a replay tells in words: how a scenario ends, and what the release lacks."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.testing import assert_allclose
from replay_page import accident, data_of, normal

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render.replay import render_replay
from deepaccident_devkit.render.replay.entries import recording_of
from deepaccident_devkit.render.styles import COLLIDER_COLOR


def test_the_countdown_ends_at_the_impact(da: DeepAccident, data: dict[str, Any]) -> None:
    scenario = accident(da)
    assert data["countdown"] == [0.5, 0.4, 0.3, 0.2, 0.1, 0.0]
    contact = da.collision(scenario)
    assert contact is not None
    origin = recording_of(da, scenario, None).origin
    assert_allclose(np.array(data["impact"]) / 100 + origin, contact.point[:2], atol=0.00501)
    facts = dict(data["facts"])
    collision = da.get("scenario", scenario)["collision"]
    first, second = collision["ids"]
    first_role, second_role = (agent.removesuffix("_vehicle") for agent in collision["agents"])
    kind, other_kind = collision["classes"]
    assert facts["Ends"] == f"{kind} {first} ({first_role}) and {other_kind} {second} ({second_role}) collide"
    assert facts["Speeds"].startswith(f"{kind} {first} {contact.speeds[0]:.1f} m/s")
    assert facts["Weather"].startswith(da.get("scenario", scenario)["weather"])


def test_where_nobody_collides_nothing_is_red(da_b: DeepAccident, tmp_path: Path) -> None:
    data = data_of(render_replay(da_b, normal(da_b), tmp_path / "normal.html"))
    assert data["countdown"] == [None] * 4
    assert data["impact"] is None
    assert dict(data["facts"])["Ends"] == "without a collision"
    assert {actor["role"] for actor in data["actors"]} == {"agent", "other"}
    assert COLLIDER_COLOR not in {actor["color"] for actor in data["actors"]}


def test_labels_alone_are_enough(da_b: DeepAccident, tmp_path: Path) -> None:
    data = data_of(render_replay(da_b, None, tmp_path / "replay.html"))
    assert data["scenario"] == accident(da_b)
    assert (data["cameras"], data["points"]) == ([[]] * 5, None)
    assert any(note.startswith("No pictures: none of the 120 camera files is here") for note in data["notes"])
    assert any(note.startswith("No LiDAR points: no file of ego is here") for note in data["notes"])
    assert all(any(state for state in actor["states"]) for actor in data["actors"])


def test_without_labels_there_are_the_agents(own_release: Path, tmp_path: Path) -> None:
    for folder in sorted(own_release.rglob("label")):
        shutil.rmtree(folder)
    dataset = DeepAccident("v1", own_release, verbose=False)
    data = data_of(render_replay(dataset, None, tmp_path / "replay.html"))
    assert data["actors"] == []
    assert [len(agent["poses"]) for agent in data["agents"]] == [4] * 5
    assert (
        data["notes"][0]
        == "The release has no labels of this scenario: the page has no boxes and does not show who sees whom."
    )
    assert any(note.startswith("How the accident happened is not known: ") for note in data["notes"])
    assert data["countdown"][-1] == 0
