"""The attributes of samples, and breakdowns by them of any evaluator's results, with intervals over
scenarios.
"""

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import Any

import pytest
from support.expected_errors import assert_raises
from support.spawned_evaluation import RatioEvaluator

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, EvaluationError
from deepaccident_devkit.evaluation.breakdowns import (
    ATTRIBUTES,
    NO_IMPACT,
    WITHIN_RECORDINGS,
    SampleAttributes,
    breakdown,
    cluster_of,
    sample_attributes,
    time_bin,
    tokens_by_value,
)
from deepaccident_devkit.evaluation.evaluator import Counts, total
from deepaccident_devkit.evaluation.intervals import Resampling
from deepaccident_devkit.taxonomy import AGENTS, INFRASTRUCTURE
from deepaccident_devkit.v2x import accident_visible

STORY = {
    "scenario_type": "type1_subtype1_accident",
    "town": "Town03",
    "weather": "HardRain",
    "weather_group": "Rainy",
    "time_of_day": "Noon",
    "time_of_day_group": "Daytime",
    "collision": "true",
    "collision_status": "collides_between_vehicles",
    "road_type": "four-way junction",
    "trajectory_type": "straight_straight",
    "signalized": "true",
}


class PooledRatioEvaluator(RatioEvaluator):
    """An evaluator of the same ratio that pools its counts."""

    def pooled(self, counts: Collection[Counts]) -> list[Counts]:
        return [{name: total(counts, name) for name in ("above", "below")}]


def attributes_of(number: int, **changes: Any) -> SampleAttributes:
    """Return the attributes of a sample of scenario `number // 10`."""
    values: dict[str, Any] = {
        "scenario": f"s{number // 10}",
        "agent": "ego_vehicle",
        "story": STORY | {"town": f"Town0{number // 10 % 3}"},
        "accident_visibility": "visible",
        "time_to_impact": f"{number % 10 // 2} s",
        "impact_step": f"{number % 10 / 2:g} s",
        "time_to_end": "2.0",
    }
    return SampleAttributes(**(values | changes))


def evaluator_of(
    numbers: range = range(100), kind: type[RatioEvaluator] = RatioEvaluator
) -> RatioEvaluator:
    evaluator = kind()
    for number in numbers:
        is_hit = number % 7 == 0 or number // 10 == 3
        evaluator.add(f"{number:03d}", {"above": float(is_hit), "below": 1.0})
    return evaluator


ATTRIBUTES_BY_TOKEN = {f"{number:03d}": attributes_of(number) for number in range(100)}


NO_RESAMPLES = Resampling(resamples=0)


def sizes_of(groups: Sequence[Any]) -> dict[Any, int]:
    return {group.value: group.samples for group in groups}


def test_groups_are_the_results_of_their_samples() -> None:
    evaluator = evaluator_of()
    by_town = breakdown(evaluator, ATTRIBUTES_BY_TOKEN, "town")
    assert (by_town.by, by_town.resampling) == ("town", Resampling())
    assert [group.value for group in by_town.groups] == ["Town00", "Town01", "Town02"]

    for index, group in enumerate(by_town.groups):
        tokens = [token for token in ATTRIBUTES_BY_TOKEN if int(token) // 10 % 3 == index]
        scenarios = len(tokens) // 10
        note = f"no confidence intervals: {scenarios} scenario pairs, at least 6 needed"
        assert group.result == evaluator.compute(tokens)
        sizes = (group.samples, group.scenarios, group.clusters)
        assert sizes == (len(tokens), scenarios, scenarios)
        assert (group.intervals, group.notes) == ({}, (note,))


def test_all_samples_are_a_breakdown_too() -> None:
    evaluator = evaluator_of()
    (group,) = breakdown(evaluator, ATTRIBUTES_BY_TOKEN, "all").groups
    assert (group.value, group.samples, group.scenarios) == ("all", 100, 10)
    assert group.result == evaluator.compute()

    low, high = group.intervals["ratio"]
    assert 0 < low < group.result.ratio < high < 1
    assert (set(group.intervals), group.notes) == ({"ratio"}, ())


def change_some(is_changed: Callable[[int], bool], **changes: Any) -> dict[str, SampleAttributes]:
    return {
        token: replace(attributes, **changes) if is_changed(int(token)) else attributes
        for token, attributes in ATTRIBUTES_BY_TOKEN.items()
    }


TWO_WITHOUT_IMPACT = change_some(
    lambda number: number in (0, 13), time_to_impact=None, impact_step=NO_IMPACT
)
WITH_POLES = change_some(lambda number: number % 10 < 4, agent=INFRASTRUCTURE)
EVERY_AGENT = {
    token: replace(attributes, agent=AGENTS[int(token) % 5])
    for token, attributes in ATTRIBUTES_BY_TOKEN.items()
}


@pytest.mark.parametrize(
    ("attributes", "by", "groups", "groups_of_vehicles"),
    [
        (
            TWO_WITHOUT_IMPACT,
            "time_to_impact",
            {"0 s": 19, "1 s": 19, **dict.fromkeys(("2 s", "3 s", "4 s"), 20), None: 2},
            None,
        ),
        (
            TWO_WITHOUT_IMPACT,
            "impact_step",
            {
                "0 s": 9,
                "0.5 s": 10,
                "1 s": 10,
                "1.5 s": 9,
                **{f"{at / 2:g} s": 10 for at in range(4, 10)},
                NO_IMPACT: 2,
            },
            None,
        ),
        (
            WITH_POLES,
            "town",
            {"Town00": 40, "Town01": 30, "Town02": 30},
            {"Town00": 24, "Town01": 18, "Town02": 18},
        ),
        (WITH_POLES, "agent", {"ego_vehicle": 60, INFRASTRUCTURE: 40}, {"ego_vehicle": 60}),
        # agents are in their usual order
        (
            EVERY_AGENT,
            "agent",
            dict.fromkeys(AGENTS, 20),
            dict.fromkeys(AGENTS[:-1], 20),
        ),
    ],
)
def test_groups_are_in_order_with_and_without_infrastructure(
    attributes, by, groups, groups_of_vehicles
) -> None:
    """Unknown values come last."""
    result = breakdown(evaluator_of(), attributes, by, NO_RESAMPLES)
    sizes = sizes_of(result.groups)
    assert list(sizes.items()) == list(groups.items())

    sizes = sizes_of(result.without_infrastructure)
    assert list(sizes.items()) == list((groups_of_vehicles or groups).items())
    assert {len(group.intervals) for group in result.groups} == {0}


@pytest.mark.parametrize(
    ("scenario", "cluster"),
    [
        ("type1_subtype1_accident/Town03_1", "type1_subtype1/Town03_1"),
        ("type1_subtype1_normal/Town03_1", "type1_subtype1/Town03_1"),
        ("nuscenes/type1_subtype1_accident-Town03_1-ego_vehicle", "type1_subtype1/Town03_1"),
        ("nuscenes/type1_subtype1_normal-Town03_1-ego_vehicle", "type1_subtype1/Town03_1"),
        ("nuscenes/type1_subtype1_normal-Town03_1-ego_vehicle_behind", "type1_subtype1/Town03_1"),
        ("nuscenes/type1_subtype1_normal-Town03_1-infrastructure", "type1_subtype1/Town03_1"),
        ("nuscenes/type12_subtype2_accident-Town-3-vehicle", "type12_subtype2/Town-3-vehicle"),
        ("nuscenes/scene-0061", "nuscenes/scene-0061"),
        ("other/Town03_1", "other/Town03_1"),
        ("other", "other"),
    ],
)
def test_a_cluster_has_no_ending(scenario: str, cluster: str) -> None:
    assert cluster_of(scenario) == cluster


@pytest.mark.parametrize("kind", [RatioEvaluator, PooledRatioEvaluator])
def test_the_order_of_samples_makes_no_difference(kind: type[RatioEvaluator]) -> None:
    expected = breakdown(evaluator_of(kind=kind), ATTRIBUTES_BY_TOKEN, "town")
    reversed_attributes = dict(reversed(list(ATTRIBUTES_BY_TOKEN.items())))
    reversed_evaluator = evaluator_of(range(99, -1, -1), kind)
    assert breakdown(reversed_evaluator, reversed_attributes, "town") == expected

    merged_evaluator = evaluator_of(range(50, 100), kind).merge(evaluator_of(range(60), kind))
    assert breakdown(merged_evaluator, reversed_attributes, "town") == expected

    plain = breakdown(evaluator_of(), ATTRIBUTES_BY_TOKEN, "town")
    assert expected.groups == plain.groups


def test_an_accident_and_its_twin_are_one_cluster() -> None:
    """Equal twins add no information: the interval is that of the accidents only."""
    accidents, both = RatioEvaluator(), RatioEvaluator()
    attributes = {}
    for number in range(80):
        cluster = number // 10
        counts = {"above": float(cluster % 2), "below": 1.0}
        for kind in ("accident", "normal"):
            token = f"{number:03d} {kind}"
            scenario = f"type1_subtype1_{kind}/Town03_{cluster}"
            attributes[token] = attributes_of(number, scenario=scenario)
            both.add(token, counts)
        accidents.add(f"{number:03d} accident", counts)

    (accident_group,) = breakdown(accidents, attributes, "all").groups
    (group,) = breakdown(both, attributes, "all").groups
    assert (group.scenarios, group.clusters) == (16, 8)
    assert (accident_group.scenarios, accident_group.clusters) == (8, 8)
    assert group.intervals["ratio"] == pytest.approx(accident_group.intervals["ratio"])


def test_unknown_samples_and_attributes_are_refused() -> None:
    evaluator = evaluator_of()
    all_but_one = dict(list(ATTRIBUTES_BY_TOKEN.items())[:-1])

    assert_raises(
        (
            lambda: breakdown(evaluator, all_but_one, "town"),
            EvaluationError,
            ("1 samples", "such as 099", "sample_attributes"),
        ),
        (
            lambda: breakdown(evaluator, {}, "town"),
            EvaluationError,
            ("100 samples", "such as 000"),
        ),
        (
            lambda: breakdown(evaluator, ATTRIBUTES_BY_TOKEN, "moon"),
            ChoiceError,
            ("by: expected one of", "town", "'moon'"),
        ),
        (
            lambda: ATTRIBUTES_BY_TOKEN["000"].value("moon"),
            ChoiceError,
            ("by: expected one of", "'moon'"),
        ),
    )


@pytest.mark.parametrize(
    ("frames", "second", "step"),
    [
        (0, "0 s", "0 s"),
        (1, "1 s", "0.5 s"),
        (5, "1 s", "0.5 s"),
        (6, "1 s", "1 s"),
        (30, "3 s", "3 s"),
        (31, "4 s", "3.5 s"),
    ],
)
def test_bins_of_time_have_their_upper_edge(frames: int, second: str, step: str) -> None:
    assert (time_bin(frames, 10), time_bin(frames, 5)) == (second, step)


def test_the_attributes_of_samples_are_those_of_their_records(da_motion: DeepAccident) -> None:
    """Read two recordings of 3.5 s: every frame of one agent, and the samples to evaluate."""
    evaluated = da_motion.samples("train", "evaluate")
    frames = [sample["token"] for sample in da_motion.sample if sample["agent"] == AGENTS[-1]]
    attributes_by_token = sample_attributes(da_motion, [*evaluated, *frames])
    assert list(attributes_by_token) == list(dict.fromkeys([*evaluated, *frames]))

    visibilities = {True: "visible", False: "invisible", None: None}
    for token, attributes in attributes_by_token.items():
        sample = da_motion.sample.get(token)
        scenario = da_motion.scenario.get(sample["scenario_token"])
        assert attributes.scenario == sample["scenario_token"]
        assert attributes.agent == sample["agent"]
        assert attributes.time_to_end == f"{(35 - int(token[-3:])) / 10:.1f}"

        bins = (NO_IMPACT, NO_IMPACT)
        if scenario["collision"]:
            tenths = round(10 * (sample["time_to_impact"] or 0))
            bins = (f"{math.ceil(tenths / 10)} s", f"{math.ceil(tenths / 5) / 2:g} s")
        assert (attributes.time_to_impact, attributes.impact_step) == bins
        visibility = visibilities[accident_visible(da_motion, token)]
        assert attributes.accident_visibility == visibility

        assert attributes.value("agent") == sample["agent"]
        assert attributes.value("all") == "all"
        assert attributes.value("town") == scenario["town"]
        assert attributes.value("Weather") == scenario["weather"]

    within = ("accident_visibility", "time_to_impact", "impact_step", "time_to_end")
    assert (ATTRIBUTES[0], ATTRIBUTES[-5:]) == ("all", ("agent", *within))
    assert {*WITHIN_RECORDINGS} == {*within}

    evaluated_attributes = {token: attributes_by_token[token] for token in evaluated}
    for name in ATTRIBUTES:
        groups = tokens_by_value(evaluated_attributes, name).values()
        assert sum(map(len, groups)) == len(evaluated)

    tokens_by_time = tokens_by_value(evaluated_attributes, "time_to_impact")
    sizes = {value: len(tokens) for value, tokens in tokens_by_time.items()}
    assert sizes == {"2 s": 10, "1 s": 10}


def test_without_a_meta_file_times_to_impact_are_unknown(
    da_motion: DeepAccident, monkeypatch: pytest.MonkeyPatch
) -> None:
    unknown = [scenario for scenario in da_motion.scenario if scenario["collision"] is None]
    record = dict(unknown[0])
    for name, value in record.items():
        if name != "token" and not isinstance(value, int):
            record[name] = None

    monkeypatch.setattr(type(da_motion), "scenario", {record["token"]: record}, raising=False)

    token = f"{record['token']}/ego_vehicle/010"
    (attributes,) = sample_attributes(da_motion, [token]).values()
    assert attributes.time_to_impact is None
    assert attributes.impact_step is None
    assert attributes.value("collision_status") is None
