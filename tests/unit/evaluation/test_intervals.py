"""Intervals of numbers by Student's t and Wilson's formula, numbers without one, and the ranges of
numbers.
"""

import math
from collections.abc import Collection, Sequence
from functools import partial
from itertools import chain

import numpy as np
import pytest
import scipy.stats
from numpy.testing import assert_allclose
from support.expected_errors import assert_raises
from support.spawned_evaluation import RatioEvaluator, RatioResult

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.evaluation.evaluator import Counts
from deepaccident_devkit.evaluation.intervals import (
    MIN_CLUSTERS,
    Intervals,
    Resampling,
    difference_intervals,
    has_interval,
    interval_ends,
    intervals_of,
    numbers_of,
    numbers_of_draws,
    pool_clusters,
    range_of,
)
from deepaccident_devkit.evaluation.motion import MotionEvaluator
from deepaccident_devkit.evaluation.runs.setups import TASKS, EvaluationSetup
from deepaccident_devkit.evaluation.task import Row
from deepaccident_devkit.plugins.safety.prevention_result import PreventedResult


def intervals_by_cluster(
    above: Sequence[float],
    below: Sequence[float] | None = None,
    resampling: Resampling | None = None,
) -> Intervals:
    """Return intervals of a ratio of sums, with one sample in each cluster."""
    samples = [
        {"above": float(numerator), "below": float(denominator)}
        for numerator, denominator in zip(above, below or [1.0] * len(above), strict=True)
    ]
    evaluator = RatioEvaluator()
    clusters = [[sample] for sample in samples]
    return intervals_of(evaluator, clusters, evaluator.result_of(samples), resampling)


class TotalEvaluator(RatioEvaluator):
    """An evaluator of a sum, under the name of a ratio."""

    def result_of(self, counts: Collection[Counts]) -> RatioResult:
        return RatioResult(float(sum(sample["above"] for sample in counts)))


def wilson_interval(share: float, count: float, t: float) -> tuple[float, float]:
    """Return Wilson's interval of `count` independent draws."""
    shrinkage = 1 + t**2 / count
    middle = (share + t**2 / 2 / count) / shrinkage
    variance = share * (1 - share) / count + t**2 / 4 / count**2
    half = t / shrinkage * math.sqrt(variance)
    return middle - half, middle + half


@pytest.mark.parametrize(("confidence", "t"), [(0.95, 2.0930), (0.9, 1.7291)])
def test_a_share_of_independent_clusters_is_wilsons(confidence: float, t: float) -> None:
    """The share is 10 of 20: 19 draws, because of n / (n − 1), and 19 degrees of freedom."""
    resampling = Resampling(confidence=confidence)
    ends = intervals_by_cluster([0, 1] * 10, resampling=resampling).ends["ratio"]
    assert ends == pytest.approx(wilson_interval(0.5, 19, t), abs=1e-4)


@pytest.mark.parametrize(("share", "end"), [(0.0, 0), (1.0, 1)])
def test_a_share_that_all_clusters_agree_on_is_not_sure(share: float, end: int) -> None:
    """The interval is not [0, 0] nor [1, 1], but that of one draw for each cluster, however many
    samples the clusters have.
    """
    for samples in (1.0, 20.0):
        ends = intervals_by_cluster([share * samples] * 12, [samples] * 12).ends["ratio"]
        assert ends == pytest.approx(wilson_interval(share, 12, 2.2010), abs=1e-4)
        assert ends[end] == share
        assert abs(ends[1 - end] - share) > 0.25

    # 50 more clusters have nothing to count
    above = [share] * 8 + [0] * 50
    below = [1] * 8 + [0] * 50
    ends = intervals_by_cluster(above, below).ends["ratio"]
    assert ends == pytest.approx(wilson_interval(share, 8, 2.3646), abs=1e-4)


def test_a_mean_from_0_on_has_an_interval_by_factors() -> None:
    low, high = intervals_by_cluster([1.0, 3.0] * 10).ends["ratio"]

    assert low * high == pytest.approx(2.0**2)
    half_width = 2.0930 * math.sqrt(1 / 19) / 2
    assert math.log(high / 2) == pytest.approx(half_width, abs=1e-4)


TOO_FEW_CLUSTERS = f"at least {MIN_CLUSTERS} needed"


@pytest.mark.parametrize(
    ("above", "below", "resampling", "ends", "notes"),
    [
        (
            [0, 1, 0, 1, 1],
            None,
            None,
            (),
            (f"no confidence intervals: 5 scenario pairs, {TOO_FEW_CLUSTERS}",),
        ),
        ([1], None, None, (), (f"no confidence intervals: 1 scenario pair, {TOO_FEW_CLUSTERS}",)),
        ([0, 1] * 3, None, None, ("ratio",), ()),
        (
            [0.3, 0.4, 0.5, 0.2, 0.1] + [0] * 20,
            [1] * 5 + [0] * 20,
            None,
            (),
            ("no interval for ratio: fewer than 6 clusters have such a number",),
        ),
        ([2.5] * 20, None, None, (), ("no interval for ratio: fewer than 6 clusters change it",)),
        (
            [0.1 * 3, 0.3] * 10,
            [0.1, 0.1] * 10,
            None,
            (),
            ("no interval for ratio: fewer than 6 clusters change it",),
        ),
        ([0, 1] * 10, None, None, ("ratio",), ()),  # NaN and medians have no interval
        ([0, 1] * 10, None, Resampling(resamples=0), (), ()),
    ],
)
def test_which_numbers_have_an_interval(above, below, resampling, ends, notes) -> None:
    intervals = intervals_by_cluster(above, below, resampling)
    assert (tuple(intervals.ends), intervals.notes) == (ends, notes)


def test_many_clusters_are_joined() -> None:
    clusters = [[{"number": number}] for number in range(345)]
    parts = pool_clusters(clusters, Resampling())
    assert [len(part) for part in parts] == [4] * 45 + [3] * 55
    assert sorted(sample["number"] for sample in chain(*parts)) == list(range(345))
    assert (
        parts
        == pool_clusters(clusters, Resampling())
        != pool_clusters(clusters, Resampling(seed=1))
    )

    assert len(pool_clusters(clusters, Resampling(resamples=40))) == 40
    assert len(pool_clusters(clusters, Resampling(resamples=2))) == MIN_CLUSTERS
    assert pool_clusters(clusters[:100], Resampling()) == clusters[:100]
    assert len(pool_clusters(clusters[:101], Resampling())) == 100


def interval_by_hand(
    value: float,
    left_out: list[float],
    limits: tuple[float, float],
    clusters_with_number: int,
    confidence: float,
) -> tuple[float, float]:
    """Return the interval of one number by scipy's t and the formulas of docs/numbers.md."""
    count = len(left_out)
    lowest, highest = limits
    differences = [estimate - value for estimate in left_out]
    squares = sum(difference**2 for difference in differences)
    changing = sum(difference != 0 for difference in differences)
    error = math.sqrt((count - 1) / count * squares)
    width = highest - lowest if math.isfinite(highest) else abs(value)
    is_same = error <= 1e-9 * width
    if is_same and math.isinf(highest):
        return math.nan, math.nan
    if (clusters_with_number if is_same else changing) < MIN_CLUSTERS:
        return math.nan, math.nan

    probability = (1 + confidence) / 2
    kurtosis_minus_1 = math.nan
    if not is_same:
        kurtosis_minus_1 = count * sum(difference**4 for difference in differences) / squares**2 - 1
    freedom = max(min(changing - 1, count / max(kurtosis_minus_1, 1e-12)), 1)
    t = scipy.stats.t.ppf(probability, freedom)
    if math.isinf(highest) and lowest == 0:
        factor = math.exp(t * error / value)
        return value / factor, value * factor
    if math.isinf(highest):
        return value - t * error, value + t * error

    share = (value - lowest) / width
    one_draw_each = (
        scipy.stats.t.ppf(probability, clusters_with_number - 1) ** 2 / clusters_with_number
    )
    spread = one_draw_each
    if not is_same:
        variance = (error / width) ** 2 / (share * (1 - share))
        by_error = min(t**2 * variance, one_draw_each)
        spread = max(one_draw_each * clusters_with_number * variance, by_error)
    middle = share + spread / 2
    half = math.sqrt(spread * share * (1 - share) + spread**2 / 4)
    low = max((middle - half) / (1 + spread), 0)
    high = min((middle + half) / (1 + spread), 1)
    return lowest + width * low, lowest + width * high


@pytest.mark.parametrize("seed", range(40))
def test_ends_equal_the_formulas_number_by_number(seed: int) -> None:
    """Take few and many parts; some change no number, and some change it much more than others."""
    generator = np.random.default_rng(seed)
    count = int(generator.integers(6, 25))
    confidence = (0.9, 0.95)[seed % 2]
    limits = [(0.0, 1.0), (0.0, 100.0), (0.0, math.inf), (-math.inf, math.inf)]
    values = generator.uniform(0.2, 0.8, 4) * [1, 100, 9, 9]
    differences = generator.normal(0, generator.choice([0.1, 0.01, 0.3]), (count, 4))
    differences = differences * (generator.random((count, 4)) < 0.8)
    differences[0] *= generator.choice([1, 5])
    differences *= [0.1, 10, 0.9, 0.9] * (generator.random(4) < 0.9)
    clusters_with_number = generator.integers(5, count + 1, 4)
    estimates = values + differences

    low, high = interval_ends(values, estimates, np.array(limits), confidence, clusters_with_number)
    for index in range(4):
        expected = interval_by_hand(
            float(values[index]),
            estimates[:, index].tolist(),
            limits[index],
            int(clusters_with_number[index]),
            confidence,
        )
        assert (low[index], high[index]) == pytest.approx(expected, nan_ok=True)


@pytest.mark.parametrize(("share", "end"), [(0.0, 0), (1.0, 1)])
def test_a_share_of_none_or_all_ends_there_exactly(share: float, end: int) -> None:
    limits = np.array([[0, 1]])
    for count in range(MIN_CLUSTERS, 400):
        estimates = np.full((count, 1), share)
        ends = interval_ends(np.array([share]), estimates, limits, 0.95)
        assert ends[end] == share
        assert ends[1 - end] != share


def test_settings_and_their_edges() -> None:
    assert Resampling() == Resampling(resamples=1000, confidence=0.95, seed=0)
    assert Resampling(resamples=100_000, confidence=0.001, seed=0).resamples == 100_000
    for name, expectation, values in (
        ("resamples", "from 0 to 100,000", (100_001, -1, True, 10.0)),
        ("seed", "from 0", (-1, 1.0)),
        ("confidence", "such as 0.95", (0, 1, 95)),
    ):
        for value in values:
            message = (f"{name}: expected", expectation, f"found {value!r}")
            assert_raises((partial(Resampling, **{name: value}), ConfigError, message))


def test_the_difference_of_two_runs_has_its_own_interval() -> None:
    first = [[{"above": 0.5, "below": 1.0}]] * 20
    second = [[{"above": -0.5, "below": 1.0}], [{"above": 3.5, "below": 1.0}]] * 10
    differences = {"ratio": 1.0, "median_of_all": 0.0}
    intervals = difference_intervals(RatioEvaluator(), (first, second), differences, Resampling())

    error = 2 / math.sqrt(19)
    low, high = 1 - 2.0930 * error, 1 + 2.0930 * error
    assert_allclose(intervals, [[low, math.nan], [high, math.nan], [error, 0]], atol=1e-3)


def test_a_share_that_depends_on_one_part_is_as_sure_as_one_draw_a_part() -> None:
    """With one degree of freedom t is 12.7, and the interval would be much wider."""
    estimates = [0.55, *[0.5 + 1e-7, 0.5 - 1e-7] * 9, 0.5 + 1e-7]
    ends = interval_ends(np.array([0.5]), np.reshape(estimates, (-1, 1)), np.array([[0, 1]]), 0.95)
    assert np.ravel(ends) == pytest.approx(wilson_interval(0.5, 20, 2.0930), abs=1e-4)


def test_the_numbers_of_a_result() -> None:
    numbers = numbers_of(MotionEvaluator().compute())
    assert list(numbers) == [
        "ranges/30x30/iou",
        "ranges/30x30/pq",
        "ranges/30x30/sq",
        "ranges/30x30/rq",
        "ranges/100x100/iou",
        "ranges/100x100/pq",
        "ranges/100x100/sq",
        "ranges/100x100/rq",
        "min_ade",
        "min_fde",
        "miss_rate",
        "path_accuracy",
    ]

    nested = {5.0: [RatioResult(0.5)], "words": ("a", None, 3, 2.0)}
    expected = {
        "5/0/ratio": 0.5,
        "5/0/nothing": math.nan,
        "5/0/median_of_all": 0.5,
        "words/3": 2.0,
    }
    assert numbers_of(nested) == pytest.approx(expected, nan_ok=True)


OWN_ROWS = tuple(chain.from_iterable(task.result_class.rows for task in TASKS.values()))
ROWS: tuple[Row, ...] = (*OWN_ROWS, *PreventedResult.rows)
PERCENTS = (
    "ranges/30x30/iou",
    "ranges/30x30/pq",
    "ranges/30x30/sq",
    "ranges/30x30/rq",
    "mean_average_precision",
    "class_average_precision/car",
)
SHARES = (
    "apa",
    "average_precision",
    "false_alarm_rate",
    "id_error",
    "precision",
    "recall",
    "within/5/accuracy",
    "beside/sample_choice=mean_first/within/5/accuracy",
    "mean_errors/ASE",
    "miss_rate",
    "path_accuracy",
    "groups/all/auc_ahead",
    "groups/all/twin_wins",
    "groups/all/area_under_curve",
    "groups/all/operating/early_share",
    "groups/all/operating/time_in_alarm",
    "figures/drive all/recall_at_half",
    "precision_at_half",
    "precision_at_r80",
    "shares/a",
    "warned",
    "extrapolated",
)
SIGNED = (
    "lateness",
    "beside/time/lateness",
    "theirs",
    "means/lead 2 s/given/lost",
    "means/lead 2 s/given/lost_way",
    "means/lead 2 s/given/lost_twins",
    "means/lead 2 s/given/lost_way_twins",
    "means/lead 0.5 s/full braking/lost",
    "beside/leads=1/means/bystander, lead 1 s/given/lost_way",
)
AMOUNTS = (
    "min_ade",
    "min_fde",
    "position_error",
    "time_error",
    "mean_errors/ATE",
    "mean_errors/AOE",
    "mean_errors/AVE",
    "groups/all/mean_time",
    "operating/tta_hit",
    "operating/tta0",
    "groups/all/tta0_after/2",
    "figures/dad all/time_at_r80",
    "time_at_half",
    "episodes_per_minute",
    "alarm_seconds_per_minute",
    "braking_seconds_per_minute",
)


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        *((path, (0, 100)) for path in PERCENTS),
        *((path, (0, 1)) for path in SHARES),
        *((path, (0, math.inf)) for path in AMOUNTS),
        *((path, (-math.inf, math.inf)) for path in SIGNED),
    ],
)
def test_the_unit_of_a_number_decides_its_range(path: str, expected: tuple[float, float]) -> None:
    assert range_of(path, np.array([-0.5, 0.5]), ROWS) == expected


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([0.0, 0.5, 1.0, math.nan], (0, 1)),
        ([0.0, 1.5], (0, math.inf)),
        ([-0.1, 0.5], (-math.inf, math.inf)),
        ([math.nan], (0, 1)),
        ([0.2, math.inf], (0, 1)),
        ([1.001], (0, math.inf)),
        ([-0.001, 3.0], (-math.inf, math.inf)),
    ],
)
def test_the_range_of_an_unknown_number_is_that_of_its_clusters(
    values: list[float], expected: tuple[float, float]
) -> None:
    assert range_of("theirs", np.array(values), ROWS) == expected


def test_a_number_above_those_of_all_its_clusters_is_no_share() -> None:
    """A number that adds up has an interval by logarithms, and clusters that change it."""
    clusters = [[{"above": 0.2 + 0.01 * index, "below": 0.0}] for index in range(12)]
    result = TotalEvaluator().result_of([*chain(*clusters)])
    intervals = intervals_of(TotalEvaluator(), clusters, result)

    assert intervals.notes == ()

    low, high = intervals.ends["ratio"]
    assert 0 < low < result.ratio < high


def test_totals_settings_and_medians_have_no_interval() -> None:
    for path in (
        "false_recordings",
        "within/5/distance",
        "median_warning",
        "threshold",
        "at/best_f1",
        "quiet",
        "beside/a=b/within/5/distance",
    ):
        assert has_interval(path) is False
    for row in ROWS:
        if row.unit != "count":
            assert has_interval(row.path.replace("*", "5"))


@pytest.mark.parametrize("task", TASKS)
def test_every_number_of_the_devkit_has_a_unit(task: str) -> None:
    """Without a unit, its range would be guessed from its clusters, and change with them."""
    rows = TASKS[task].result_class.rows
    for protocol in TASKS[task].protocols:
        result = EvaluationSetup(task=task, protocol=protocol).evaluator().compute()
        for path in numbers_of(result):
            ranges = {range_of(path, np.array([value]), rows) for value in (0.5, 2.0, -1.0)}
            assert len(ranges) == 1 or not has_interval(path), path


def test_draws_of_no_numbers_are_empty_rows() -> None:
    repetitions = np.eye(6, dtype=np.int64)
    draws = numbers_of_draws(RatioEvaluator(), [[]] * 6, repetitions, [])
    assert draws.shape == (6, 0)
