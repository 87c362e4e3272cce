"""Whom an oracle sees, how they turn, and where constant motion takes them."""

from importlib import import_module

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import assert_refused

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

FRAME = 25


def sample(da: DeepAccident, agent: str = "ego_vehicle", frame: int = FRAME) -> str:
    return f"{da.scenario[0]['token']}/{agent}/{frame:03d}"


@pytest.mark.parametrize("agents", ["single", "+infrastructure", "all", ["other_vehicle"]])
def test_it_knows_whom_the_released_rule_calls_seen_and_the_ego(
    da_hidden: DeepAccident, agents: str
) -> None:
    token = sample(da_hidden)
    seen = seen_actors(da_hidden, token, agents=agents)
    own = da_hidden.agent.get(token.rsplit("/", 1)[0])["actor_id"]
    assert seen.own_actor_id == own
    others = sorted(set(visible_actors(da_hidden, token, agents=agents).tolist()) - {own})
    assert seen.boxes.actor_id.tolist() == [OWN_ACTOR_ID, *others]


def test_the_ego_is_where_its_own_label_has_it_whoever_else_sees_it(
    da_hidden: DeepAccident,
) -> None:
    token = sample(da_hidden)
    seen = seen_actors(da_hidden, token, agents="all", link=Link(pose_noise=0.5, latency=0.5))
    own = da_hidden.boxes(token, "ego")
    own = own.select(np.flatnonzero(own.actor_id == OWN_ACTOR_ID))
    np.testing.assert_array_equal(seen.boxes.center[0], own.center[0])
    np.testing.assert_array_equal(seen.boxes.velocity[0], own.velocity[0])
    assert seen.seen_by[0] == 1 << AGENTS.index("ego_vehicle")


def test_a_partner_does_not_count_as_seen_by_itself(da_hidden: DeepAccident) -> None:
    token = sample(da_hidden)
    other = da_hidden.agent.get(f"{da_hidden.scenario[0]['token']}/other_vehicle")["actor_id"]
    assert other not in seen_actors(da_hidden, token, agents="+other").boxes.actor_id
    assert other in seen_actors(da_hidden, token, agents="+infrastructure").boxes.actor_id


def test_the_pole_has_no_box_of_its_own(da_hidden: DeepAccident) -> None:
    seen = seen_actors(da_hidden, sample(da_hidden, "infrastructure"))
    assert not seen.has_own
    assert len(seen.boxes)


def test_late_boxes_lag_behind_by_the_way_made_since(da_hidden: DeepAccident) -> None:
    token = sample(da_hidden)
    other = da_hidden.agent.get(f"{da_hidden.scenario[0]['token']}/other_vehicle")["actor_id"]
    now, late = (
        seen_actors(da_hidden, token, agents="+infrastructure", link=link, frame="world").boxes
        for link in (None, Link(latency=0.3))
    )
    (here,), (there,) = (
        boxes.select(np.flatnonzero(boxes.actor_id == other)).center for boxes in (now, late)
    )
    moved = now.velocity[now.actor_id == other][0]
    np.testing.assert_allclose(
        here - there, 0.3 * moved, atol=0.15
    )  # it still gathers speed a little


def test_who_drives_straight_on_does_not_turn(da_hidden: DeepAccident) -> None:
    present = seen_actors(da_hidden, sample(da_hidden), agents="all")
    rates = turn_rates(da_hidden, sample(da_hidden), agents="all")
    other = da_hidden.agent.get(f"{da_hidden.scenario[0]['token']}/other_vehicle")["actor_id"]
    two = np.isin(present.boxes.actor_id, [OWN_ACTOR_ID, other])
    assert two.sum() == 2
    np.testing.assert_allclose(rates[two], 0, atol=1e-2)  # poses in files are rounded


def test_turn_rates_are_those_since_the_earliest_sight(
    da_hidden: DeepAccident, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two turn by 0.04 rad a frame, across ±π; one was hidden until 0.3 s ago, a third one until
    now.
    """
    asked = []

    def seen(_dataset: object, token: str, **_options: object) -> SeenActors:
        frame = int(token.rsplit("/", 1)[1])
        asked.append(frame - FRAME)
        yaw = 0.04 * (frame - FRAME) * np.array([1.0, -1.0, 1.0]) + [3.1, -3.1, 0.0]
        ids = [7, 8, 9] if frame == FRAME else [7, 8] if frame >= FRAME - 3 else [7]
        boxes = Boxes.from_arrays(np.zeros((3, 3)), np.ones((3, 3)), yaw, actor_id=[7, 8, 9])
        rows = np.arange(len(ids))
        return SeenActors(
            boxes=boxes.select(rows), seen_by=np.zeros(len(ids), np.uint8), own_actor_id=None
        )

    monkeypatch.setattr(
        import_module("deepaccident_devkit.plugins.baselines.outlook"), "seen_actors", seen
    )
    np.testing.assert_allclose(
        turn_rates(da_hidden, sample(da_hidden)), [0.4, -0.4, 0.0], atol=1e-9
    )
    assert asked == [0, -5, -4, -3, -2, -1]


def test_turn_rates_need_no_past(da_hidden: DeepAccident) -> None:
    first, late = sample(da_hidden, frame=1), sample(da_hidden, frame=3)
    assert not turn_rates(da_hidden, first).any()
    assert not turn_rates(da_hidden, late, agents="all", link=Link(latency=0.2)).any()


def test_frames_are_of_the_same_boxes(da_hidden: DeepAccident) -> None:
    token = sample(da_hidden)
    ego, world = (
        seen_actors(da_hidden, token, agents="all", frame=frame).boxes for frame in ("ego", "world")
    )
    world_from_ego: SE3 = da_hidden.world_from(token, "ego")
    np.testing.assert_allclose(world_from_ego.apply(ego.center), world.center, atol=1e-6)


def test_unknown_agents_are_refused_and_an_unlabelled_sample_tells_an_oracle_nothing(
    da_hidden: DeepAccident, monkeypatch: pytest.MonkeyPatch
) -> None:
    token = sample(da_hidden)
    assert_refused(
        (
            lambda: seen_actors(da_hidden, token, agents="nobody"),
            ChoiceError,
            ("agents", "single", "nobody"),
        )
    )
    record = da_hidden.get("sample", token) | {"labelled": False}
    monkeypatch.setattr(DeepAccident, "get", lambda *_: record)
    assert_refused(
        (
            lambda: seen_actors(da_hidden, token),
            NotAvailableError,
            (token, "no label", "a labelled sample"),
        )
    )


POSE = np.array([[1.0, 2.0, 0.5], [0.0, 0.0, -3.0]])
numbers = st.floats(-20, 20, allow_nan=False)


def test_constant_velocity_goes_straight_on_and_keeps_the_heading() -> None:
    poses = constant_velocity(
        POSE, np.array([[2.0, -1.0], [np.nan, np.nan]]), np.array([0.0, 0.5, 2.0])
    )
    np.testing.assert_array_equal(poses[0], POSE)
    np.testing.assert_allclose(poses[1:, 0], [[2.0, 1.5, 0.5], [5.0, 0.0, 0.5]])
    np.testing.assert_array_equal(poses[1:, 1], [POSE[1], POSE[1]])  # who has no velocity stands


def test_a_full_turn_ends_where_it_began_and_half_of_it_across() -> None:
    rate, speed = 0.5, 4.0
    times = np.array([np.pi, 2 * np.pi]) / rate
    poses = constant_turn_rate(np.zeros((1, 3)), np.array([[speed, 0.0]]), np.array([rate]), times)
    np.testing.assert_allclose(
        poses[0, 0], [0, 2 * speed / rate, np.pi], atol=1e-9
    )  # counter-clockwise, to the left
    np.testing.assert_allclose(poses[1, 0], [0, 0, 2 * np.pi], atol=1e-9)


@given(x=numbers, y=numbers, rate=st.floats(-2, 2), first=st.floats(0, 3), second=st.floats(0, 3))
def test_two_steps_are_one(x: float, y: float, rate: float, first: float, second: float) -> None:
    velocity, rates = np.array([[x, y]]), np.array([rate])
    halfway = constant_turn_rate(POSE[:1], velocity, rates, np.array([first]))[0]
    turn = rate * first
    turned = np.array([[np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y]])
    in_steps = constant_turn_rate(halfway, turned, rates, np.array([second]))[0]
    at_once = constant_turn_rate(POSE[:1], velocity, rates, np.array([first + second]))[0]
    np.testing.assert_allclose(in_steps, at_once, atol=1e-4)


@pytest.mark.parametrize("rate", [1e-12, -1e-7, 3e-6])
def test_a_hardly_turning_path_is_a_straight_one(rate: float) -> None:
    velocity, times = np.array([[10.0, 5.0]]), np.array([0.0, 1.0, 4.0])
    turning = constant_turn_rate(POSE[:1], velocity, np.array([rate]), times)
    np.testing.assert_allclose(turning, constant_velocity(POSE[:1], velocity, times), atol=1e-3)
