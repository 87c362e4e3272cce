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

EXCHANGED_ROLES = """
exchange: true
road: {hump: {arm: west}}
actors:
  - {role: ego, from: west, category: van}
  - {role: ego_behind, gap: 7}
  - {role: other, from: [north, south], turn: left, max_speed: [8, 12], ignores: [priority]}
  - {role: pedestrian, from: east}
meet: {offset: [0.1, 0.3]}
"""


def draw_specs(text: str, count: int = 200) -> list[ScenarioSpec]:
    template = parse_spec(text)
    return [draw(template, np.random.default_rng(seed)) for seed in range(count)]


def test_a_draw_has_what_the_file_says_and_defaults_for_the_rest(small):
    (spec,) = draw_specs(small, 1)
    assert spec == ScenarioSpec(
        name="small",
        actors=(
            ActorSpec(role="ego", from_arm="west"),
            ActorSpec(role="other", from_arm="north"),
            ActorSpec(role="ego_behind"),
            ActorSpec(role="other_behind"),
        ),
        meet=MeetSpec(actors=("ego", "other"), offset=0.5),
    )


def test_ranges_are_filled_and_kept(with_other):
    text = with_other("max_speed: [8, 12], turn: [straight, left, left]")
    specs = draw_specs(text + "background: {parked: [3, 5]}\n")
    speeds = [spec.actor("other").max_speed for spec in specs]
    assert min(speeds) == pytest.approx(8.1, abs=0.1)
    assert max(speeds) == pytest.approx(11.9, abs=0.1)
    assert {spec.background.parked for spec in specs} == {3, 4, 5}

    left = np.mean([spec.actor("other").turn == "left" for spec in specs])
    assert left == pytest.approx(2 / 3, abs=0.1), "a word that stands twice is twice as likely"


def test_an_exchange_keeps_the_scene_but_for_the_names():
    specs = draw_specs(EXCHANGED_ROLES)
    assert 0.4 < np.mean([spec.exchange for spec in specs]) < 0.6
    assert {spec.spawn_side for spec in specs if spec.exchange} == {"left", "right"}

    for spec in specs:
        roles = ("other", "ego") if spec.exchange else ("ego", "other")
        mover, turner = (spec.actor(role) for role in roles)
        assert spec.actor("ego").from_arm == "west"
        assert (mover.category, turner.ignores) == ("van", ("priority",))
        assert spec.actor(f"{mover.role}_behind").gap == 7
        assert spec.meet.actors == roles
        assert spec.road.hump.arm == mover.from_arm, "the hump turns with the arms"

        opposite_arm = ARMS[(ARMS.index(mover.from_arm) + 2) % 4]
        assert spec.actor("pedestrian").from_arm == opposite_arm


def test_a_three_way_junction_keeps_its_arms_in_an_exchange():
    text = """
exchange: true
road: {kind: three-way}
actors:
  - {role: ego, from: west, turn: right}
  - {role: other, from: east, turn: left}
"""
    assert {spec.actor("ego").from_arm for spec in draw_specs(text, 40)} == {"west", "east"}


@pytest.mark.parametrize(("turn", "lanes"), [("left", {1}), ("right", {0}), ("straight", {0, 1})])
def test_a_missing_lane_follows_from_the_turn(with_other, turn, lanes):
    text = with_other(f"turn: {turn}")
    specs = draw_specs(text.replace("meet: {offset: 0.5}", "road: {lanes: 2}"), 30)
    assert {spec.actor("other").lane for spec in specs} == lanes


@given(st.sampled_from(ARMS), st.sampled_from(ARMS))
def test_spawn_sides_are_seen_from_ego(ego_arm, other_arm):
    spec = ScenarioSpec(
        actors=(
            ActorSpec(role="ego", from_arm=ego_arm),
            ActorSpec(role="other", from_arm=other_arm),
        )
    )
    # the arms go round counter-clockwise
    quarter_turns = (ARMS.index(other_arm) - ARMS.index(ego_arm)) % 4
    assert spec.spawn_side == ("same", "right", "opposite", "left")[quarter_turns]
