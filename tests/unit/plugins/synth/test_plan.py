from collections import Counter

import numpy as np
import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.synth import SynthConfig
from deepaccident_devkit.plugins.synth.plan import plan_scenarios, plan_splits
from deepaccident_devkit.plugins.synth.scenario import build_scenario
from deepaccident_devkit.selection.splits import split_records
from deepaccident_devkit.taxonomy import TOWNS


def make_plans(**fields):
    return plan_scenarios(SynthConfig(**fields))


def test_accidents_and_twins_alternate_and_go_round_the_designs():
    plans = make_plans(scenarios=26)
    assert [plan.accident for plan in plans] == [True, False] * 13
    assert [plan.design for plan in plans[::2]] == [1, 7, 2, 8, 3, 9, 4, 10, 5, 11, 6, 12, 1]
    assert {plan.traits.subtype for plan in plans[:4]} == {1, 2}

    some = make_plans(scenarios=6, designs=(3, 9))
    assert [plan.design for plan in some[::2]] == [3, 9, 3]

    for accident, twin in zip(plans[::2], plans[1::2], strict=True):
        for field in ("name", "split", "traits"):
            assert getattr(accident, field) == getattr(twin, field)
        kind = f"type1_subtype{accident.traits.subtype}"
        assert accident.scenario_type == f"{kind}_accident"
        assert twin.scenario_type == f"{kind}_normal"


def test_names_are_the_release_s_and_unique():
    plans = make_plans(scenarios=60)
    assert len({plan.token for plan in plans}) == 60
    assert len({plan.name for plan in plans}) == 30

    towns = {plan.name.split("_")[0] for plan in plans}
    assert towns <= set(TOWNS)
    assert len(towns) > 4
    subtype, number = plans[6].traits.subtype, 1 + plans[6].pair
    assert plans[6].name.endswith(f"_type001_subtype{subtype:04d}_scenario{number:05d}")


def test_seeds_repeat_and_differ_and_more_scenarios_keep_the_first():
    plans = make_plans(seed=1)
    assert plans == make_plans(seed=1)
    assert [plan.name for plan in plans] != [plan.name for plan in make_plans(seed=2)]

    few, many = make_plans(scenarios=4), make_plans(scenarios=40)
    assert [plan.token for plan in few] == [plan.token for plan in many[:4]]


@pytest.mark.parametrize("design", range(1, 13))
def test_a_draw_has_the_plan_s_traits(design):
    for plan in make_plans(scenarios=20, designs=(design,)):
        traits = plan.traits

        for seed in range(3):
            spec = plan.draw(np.random.default_rng(seed))
            assert spec.road.signalized == (traits.subtype == 1) == (design < 7)
            assert f"{spec.road.kind} junction" == traits.road_type
            assert spec.spawn_side == traits.spawn_side
            assert spec.view == "open" or design in (1, 2, 6, 7, 8, 12)


def test_a_view_that_is_asked_for_holds_for_every_draw():
    for view, designs in (("open", range(1, 13)), ("hidden", (1, 7))):
        for plan in make_plans(scenarios=24, view=view):
            assert plan.design in designs
            drawn_views = {plan.draw(np.random.default_rng(seed)).view for seed in range(3)}
            assert drawn_views == {view}


def test_the_first_three_pairs_of_a_small_release_fill_the_splits():
    plans = make_plans(scenarios=6)
    assert [plan.split for plan in plans] == ["train", "train", "val", "val", "test", "test"]

    splits = plan_splits(plans)
    assert splits.train == splits.train_mini == tuple(sorted(plan.token for plan in plans[:2]))
    assert splits.val_mini == splits.val
    assert plan_splits(plans[:2]).val_mini == ()


def test_a_large_release_is_split_by_the_official_procedure():
    plans = make_plans(scenarios=691)
    assert Counter(plan.split for plan in plans) == {"train": 483, "val": 104, "test": 104}, (
        "the real release's counts"
    )

    splits = plan_splits(plans)
    val_tokens = {plan.token for plan in plans if plan.split == "val"}
    assert set(splits.val_mini) < set(splits.val) == val_tokens
    assert len({(plan.pair, plan.split) for plan in plans}) == len({plan.pair for plan in plans})


@pytest.mark.parametrize("scenarios", [*range(1, 13), 30, 49, 240, 691])
def test_minis_are_whole_pairs_and_six_scenarios_fill_all_splits(scenarios):
    """A mini split has at most a fifth of its split, or one pair."""
    plans = make_plans(scenarios=scenarios)
    assert {plan.split for plan in plans} == {"train", "val", "test"} or scenarios <= 5

    splits = plan_splits(plans)
    pair_of = {plan.token: plan.pair for plan in plans}
    for whole, mini in (
        (splits.train, splits.train_mini),
        (splits.val, splits.val_mini),
    ):
        pairs = {pair_of[token] for token in mini}
        assert set(mini) == {token for token in whole if pair_of[token] in pairs}
        assert len(pairs) == 1 or 5 * len(mini) <= len(whole)
        assert bool(mini) == bool(whole)


def test_unplanned_accidents_come_at_their_rate():
    for fields, expected_share in (
        ({"unplanned": 0.25, "designed": True}, pytest.approx(0.25, abs=0.05)),
        ({"unplanned": 0.0, "designed": True}, 0),
        ({"unplanned": 1.0, "view": "hidden"}, 0),
    ):
        plans = make_plans(scenarios=800, **fields)
        assert np.mean([plan.unplanned for plan in plans]) == expected_share


def test_a_hidden_view_has_designs_that_a_house_can_hide_and_faster_cars():
    plans = make_plans(scenarios=6, view="hidden")
    assert [plan.design for plan in plans[::2]] == [1, 7, 1]

    spec = plans[0].draw(np.random.default_rng(0))
    assert spec.view == "hidden"
    for role in ("ego", "other"):
        assert 12 <= spec.actor(role).max_speed <= 14


OWN_SPEC = """\
road: {signalized: [true, false], kind: [four-way, three-way]}
view: hidden
actors:
  - {role: ego, from: west, turn: right}
  - {role: other, from: south, turn: [left, right]}
"""


@pytest.fixture
def write_spec(tmp_path):
    """A function that writes a scenario file and returns its path."""

    def write(text):
        (tmp_path / "own.yaml").write_text(text)
        return tmp_path / "own.yaml"

    return write


def test_what_cannot_be_planned_is_refused(write_spec):
    opposite = OWN_SPEC.replace("view: hidden\n", "").replace(
        "from: south, turn: [left, right]", "from: east"
    )
    assert_raises(
        (
            lambda: make_plans(view="hidden", designs=(3,)),
            ConfigError,
            ("view: hidden needs ", "in 'unprotected left turn' it is on the side 'o"),
        ),
        (
            lambda: make_plans(spec=write_spec(opposite), view="hidden"),
            ConfigError,
            ("own.yaml:2: actors: view: hidden needs ", "choose other arms, or the view open"),
        ),
        (
            lambda: make_plans(spec=write_spec(OWN_SPEC + "meet: {actors: [ego, ego]}\n")),
            ConfigError,
            ("ego cannot meet itself",),
        ),
    )


def test_an_own_file_takes_the_designs_place(write_spec):
    text = OWN_SPEC.replace("turn: right}", "turn: straight}", 1) + "meet: {}\n"
    plans = make_plans(spec=write_spec(text), scenarios=40, unplanned=1.0)

    assert {(plan.design, plan.unplanned, plan.traits.subtype) for plan in plans} == {
        (None, False, 1),
        (None, False, 2),
    }

    for plan in plans:
        spec = plan.draw(np.random.default_rng(plan.pair))
        assert spec.road.signalized == (plan.traits.subtype == 1)
        assert spec.view == "hidden"


def test_a_file_in_which_nobody_meets_gives_normal_scenarios(write_spec):
    plans = make_plans(spec=write_spec(OWN_SPEC), scenarios=5)
    assert [plan.pair for plan in plans] == [0, 1, 2, 3, 4]
    assert not any(plan.accident for plan in plans)
    assert len({plan.token for plan in plans}) == 5


@pytest.mark.slow
def test_the_split_lists_equal_the_official_procedure_s():
    config = SynthConfig(scenarios=24, frames=1, unplanned=0.3, seed=3)
    plans = plan_scenarios(config)
    assert {plan.unplanned for plan in plans} == {True, False}

    def make_record(plan):
        meta = build_scenario(config, plan).meta
        return {
            "token": plan.token,
            "name": plan.name,
            "scenario_type": plan.scenario_type,
            "weather": "Clear",
            "designed_accident": plan.accident,
            "collision": meta and meta.collision and {"agents": meta.collision.agents},
            "road_type": meta and meta.road_type,
            "spawn_side": meta and meta.spawn_side,
        }

    official = split_records([make_record(plan) for plan in plans])
    splits = plan_splits(plans)
    assert splits.train == official.train
    assert splits.val == official.val
    assert splits.test == official.test
    assert set(official.train_mini) >= set(splits.train_mini)
    assert (len(official.val_mini), len(splits.val_mini)) == (0, 2), (
        "the procedure leaves a small mini split empty"
    )
