from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepaccident_devkit.synth.roads import ARMS
from deepaccident_devkit.synth.spec import ActorSpec, ScenarioSpec, draw, parse_spec

EXCHANGING = """
exchange: true
road: {hump: {arm: west}}
actors:
  - {role: ego, from: west, category: van}
  - {role: ego_behind, gap: 7}
  - {role: other, from: [north, south], turn: left, max_speed: [8, 12], ignores: [priority]}
  - {role: pedestrian, from: east}
meet: {offset: [0.1, 0.3]}
"""


def draws(text: str, count: int = 200) -> list[ScenarioSpec]:
    template = parse_spec(text)
    return [draw(template, np.random.default_rng(seed)) for seed in range(count)]


def test_a_draw_has_what_the_file_says_and_defaults_for_the_rest(small):
    spec = draws(small, 1)[0]
    actors = (
        ActorSpec(role="ego", from_arm="west"),
        ActorSpec(role="other", from_arm="north"),
        ActorSpec(role="ego_behind"),
        ActorSpec(role="other_behind"),
    )
    assert spec == ScenarioSpec(name="small", actors=actors, meet=replace(spec.meet, offset=0.5))
    assert spec.meet.actors == ("ego", "other")


def test_the_same_numbers_give_the_same_draw():
    assert draws(EXCHANGING, 20) == draws(EXCHANGING, 20)


def test_ranges_are_filled_and_kept(with_other):
    text = with_other("max_speed: [8, 12], turn: [straight, left, left]") + "background: {parked: [3, 5]}\n"
    made = draws(text)
    speeds = [spec.actor("other").max_speed for spec in made]
    assert 8 <= min(speeds) < 8.2
    assert 11.8 < max(speeds) <= 12
    assert {spec.background.parked for spec in made} == {3, 4, 5}
    left = np.mean([spec.actor("other").turn == "left" for spec in made])
    assert left == pytest.approx(2 / 3, abs=0.1), "a word that stands twice is twice as likely"


def test_an_exchange_keeps_the_scene_but_for_the_names():
    made = draws(EXCHANGING)
    exchanged = [spec for spec in made if spec.exchange]
    assert 0.4 < len(exchanged) / len(made) < 0.6
    for spec in made:
        mover, turner = ("other", "ego") if spec.exchange else ("ego", "other")
        assert spec.actor("ego").from_arm == "west"
        assert spec.actor(turner).ignores == ("priority",)
        assert spec.actor(mover).category == "van"
        assert spec.actor(f"{mover}_behind").gap == 7
        assert spec.meet.actors == (mover, turner)
        assert spec.road.hump.arm == spec.actor(mover).from_arm, "the hump turns with the arms"
        across = (ARMS.index(spec.actor(mover).from_arm) + 2) % 4
        assert spec.actor("pedestrian").from_arm == ARMS[across]
    assert {spec.spawn_side for spec in exchanged} == {"left", "right"}


def test_a_three_way_junction_keeps_its_arms_in_an_exchange():
    text = "exchange: true\nroad: {kind: three-way}\nactors:\n  - {role: ego, from: west, turn: right}\n"
    made = draws(text + "  - {role: other, from: east, turn: left}\n", 40)
    assert {spec.actor("ego").from_arm for spec in made} == {"west", "east"}


@pytest.mark.parametrize(("turn", "lanes"), [("left", {1}), ("right", {0}), ("straight", {0, 1})])
def test_a_lane_that_is_not_said_follows_from_the_turn(with_other, turn, lanes):
    made = draws(with_other(f"turn: {turn}").replace("meet: {offset: 0.5}", "road: {lanes: 2}"), 30)
    assert {spec.actor("other").lane for spec in made} == lanes


@given(st.sampled_from(ARMS), st.sampled_from(ARMS))
def test_spawn_sides_are_seen_from_ego(ego, other):
    spec = ScenarioSpec(actors=(ActorSpec(role="ego", from_arm=ego), ActorSpec(role="other", from_arm=other)))
    places = {"west": (-1, 0), "south": (0, -1), "east": (1, 0), "north": (0, 1)}
    heading = -np.array(places[ego])
    ahead = float(heading @ places[other])
    left = float(heading[0] * places[other][1] - heading[1] * places[other][0])
    wanted = {(1, 0): "opposite", (0, 1): "left", (0, -1): "right", (-1, 0): "same"}[ahead, left]
    assert spec.spawn_side == wanted
