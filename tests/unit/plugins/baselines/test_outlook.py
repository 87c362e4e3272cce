"""Actors that an oracle sees, how they turn, and where constant motion takes them."""

from importlib import import_module

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, NotAvailableError
from deepaccident_devkit.geometry import SE3, Boxes
from deepaccident_devkit.plugins.baselines import (
    SeenActors,
    constant_turn_rate,
    constant_velocity,
    seen_actors,
    turn_rates,
)
from deepaccident_devkit.taxonomy import AGENTS, OWN_ACTOR_ID
from deepaccident_devkit.v2x import Link
from deepaccident_devkit.v2x.cooperation import visible_actors

PRESENT_FRAME = 25


def sample_token(da: DeepAccident, agent: str = "ego_vehicle", frame: int = PRESENT_FRAME) -> str:
    return f"{da.scenario[0]['token']}/{agent}/{frame:03d}"


def other_vehicle_id(da: DeepAccident) -> int:
    return da.agent.get(f"{da.scenario[0]['token']}/other_vehicle")["actor_id"]


@pytest.mark.parametrize("agents", ["single", "+infrastructure", "all", ["other_vehicle"]])
def test_an_oracle_knows_the_ego_and_the_actors_that_the_released_rule_calls_seen(
    da_hidden: DeepAccident, agents: str
) -> None:
    token = sample_token(da_hidden)
    seen = seen_actors(da_hidden, token, agents=agents)
    ego_id = da_hidden.agent.get(token.rsplit("/", 1)[0])["actor_id"]
    assert seen.own_actor_id == ego_id
    visible_ids = set(visible_actors(da_hidden, token, agents=agents).tolist())
    assert seen.boxes.actor_id.tolist() == [OWN_ACTOR_ID, *sorted(visible_ids - {ego_id})]


def test_the_ego_is_where_its_own_label_has_it_even_if_others_see_it(
    da_hidden: DeepAccident,
) -> None:
    token = sample_token(da_hidden)
    seen = seen_actors(da_hidden, token, agents="all", link=Link(pose_noise=0.5, latency=0.5))
    boxes = da_hidden.boxes(token, "ego")
    ego_box = boxes.select(np.flatnonzero(boxes.actor_id == OWN_ACTOR_ID))
    np.testing.assert_array_equal(seen.boxes.center[0], ego_box.center[0])
    np.testing.assert_array_equal(seen.boxes.velocity[0], ego_box.velocity[0])
    assert seen.seen_by[0] == 1 << AGENTS.index("ego_vehicle")


def test_a_partner_does_not_count_as_seen_by_itself(da_hidden: DeepAccident) -> None:
    token = sample_token(da_hidden)
    partner_id = other_vehicle_id(da_hidden)
    assert partner_id not in seen_actors(da_hidden, token, agents="+other").boxes.actor_id
    assert partner_id in seen_actors(da_hidden, token, agents="+infrastructure").boxes.actor_id


def test_the_infrastructure_has_no_box_of_its_own(da_hidden: DeepAccident) -> None:
    seen = seen_actors(da_hidden, sample_token(da_hidden, "infrastructure"))
    assert not seen.has_own
    assert len(seen.boxes)


def test_late_boxes_lag_behind_by_the_distance_driven_since(da_hidden: DeepAccident) -> None:
    actor_id = other_vehicle_id(da_hidden)

    def box_with(link: Link | None) -> Boxes:
        boxes = seen_actors(
            da_hidden,
            sample_token(da_hidden),
            agents="+infrastructure",
            link=link,
            frame="world",
        ).boxes
        return boxes.select(np.flatnonzero(boxes.actor_id == actor_id))

    present, late = box_with(None), box_with(Link(latency=0.3))
    np.testing.assert_allclose(
        present.center[0] - late.center[0],
        0.3 * present.velocity[0],
        atol=0.15,  # it still accelerates a little
    )


def test_a_vehicle_that_drives_straight_on_does_not_turn(da_hidden: DeepAccident) -> None:
    token = sample_token(da_hidden)
    seen = seen_actors(da_hidden, token, agents="all")
    rates = turn_rates(da_hidden, token, agents="all")
    is_straight = np.isin(seen.boxes.actor_id, [OWN_ACTOR_ID, other_vehicle_id(da_hidden)])
    assert is_straight.sum() == 2
    np.testing.assert_allclose(rates[is_straight], 0, atol=1e-2)  # poses in files are rounded


def test_turn_rates_are_measured_since_the_earliest_sight(
    da_hidden: DeepAccident, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two actors turn by 0.04 rad a frame, across ±π; the second was hidden until 0.3 s ago, and a
    third one until now.
    """
    requested_frames = []

    def fake_seen_actors(_dataset: object, token: str, **_options: object) -> SeenActors:
        frame = int(token.rsplit("/", 1)[1]) - PRESENT_FRAME
        requested_frames.append(frame)
        yaw = 0.04 * frame * np.array([1.0, -1.0, 1.0]) + [3.1, -3.1, 0.0]
        boxes = Boxes.from_arrays(np.zeros((3, 3)), np.ones((3, 3)), yaw, actor_id=[7, 8, 9])
        num_seen = 1
        if frame == 0:
            num_seen = 3
        elif frame >= -3:
            num_seen = 2
        return SeenActors(
            boxes=boxes.select(np.arange(num_seen)),
            seen_by=np.zeros(num_seen, np.uint8),
            own_actor_id=None,
        )

    outlook = import_module("deepaccident_devkit.plugins.baselines.outlook")
    monkeypatch.setattr(outlook, "seen_actors", fake_seen_actors)
    rates = turn_rates(da_hidden, sample_token(da_hidden))
    np.testing.assert_allclose(rates, [0.4, -0.4, 0.0], atol=1e-9)
    assert requested_frames == [0, -5, -4, -3, -2, -1]


def test_turn_rates_need_no_past(da_hidden: DeepAccident) -> None:
    first, late = sample_token(da_hidden, frame=1), sample_token(da_hidden, frame=3)
    assert not turn_rates(da_hidden, first).any()
    assert not turn_rates(da_hidden, late, agents="all", link=Link(latency=0.2)).any()


def test_boxes_in_all_frames_are_the_same_boxes(da_hidden: DeepAccident) -> None:
    token = sample_token(da_hidden)
    in_ego = seen_actors(da_hidden, token, agents="all", frame="ego").boxes
    in_world = seen_actors(da_hidden, token, agents="all", frame="world").boxes
    world_from_ego: SE3 = da_hidden.world_from(token, "ego")
    np.testing.assert_allclose(world_from_ego.apply(in_ego.center), in_world.center, atol=1e-6)


def test_unknown_agents_are_refused_and_an_unlabelled_sample_tells_an_oracle_nothing(
    da_hidden: DeepAccident, monkeypatch: pytest.MonkeyPatch
) -> None:
    token = sample_token(da_hidden)
    assert_raises(
        (
            lambda: seen_actors(da_hidden, token, agents="nobody"),
            ChoiceError,
            ("agents", "single", "nobody"),
        )
    )
    record = da_hidden.get("sample", token) | {"labelled": False}
    monkeypatch.setattr(DeepAccident, "get", lambda *_: record)
    assert_raises(
        (
            lambda: seen_actors(da_hidden, token),
            NotAvailableError,
            (token, "no label", "a labelled sample"),
        )
    )


POSES = np.array([[1.0, 2.0, 0.5], [0.0, 0.0, -3.0]])
speeds = st.floats(-20, 20, allow_nan=False)


def test_constant_velocity_goes_straight_on_and_keeps_the_heading() -> None:
    velocity = np.array([[2.0, -1.0], [np.nan, np.nan]])
    times = np.array([0.0, 0.5, 2.0])
    poses = constant_velocity(POSES, velocity, times)
    moving, without_velocity = poses[:, 0], poses[:, 1]
    np.testing.assert_array_equal(poses[0], POSES)
    np.testing.assert_allclose(
        moving[1:],
        [
            [2.0, 1.5, 0.5],
            [5.0, 0.0, 0.5],
        ],
    )
    np.testing.assert_array_equal(without_velocity, [POSES[1]] * 3)


def test_a_full_turn_ends_where_it_began_and_half_a_turn_opposite() -> None:
    rate, speed = 0.5, 4.0
    poses = constant_turn_rate(
        np.zeros((1, 3)),
        np.array([[speed, 0.0]]),
        np.array([rate]),
        np.array([np.pi, 2 * np.pi]) / rate,
    )
    half_turn, full_turn = poses[:, 0]
    # counter-clockwise, to the left
    np.testing.assert_allclose(half_turn, [0, 2 * speed / rate, np.pi], atol=1e-9)
    np.testing.assert_allclose(full_turn, [0, 0, 2 * np.pi], atol=1e-9)


@given(vx=speeds, vy=speeds, rate=st.floats(-2, 2), first=st.floats(0, 3), second=st.floats(0, 3))
def test_two_steps_are_one(vx: float, vy: float, rate: float, first: float, second: float) -> None:
    velocity = np.array([[vx, vy]])
    cos, sin = np.cos(rate * first), np.sin(rate * first)
    turned_velocity = np.array([[cos * vx - sin * vy, sin * vx + cos * vy]])

    def move(pose: np.ndarray, velocity: np.ndarray, seconds: float) -> np.ndarray:
        return constant_turn_rate(pose, velocity, np.array([rate]), np.array([seconds]))[0]

    halfway = move(POSES[:1], velocity, first)
    in_steps = move(halfway, turned_velocity, second)
    at_once = move(POSES[:1], velocity, first + second)
    np.testing.assert_allclose(in_steps, at_once, atol=1e-4)


@pytest.mark.parametrize("rate", [1e-12, -1e-7, 3e-6])
def test_a_hardly_turning_path_is_a_straight_one(rate: float) -> None:
    velocity = np.array([[10.0, 5.0]])
    times = np.array([0.0, 1.0, 4.0])
    turning = constant_turn_rate(POSES[:1], velocity, np.array([rate]), times)
    straight = constant_velocity(POSES[:1], velocity, times)
    np.testing.assert_allclose(turning, straight, atol=1e-3)
