"""Prevented accidents of recordings made by hand, whose ends are known for each frame of the first
alarm.
"""

import math
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluation_runs import evaluation_run
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.collisions import (
    BRAKINGS,
    OUTCOMES,
    Skipped,
    accident_of,
    outcomes,
    outcomes_of,
)
from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation import (
    Accident,
    MotionEvaluator,
    Resampling,
    WarningEvaluator,
    accident_context,
)
from deepaccident_devkit.evaluation.intervals import numbers_of
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.evaluation.warning import CleanWarnings, anticipation
from deepaccident_devkit.plugins.safety.prevention import (
    PREVENTED,
    PreventedEvaluator,
    accident_outcomes,
    prevented_accidents,
    prevention_tables,
    with_prevented,
)
from deepaccident_devkit.plugins.safety.prevention_result import (
    NOMINAL,
    SETTINGS,
    AccidentOutcomes,
    OutcomeTable,
    PreventedResult,
)

FRAMES = np.arange(1, 62, 5)
IMPACT = 61
AVOIDED, MITIGATED, UNCHANGED = (
    OUTCOMES.index(name) for name in ("avoided", "mitigated", "unchanged")
)
GROUP = "ego_involved"
Scores = Sequence[float | None]
"""A score a frame of `FRAMES`; None for no alarm."""


@pytest.fixture(scope="module", autouse=True)
def _few_draws() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(anticipation, "RANDOM_DRAWS", 2)
        yield


def end_of(frame: float, reaction: float, deceleration: float, latency: float = 0.0) -> int:
    """What becomes of an accident: who brakes early and hard enough stops in time."""
    left = (IMPACT - frame) / 10 - reaction - latency
    return (
        AVOIDED
        if left >= 12 / deceleration
        else MITIGATED
        if left >= 6 / deceleration
        else UNCHANGED
    )


def table(latencies: tuple[float, ...] = (0.0,), *, pedestrian: bool = False) -> OutcomeTable:
    ends = [
        [
            [end_of(frame, each.reaction, each.deceleration, late) for each in BRAKINGS]
            for frame in FRAMES
        ]
        + [[UNCHANGED] * len(BRAKINGS)]
        for late in latencies
    ]
    outcome = np.array(ends, dtype=np.int8)
    return OutcomeTable(
        frame=FRAMES,
        outcome=outcome,
        extrapolated=outcome == MITIGATED,
        latencies=latencies,
        pedestrian=pedestrian,
    )


def counts(
    recording: str, frame: int, score: float | None, *, crash: bool, right: bool = True, **more: Any
) -> Any:
    """What `sample_counts` says of a sample."""
    return {
        "recording": recording,
        "frame": frame,
        "kind": "accident" if crash else "twins",
        "involvement": GROUP,
        "ahead": IMPACT - frame if crash else None,
        "to_end": IMPACT - frame,
        "alarms": [] if score is None else [[score, int(crash and right)]],
        "unjudged": [],
        "beyond": 0,
        "references": [[None, None], [None, None]],
        **more,
    }


def evaluated(
    accidents: Sequence[Scores],
    normal: Sequence[Scores],
    outcomes: AccidentOutcomes | None = None,
    agent: str = "ego_vehicle",
    threshold: float | None = None,
    **more: Any,
) -> PreventedEvaluator:
    """Recordings of 6 s, two samples a second, each accident with the same table unless told
    otherwise.
    """
    numbers = range(max(len(accidents), len(normal)))
    names = [f"type1_subtype1_accident/s{number}/{agent}" for number in numbers]
    tables = dict.fromkeys(names[: len(accidents)], table())
    rules = more.pop("rules", None) or CleanWarnings(threshold=threshold)
    made = PreventedEvaluator(outcomes or AccidentOutcomes(tables=tables), rules)
    for crash, recordings in ((True, accidents), (False, normal)):
        for accident, scores in zip(names, recordings, strict=False):
            name = accident if crash else accident.replace("accident", "normal")
            for frame, score in zip(FRAMES.tolist(), scores, strict=False):
                made.add(f"{name}/{frame:03d}", counts(name, frame, score, crash=crash, **more))
    return made


def shares(
    result: PreventedResult, setting: str = NOMINAL, alarms: str = "right"
) -> dict[str, float]:
    return dict(getattr(result.groups[GROUP], alarms)[0.0][setting].shares)


def alarm_from(frame: int, score: float = 0.9) -> Scores:
    """No alarm, and from a frame on one."""
    return [score if each >= frame else None for each in FRAMES]


def test_ends_that_are_known() -> None:
    """At 1 s and 6 m/s² 3 s before the impact is enough, 2 s mitigates, 1.5 s does nothing; an
    alarm at it is none.
    """
    accidents = [alarm_from(31), alarm_from(41), alarm_from(46), alarm_from(IMPACT)]
    result = evaluated(accidents, [[]], threshold=0.5).compute()
    figures = result.groups[GROUP].right[0.0][NOMINAL]
    assert figures.counts == {
        "avoided": 1,
        "stopped": 0,
        "mitigated": 1,
        "unchanged": 2,
        "worsened": 0,
    }
    assert figures.shares == {
        "avoided": 0.25,
        "stopped": 0.0,
        "mitigated": 0.25,
        "unchanged": 0.5,
        "worsened": 0.0,
    }
    assert (figures.warned, figures.extrapolated, result.avoided(GROUP)) == (0.75, 0.25, 0.25)
    for setting, braking in zip(SETTINGS, BRAKINGS, strict=True):
        expected = [
            end_of(frame, braking.reaction, braking.deceleration)
            for frame in (31, 41, 46, math.inf)
        ]
        assert shares(result, setting) == {
            name: expected.count(code) / 4 for code, name in enumerate(OUTCOMES)
        }


def test_the_cost_is_of_normal_recordings_alone() -> None:
    """Six seconds each, cut at the twin's impact: two alarms of 1 s and one of 2 s in 12 s."""
    flicker: Scores = [0.9, 0.9, None, 0.9, 0.9, None] + [None] * 7
    result = evaluated(
        [alarm_from(1)] * 2, [flicker, [None] * 8 + [0.9] * 5], threshold=0.5
    ).compute()
    cost = {
        name: each.braking_seconds_per_minute
        for name, each in result.groups[GROUP].right[0.0].items()
    }
    seconds = {"0.5 s, 4 m/s²": 0.5 + 0.5 + 1.5, NOMINAL: 1.0, "1.5 s, 8 m/s²": 0.5}
    assert result.groups[GROUP].minutes == pytest.approx(0.2)
    assert {name: cost[name] for name in seconds} == pytest.approx(
        {name: 5 * each for name, each in seconds.items()}
    )


def random_scores(seed: int, many: int = 5) -> list[Scores]:
    source = np.random.default_rng(seed)
    return [
        [round(each, 1) if each > 0.2 else None for each in source.random(13).tolist()]
        for _ in range(many)
    ]


@settings(max_examples=6)
@given(st.integers(0, 10_000))
def test_a_siren_prevents_and_costs_the_most_and_silence_nothing(seed: int) -> None:
    result = evaluated(random_scores(seed), random_scores(seed + 1), threshold=0.6).compute()
    groups = (
        result.references["always"][GROUP],
        result.groups[GROUP],
        result.references["never"][GROUP],
    )
    for setting in SETTINGS:
        figures = [each.right[0.0][setting] for each in groups]
        avoided = [each.shares["avoided"] for each in figures]
        cost = [each.braking_seconds_per_minute for each in figures]
        assert (avoided, cost) == (sorted(avoided, reverse=True), sorted(cost, reverse=True))
        assert (avoided[-1], cost[-1], figures[-1].shares["unchanged"]) == (0, 0, 1)


@settings(max_examples=6)
@given(st.integers(0, 10_000))
def test_a_higher_threshold_never_prevents_or_costs_more(seed: int) -> None:
    curve = evaluated(random_scores(seed), random_scores(seed + 1)).compute().curves[GROUP]
    assert (curve.threshold[0], curve.braking_seconds_per_minute[0].max()) == (math.inf, 0)
    assert (np.diff(curve.threshold) < 0).all()
    growing = [curve.avoided, curve.avoided + curve.mitigated, curve.braking_seconds_per_minute]
    assert (np.diff(growing, axis=1) > -1e-12).all()


@settings(max_examples=6)
@given(st.integers(0, 10_000))
def test_without_a_threshold_it_is_the_lowest_within_the_budget(seed: int) -> None:
    result = evaluated(random_scores(seed, 2), random_scores(seed + 1, 8)).compute()
    figures, curve = result.groups[GROUP], result.curves[GROUP]
    cost = curve.braking_seconds_per_minute[:, SETTINGS.index(NOMINAL)]
    assert figures.threshold == figures.quiet_braking == curve.threshold[cost <= 1.0].min()


def test_order_and_parts_change_no_bit() -> None:
    whole = evaluated(random_scores(1), random_scores(2))
    told = str(whole.compute().as_dict())
    tokens = sorted(whole.tokens, key=lambda token: token[::-1])
    for chosen in (tokens, tokens[::-1]):
        parts = whole.fresh(), whole.fresh()
        for number, token in enumerate(chosen):
            parts[number % 2].add(token, whole.counts[token])
        assert str(parts[0].merge(parts[1]).compute().as_dict()) == told


def test_draws_count_as_often_as_they_say() -> None:
    whole = evaluated(random_scores(3, 3), random_scores(4, 3), threshold=0.6)
    parts = [
        [each for token, each in whole.counts.items() if f"/s{number}/" in token]
        for number in range(3)
    ]
    once, twice = whole.resampled(parts, np.array([[1, 1, 1], [0, 2, 1]]))
    assert numbers_of(once) == numbers_of(
        whole.result_of([each for part in parts for each in part])
    )
    assert (once.references, once.curves, twice.groups[GROUP].accidents) == ({}, {}, 3)
    _, one, other = (shares(whole.result_of(part)) for part in parts)
    assert shares(twice) == pytest.approx(
        {name: (2 * one[name] + other[name]) / 3 for name in OUTCOMES}
    )


def test_any_alarm_warns_too_and_alone_where_nobody_is_named() -> None:
    """An alarm that is not right prevents nothing, unless the predictor names nobody."""
    how: dict[str, Any] = {"accidents": [alarm_from(1)], "normal": [[None] * 13], "right": False}
    named = evaluated(threshold=0.5, **how).compute()
    nobody = evaluated(rules=CleanWarnings(threshold=0.5, scores_of="recording"), **how).compute()
    assert [(each.alarms, each.avoided(GROUP)) for each in (named, nobody)] == [
        ("right", 0),
        ("any_alarm", 1),
    ]
    assert (shares(named)["avoided"], shares(named, alarms="any_alarm")["avoided"]) == (0, 1)
    assert shares(nobody, alarms="lasting")["avoided"] == 1


def test_alarms_that_flicker_prevent_for_free_unless_they_must_last() -> None:
    flicker: Scores = [0.9, 0.9, None] * 4 + [None]
    result = evaluated([flicker] * 3, [flicker] * 3, threshold=0.5).compute()
    assert result.groups[GROUP].right[0.0][NOMINAL].braking_seconds_per_minute == 0
    assert (shares(result)["avoided"], shares(result, alarms="lasting")["avoided"]) == (1, 0)
    assert shares(result, "0.5 s, 6 m/s²", "lasting")["avoided"] == 1
    chance = result.references["random per frame, quiet"][GROUP]
    assert (
        chance.right[0.0][NOMINAL].shares["avoided"]
        > chance.lasting[0.0][NOMINAL].shares["avoided"]
    )


def test_a_latency_is_less_time_to_brake() -> None:
    outcomes = AccidentOutcomes(
        tables={"type1_subtype1_accident/s0/infrastructure": table((0.0, 0.1, 0.3))}
    )
    result = evaluated([alarm_from(31)], [[None] * 13], outcomes, "infrastructure", 0.5).compute()
    found = {
        latency: settings[NOMINAL].shares["avoided"]
        for latency, settings in result.groups[GROUP].right.items()
    }
    assert found == {0.0: 1, 0.1: 0, 0.3: 0}


def test_accidents_without_a_table_are_left_out_and_named() -> None:
    kind = "type1_subtype1_accident"
    outcomes = AccidentOutcomes(
        tables={f"{kind}/s1/ego_vehicle": table()},
        dropped=(Skipped(scenario=f"{kind}/s0", reason="2 m apart"),),
        skipped=(Skipped(scenario=f"{kind}/s2", reason="no labels"),),
    )
    result = evaluated([alarm_from(1)] * 3, [[None] * 13], outcomes, threshold=0.5).compute()
    assert result.groups[GROUP].accidents == 1
    assert result.as_dict()["dropped"] == [{"scenario": f"{kind}/s0", "reason": "2 m apart"}]


def test_pedestrians_are_apart_with_the_same_normal_recordings() -> None:
    names = [f"type1_subtype1_accident/s{number}/ego_vehicle" for number in range(3)]
    outcomes = AccidentOutcomes(tables={name: table(pedestrian=name == names[0]) for name in names})
    scores = [alarm_from(1), alarm_from(41), alarm_from(61)]
    result = evaluated(scores, [[None] * 13] * 3, outcomes, threshold=0.5).compute()
    found = {
        name: (each.accidents, each.recordings, result.avoided(name))
        for name, each in result.groups.items()
    }
    assert found == {GROUP: (2, 3, 0), f"{GROUP}, pedestrian": (1, 3, 1)}


def test_nothing_to_count_is_no_number() -> None:
    result = evaluated([], [alarm_from(1)], threshold=0.5).compute()
    figures = result.groups[GROUP].right[0.0][NOMINAL]
    assert all(
        math.isnan(each)
        for each in (figures.warned, figures.extrapolated, *figures.shares.values())
    )
    assert figures.braking_seconds_per_minute == pytest.approx(5.0 * 10)
    result = evaluated([alarm_from(1)], [], threshold=0.5).compute()
    assert shares(result)["avoided"] == 1
    assert math.isnan(result.groups[GROUP].right[0.0][NOMINAL].braking_seconds_per_minute)
    result = evaluated([alarm_from(1)], []).compute()
    assert np.isnan([result.groups[GROUP].threshold, result.avoided(GROUP)]).all()
    assert evaluated([], []).compute().groups == {}


def test_what_does_not_fit_is_refused(da_motion: DeepAccident) -> None:
    whole = table()
    shape = "expected shape (1, 14, 9)"
    assert_refused(
        (
            lambda: PreventedEvaluator(AccidentOutcomes(), "field"),
            EvaluationError,
            ("protocol clean", "FieldWarnings"),
        ),
        *(
            (
                lambda evaluator=each: prevented_accidents(da_motion, evaluator),
                EvaluationError,
                ("warnings", "clean"),
            )
            for each in (WarningEvaluator("field"), MotionEvaluator())
        ),
        *(
            (lambda change=change: replace(whole, **change), EvaluationError, named)
            for change, named in (
                ({"outcome": whole.outcome[:, 1:]}, ("outcome", shape, "found (1, 13, 9)")),
                ({"extrapolated": whole.extrapolated[..., 0]}, ("extrapolated", shape)),
                ({"outcome": whole.outcome + 3}, ("OUTCOMES, 0 to 4",)),
                ({"frame": whole.frame[::-1]}, ("ascending frame numbers",)),
            )
        ),
    )


EVERYONE = ("ego_vehicle", "other_vehicle_behind", "infrastructure")


@pytest.fixture(scope="module")
def crash(da_motion: DeepAccident) -> str:
    (token,) = (each["token"] for each in da_motion.scenario if each["collision"] is not None)
    return token


def foreseen(
    dataset: DeepAccident, agents: Sequence[str], frames: Sequence[int], crash: str
) -> WarningEvaluator:
    """The true accident is foreseen from a frame on, surer and surer; in the twin something at its
    first frame.
    """
    evaluator = WarningEvaluator()
    for token in (each for each in dataset.samples("train", "all") if each.split("/")[2] in agents):
        context, frame, alarms = accident_context(dataset, token, 10.0), int(token[-3:]), []
        impact = context.truth and context.truth.impact
        if impact is not None and frame >= min(frames):
            score = 0.3 if frame < max(frames) else 0.9
            alarms = [
                Accident(positions=impact.positions, time=impact.time, ids=impact.ids, score=score)
            ]
        elif not token.startswith(crash) and frame == 1:
            alarms = [Accident(positions=np.ones((2, 2)), time=0.5, score=0.3)]
        evaluator.update(token, alarms, None, context)
    return evaluator


def own_brakes(accident: Any) -> tuple[bool, ...]:
    """The ego alone."""
    return tuple(agent == "ego_vehicle" for agent in accident.agents)


def test_tables_are_what_braking_makes_of_the_accident(da_motion: DeepAccident, crash: str) -> None:
    """Agents of the pair brake alone and at once; others warn both, after a latency."""
    accident, frames = accident_of(da_motion, crash), (1, 11, 21, 31)
    made = accident_outcomes(da_motion, {crash: dict.fromkeys(EVERYONE, frames)}, workers=1)
    assert (made.dropped, made.skipped) == ((), ())
    times = [*((frame - accident.first_frame) * 0.1 for frame in frames), math.nan]
    ego, behind, pole = (made.tables[f"{crash}/{agent}"] for agent in EVERYONE)
    own = outcomes_of(accident, own_brakes(accident), times)
    both = [
        outcomes_of(accident, (True, True), times, latency=latency).outcome
        for latency in pole.latencies
    ]
    assert (ego.latencies, pole.latencies) == ((0.0,), (0.0, 0.1, 0.3))
    np.testing.assert_array_equal(
        [ego.outcome, ego.extrapolated], [[own.outcome], [own.extrapolated]]
    )
    assert ego.outcome[0, -1].tolist() == [OUTCOMES.index("unchanged")] * len(BRAKINGS)
    np.testing.assert_array_equal([pole.outcome, behind.outcome], [both, both])


def test_the_tables_say_what_the_result_does(da_motion: DeepAccident, crash: str) -> None:
    result = prevented_accidents(
        da_motion, foreseen(da_motion, EVERYONE, (11, 21), crash), workers=1
    )
    told = {**result.as_dict(), "intervals": {}}
    tables = prevention_tables(told)
    assert [row[0] for row in tables[1].rows] == ["ego_involved, given", *SETTINGS]
    group = result.groups["ego_involved"]
    cells = [
        *group.right[0.0][NOMINAL].shares.values(),
        group.lasting[0.0][NOMINAL].shares["avoided"],
    ]
    assert [float(each) for each in tables[0].rows[1][1:7]] == pytest.approx(cells, abs=5e-4)
    assert PREVENTED.text(told).endswith("--threshold-from BUNDLE --threshold-by braking")


def test_intervals_leave_out_an_accident_and_its_twin(da_motion: DeepAccident) -> None:
    tokens = [
        each for each in da_motion.samples("train", "all") if each.split("/")[2] == "ego_vehicle"
    ]
    run = evaluation_run(da_motion, EvaluationSetup(task="warning", protocol="clean"), tokens)
    made = with_prevented(run, da_motion, Resampling(resamples=7))
    (group,), summary = made.prevented.groups, made.summary()["prevented"]
    assert (group.clusters, made.prevented.resampling.resamples) == (1, 7)
    assert summary["interval_notes"] == list(group.notes)
    assert "prevented" not in run.summary()


def test_scenarios_that_cannot_be_judged_are_named(
    own_release: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One has no meta file, one no collision, and of one the boxes are taken to be too far
    apart.
    """
    monkeypatch.setattr(outcomes, "MOST_MARGIN", -1.0)
    bare = DeepAccident("v1", own_release, verbose=False).find(collision=True)[0]
    (own_release / bare["folder"] / bare["scenario_type"] / "meta" / f"{bare['name']}.txt").unlink()
    shutil.rmtree(own_release / ".deepaccident")
    dataset = DeepAccident("v1", own_release, verbose=False)
    far, normal = (dataset.find(collision=ends)[0]["token"] for ends in (True, False))
    asked = {token: {"ego_vehicle": (1, 2)} for token in (bare["token"], far, normal)}
    made = accident_outcomes(dataset, asked, workers=1)
    assert [each.scenario for each in made.dropped] == [far]
    assert {each.scenario for each in made.skipped} == {bare["token"], normal}
