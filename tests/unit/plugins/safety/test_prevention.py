"""Prevented accidents of hand-made recordings with a known outcome for each frame of the first
alarm.
"""

import math
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.evaluation_runs import evaluation_run
from support.expected_errors import assert_raises

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
IMPACT_FRAME = 61
AVOIDED, MITIGATED, UNCHANGED = (
    OUTCOMES.index(name) for name in ("avoided", "mitigated", "unchanged")
)
GROUP = "ego_involved"
Scores = Sequence[float | None]
"""One score for each frame of `FRAMES`; None for no alarm."""


@pytest.fixture(scope="module", autouse=True)
def _few_draws() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(anticipation, "RANDOM_DRAWS", 2)
        yield


def outcome_of_alarm(
    frame: float, reaction: float, deceleration: float, latency: float = 0.0
) -> int:
    """Return the outcome of an alarm: braking early and hard enough stops the car in time."""
    braking_time = (IMPACT_FRAME - frame) / 10 - reaction - latency
    if braking_time >= 12 / deceleration:
        return AVOIDED
    if braking_time >= 6 / deceleration:
        return MITIGATED
    return UNCHANGED


def make_table(latencies: tuple[float, ...] = (0.0,), *, pedestrian: bool = False) -> OutcomeTable:
    outcome = np.full((len(latencies), len(FRAMES) + 1, len(BRAKINGS)), UNCHANGED, dtype=np.int8)
    for row, latency in enumerate(latencies):
        outcome[row, :-1] = [
            [
                outcome_of_alarm(frame, braking.reaction, braking.deceleration, latency)
                for braking in BRAKINGS
            ]
            for frame in FRAMES
        ]
    return OutcomeTable(
        frame=FRAMES,
        outcome=outcome,
        extrapolated=outcome == MITIGATED,
        latencies=latencies,
        pedestrian=pedestrian,
    )


def make_counts(
    recording: str,
    frame: int,
    score: float | None,
    *,
    crash: bool,
    right: bool = True,
    **changes: Any,
) -> Any:
    """Make the counts of one sample, as `sample_counts` returns them."""
    return {
        "recording": recording,
        "frame": frame,
        "kind": "accident" if crash else "twins",
        "involvement": GROUP,
        "ahead": IMPACT_FRAME - frame if crash else None,
        "to_end": IMPACT_FRAME - frame,
        "alarms": [] if score is None else [[score, int(crash and right)]],
        "unjudged": [],
        "beyond": 0,
        "references": [[None, None], [None, None]],
        **changes,
    }


def make_evaluator(
    accidents: Sequence[Scores],
    normal: Sequence[Scores],
    outcomes: AccidentOutcomes | None = None,
    agent: str = "ego_vehicle",
    threshold: float | None = None,
    **changes: Any,
) -> PreventedEvaluator:
    """Make an evaluator of recordings of 6 s with two samples a second.

    All accidents have the same outcome table unless `outcomes` has others.
    """
    numbers = range(max(len(accidents), len(normal)))
    names = [f"type1_subtype1_accident/s{number}/{agent}" for number in numbers]
    tables = dict.fromkeys(names[: len(accidents)], make_table())
    rules = changes.pop("rules", None) or CleanWarnings(threshold=threshold)
    evaluator = PreventedEvaluator(outcomes or AccidentOutcomes(tables=tables), rules)

    for crash, recordings in ((True, accidents), (False, normal)):
        for accident, scores in zip(names, recordings, strict=False):
            name = accident if crash else accident.replace("accident", "normal")
            for frame, score in zip(FRAMES.tolist(), scores, strict=False):
                counts = make_counts(name, frame, score, crash=crash, **changes)
                evaluator.add(f"{name}/{frame:03d}", counts)
    return evaluator


def shares_of(
    result: PreventedResult, setting: str = NOMINAL, alarms: str = "right"
) -> dict[str, float]:
    figures = getattr(result.groups[GROUP], alarms)
    return dict(figures[0.0][setting].shares)


def alarm_from(frame: int, score: float = 0.9) -> Scores:
    """Make scores with no alarm before a frame, and one at each frame from then on."""
    return [score if number >= frame else None for number in FRAMES]


def test_ends_that_are_known() -> None:
    """With a reaction of 1 s and 6 m/s², an alarm 3 s before the impact avoids it, 2 s mitigates
    it, 1.5 s changes nothing; an alarm at the impact is none.
    """
    accidents = [alarm_from(31), alarm_from(41), alarm_from(46), alarm_from(IMPACT_FRAME)]
    result = make_evaluator(accidents, [[]], threshold=0.5).compute()
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
            outcome_of_alarm(frame, braking.reaction, braking.deceleration)
            for frame in (31, 41, 46, math.inf)
        ]
        assert shares_of(result, setting) == {
            name: expected.count(code) / 4 for code, name in enumerate(OUTCOMES)
        }


def test_only_normal_recordings_cost_braking() -> None:
    """Two recordings of 6 s, cut at the twin's impact: two alarms of 1 s and one of 2 s in 12 s."""
    flicker: Scores = [0.9, 0.9, None, 0.9, 0.9, None] + [None] * 7
    late: Scores = [None] * 8 + [0.9] * 5
    result = make_evaluator([alarm_from(1)] * 2, [flicker, late], threshold=0.5).compute()
    group = result.groups[GROUP]
    assert group.minutes == pytest.approx(0.2)

    seconds = {"0.5 s, 4 m/s²": 0.5 + 0.5 + 1.5, NOMINAL: 1.0, "1.5 s, 8 m/s²": 0.5}
    for setting, braking_seconds in seconds.items():
        figures = group.right[0.0][setting]
        assert figures.braking_seconds_per_minute == pytest.approx(5 * braking_seconds)


def draw_scores(seed: int, recordings: int = 5) -> list[Scores]:
    rng = np.random.default_rng(seed)
    return [
        [round(score, 1) if score > 0.2 else None for score in rng.random(13).tolist()]
        for _ in range(recordings)
    ]


@settings(max_examples=6)
@given(st.integers(0, 10_000))
def test_a_siren_prevents_and_costs_the_most_and_silence_nothing(seed: int) -> None:
    result = make_evaluator(draw_scores(seed), draw_scores(seed + 1), threshold=0.6).compute()
    groups = (
        result.references["always"][GROUP],
        result.groups[GROUP],
        result.references["never"][GROUP],
    )

    for setting in SETTINGS:
        figures = [group.right[0.0][setting] for group in groups]
        avoided = [figure.shares["avoided"] for figure in figures]
        cost = [figure.braking_seconds_per_minute for figure in figures]
        assert avoided == sorted(avoided, reverse=True)
        assert cost == sorted(cost, reverse=True)
        assert (avoided[-1], cost[-1], figures[-1].shares["unchanged"]) == (0, 0, 1)


@settings(max_examples=6)
@given(st.integers(0, 10_000))
def test_a_higher_threshold_never_prevents_or_costs_more(seed: int) -> None:
    result = make_evaluator(draw_scores(seed), draw_scores(seed + 1)).compute()
    curve = result.curves[GROUP]
    assert curve.threshold[0] == math.inf
    assert curve.braking_seconds_per_minute[0].max() == 0
    assert (np.diff(curve.threshold) < 0).all()

    growing = [
        curve.avoided,
        curve.avoided + curve.mitigated,
        curve.braking_seconds_per_minute,
    ]
    assert (np.diff(growing, axis=1) > -1e-12).all()


@settings(max_examples=6)
@given(st.integers(0, 10_000))
def test_without_a_threshold_it_is_the_lowest_within_the_budget(seed: int) -> None:
    result = make_evaluator(draw_scores(seed, 2), draw_scores(seed + 1, 8)).compute()
    figures = result.groups[GROUP]
    curve = result.curves[GROUP]
    cost = curve.braking_seconds_per_minute[:, SETTINGS.index(NOMINAL)]

    assert figures.threshold == figures.quiet_braking == curve.threshold[cost <= 1.0].min()


def test_order_and_parts_change_no_bit() -> None:
    whole = make_evaluator(draw_scores(1), draw_scores(2))
    expected = str(whole.compute().as_dict())
    tokens = sorted(whole.tokens, key=lambda token: token[::-1])

    for ordered_tokens in (tokens, tokens[::-1]):
        parts = [whole.fresh(), whole.fresh()]
        for number, token in enumerate(ordered_tokens):
            parts[number % 2].add(token, whole.counts[token])
        assert str(parts[0].merge(parts[1]).compute().as_dict()) == expected


def test_draws_count_as_often_as_they_say() -> None:
    whole = make_evaluator(draw_scores(3, 3), draw_scores(4, 3), threshold=0.6)
    parts = [
        [counts for token, counts in whole.counts.items() if f"/s{number}/" in token]
        for number in range(3)
    ]
    once, twice = whole.resampled(parts, np.array([[1, 1, 1], [0, 2, 1]]))
    expected = whole.result_of([*parts[0], *parts[1], *parts[2]])
    assert numbers_of(once) == numbers_of(expected)
    assert (once.references, once.curves, twice.groups[GROUP].accidents) == ({}, {}, 3)

    second, third = (shares_of(whole.result_of(part)) for part in parts[1:])
    assert shares_of(twice) == pytest.approx(
        {name: (2 * second[name] + third[name]) / 3 for name in OUTCOMES}
    )


def test_any_alarm_counts_too_and_is_the_main_result_where_nobody_is_named() -> None:
    """An alarm that is not right prevents nothing, unless the predictor names nobody."""
    recordings: dict[str, Any] = {
        "accidents": [alarm_from(1)],
        "normal": [[None] * 13],
        "right": False,
    }
    named = make_evaluator(threshold=0.5, **recordings).compute()
    assert (named.alarms, named.avoided(GROUP)) == ("right", 0)
    assert shares_of(named)["avoided"] == 0
    assert shares_of(named, alarms="any_alarm")["avoided"] == 1

    rules = CleanWarnings(threshold=0.5, scores_of="recording")
    unnamed = make_evaluator(rules=rules, **recordings).compute()
    assert (unnamed.alarms, unnamed.avoided(GROUP)) == ("any_alarm", 1)
    assert shares_of(unnamed, alarms="lasting")["avoided"] == 1


def test_alarms_that_flicker_prevent_for_free_unless_they_must_last() -> None:
    flicker: Scores = [0.9, 0.9, None] * 4 + [None]
    result = make_evaluator([flicker] * 3, [flicker] * 3, threshold=0.5).compute()
    assert result.groups[GROUP].right[0.0][NOMINAL].braking_seconds_per_minute == 0
    assert shares_of(result)["avoided"] == 1
    assert shares_of(result, alarms="lasting")["avoided"] == 0
    assert shares_of(result, "0.5 s, 6 m/s²", "lasting")["avoided"] == 1

    chance = result.references["random per frame, quiet"][GROUP]
    avoided = chance.right[0.0][NOMINAL].shares["avoided"]
    assert avoided > chance.lasting[0.0][NOMINAL].shares["avoided"]


def test_a_latency_is_less_time_to_brake() -> None:
    outcomes = AccidentOutcomes(
        tables={"type1_subtype1_accident/s0/infrastructure": make_table((0.0, 0.1, 0.3))}
    )
    evaluator = make_evaluator(
        [alarm_from(31)],
        [[None] * 13],
        outcomes,
        "infrastructure",
        0.5,
    )
    by_latency = evaluator.compute().groups[GROUP].right
    avoided = {
        latency: figures[NOMINAL].shares["avoided"] for latency, figures in by_latency.items()
    }
    assert avoided == {0.0: 1, 0.1: 0, 0.3: 0}


def test_accidents_without_a_table_are_left_out_and_named() -> None:
    kind = "type1_subtype1_accident"
    outcomes = AccidentOutcomes(
        tables={f"{kind}/s1/ego_vehicle": make_table()},
        dropped=(Skipped(scenario=f"{kind}/s0", reason="2 m apart"),),
        skipped=(Skipped(scenario=f"{kind}/s2", reason="no labels"),),
    )
    result = make_evaluator([alarm_from(1)] * 3, [[None] * 13], outcomes, threshold=0.5).compute()

    assert result.groups[GROUP].accidents == 1
    assert result.as_dict()["dropped"] == [{"scenario": f"{kind}/s0", "reason": "2 m apart"}]


def test_pedestrians_are_apart_with_the_same_normal_recordings() -> None:
    names = [f"type1_subtype1_accident/s{number}/ego_vehicle" for number in range(3)]
    tables = {name: make_table(pedestrian=name == names[0]) for name in names}
    scores = [alarm_from(1), alarm_from(41), alarm_from(61)]
    result = make_evaluator(
        scores,
        [[None] * 13] * 3,
        AccidentOutcomes(tables=tables),
        threshold=0.5,
    ).compute()
    counts = {
        name: (group.accidents, group.recordings, result.avoided(name))
        for name, group in result.groups.items()
    }

    assert counts == {GROUP: (2, 3, 0), f"{GROUP}, pedestrian": (1, 3, 1)}


def test_nothing_to_count_is_no_number() -> None:
    no_accidents = make_evaluator([], [alarm_from(1)], threshold=0.5).compute()
    figures = no_accidents.groups[GROUP].right[0.0][NOMINAL]
    for value in (figures.warned, figures.extrapolated, *figures.shares.values()):
        assert math.isnan(value)
    assert figures.braking_seconds_per_minute == pytest.approx(5.0 * 10)

    no_normal = make_evaluator([alarm_from(1)], [], threshold=0.5).compute()
    assert shares_of(no_normal)["avoided"] == 1
    assert math.isnan(no_normal.groups[GROUP].right[0.0][NOMINAL].braking_seconds_per_minute)

    no_threshold = make_evaluator([alarm_from(1)], []).compute()
    assert math.isnan(no_threshold.groups[GROUP].threshold)
    assert math.isnan(no_threshold.avoided(GROUP))
    assert make_evaluator([], []).compute().groups == {}


def test_what_does_not_fit_is_refused(da_motion: DeepAccident) -> None:
    assert_raises(
        (
            lambda: PreventedEvaluator(AccidentOutcomes(), "field"),
            EvaluationError,
            ("protocol clean", "FieldWarnings"),
        )
    )
    for evaluator in (WarningEvaluator("field"), MotionEvaluator()):
        call = partial(prevented_accidents, da_motion, evaluator)
        assert_raises((call, EvaluationError, ("warnings", "clean")))

    table = make_table()
    shape = "expected shape (1, 14, 9)"
    for changes, words in (
        ({"outcome": table.outcome[:, 1:]}, ("outcome", shape, "found (1, 13, 9)")),
        ({"extrapolated": table.extrapolated[..., 0]}, ("extrapolated", shape)),
        ({"outcome": table.outcome + 3}, ("OUTCOMES, 0 to 4",)),
        ({"frame": table.frame[::-1]}, ("ascending frame numbers",)),
    ):
        assert_raises((partial(replace, table, **changes), EvaluationError, words))


EVERYONE = ("ego_vehicle", "other_vehicle_behind", "infrastructure")


@pytest.fixture(scope="module")
def crash(da_motion: DeepAccident) -> str:
    (scenario,) = da_motion.find(collision=True)
    return scenario["token"]


def make_warnings(
    dataset: DeepAccident, agents: Sequence[str], frames: Sequence[int], crash: str
) -> WarningEvaluator:
    """Evaluate warnings that foresee the true accident from a frame on, with a growing score.

    In the first frame of the twin they foresee an accident that does not happen.
    """
    evaluator = WarningEvaluator()
    for token in dataset.samples("train", "all"):
        if token.split("/")[2] not in agents:
            continue
        frame = int(token[-3:])
        context = accident_context(dataset, token, 10.0)
        impact = context.truth and context.truth.impact

        alarms = []
        if impact is not None and frame >= min(frames):
            score = 0.3 if frame < max(frames) else 0.9
            alarms = [
                Accident(positions=impact.positions, time=impact.time, ids=impact.ids, score=score)
            ]
        elif not token.startswith(crash) and frame == 1:
            alarms = [Accident(positions=np.ones((2, 2)), time=0.5, score=0.3)]
        evaluator.update(token, alarms, None, context)
    return evaluator


def test_tables_are_what_braking_makes_of_the_accident(da_motion: DeepAccident, crash: str) -> None:
    """An agent of the pair brakes itself, at once; any other agent warns both after a latency."""
    accident = accident_of(da_motion, crash)
    frames = (1, 11, 21, 31)
    result = accident_outcomes(da_motion, {crash: dict.fromkeys(EVERYONE, frames)}, workers=1)
    assert (result.dropped, result.skipped) == ((), ())
    ego, behind, pole = (result.tables[f"{crash}/{agent}"] for agent in EVERYONE)
    assert (ego.latencies, pole.latencies) == ((0.0,), (0.0, 0.1, 0.3))

    times = [*((frame - accident.first_frame) * 0.1 for frame in frames), math.nan]
    ego_brakes = tuple(agent == "ego_vehicle" for agent in accident.agents)
    own = outcomes_of(accident, ego_brakes, times)
    np.testing.assert_array_equal(ego.outcome, [own.outcome])
    np.testing.assert_array_equal(ego.extrapolated, [own.extrapolated])
    assert ego.outcome[0, -1].tolist() == [UNCHANGED] * len(BRAKINGS)

    both = [
        outcomes_of(accident, (True, True), times, latency=latency).outcome
        for latency in pole.latencies
    ]
    np.testing.assert_array_equal(pole.outcome, both)
    np.testing.assert_array_equal(behind.outcome, both)


def test_the_tables_say_what_the_result_does(da_motion: DeepAccident, crash: str) -> None:
    warnings = make_warnings(da_motion, EVERYONE, (11, 21), crash)
    result = prevented_accidents(da_motion, warnings, workers=1)
    summary = {**result.as_dict(), "intervals": {}}
    main, settings_table, *_ = prevention_tables(summary)
    assert [row[0] for row in settings_table.rows] == [
        "ego involved in the accident, this model",
        *SETTINGS,
    ]

    group = result.groups["ego_involved"]
    expected = [
        *group.right[0.0][NOMINAL].shares.values(),
        group.lasting[0.0][NOMINAL].shares["avoided"],
    ]
    assert [float(cell) for cell in main.rows[1][1:7]] == pytest.approx(expected, abs=5e-4)
    assert PREVENTED.text(summary).endswith("--threshold-from BUNDLE --threshold-by braking")


def test_intervals_leave_out_an_accident_and_its_twin(da_motion: DeepAccident) -> None:
    samples = da_motion.samples("train", "all")
    ego_samples = [token for token in samples if token.split("/")[2] == "ego_vehicle"]
    setup = EvaluationSetup(task="warning", protocol="clean")
    run = evaluation_run(da_motion, setup, ego_samples)

    extended = with_prevented(run, da_motion, Resampling(resamples=7))
    prevented = extended.prevented
    (group,) = prevented.groups
    assert (group.clusters, prevented.resampling.resamples) == (1, 7)
    assert extended.summary()["prevented"]["interval_notes"] == list(group.notes)
    assert "prevented" not in run.summary()


def test_scenarios_that_cannot_be_judged_are_named(
    own_release: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One has no meta file, one has no collision, and in one the boxes are taken to be too far
    apart.
    """
    monkeypatch.setattr(outcomes, "MAX_END_GAP_M", -1.0)
    bare = DeepAccident("v1", own_release, verbose=False).find(collision=True)[0]
    (own_release / bare["folder"] / bare["scenario_type"] / "meta" / f"{bare['name']}.txt").unlink()
    shutil.rmtree(own_release / ".deepaccident")

    dataset = DeepAccident("v1", own_release, verbose=False)
    apart, normal = (dataset.find(collision=collides)[0]["token"] for collides in (True, False))
    frames = {token: {"ego_vehicle": (1, 2)} for token in (bare["token"], apart, normal)}
    result = accident_outcomes(dataset, frames, workers=1)
    assert [dropped.scenario for dropped in result.dropped] == [apart]
    assert {skipped.scenario for skipped in result.skipped} == {bare["token"], normal}
