"""The twelve designs are the paper's: the accident that each means is of its type (format.md, accident types)."""

import numpy as np
import pytest

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.release import Collision, Meta
from deepaccident_devkit.synth.spec import DESIGN_NUMBERS, DESIGNS, design_text, draw
from deepaccident_devkit.tables.accidents import accident_type


@pytest.mark.parametrize("number", DESIGN_NUMBERS)
def test_each_draw_of_a_design_is_of_its_type(number):
    for seed in range(30):
        spec = draw(DESIGNS[number], np.random.default_rng(seed))
        pair = Collision(
            ids=(1, 2),
            classes=("car", "car"),
            impact=1.0,
            spawn_relation="same",
            contact_side="front_side",
            agents=None,
        )
        meta = Meta(
            weather=spec.weather,
            time_of_day=spec.time_of_day,
            collision=pair,
            simulated_frames=50,
            agent_ids=(1, 3, 2, 4),
            road_type=f"{spec.road.kind} junction",
            spawn_side=spec.spawn_side,
            ego_direction=spec.actor("ego").turn,
            other_direction=spec.actor("other").turn,
        )
        assert accident_type(meta, signalized=spec.road.signalized) == number == spec.design


@pytest.mark.parametrize("number", DESIGN_NUMBERS)
def test_one_of_the_two_who_meet_breaks_a_rule(number):
    spec = draw(DESIGNS[number], np.random.default_rng(0))
    rules = [set(spec.actor(role).ignores) for role in spec.meet.actors]
    assert set(spec.meet.actors) == {"ego", "other"}
    assert sorted(map(bool, rules)) == [False, True]
    assert ("signal" in set().union(*rules)) == (number in (1, 2, 6))


def test_both_parts_fall_to_ego_and_all_weathers_come():
    made = [draw(DESIGNS[3], np.random.default_rng(seed)) for seed in range(100)]
    assert {spec.actor("ego").turn for spec in made} == {"left", "straight"}
    assert len({spec.weather for spec in made}) == 7
    assert len({spec.time_of_day for spec in made}) == 3
    assert 0.1 < np.mean([spec.road.hump is not None for spec in made]) < 0.4


def test_the_catalogue_is_a_mapping():
    assert tuple(DESIGNS) == DESIGN_NUMBERS
    assert len(DESIGNS) == 12
    assert len({template.name for template in DESIGNS.values()}) == 12
    with pytest.raises(KeyError, match="13"):
        DESIGNS[13]
    with pytest.raises(ConfigError, match="design: 13 is not one of 1 to 12; choose one of these"):
        design_text(13)
