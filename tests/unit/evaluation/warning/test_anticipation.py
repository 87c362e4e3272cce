"""Protocol `clean` and `field`: what a siren, silence and chance score, twins, groups, references, operating points."""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, ConfigError
from deepaccident_devkit.evaluation import Accident, accident_truth
from deepaccident_devkit.evaluation.accident import AccidentContext, BoxTruth, accident_context
from deepaccident_devkit.evaluation.accident_truth import constant_velocity_alarms
from deepaccident_devkit.evaluation.intervals import numbers_of
from deepaccident_devkit.evaluation.task import headlines
from deepaccident_devkit.evaluation.warning import (
    AnticipationResult,
    CleanScores,
    CleanWarnings,
    ScoreSeries,
    WarningEvaluator,
    anticipation,
    field_figures,
    printed_figures,
)
from deepaccident_devkit.evaluation.warning.anticipation import mean_of
from deepaccident_devkit.evaluation.warning.recordings import REFERENCES, TRIVIAL, surest

PAIR = (11, 22)
MEETING = np.array([[20.0, 10.0], [16.0, 10.0]])
PREDICTORS = 20
Scores = Callable[[bool, np.ndarray], np.ndarray]
"""Whether the recording is an accident, and seconds to its end at each sample → scores; NaN for no alarm."""


@functools.cache
def context(name: str, frame: int, last: int, twin_last: int, involvement: str = "ego_involved") -> AccidentContext:
    """Two stand apart where they will meet; the boxes are known for 2 s."""
    crash = "accident" in name
    ahead = (last - frame) / 10
    moments = max(min(20, last - frame) + 1, 1)
    impact = Accident(positions=MEETING, time=ahead, ids=PAIR) if crash else None
    boxes = np.concatenate([MEETING, [[4.0, 2.0, 0.0]] * 2], axis=1)
    return AccidentContext(
        pair=PAIR if crash else None,
        known=True,
        truth=BoxTruth(
            time=np.arange(moments) / 10,
            actor_id=np.array(PAIR),
            footprint=np.tile(boxes, (moments, 1, 1)),
            accident=impact if ahead <= 2 else None,
            impact=impact,
            horizon=2.0,
        ),
        time_to_impact=ahead if crash else None,
        time_to_end=ahead,
        twin=not crash,
        time_to_twin_impact=None if crash else (twin_last - frame) / 10,
        involvement=involvement,
    )


def evaluated(
    scores: Scores,
    protocol: str | CleanWarnings = "clean",
    pairs: int = 16,
    ids: tuple[int, int] = PAIR,
    time: float = 1.0,
    away: float = 0.0,
    agents: Sequence[tuple[str, str]] = (("ego_vehicle", "ego_involved"),),
) -> WarningEvaluator:
    """Accident recordings of 6 s and twins of 9 s, two samples a second; alarms `away` metres off."""
    evaluator = WarningEvaluator(protocol)
    for number in range(pairs):
        for ending, last in (("accident", 61), ("normal", 91)):
            for agent, involvement in agents:
                frames = np.arange(1, last + 1, 5)
                given = scores(ending == "accident", (last - frames) / 10)
                for frame, score in zip(frames, given, strict=True):
                    alarm = Accident(positions=MEETING + away, time=time, score=float(np.nan_to_num(score)), ids=ids)
                    evaluator.update(
                        f"type1_subtype1_{ending}/s{number}/{agent}/{frame:03d}",
                        [] if math.isnan(score) else [alarm],
                        None,
                        context(ending, int(frame), last, 61, involvement),
                    )
    return evaluator


def skilled(seed: int) -> Scores:
    """Higher scores before accidents, of a kind, strength, lead and noise that the seed draws."""
    source = np.random.default_rng(seed)
    kind = seed % 4
    strength, lead, noise = source.uniform(0.25, 0.6), source.uniform(0.5, 4.0), source.uniform(0.02, 0.3)

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


def headline(evaluator: WarningEvaluator) -> float:
    first = headlines("warning", evaluator.compute())[0]
    assert first.path == "groups/ego_involved/auc_ahead"
    assert first.value is not None
    return first.value


def always(_crash: bool, ahead: np.ndarray) -> np.ndarray:
    return np.ones(len(ahead))


def never(_crash: bool, ahead: np.ndarray) -> np.ndarray:
    return np.full(len(ahead), np.nan)


@pytest.mark.slow
def test_the_headline_ranks_skill_above_a_siren_silence_and_chance() -> None:
    honest = [evaluated(skilled(seed)) for seed in range(PREDICTORS)]
    lowest = min(headline(each) for each in honest)
    for trivial in (always, never):
        assert headline(evaluated(trivial)) == 0.5 < lowest
    for evaluator in honest:
        result = evaluator.compute()
        assert set(result.references) == {*TRIVIAL, *REFERENCES}
        for name in TRIVIAL:
            assert result.references[name]["ego_involved"].auc_ahead < result.groups["ego_involved"].auc_ahead


@pytest.mark.parametrize("ids", [PAIR, (33, 44)])
def test_a_siren_pays_in_precision_and_time_and_names_do_not_help_it(ids: tuple[int, int]) -> None:
    siren = evaluated(always, CleanWarnings(threshold=0.5), pairs=5, ids=ids).compute().groups["ego_involved"]
    assert (siren.operating.time_in_alarm, siren.operating.alarm_seconds_per_minute) == (1.0, 60.0)
    assert siren.operating.episodes_per_minute == pytest.approx(10)
    assert siren.operating.precision == 0.5
    assert siren.operating.tta0 == 6.0
    assert (siren.average_precision, siren.twin_wins) == (0.5, 0.5)


def test_whoever_names_others_foresees_nothing_but_where_recordings_count() -> None:
    """The place is wrong, too."""

    def right_time(crash: bool, ahead: np.ndarray) -> np.ndarray:
        return np.where(crash & (ahead <= 2), 0.9, np.nan)

    of_pair = evaluated(right_time, CleanWarnings(threshold=0.5), pairs=4, ids=(33, 44), away=50)
    misled = of_pair.compute().groups["ego_involved"]
    assert (misled.average_precision, misled.operating.precision, misled.operating.recall) == (0, 0, 0)
    whole = CleanWarnings(scores_of="recording", threshold=0.5)
    figures = evaluated(right_time, whole, pairs=4, ids=(33, 44), away=50).compute().groups["ego_involved"]
    assert (figures.average_precision, figures.area_under_curve, figures.twin_wins) == (1, 1, 1)
    assert (figures.operating.recall, figures.operating.tta0, figures.operating.time_in_alarm) == (1, 2, 0)


def test_twins_are_cut_to_the_accidents_length_and_the_impact_is_no_frame() -> None:
    """Who alarms at the impact alone foresees nothing; what a twin shows after it would have come does not count."""

    def at_the_impact(crash: bool, ahead: np.ndarray) -> np.ndarray:
        return np.where(ahead == 0, 1.0, np.nan)

    assert evaluated(at_the_impact, pairs=3).compute().groups["ego_involved"].average_precision == 0

    def late_in_twins(crash: bool, ahead: np.ndarray) -> np.ndarray:
        return np.where((ahead < 3) & ~np.bool_(crash), 1.0, np.where(crash & (ahead == 1), 0.4, np.nan))

    figures = evaluated(late_in_twins, pairs=3).compute().groups["ego_involved"]
    assert (figures.twin_wins, figures.average_precision) == (1.0, 1.0)
    assert figures.operating.time_in_alarm == 0


def test_length_does_not_tell_the_label() -> None:
    """Recordings without a twin are longer; who is the less sure the longer it drives is no better than chance."""

    def wearing_off(crash: bool, ahead: np.ndarray) -> np.ndarray:
        return 1 / (1 + np.arange(len(ahead)))

    evaluator = evaluated(wearing_off, pairs=6)
    others = {
        token: dict(counts, kind="others", to_end=None)
        for token, counts in evaluator.counts.items()
        if counts["kind"] == "twins"
    }
    alone = [counts for counts in evaluator.counts.values() if counts["kind"] == "accident"]
    figures = CleanWarnings().result([*alone, *others.values()]).groups["ego_involved"]
    assert figures.recordings == {"accident": 6, "twins": 0, "others": 6}
    assert figures.auc_ahead == 0.5


def test_alarms_for_later_than_the_horizon_are_none() -> None:
    result = evaluated(always, pairs=2, time=2.04).compute()
    assert result.beyond == 0
    assert result.groups["ego_involved"].average_precision == 0.5
    late = evaluated(always, pairs=2, time=900.0).compute()
    assert late.beyond == late.samples
    assert late.groups["ego_involved"].average_precision == 0
    assert "alarms are for later than the horizon and do not count" in " ".join(late.notes)


def test_agents_are_never_pooled_and_bystanders_lose_the_latency() -> None:
    agents = (
        ("ego_vehicle", "ego_involved"),
        ("ego_vehicle_behind", "bystander"),
        ("infrastructure", "infrastructure"),
    )

    def two_seconds(crash: bool, ahead: np.ndarray) -> np.ndarray:
        return np.where(crash & (ahead <= 2), 0.9, np.nan)

    groups = evaluated(two_seconds, pairs=3, agents=agents).compute().groups
    assert list(groups) == ["ego_involved", "bystander", "infrastructure"]
    assert {name: each.recordings["accident"] for name, each in groups.items()} == dict.fromkeys(groups, 3)
    assert groups["ego_involved"].tta0_after == {}
    assert groups["bystander"].tta0_after == pytest.approx({0.0: 2.0, 0.1: 1.9, 0.3: 1.7})


def test_the_operating_point_is_given_or_found() -> None:
    scores = [0.9, 0.8, 0.7, 0.6, 0.2]
    count = iter(scores)

    def one_each(crash: bool, ahead: np.ndarray) -> np.ndarray:
        return np.where(crash & (ahead == 1.5), next(count) if crash else np.nan, np.nan)

    evaluator = evaluated(one_each, pairs=5)
    found = evaluator.compute()
    assert found.operating_by == "recall"
    figures = found.groups["ego_involved"]
    assert (figures.operating, figures.operating.threshold, figures.operating.recall) == (figures.at_r80, 0.6, 0.8)
    assert (figures.best_f1, figures.quiet) == (0.2, 0.2)
    assert figures.operating.tta_hit == 1.5
    assert figures.operating.tta0 == pytest.approx(1.2)
    given = CleanWarnings(threshold=0.75).result(list(evaluator.counts.values()))
    assert [any("on these very recordings" in note for note in each.notes) for each in (found, given)] == [True, False]
    assert (given.operating_by, given.groups["ego_involved"].operating.recall) == ("given", 0.4)


def test_draws_are_as_the_result_of_the_same_samples_given_so_often() -> None:
    evaluator = evaluated(skilled(3), pairs=6)
    by_pair: dict[str, list] = {}
    for token, counts in evaluator.counts.items():
        by_pair.setdefault(token.split("/")[1], []).append(counts)
    parts = list(by_pair.values())
    times = np.array([[1] * 6, [2, 0, 1, 0, 3, 0], [0, 6, 0, 0, 0, 0]])
    drawn = [numbers_of(each) for each in evaluator.resampled(parts, times)]
    pooled = [evaluator.pooled(part) for part in parts]
    for draw, numbers in zip(times, drawn, strict=True):
        again = [each for part, often in zip(pooled, draw, strict=True) for _ in range(often) for each in part]
        expected = numbers_of(evaluator.result_of(again))
        assert expected.keys() == numbers.keys()
        assert_allclose(list(numbers.values()), list(expected.values()), rtol=1e-12)
    assert numbers_of(evaluator.result_of(list(evaluator.counts.values()))) == drawn[0]


def test_recall_and_lead_never_stand_without_precision_and_time_in_alarm() -> None:
    names = [each.name for each in headlines("warning", evaluated(skilled(0), pairs=3).compute())]
    leads = [at for at, name in enumerate(names) if name.startswith(("recall", "tta"))]
    assert leads
    for word in ("precision", "time_in_alarm"):
        assert min(at for at, name in enumerate(names) if word in name) < min(leads)


def test_field_says_why_a_number_is_none() -> None:
    result = evaluated(never, "field", pairs=2).compute()
    figures = result.figures["ustring ego_involved"]
    assert math.isnan(figures.average_precision)
    assert any("recordings without an accident count as true positives" in note for note in result.notes)


def test_what_a_code_prints_may_be_above_1() -> None:
    nothing = ScoreSeries(scores=np.zeros((4, 6)), positive=np.array([True, False] * 2), toa=np.full(4, 6.0), fps=2.0)
    assert printed_figures(nothing, "ustring").average_precision == 2.0
    assert math.isnan(field_figures(nothing, "ustring").average_precision)


def test_without_recordings_there_is_nothing() -> None:
    for protocol in ("clean", "field"):
        assert WarningEvaluator(protocol).compute().samples == 0
    empty = CleanScores(ScoreSeries(scores=np.zeros((0, 3)), positive=np.zeros(0, bool), toa=np.zeros(0), fps=2.0))
    assert math.isnan(empty.average_precision(np.zeros(0)))
    assert math.isnan(empty.at(0.5, np.zeros(0)).recall)


@pytest.mark.parametrize(
    ("choices", "error", "message"),
    [
        ({"scores_of": "scene"}, ChoiceError, "scores_of: expected one of pair, recording"),
        ({"threshold": math.inf}, ConfigError, "threshold: expected a number, or None"),
    ],
)
def test_choices_are_checked(choices: dict, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        CleanWarnings(**choices)


def test_means_over_draws_leave_unknown_numbers_out_and_keep_counts_and_words() -> None:
    parts = [{"a": {"x": value, "n": 3, "by": "f1"}} for value in (1.0, math.nan, 4.0)]
    assert mean_of(parts) == {"a": {"x": 2.5, "n": 3, "by": "f1"}}
    assert math.isnan(mean_of([math.nan, math.nan]))


def test_the_context_tells_involvement_twins_and_what_constant_velocities_lead_to(
    da_motion: DeepAccident, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a synthetic accident; just before the impact the colliding pair is foreseen."""
    crash = next(each for each in da_motion.scenario if each["collision"] is not None)
    pair = set(crash["collision"]["ids"])
    last = crash["num_frames"]
    for agent in ("ego_vehicle", "ego_vehicle_behind", "infrastructure"):
        there = accident_context(da_motion, f"{crash['token']}/{agent}/{last - 1:03d}", 2.0, references=True)
        expected = "bystander" if there.own_actor_id not in pair else "ego_involved"
        assert there.involvement == ("infrastructure" if agent == "infrastructure" else expected)
        assert tuple(there.references) == REFERENCES
        assert there.time_to_twin_impact is None
    involved = next(
        agent
        for agent in ("ego_vehicle", "ego_vehicle_behind", "other_vehicle", "other_vehicle_behind")
        if accident_context(da_motion, f"{crash['token']}/{agent}/001").own_actor_id in pair
    )
    foreseen = accident_context(da_motion, f"{crash['token']}/{involved}/{last - 1:03d}", 2.0, references=True)
    assert set(foreseen.references[REFERENCES[0]][0].ids) == pair
    twin = f"{crash['token'].replace('_accident/', '_normal/')}/{involved}/001"
    other = accident_context(da_motion, twin, 2.0)
    assert other.time_to_twin_impact == pytest.approx((last - 1) / 10)
    asked = []
    monkeypatch.setattr(accident_truth, "constant_velocity_alarms", lambda _boxes, _names, own: asked.append(own) or ())
    for agent in ("ego_vehicle", "ego_vehicle_behind", "infrastructure"):
        there = accident_context(da_motion, f"{crash['token']}/{agent}/{last - 1:03d}", 2.0, references=True)
        assert set(asked) == {there.own_actor_id if there.involvement == "ego_involved" else None}
        asked.clear()
    assert other.involvement == "ego_involved"


def test_constant_velocity_alarms_by_hand(da_motion: DeepAccident) -> None:
    boxes = da_motion.boxes(da_motion.training_samples("train")[0], "ego").select(np.arange(3))
    placed = replace(
        boxes,
        center=np.array([[0.0, 0, 0], [24, 0, 0], [0, 50, 0]]),
        rotation=np.tile([1.0, 0, 0, 0], (3, 1)),
        size=np.tile([4.0, 2, 2], (3, 1)),
        velocity=np.array([[10.0, 0, 0], [0, 0, 0], [np.nan, np.nan, np.nan]]),
        actor_id=np.array([-100, 7, 8]),
    )
    (alarm,) = constant_velocity_alarms(placed, {-100: 5}, None)
    assert alarm.ids == (5, 7)
    assert (alarm.time, alarm.score) == (pytest.approx(2.0), pytest.approx(1 / 3))
    assert_allclose(alarm.positions, [[20, 0], [24, 0]])
    assert constant_velocity_alarms(placed, {-100: 5}, 8) == ()


def test_results_are_as_json_holds_them() -> None:
    result = evaluated(skilled(1), pairs=3).compute()
    assert isinstance(result, AnticipationResult)
    assert result.as_dict()["groups"]["ego_involved"]["recordings"] == {"accident": 3, "twins": 3, "others": 0}


def test_random_rows_are_means_of_their_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    def row(draws: int) -> float:
        monkeypatch.setattr(anticipation, "RANDOM_DRAWS", draws)
        found = evaluated(skilled(0), pairs=4).compute()
        return next(each for name, each in found.references.items() if name.startswith("random"))[
            "ego_involved"
        ].auc_ahead

    one, two = row(1), row(2)
    assert one != two
    monkeypatch.setattr(anticipation, "mean_of", None)  # which one draw has no need of
    assert row(1) == one


def test_only_bystanders_and_the_pole_hand_their_alarm_on() -> None:
    evaluator = WarningEvaluator("clean")
    for involvement in ("ego_involved", "bystander", "infrastructure", ""):
        for frame in range(1, 41, 5):
            known = context("accident", frame, 41, 41, involvement)
            alarms = [Accident(positions=MEETING, time=1.0, score=0.5, ids=PAIR)]
            evaluator.update(f"type1_subtype1_accident/s{involvement}/ego_vehicle/{frame:03d}", alarms, None, known)
    groups = evaluator.compute().groups
    assert {name: bool(each.tta0_after) for name, each in groups.items()} == {
        "ego_involved": False,
        "bystander": True,
        "infrastructure": True,
        "unknown": False,
    }


@pytest.mark.parametrize("references", [False, True])
def test_the_published_metrics_of_reference_predictors_are_counted_where_they_are_asked_for(
    *, references: bool
) -> None:
    evaluator = evaluated(skilled(0), "field", pairs=2)
    counts = [evaluator.counts[token] for token in evaluator.counts]
    made = evaluator.protocol.result(counts, references=references)
    assert bool(made.references) is references


def test_the_surest_right_alarm_is_the_surest() -> None:
    alarms = [[0.2, True], [0.9, False], [0.6, True]]
    assert surest(alarms, "accident") == [0.6, 0.9]
    assert surest(alarms, "twins") == [0.9, 0.9]


def test_predictors_that_know_nothing_work_at_a_threshold_of_their_own() -> None:
    result = evaluated(skilled(0), pairs=8).compute()
    recall = {name: each["ego_involved"].operating.recall for name, each in result.references.items()}
    assert (recall["always"], recall["never"]) == (1, 0)
    assert 0.2 < recall["random per recording"] < 0.8
    assert not [note for note in result.notes if "no recording" in note]
