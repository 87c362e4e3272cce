"""Protocol `clean`: the scores of a siren, of silence and of chance; twins, groups, references and
operating points.
"""

import math
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from support.expected_errors import assert_raises
from support.warning_evaluations import ScoreFunction, always_alarm, evaluate_scores, never_alarm

from deepaccident_devkit.errors import ChoiceError, ConfigError
from deepaccident_devkit.evaluation.intervals import numbers_of
from deepaccident_devkit.evaluation.task import headlines
from deepaccident_devkit.evaluation.warning import CleanWarnings, WarningEvaluator
from deepaccident_devkit.evaluation.warning.anticipation import (
    LATENCIES,
    mean_of_records,
    reference_threshold,
)
from deepaccident_devkit.evaluation.warning.recordings import PREDICTORS, REFERENCES, TRIVIAL


def read_ego_figures(evaluator: WarningEvaluator) -> Any:
    return evaluator.compute().groups["ego_involved"]


def make_skilled_scores(seed: int) -> ScoreFunction:
    """Make scores that are higher before accidents; the seed draws kind, strength, lead and
    noise.
    """
    random = np.random.default_rng(seed)
    kind = seed % 4
    strength = random.uniform(0.25, 0.6)
    lead_s = random.uniform(0.5, 4.0)
    noise = random.uniform(0.02, 0.3)

    def scores(is_accident: bool, seconds: np.ndarray) -> np.ndarray:
        values = random.normal(0.3, noise, len(seconds))
        if kind == 0:  # surer and surer
            values += is_accident * strength * np.clip(1 - seconds / 6, 0, 1)
        elif kind == 1:  # from some time before the impact on, and sometimes late
            late_lead_s = lead_s * random.uniform(0.7, 1.0)
            values += is_accident * strength * (seconds <= late_lead_s)
        elif kind == 2:  # alarms that flicker, twice as often before accidents
            is_alarm = random.random(len(seconds)) < 0.3 * (1 + is_accident)
            values = np.where(is_alarm, 0.8, np.nan)
        else:  # mostly right about the whole recording
            is_high = random.random() < (0.75 if is_accident else 0.25)
            values += is_high * strength
        return np.clip(values, 0.01, 1)

    return scores


def alarm_in_last_two_seconds(is_accident: bool, seconds: np.ndarray) -> np.ndarray:
    return np.where(
        is_accident & (seconds <= 2),
        0.9,
        np.nan,
    )


def alarm_at_impact(_is_accident: bool, seconds: np.ndarray) -> np.ndarray:
    return np.where(
        seconds == 0,
        1.0,
        np.nan,
    )


def alarm_later_in_twins(is_accident: bool, seconds: np.ndarray) -> np.ndarray:
    if is_accident:
        return np.where(seconds == 1, 0.4, np.nan)
    return np.where(seconds < 3, 1.0, np.nan)


@pytest.mark.slow
def test_the_headline_ranks_skill_above_a_siren_silence_and_chance() -> None:
    for trivial in (always_alarm, never_alarm):
        assert read_ego_figures(evaluate_scores(trivial)).auc_ahead == 0.5
    for seed in range(20):
        result = evaluate_scores(make_skilled_scores(seed)).compute()
        skill = result.groups["ego_involved"].auc_ahead
        assert set(result.references) == {*TRIVIAL, *REFERENCES}
        assert skill > 0.5
        for name in TRIVIAL:
            assert skill > result.references[name]["ego_involved"].auc_ahead


OPERATING_POINT = {
    "threshold": 0.5,
    "recall": 1.0,
    "precision": 0.5,
    "tta_hit": 6.0,
    "tta0": 6.0,
    "time_in_alarm": 1.0,
    "alarm_seconds_per_minute": 60.0,
    "episodes_per_minute": pytest.approx(10),
    "false_recordings": 5.0,
    "early_share": 1.0,
}


def test_a_siren_pays_in_precision_and_time() -> None:
    """The result holds the given threshold, and for references that of the only score."""
    result = evaluate_scores(always_alarm, CleanWarnings(threshold=0.5), pairs=5).compute()
    siren = {
        "auc_ahead": 0.5,
        "twin_wins": 0.5,
        "average_precision": 0.5,
        "area_under_curve": 0.5,
        "mean_time": 6.0,
        "operating": OPERATING_POINT,
        "at_r80": OPERATING_POINT | {"threshold": 1.0},
        "at_p80": dict.fromkeys(OPERATING_POINT),
        "best_f1": 1.0,
        "quiet": None,
        "tta0_after": {},
        "recordings": {"accident": 5, "twins": 5, "others": 0},
        "twins": 5,
    }
    values = result.as_dict()
    references = values.pop("references")
    assert values == {
        "samples": 5 * (13 + 19),
        "operating_by": "given",
        "groups": {"ego_involved": siren},
        "beyond": 0,
        "notes": [
            (
                "the rows 'TTC < 3 s' need predictions at constant velocity; give "
                "accident_context(…, references=True)"
            )
        ],
    }
    assert list(references) == [*TRIVIAL, *REFERENCES]
    at_its_score = {"operating": OPERATING_POINT | {"threshold": 1.0}}
    assert references["always"]["ego_involved"] == siren | at_its_score

    rows = [(row.name, row.unit, row.higher_is_better) for row in headlines(result)]
    # costs come before the numbers that grow with more alarms
    assert rows == [
        ("auc_ahead ego_involved", "share", True),
        ("twin_wins ego_involved", "share", True),
        ("AP ego_involved", "share", True),
        ("precision ego_involved", "share", True),
        ("time_in_alarm ego_involved", "share", False),
        ("recall ego_involved", "share", True),
        ("tta0 ego_involved", "s", True),
    ]


@pytest.mark.parametrize(
    ("scores", "choices", "right", "expected"),
    [
        # alarms for other actors
        (
            alarm_in_last_two_seconds,
            {"threshold": 0.5},
            False,
            {"average_precision": 0, "precision": 0, "recall": 0},
        ),
        (
            alarm_in_last_two_seconds,
            {"threshold": 0.5, "scores_of": "recording"},
            False,
            {
                "average_precision": 1,
                "area_under_curve": 1,
                "twin_wins": 1,
                "recall": 1,
                "tta0": 2,
                "time_in_alarm": 0,
            },
        ),
        # an alarm at the impact foresees nothing
        (
            alarm_at_impact,
            {},
            True,
            {"average_precision": 0, "recall": 0, "threshold": math.inf},
        ),
        (
            alarm_later_in_twins,
            {},
            True,
            {"average_precision": 1, "twin_wins": 1, "time_in_alarm": 0, "threshold": 0.4},
        ),
    ],
)
def test_what_alarms_score(
    scores: ScoreFunction, choices: Any, right: bool, expected: dict[str, float]
) -> None:
    """Alarms in a twin after the time of the impact do not count."""
    evaluator = evaluate_scores(scores, CleanWarnings(**choices), pairs=3, right=right)
    figures = read_ego_figures(evaluator)
    values = asdict(figures) | asdict(figures.operating)
    assert {name: values[name] for name in expected} == expected


def test_length_does_not_reveal_the_label() -> None:
    """Recordings without a twin are longer; scores that fall with time are no better than
    chance.
    """
    evaluator = evaluate_scores(
        lambda _, seconds: 1 / (1 + np.arange(len(seconds))),
        pairs=6,
    )
    counts = []
    for sample in evaluator.counts.values():
        is_twin = sample["kind"] == "twins"
        counts.append({**sample, "kind": "others", "to_end": None} if is_twin else sample)
    figures = CleanWarnings().result(counts).groups["ego_involved"]
    assert figures.recordings == {"accident": 6, "twins": 0, "others": 6}
    assert figures.auc_ahead == 0.5


def test_agents_are_never_pooled_and_witnesses_lose_the_latency() -> None:
    evaluator = evaluate_scores(
        alarm_in_last_two_seconds,
        pairs=3,
        agents=[
            ("ego_vehicle", "ego_involved"),
            ("other_vehicle", "bystander"),
            ("infrastructure", "infrastructure"),
            ("unknown_vehicle", None),
        ],
    )
    after = pytest.approx({0.0: 2.0, 0.1: 1.9, 0.3: 1.7})
    expected = {"ego_involved": {}, "bystander": after, "infrastructure": after, "unknown": {}}
    groups = evaluator.compute().groups
    assert [*groups] == [*expected]
    for name, figures in groups.items():
        assert figures.recordings["accident"] == 3
        assert figures.tta0_after == expected[name]
    assert LATENCIES == (0.0, 0.1, 0.3)


def test_the_operating_point_is_given_or_found() -> None:
    accident_scores = iter([0.9, 0.8, 0.7, 0.6, 0.2])

    def alarm_once(is_accident: bool, seconds: np.ndarray) -> np.ndarray:
        score = next(accident_scores) if is_accident else np.nan
        return np.where(seconds == 1.5, score, np.nan)

    evaluator = evaluate_scores(alarm_once, pairs=5)
    by_recall = evaluator.compute()
    figures = by_recall.groups["ego_involved"]
    assert figures.operating == figures.at_r80
    assert (figures.operating.threshold, figures.operating.recall) == (0.6, 0.8)
    assert (figures.best_f1, figures.quiet, figures.at_p80.threshold) == (0.2, 0.2, 0.2)
    assert (figures.operating.tta_hit, figures.operating.tta0) == (1.5, pytest.approx(1.2))

    by_threshold = CleanWarnings(threshold=0.75).result(list(evaluator.counts.values()))
    assert "on these very recordings" in " ".join(by_recall.notes)
    assert "on these very recordings" not in " ".join(by_threshold.notes)
    assert (by_recall.operating_by, by_threshold.operating_by) == ("recall", "given")
    assert by_threshold.groups["ego_involved"].operating.recall == 0.4


def test_draws_equal_the_result_of_the_repeated_samples() -> None:
    evaluator = evaluate_scores(make_skilled_scores(3), pairs=6)
    counts_by_pair: dict[str, list] = {}
    for token, counts in evaluator.counts.items():
        counts_by_pair.setdefault(token.split("/")[1], []).append(counts)
    parts = list(counts_by_pair.values())
    times = np.array([[1] * 6, [2, 0, 1, 0, 3, 0], [0, 6, 0, 0, 0, 0]])

    results = list(evaluator.resampled(parts, times))

    pooled = [evaluator.pooled(part) for part in parts]
    for part_times, result in zip(times, results, strict=True):
        repeated = []
        for part, repetitions in zip(pooled, part_times, strict=True):
            repeated += [*part] * repetitions
        expected = evaluator.result_of(repeated)
        assert (result.samples, result.beyond, result.operating_by) == (
            expected.samples,
            0,
            "recall",
        )
        recordings = expected.groups["ego_involved"].recordings
        assert result.groups["ego_involved"].recordings == recordings
        numbers = numbers_of(result)
        expected_numbers = numbers_of(expected)
        assert numbers.keys() == expected_numbers.keys()
        assert_allclose(
            [*numbers.values()],
            [*expected_numbers.values()],
            rtol=1e-12,
        )
    whole = evaluator.result_of(list(evaluator.counts.values()))
    assert numbers_of(whole) == numbers_of(results[0])


def test_choices_are_checked() -> None:
    assert asdict(CleanWarnings()) == {"scores_of": "pair", "threshold": None}
    assert_raises(
        (
            lambda: CleanWarnings(scores_of="scene"),  # type: ignore[arg-type]
            ChoiceError,
            ("scores_of", "pair, recording", "scene"),
        ),
        (
            lambda: CleanWarnings(threshold=math.inf),
            ConfigError,
            ("threshold", "None", "inf"),
        ),
    )


def test_means_over_draws_leave_unknown_numbers_out_and_keep_counts_and_words() -> None:
    draws = [
        {"a": {"x": 1.0, "n": 3, "by": "f1"}},
        {"a": {"x": math.nan, "n": 3, "by": "f1"}},
        {"a": {"x": 4.0, "n": 3, "by": "f1"}},
    ]
    assert mean_of_records(draws) == {"a": {"x": 2.5, "n": 3, "by": "f1"}}
    assert math.isnan(mean_of_records([math.nan, math.nan]))


def test_predictors_that_know_nothing_work_at_a_threshold_of_their_own() -> None:
    lowest = float(np.nextafter(0.0, 1.0))
    thresholds = [reference_threshold(name) for name in PREDICTORS[1:]]
    assert thresholds == [1.0, 1.0, 0.5, 0.5, lowest, lowest]

    references = evaluate_scores(make_skilled_scores(0), pairs=8).compute().references
    recall = {name: groups["ego_involved"].operating.recall for name, groups in references.items()}
    assert (recall["always"], recall["never"]) == (1, 0)
    assert 0.2 < recall["random per recording"] < 0.8


@pytest.mark.parametrize(
    ("kinds", "beginning"),
    [
        ({"accident"}, "no recording without an accident was evaluated"),
        ({"twins"}, "no recording of an accident was evaluated"),
        ({"accident", "twins"}, "the operating point has a recall of 0.8"),
        (set(), None),
    ],
)
def test_the_first_note_names_what_was_not_evaluated(
    kinds: set[str], beginning: str | None
) -> None:
    counts = evaluate_scores(always_alarm, pairs=1).counts.values()
    selected = [sample for sample in counts if sample["kind"] in kinds]
    notes = CleanWarnings().result(selected).notes
    if beginning is None:
        assert notes == ()
    else:
        assert notes[0].startswith(beginning)
