"""Results by attribute, of any evaluator, with intervals over scenarios."""

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any

import pytest
from generated_bundles import motion_counts

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, ConfigError, EvaluationError
from deepaccident_devkit.evaluation.breakdowns import (
    NO_IMPACT,
    SampleAttributes,
    breakdown,
    cluster_of,
    sample_attributes,
)
from deepaccident_devkit.evaluation.evaluator import Counts, Evaluator, ratio, total
from deepaccident_devkit.evaluation.intervals import Resampling
from deepaccident_devkit.evaluation.motion import MotionEvaluator
from deepaccident_devkit.evaluation.predictions import instances_of
from deepaccident_devkit.taxonomy import AGENTS, INFRASTRUCTURE

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


@dataclass(frozen=True)
class Share:
    hits: int
    share: float
    unknown: float | None = None


class Shares(Evaluator[Share]):
    """The share of hits."""

    @property
    def settings(self) -> dict[str, Any]:
        return {}

    def update(self, token: str, *arguments: Any) -> None:
        self.add(token, {"hit": arguments[0]})

    def result_of(self, counts: Collection[Counts]) -> Share:
        hits = total(counts, "hit")
        return Share(hits=int(hits), share=ratio(hits, len(counts)))


class PooledShares(Shares):
    """The same from sums."""

    def pooled(self, counts: Collection[Counts]) -> list[Counts]:
        return [{"hit": total(counts, "hit"), "samples": sum(each.get("samples", 1) for each in counts)}]

    def result_of(self, counts: Collection[Counts]) -> Share:
        hits, samples = total(counts, "hit"), sum(each.get("samples", 1) for each in counts)
        return Share(hits=int(hits), share=ratio(hits, samples))


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


def filled(numbers: range = range(100), kind: type[Shares] = Shares) -> Shares:
    evaluator = kind()
    for number in numbers:
        evaluator.add(f"{number:03d}", {"hit": float(number % 7 == 0 or number // 10 == 3)})
    return evaluator


MANY = {f"{number:03d}": attributes_of(number) for number in range(100)}


def test_groups_are_the_results_of_their_samples() -> None:
    evaluator = filled()
    found = breakdown(evaluator, MANY, "town")
    assert [group.value for group in found.groups] == ["Town00", "Town01", "Town02"]
    for index, group in enumerate(found.groups):
        tokens = [token for token in MANY if int(token) // 10 % 3 == index]
        assert group.result == evaluator.compute(tokens)
        assert (group.samples, group.scenarios) == (len(tokens), len(tokens) // 10)
        assert group.intervals == {}
        count = len(tokens) // 10
        text = f"no intervals: of {count} clusters (an accident and its twin are one); at least 6 are needed"
        assert group.notes == (text,)
    assert sum(group.result.hits for group in found.groups) == evaluator.compute().hits


def test_everything_is_a_breakdown_too() -> None:
    (group,) = breakdown(filled(), MANY, "all").groups
    assert (group.value, group.samples, group.scenarios) == ("all", 100, 10)
    assert group.result == filled().compute()
    low, high = group.intervals["share"]
    assert 0 < low < group.result.share < high < 1
    assert (set(group.intervals), group.notes) == ({"share"}, ())


def test_times_are_in_order_and_what_is_unknown_comes_last() -> None:
    changed = {"time_to_impact": None, "impact_step": NO_IMPACT}
    attributes = MANY | {token: attributes_of(int(token), **changed) for token in ("000", "013")}
    by_second = breakdown(filled(), attributes, "time_to_impact", Resampling(resamples=0))
    assert [group.value for group in by_second.groups] == ["0 s", "1 s", "2 s", "3 s", "4 s", None]
    by_step = breakdown(filled(), attributes, "impact_step", Resampling(resamples=0))
    values = [group.value for group in by_step.groups]
    assert values == ["0 s", "0.5 s", "1 s", "1.5 s", "2 s", "2.5 s", "3 s", "3.5 s", "4 s", "4.5 s", NO_IMPACT]
    assert by_step.groups[-1].samples == 2
    assert not by_step.groups[0].intervals


@pytest.mark.parametrize(
    ("scenario", "cluster"),
    [
        ("type1_subtype1_accident/Town03_1", "type1_subtype1/Town03_1"),
        ("type1_subtype1_normal/Town03_1", "type1_subtype1/Town03_1"),
        ("other/Town03_1", "other/Town03_1"),
        ("other", "other"),
    ],
)
def test_a_cluster_has_no_ending(scenario: str, cluster: str) -> None:
    assert cluster_of(scenario) == cluster


def test_the_pole_is_left_out_beside() -> None:
    poles = {token: replace(each, agent=INFRASTRUCTURE) for token, each in MANY.items() if int(token) % 10 < 4}
    found = breakdown(filled(), MANY | poles, "town", Resampling(resamples=0))
    assert [group.samples for group in found.groups] == [40, 30, 30]
    assert [group.samples for group in found.without_infrastructure] == [24, 18, 18]
    by_agent = breakdown(filled(), MANY | poles, "agent", Resampling(resamples=0))
    assert [group.value for group in by_agent.groups] == ["ego_vehicle", INFRASTRUCTURE]
    assert [group.value for group in by_agent.without_infrastructure] == ["ego_vehicle"]


def test_agents_are_in_their_usual_order() -> None:
    attributes = {token: replace(each, agent=AGENTS[int(token) % 5]) for token, each in MANY.items()}
    found = breakdown(filled(), attributes, "agent", Resampling(resamples=0))
    assert [group.value for group in found.groups] == list(AGENTS) != sorted(AGENTS)


@pytest.mark.parametrize("kind", [Shares, PooledShares])
def test_no_order_makes_a_difference(kind: type[Shares]) -> None:
    expected = breakdown(filled(kind=kind), MANY, "town")
    backwards = dict(reversed(list(MANY.items())))
    assert breakdown(filled(range(99, -1, -1), kind), backwards, "town") == expected
    parts = filled(range(50, 100), kind).merge(filled(range(60), kind))
    assert breakdown(parts, backwards, "town") == expected
    assert [group.intervals for group in expected.groups] == [
        group.intervals for group in breakdown(filled(), MANY, "town").groups
    ]


def test_an_accident_and_its_twin_are_one_cluster() -> None:
    """Twins that are equal tell nothing new: the interval is that of the accidents alone."""
    accidents, both = Shares(), Shares()
    attributes = {}
    for number in range(80):
        for kind in ("accident", "normal"):
            token = f"{number:03d} {kind}"
            story = f"type1_subtype1_{kind}/Town03_{number // 10}"
            attributes[token] = attributes_of(number, scenario=story)
            for evaluator in (accidents, both) if kind == "accident" else (both,):
                evaluator.add(token, {"hit": float(number // 10 % 2)})
    [one], [two] = (breakdown(each, attributes, "all").groups for each in (accidents, both))
    assert (two.scenarios, two.clusters, one.scenarios, one.clusters) == (16, 8, 8, 8)
    assert two.intervals["share"] == pytest.approx(one.intervals["share"])


def test_a_percentage_that_is_always_100_is_not_sure() -> None:
    evaluator = MotionEvaluator()
    for number in range(120):
        evaluator.add(f"{number:03d}", motion_counts(found=50, missed=0))
    attributes = {token: attributes_of(int(token)) for token in evaluator.tokens}
    (group,) = breakdown(evaluator, attributes, "all").groups
    low, high = group.intervals["ranges/30x30/iou"]
    assert 60 < low < 80
    assert high == group.result.ranges["30x30"].iou == 100
    assert "min_ade" not in group.intervals  # NaN


def test_what_cannot_be_broken_down() -> None:
    for error, words, refused in (
        (
            EvaluationError,
            "1 samples have no attributes, such as 099",
            lambda: breakdown(filled(), dict(list(MANY.items())[:-1]), "town"),
        ),
        (EvaluationError, "100 samples have no attributes, such as 000", lambda: breakdown(filled(), {}, "town")),
        (ChoiceError, r"by: expected one of .*town, .* found 'moon'", lambda: breakdown(filled(), MANY, "moon")),
        (ConfigError, "resamples: expected a whole number from 0", lambda: Resampling(resamples=-1)),
        (ConfigError, "confidence: expected a share between 0 and 1", lambda: Resampling(confidence=95)),
    ):
        with pytest.raises(error, match=words):
            refused()


def test_a_breakdown_of_motion_metrics(da_motion: DeepAccident) -> None:
    evaluator = MotionEvaluator(trajectories=False)
    tokens = [
        f"{record['token']}/{agent}/030" for record in da_motion.scenario for agent in ("ego_vehicle", INFRASTRUCTURE)
    ]
    for token in tokens:
        label = da_motion.motion_labels(token)
        evaluator.update(token, instances_of(label.to_present().instance, label.config.grid), label)
    found = breakdown(evaluator, sample_attributes(da_motion, tokens), "collision_status")
    assert [(group.value, group.samples) for group in found.groups] == [
        ("collides_between_vehicles", 2),
        ("no_collision", 2),
    ]
    assert [group.samples for group in found.without_infrastructure] == [1, 1]
    (everything,) = breakdown(evaluator, sample_attributes(da_motion, tokens), "all").groups
    assert (everything.clusters, dict(everything.intervals)) == (1, {})
