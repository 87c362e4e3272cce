import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepaccident_devkit.plugins.synth.roads import ARMS
from deepaccident_devkit.plugins.synth.spec import (
    ActorSpec,
    MeetSpec,
    ScenarioSpec,
    draw,
    parse_spec,
)

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
    (spec,) = draws(small, 1)
    said = {"ego": "west", "other": "north", "ego_behind": None, "other_behind": None}
    actors = tuple(
        ActorSpec(role=role, from_arm=arm) if arm else ActorSpec(role=role)
        for role, arm in said.items()
    )
    assert spec == ScenarioSpec(
        name="small", actors=actors, meet=MeetSpec(actors=("ego", "other"), offset=0.5)
    )


def test_ranges_are_filled_and_kept(with_other):
    made = draws(
        with_other("max_speed: [8, 12], turn: [straight, left, left]")
        + "background: {parked: [3, 5]}\n"
    )
    speeds = [spec.actor("other").max_speed for spec in made]
    assert (min(speeds), max(speeds)) == pytest.approx((8.1, 11.9), abs=0.1)
    assert {spec.background.parked for spec in made} == {3, 4, 5}
    left = np.mean([spec.actor("other").turn == "left" for spec in made])
    assert left == pytest.approx(2 / 3, abs=0.1), "a word that stands twice is twice as likely"


def test_an_exchange_keeps_the_scene_but_for_the_names():
    made = draws(EXCHANGING)
    assert 0.4 < np.mean([spec.exchange for spec in made]) < 0.6
    assert {spec.spawn_side for spec in made if spec.exchange} == {"left", "right"}
    for spec in made:
        mover, turner = (
            spec.actor(role) for role in (("other", "ego") if spec.exchange else ("ego", "other"))
        )
        assert (spec.actor("ego").from_arm, turner.ignores, mover.category) == (
            "west",
            ("priority",),
            "van",
        )
        assert (spec.actor(f"{mover.role}_behind").gap, spec.meet.actors) == (
            7,
            (mover.role, turner.role),
        )
        assert spec.road.hump.arm == mover.from_arm, "the hump turns with the arms"
        assert spec.actor("pedestrian").from_arm == ARMS[(ARMS.index(mover.from_arm) + 2) % 4]


def test_a_three_way_junction_keeps_its_arms_in_an_exchange():
    text = (
        "exchange: true\nroad: {kind: three-way}\nactors:\n  - {role: ego, "
        "from: west, turn: right}\n"
    )
    made = draws(text + "  - {role: other, from: east, turn: left}\n", 40)
    assert {spec.actor("ego").from_arm for spec in made} == {"west", "east"}


@pytest.mark.parametrize(("turn", "lanes"), [("left", {1}), ("right", {0}), ("straight", {0, 1})])
def test_a_lane_that_is_not_said_follows_from_the_turn(with_other, turn, lanes):
    made = draws(with_other(f"turn: {turn}").replace("meet: {offset: 0.5}", "road: {lanes: 2}"), 30)
    assert {spec.actor("other").lane for spec in made} == lanes


@given(st.sampled_from(ARMS), st.sampled_from(ARMS))
def test_spawn_sides_are_seen_from_ego(ego, other):
    spec = ScenarioSpec(
        actors=(ActorSpec(role="ego", from_arm=ego), ActorSpec(role="other", from_arm=other))
    )
    turned = (ARMS.index(other) - ARMS.index(ego)) % 4  # the arms go round counter-clockwise
    assert spec.spawn_side == ("same", "right", "opposite", "left")[turned]
