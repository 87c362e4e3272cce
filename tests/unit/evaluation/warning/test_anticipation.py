"""Protocol `clean`: what a siren, silence and chance score, twins, groups, references, operating
points.
"""

import math
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest
from evaluation_of_warnings import Scores, always, evaluated, never
from numpy.testing import assert_allclose
from refusals import assert_refused

from deepaccident_devkit.errors import ChoiceError, ConfigError
from deepaccident_devkit.evaluation.intervals import numbers_of
from deepaccident_devkit.evaluation.task import headlines
from deepaccident_devkit.evaluation.warning import CleanWarnings, WarningEvaluator
from deepaccident_devkit.evaluation.warning.anticipation import (
    LATENCIES,
    mean_of,
    reference_threshold,
)
from deepaccident_devkit.evaluation.warning.recordings import PREDICTORS, REFERENCES, TRIVIAL


def ego(evaluator: WarningEvaluator) -> Any:
    return evaluator.compute().groups["ego_involved"]


def skilled(seed: int) -> Scores:
    """Higher scores before accidents, of a kind, strength, lead and noise that the seed draws."""
    source = np.random.default_rng(seed)
    kind = seed % 4
    strength, lead, noise = (
        source.uniform(0.25, 0.6),
        source.uniform(0.5, 4.0),
        source.uniform(0.02, 0.3),
    )

    def scores(crash: bool, ahead: np.ndarray) -> np.ndarray:
        made = source.normal(0.3, noise, len(ahead))
        if kind == 0:  # surer and surer
            made += crash * strength * np.clip(1 - ahead / 6, 0, 1)
        elif kind == 1:  # from some time before the impact on, and late at times
            made += crash * strength * (ahead <= lead * source.uniform(0.7, 1.0))
        elif kind == 2:  # alarms that flicker, twice as often before accidents
            made = np.where(source.random(len(ahead)) < 0.3 * (1 + crash), 0.8, np.nan)
        else:  # mostly right about the whole recording
            made += (source.random() < (0.75 if crash else 0.25)) * strength
        return np.clip(made, 0.01, 1)

    return scores


def two_seconds(crash: bool, ahead: np.ndarray) -> np.ndarray:
    return np.where(crash & (ahead <= 2), 0.9, np.nan)


def at_the_impact(_crash: bool, ahead: np.ndarray) -> np.ndarray:
    return np.where(ahead == 0, 1.0, np.nan)


def late_in_twins(crash: bool, ahead: np.ndarray) -> np.ndarray:
    return np.where(
        (ahead < 3) & ~np.bool_(crash), 1.0, np.where(crash & (ahead == 1), 0.4, np.nan)
    )


@pytest.mark.slow
def test_the_headline_ranks_skill_above_a_siren_silence_and_chance() -> None:
    results = [evaluated(skilled(seed)).compute() for seed in range(20)]
    lowest = min(each.groups["ego_involved"].auc_ahead for each in results)
    assert [ego(evaluated(trivial)).auc_ahead for trivial in (always, never)] == [0.5, 0.5]
    for result in results:
        assert set(result.references) == {*TRIVIAL, *REFERENCES}
        chance = max(result.references[name]["ego_involved"].auc_ahead for name in TRIVIAL)
        assert min(lowest - 0.5, result.groups["ego_involved"].auc_ahead - chance) > 0


POINT = {
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
NOTHING = dict.fromkeys(POINT)


def test_a_siren_pays_in_precision_and_time() -> None:
    """All that a result holds: at the threshold given, and at that of its only score."""
    result = evaluated(always, CleanWarnings(threshold=0.5), pairs=5).compute()
    siren = {
        "auc_ahead": 0.5,
        "twin_wins": 0.5,
        "average_precision": 0.5,
        "area_under_curve": 0.5,
        "mean_time": 6.0,
        "operating": POINT,
        "at_r80": POINT | {"threshold": 1.0},
        "at_p80": NOTHING,
        "best_f1": 1.0,
        "quiet": None,
        "tta0_after": {},
        "recordings": {"accident": 5, "twins": 5, "others": 0},
        "twins": 5,
    }
    found = result.as_dict()
    references = found.pop("references")
    assert found == {
        "samples": 5 * (13 + 19),
        "operating_by": "given",
        "groups": {"ego_involved": siren},
        "beyond": 0,
        "notes": [
            (
                "the rows 'TTC < 3 s' need what constant velocities lead to: "
                "accident_context(…, references=True)"
            )
        ],
    }
    assert list(references) == [*TRIVIAL, *REFERENCES]
    assert references["always"]["ego_involved"] == siren | {"operating": POINT | {"threshold": 1.0}}
    better = (
        "auc_ahead",
        "twin_wins",
        "AP",
        "precision",
    )  # the costs before what grows with more alarms
    rows = [
        *((name, "share", True) for name in better),
        ("time_in_alarm", "share", False),
        ("recall", "share", True),
    ]
    assert [(each.name, each.unit, each.higher_is_better) for each in headlines(result)] == [
        (f"{name} ego_involved", *facts) for name, *facts in (*rows, ("tta0", "s", True))
    ]


@pytest.mark.parametrize(
    ("scores", "choices", "right", "expected"),
    [
        (
            two_seconds,
            {"threshold": 0.5},
            False,
            {"average_precision": 0, "precision": 0, "recall": 0},
        ),  # of others
        (
            two_seconds,
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
        (
            at_the_impact,
            {},
            True,
            {"average_precision": 0, "recall": 0, "threshold": math.inf},
        ),  # foresees nothing
        (
            late_in_twins,
            {},
            True,
            {"average_precision": 1, "twin_wins": 1, "time_in_alarm": 0, "threshold": 0.4},
        ),
    ],
)
def test_what_alarms_score(
    scores: Scores, choices: Any, right: bool, expected: dict[str, float]
) -> None:
    """What a twin shows after the impact would have come does not count."""
    figures = ego(evaluated(scores, CleanWarnings(**choices), pairs=3, right=right))
    found = asdict(figures) | asdict(figures.operating)
    assert {name: found[name] for name in expected} == expected


def test_length_does_not_tell_the_label() -> None:
    """Recordings without a twin are longer; who is the less sure the longer it drives is no better
    than chance.
    """
    evaluator = evaluated(lambda _crash, ahead: 1 / (1 + np.arange(len(ahead))), pairs=6)
    counts = [
        dict(each, kind="others", to_end=None) if each["kind"] == "twins" else each
        for each in evaluator.counts.values()
    ]
    figures = CleanWarnings().result(counts).groups["ego_involved"]
    assert (figures.recordings, figures.auc_ahead) == (
        {"accident": 6, "twins": 0, "others": 6},
        0.5,
    )


def test_agents_are_never_pooled_and_those_who_see_the_accident_of_others_lose_the_latency() -> (
    None
):
    groups = ("ego_involved", "bystander", "infrastructure", None)
    made = (
        evaluated(two_seconds, pairs=3, agents=[(str(each), each) for each in groups])
        .compute()
        .groups
    )
    assert [*made] == ["ego_involved", "bystander", "infrastructure", "unknown"]
    assert {name: each.recordings["accident"] for name, each in made.items()} == dict.fromkeys(
        made, 3
    )
    after = pytest.approx({0.0: 2.0, 0.1: 1.9, 0.3: 1.7})
    assert [each.tta0_after for each in made.values()] == [{}, after, after, {}]
    assert LATENCIES == (0.0, 0.1, 0.3)


def test_the_operating_point_is_given_or_found() -> None:
    count = iter([0.9, 0.8, 0.7, 0.6, 0.2])
    evaluator = evaluated(
        lambda crash, ahead: np.where(
            crash & (ahead == 1.5), next(count) if crash else np.nan, np.nan
        ),
        pairs=5,
    )
    found = evaluator.compute()
    figures = found.groups["ego_involved"]
    assert (figures.operating, figures.operating.threshold, figures.operating.recall) == (
        figures.at_r80,
        0.6,
        0.8,
    )
    assert (figures.best_f1, figures.quiet, figures.at_p80.threshold) == (0.2, 0.2, 0.2)
    assert (figures.operating.tta_hit, figures.operating.tta0) == (1.5, pytest.approx(1.2))
    given = CleanWarnings(threshold=0.75).result(list(evaluator.counts.values()))
    assert [
        any("on these very recordings" in note for note in each.notes) for each in (found, given)
    ] == [True, False]
    assert (found.operating_by, given.operating_by) == ("recall", "given")
    assert given.groups["ego_involved"].operating.recall == 0.4


def test_draws_are_as_the_result_of_the_same_samples_given_so_often() -> None:
    evaluator = evaluated(skilled(3), pairs=6)
    by_pair: dict[str, list] = {}
    for token, counts in evaluator.counts.items():
        by_pair.setdefault(token.split("/")[1], []).append(counts)
    parts, times = (
        list(by_pair.values()),
        np.array([[1] * 6, [2, 0, 1, 0, 3, 0], [0, 6, 0, 0, 0, 0]]),
    )
    drawn = list(evaluator.resampled(parts, times))
    pooled = [evaluator.pooled(part) for part in parts]
    for draw, made in zip(times, drawn, strict=True):
        again = [
            each
            for part, often in zip(pooled, draw, strict=True)
            for _ in range(often)
            for each in part
        ]
        expected = evaluator.result_of(again)
        assert (made.samples, made.beyond, made.operating_by) == (expected.samples, 0, "recall")
        assert made.groups["ego_involved"].recordings == expected.groups["ego_involved"].recordings
        assert numbers_of(made).keys() == numbers_of(expected).keys()
        assert_allclose(
            list(numbers_of(made).values()), list(numbers_of(expected).values()), rtol=1e-12
        )
    assert numbers_of(evaluator.result_of(list(evaluator.counts.values()))) == numbers_of(drawn[0])


def test_choices_are_checked() -> None:
    assert asdict(CleanWarnings()) == {"scores_of": "pair", "threshold": None}
    assert_refused(
        (
            lambda: CleanWarnings(scores_of="scene"),
            ChoiceError,
            ("scores_of", "pair, recording", "scene"),
        ),  # type: ignore[arg-type]
        (lambda: CleanWarnings(threshold=math.inf), ConfigError, ("threshold", "None", "inf")),
    )


def test_means_over_draws_leave_unknown_numbers_out_and_keep_counts_and_words() -> None:
    parts = [{"a": {"x": value, "n": 3, "by": "f1"}} for value in (1.0, math.nan, 4.0)]
    assert mean_of(parts) == {"a": {"x": 2.5, "n": 3, "by": "f1"}}
    assert math.isnan(mean_of([math.nan, math.nan]))


def test_predictors_that_know_nothing_work_at_a_threshold_of_their_own() -> None:
    least = float(np.nextafter(0.0, 1.0))
    assert [reference_threshold(name) for name in PREDICTORS[1:]] == [
        1.0,
        1.0,
        0.5,
        0.5,
        least,
        least,
    ]
    recall = {
        name: each["ego_involved"].operating.recall
        for name, each in evaluated(skilled(0), pairs=8).compute().references.items()
    }
    assert (recall["always"], recall["never"]) == (1, 0)
    assert 0.2 < recall["random per recording"] < 0.8


@pytest.mark.parametrize(
    ("kinds", "said"),
    [
        ({"accident"}, "no recording without an accident was evaluated"),
        ({"twins"}, "no recording of an accident was evaluated"),
        ({"accident", "twins"}, "the operating point is that of a recall of 0.8"),
        (set(), None),
    ],
)
def test_the_first_note_says_what_was_not_evaluated(kinds: set[str], said: str | None) -> None:
    counts = [each for each in evaluated(always, pairs=1).counts.values() if each["kind"] in kinds]
    notes = CleanWarnings().result(counts).notes
    assert notes[0].startswith(said) if said else notes == ()
