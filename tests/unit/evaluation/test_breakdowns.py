"""The attributes of samples, and results by them, of any evaluator, with intervals over
scenarios.
"""

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import Any

import pytest
from evaluating import Ratios
from refusals import assert_refused

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


class PooledRatios(Ratios):
    """The same from sums."""

    def pooled(self, counts: Collection[Counts]) -> list[Counts]:
        return [{name: total(counts, name) for name in ("above", "below")}]


def attributes_of(number: int, **changes: Any) -> SampleAttributes:
    """Of a sample of scenario `number // 10`."""
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


def filled(numbers: range = range(100), kind: type[Ratios] = Ratios) -> Ratios:
    evaluator = kind()
    for number in numbers:
        evaluator.add(
            f"{number:03d}", {"above": float(number % 7 == 0 or number // 10 == 3), "below": 1.0}
        )
    return evaluator


MANY = {f"{number:03d}": attributes_of(number) for number in range(100)}


ALL_AT_ONCE = Resampling(resamples=0)


def shown(groups: Sequence[Any]) -> dict[Any, int]:
    return {group.value: group.samples for group in groups}


def test_groups_are_the_results_of_their_samples() -> None:
    evaluator = filled()
    found = breakdown(evaluator, MANY, "town")
    assert (found.by, found.resampling) == ("town", Resampling())
    assert [group.value for group in found.groups] == ["Town00", "Town01", "Town02"]
    for index, group in enumerate(found.groups):
        tokens = [token for token in MANY if int(token) // 10 % 3 == index]
        count = len(tokens) // 10
        text = (
            f"no intervals: of {count} clusters (an accident and its twin are "
            f"one); at least 6 are needed"
        )
        assert group.result == evaluator.compute(tokens)
        assert (group.samples, group.scenarios, group.clusters) == (len(tokens), count, count)
        assert (group.intervals, group.notes) == ({}, (text,))


def test_everything_is_a_breakdown_too() -> None:
    (group,) = breakdown(filled(), MANY, "all").groups
    assert (group.value, group.samples, group.scenarios) == ("all", 100, 10)
    assert group.result == filled().compute()
    low, high = group.intervals["ratio"]
    assert 0 < low < group.result.ratio < high < 1
    assert (set(group.intervals), group.notes) == ({"ratio"}, ())


def changed(some: Callable[[int], bool], **changes: Any) -> dict[str, SampleAttributes]:
    return {
        token: replace(each, **changes) if some(int(token)) else each
        for token, each in MANY.items()
    }


FIRST_TWO = changed(lambda number: number in (0, 13), time_to_impact=None, impact_step=NO_IMPACT)
POLES = changed(lambda number: number % 10 < 4, agent=INFRASTRUCTURE)
AGENT_EACH = {token: replace(each, agent=AGENTS[int(token) % 5]) for token, each in MANY.items()}


@pytest.mark.parametrize(
    ("attributes", "by", "groups", "without"),
    [
        (
            FIRST_TWO,
            "time_to_impact",
            {"0 s": 19, "1 s": 19, **dict.fromkeys(("2 s", "3 s", "4 s"), 20), None: 2},
            None,
        ),
        (
            FIRST_TWO,
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
            POLES,
            "town",
            {"Town00": 40, "Town01": 30, "Town02": 30},
            {"Town00": 24, "Town01": 18, "Town02": 18},
        ),
        (POLES, "agent", {"ego_vehicle": 60, INFRASTRUCTURE: 40}, {"ego_vehicle": 60}),
        (
            AGENT_EACH,
            "agent",
            dict.fromkeys(AGENTS, 20),
            dict.fromkeys(AGENTS[:-1], 20),
        ),  # in their usual order
    ],
)
def test_groups_are_in_order_and_the_pole_is_left_out_beside(
    attributes, by, groups, without
) -> None:
    """What is unknown comes last."""
    found = breakdown(filled(), attributes, by, ALL_AT_ONCE)
    assert list(shown(found.groups).items()) == list(groups.items())
    assert list(shown(found.without_infrastructure).items()) == list((without or groups).items())
    assert {len(group.intervals) for group in found.groups} == {0}


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


@pytest.mark.parametrize("kind", [Ratios, PooledRatios])
def test_no_order_makes_a_difference(kind: type[Ratios]) -> None:
    expected = breakdown(filled(kind=kind), MANY, "town")
    backwards = dict(reversed(list(MANY.items())))
    assert breakdown(filled(range(99, -1, -1), kind), backwards, "town") == expected
    parts = filled(range(50, 100), kind).merge(filled(range(60), kind))
    assert breakdown(parts, backwards, "town") == expected
    assert expected.groups == breakdown(filled(), MANY, "town").groups


def test_an_accident_and_its_twin_are_one_cluster() -> None:
    """Twins that are equal tell nothing new: the interval is that of the accidents alone."""
    accidents, both, attributes = Ratios(), Ratios(), {}
    for number in range(80):
        for kind in ("accident", "normal"):
            token, story = f"{number:03d} {kind}", f"type1_subtype1_{kind}/Town03_{number // 10}"
            attributes[token] = attributes_of(number, scenario=story)
            for evaluator in (accidents, both) if kind == "accident" else (both,):
                evaluator.add(token, {"above": float(number // 10 % 2), "below": 1.0})
    [one], [two] = (breakdown(each, attributes, "all").groups for each in (accidents, both))
    assert (two.scenarios, two.clusters, one.scenarios, one.clusters) == (16, 8, 8, 8)
    assert two.intervals["ratio"] == pytest.approx(one.intervals["ratio"])


def test_what_cannot_be_broken_down() -> None:
    few = dict(list(MANY.items())[:-1])
    assert_refused(
        (
            lambda: breakdown(filled(), few, "town"),
            EvaluationError,
            ("1 samples", "such as 099", "sample_attributes"),
        ),
        (lambda: breakdown(filled(), {}, "town"), EvaluationError, ("100 samples", "such as 000")),
        (
            lambda: breakdown(filled(), MANY, "moon"),
            ChoiceError,
            ("by: expected one of", "town", "'moon'"),
        ),
        (lambda: MANY["000"].value("moon"), ChoiceError, ("by: expected one of", "'moon'")),
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
    """Of two recordings of 3.5 s: every tenth of a second of one agent, and the samples that are
    evaluated.
    """
    evaluated = da_motion.samples("train", "evaluate")
    tokens = [sample["token"] for sample in da_motion.sample if sample["agent"] == AGENTS[-1]]
    attributes = sample_attributes(da_motion, [*evaluated, *tokens])
    assert list(attributes) == list(dict.fromkeys([*evaluated, *tokens]))
    words = {True: "visible", False: "invisible", None: None}
    for token, each in attributes.items():
        sample = da_motion.sample.get(token)
        scenario = da_motion.scenario.get(sample["scenario_token"])
        tenths = round(10 * (sample["time_to_impact"] or 0))
        bins = f"{math.ceil(tenths / 10)} s", f"{math.ceil(tenths / 5) / 2:g} s"
        assert (each.scenario, each.agent, each.time_to_end) == (
            sample["scenario_token"],
            sample["agent"],
            f"{(35 - int(token[-3:])) / 10:.1f}",
        )
        assert (each.time_to_impact, each.impact_step) == (
            bins if scenario["collision"] else (NO_IMPACT, NO_IMPACT)
        )
        assert each.accident_visibility == words[accident_visible(da_motion, token)]
        assert [each.value(name) for name in ("agent", "all", "town", "Weather")] == [
            sample["agent"],
            "all",
            scenario["town"],
            scenario["weather"],
        ]
    within = ("accident_visibility", "time_to_impact", "impact_step", "time_to_end")
    assert (ATTRIBUTES[0], ATTRIBUTES[-5:], {*WITHIN_RECORDINGS}) == (
        "all",
        ("agent", *within),
        {*within},
    )
    chosen = {token: attributes[token] for token in evaluated}
    by_value = {name: tokens_by_value(chosen, name) for name in ATTRIBUTES}
    assert {sum(map(len, each.values())) for each in by_value.values()} == {len(evaluated)}
    assert {value: len(each) for value, each in by_value["time_to_impact"].items()} == {
        "2 s": 10,
        "1 s": 10,
    }


def test_without_meta_it_is_not_known_whether_there_is_an_impact(
    da_motion: DeepAccident, monkeypatch: pytest.MonkeyPatch
) -> None:
    [record, *_] = [each for each in da_motion.scenario if each["collision"] is None]
    token = f"{record['token']}/ego_vehicle/010"
    unknown = {
        name: None
        for name, value in record.items()
        if name != "token" and not isinstance(value, int)
    }
    monkeypatch.setattr(
        type(da_motion), "scenario", {record["token"]: record | unknown}, raising=False
    )
    [each] = sample_attributes(da_motion, [token]).values()
    assert (each.time_to_impact, each.impact_step, each.value("collision_status")) == (
        None,
        None,
        None,
    )
