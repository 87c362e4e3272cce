from collections import Counter

import numpy as np
import pytest
from refusals import assert_refused

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.synth import SynthConfig
from deepaccident_devkit.plugins.synth.plan import plan_scenarios, plan_splits
from deepaccident_devkit.plugins.synth.scenario import build_scenario
from deepaccident_devkit.selection.splits import split_records
from deepaccident_devkit.taxonomy import TOWNS


def plans_of(**fields):
    return plan_scenarios(SynthConfig(**fields))


def test_accidents_and_twins_by_turns_go_round_the_designs_all_or_chosen():
    plans = plans_of(scenarios=26)
    assert [plan.accident for plan in plans] == [True, False] * 13
    assert [plan.design for plan in plans[::2]] == [1, 7, 2, 8, 3, 9, 4, 10, 5, 11, 6, 12, 1]
    assert [plan.design for plan in plans_of(scenarios=6, designs=(3, 9))[::2]] == [3, 9, 3]
    assert {plan.traits.subtype for plan in plans[:4]} == {1, 2}
    for accident, twin in zip(plans[::2], plans[1::2], strict=True):
        assert (accident.name, accident.split, accident.traits) == (
            twin.name,
            twin.split,
            twin.traits,
        )
        kind = f"type1_subtype{accident.traits.subtype}"
        assert (accident.scenario_type, twin.scenario_type) == (
            f"{kind}_accident",
            f"{kind}_normal",
        )


def test_names_are_the_release_s_and_unique():
    plans = plans_of(scenarios=60)
    assert (len({plan.token for plan in plans}), len({plan.name for plan in plans})) == (60, 30)
    towns = {plan.name.split("_")[0] for plan in plans}
    assert (towns <= set(TOWNS), len(towns) > 4) == (True, True)
    assert plans[6].name.endswith(
        f"_type001_subtype{plans[6].traits.subtype:04d}_scenario{1 + plans[6].pair:05d}"
    )


def test_seeds_differ_and_repeat_and_more_scenarios_leave_the_first_as_they_are_but_for_splits():
    assert plans_of(seed=1) == plans_of(seed=1)
    assert [plan.name for plan in plans_of(seed=1)] != [plan.name for plan in plans_of(seed=2)]
    few, many = plans_of(scenarios=4), plans_of(scenarios=40)
    assert [plan.token for plan in few] == [plan.token for plan in many[:4]]


@pytest.mark.parametrize("design", range(1, 13))
def test_a_draw_has_the_plan_s_traits(design):
    for plan in plans_of(scenarios=20, designs=(design,)):
        for seed in range(3):
            spec = plan.draw(np.random.default_rng(seed))
            assert spec.road.signalized == (plan.traits.subtype == 1) == (design < 7)
            assert (f"{spec.road.kind} junction", spec.spawn_side) == (
                plan.traits.road_type,
                plan.traits.spawn_side,
            )
            assert spec.view == "open" or design in (1, 2, 6, 7, 8, 12)


def test_a_view_that_is_asked_for_holds_for_every_draw():
    for view, designs in (("open", range(1, 13)), ("hidden", (1, 7))):
        for plan in plans_of(scenarios=24, view=view):
            assert plan.design in designs
            assert {plan.draw(np.random.default_rng(seed)).view for seed in range(3)} == {view}


def test_the_first_three_pairs_of_a_small_release_fill_the_splits():
    plans = plans_of(scenarios=6)
    assert [plan.split for plan in plans] == ["train", "train", "val", "val", "test", "test"]
    splits = plan_splits(plans)
    assert splits.train == splits.train_mini == tuple(sorted(plan.token for plan in plans[:2]))
    assert (splits.val_mini, plan_splits(plans[:2]).val_mini) == (splits.val, ())


def test_a_large_release_is_split_by_the_official_procedure():
    plans = plans_of(scenarios=691)
    assert Counter(plan.split for plan in plans) == {"train": 483, "val": 104, "test": 104}, (
        "the real release's counts"
    )
    splits = plan_splits(plans)
    assert (
        set(splits.val_mini)
        < set(splits.val)
        == {plan.token for plan in plans if plan.split == "val"}
    )
    assert len({(plan.pair, plan.split) for plan in plans}) == len({plan.pair for plan in plans})


@pytest.mark.parametrize("scenarios", [*range(1, 13), 30, 49, 240, 691])
def test_minis_are_whole_pairs_a_fifth_at_most_and_no_split_is_empty_from_six_scenarios_on(
    scenarios,
):
    plans = plans_of(scenarios=scenarios)
    assert {plan.split for plan in plans} == {"train", "val", "test"} or scenarios <= 5
    splits, pair_of = plan_splits(plans), {plan.token: plan.pair for plan in plans}
    for whole, mini in ((splits.train, splits.train_mini), (splits.val, splits.val_mini)):
        pairs = {pair_of[token] for token in mini}
        assert set(mini) == {token for token in whole if pair_of[token] in pairs}
        assert len(pairs) == 1 or 5 * len(mini) <= len(whole)
        assert bool(mini) == bool(whole)


def test_unplanned_accidents_come_at_their_rate():
    asked = (
        {"unplanned": 0.25, "designed": True},
        {"unplanned": 0.0, "designed": True},
        {"unplanned": 1.0, "view": "hidden"},
    )
    shares = [
        np.mean([plan.unplanned for plan in plans_of(scenarios=800, **each)]) for each in asked
    ]
    assert shares == [pytest.approx(0.25, abs=0.05), 0, 0]


def test_a_hidden_view_has_designs_that_a_house_can_hide_and_faster_cars():
    plans = plans_of(scenarios=6, view="hidden")
    spec = plans[0].draw(np.random.default_rng(0))
    assert ([plan.design for plan in plans[::2]], spec.view) == ([1, 7, 1], "hidden")
    assert all(12 <= spec.actor(role).max_speed <= 14 for role in ("ego", "other"))


OWN = """\
road: {signalized: [true, false], kind: [four-way, three-way]}
view: hidden
actors:
  - {role: ego, from: west, turn: right}
  - {role: other, from: south, turn: [left, right]}
"""


@pytest.fixture
def own(tmp_path):
    """Writes a scenario file."""

    def write(text):
        (tmp_path / "own.yaml").write_text(text)
        return tmp_path / "own.yaml"

    return write


def test_what_cannot_be_planned_is_refused(own):
    opposite = OWN.replace("view: hidden\n", "").replace(
        "from: south, turn: [left, right]", "from: east"
    )
    assert_refused(
        (
            lambda: plans_of(view="hidden", designs=(3,)),
            ConfigError,
            ("view: hidden needs ", "in 'unprotected left turn' it is on the side 'o"),
        ),
        (
            lambda: plans_of(spec=own(opposite), view="hidden"),
            ConfigError,
            ("own.yaml:2: actors: view: hidden needs ", "choose other arms, or the view open"),
        ),
        (
            lambda: plans_of(spec=own(OWN + "meet: {actors: [ego, ego]}\n")),
            ConfigError,
            ("ego cannot meet itself",),
        ),
    )


def test_an_own_file_takes_the_designs_place(own):
    plans = plans_of(
        spec=own(OWN.replace("turn: right}", "turn: straight}", 1) + "meet: {}\n"),
        scenarios=40,
        unplanned=1.0,
    )
    assert {(plan.design, plan.unplanned, plan.traits.subtype) for plan in plans} == {
        (None, False, 1),
        (None, False, 2),
    }
    for plan in plans:
        spec = plan.draw(np.random.default_rng(plan.pair))
        assert (spec.road.signalized, spec.view) == (plan.traits.subtype == 1, "hidden")


def test_a_file_in_which_nobody_meets_gives_normal_scenarios(own):
    plans = plans_of(spec=own(OWN), scenarios=5)
    assert [(plan.pair, plan.accident) for plan in plans] == [(k, False) for k in range(5)]
    assert len({plan.token for plan in plans}) == 5


@pytest.mark.slow
def test_the_lists_are_what_the_official_procedure_makes_of_what_is_built():
    config = SynthConfig(scenarios=24, frames=1, unplanned=0.3, seed=3)
    plans = plan_scenarios(config)
    assert {plan.unplanned for plan in plans} == {True, False}

    def record(plan):
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

    official, made = split_records([record(plan) for plan in plans]), plan_splits(plans)
    assert (made.train, made.val, made.test) == (official.train, official.val, official.test)
    assert set(official.train_mini) >= set(made.train_mini)
    assert (len(official.val_mini), len(made.val_mini)) == (0, 2), (
        "the procedure leaves a small mini split empty"
    )
