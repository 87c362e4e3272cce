"""Intervals of numbers: by Student's t and Wilson's formula, and where there is none; what numbers
can be.
"""

import math
from collections.abc import Collection, Sequence
from functools import partial
from itertools import chain

import numpy as np
import pytest
import scipy.stats
from evaluating import Ratio, Ratios
from numpy.testing import assert_allclose
from refusals import assert_refused

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.evaluation.evaluator import Counts
from deepaccident_devkit.evaluation.intervals import (
    LEAST_CLUSTERS,
    Intervals,
    Resampling,
    difference_intervals,
    has_interval,
    interval_ends,
    intervals_of,
    numbers_of,
    numbers_of_draws,
    parts_of,
    range_of,
)
from deepaccident_devkit.evaluation.motion import MotionEvaluator
from deepaccident_devkit.evaluation.runs.setups import TASKS, EvaluationSetup
from deepaccident_devkit.evaluation.task import Row
from deepaccident_devkit.plugins.safety.prevention_result import PreventedResult


def made(
    above: Sequence[float],
    below: Sequence[float] | None = None,
    resampling: Resampling | None = None,
) -> Intervals:
    """Of one sample a cluster."""
    given = zip(above, below or [1.0] * len(above), strict=True)
    clusters = [[{"above": float(one), "below": float(other)}] for one, other in given]
    evaluator = Ratios()
    result = evaluator.result_of([sample for samples in clusters for sample in samples])
    return intervals_of(evaluator, clusters, result, resampling)


class Totals(Ratios):
    """Sums, under the name of a ratio."""

    def result_of(self, counts: Collection[Counts]) -> Ratio:
        return Ratio(float(sum(each["above"] for each in counts)))


def wilson(share: float, count: float, t: float) -> tuple[float, float]:
    """Wilson's interval of `count` independent draws."""
    middle = (share + t**2 / 2 / count) / (1 + t**2 / count)
    half = t / (1 + t**2 / count) * math.sqrt(share * (1 - share) / count + t**2 / 4 / count**2)
    return middle - half, middle + half


@pytest.mark.parametrize(("confidence", "t"), [(0.95, 2.0930), (0.9, 1.7291)])
def test_a_share_of_independent_clusters_is_wilsons(confidence: float, t: float) -> None:
    """Of 10 of 20: as many draws as clusters but for n / (n − 1), and 19 degrees of freedom."""
    ends = made([0, 1] * 10, resampling=Resampling(confidence=confidence)).ends["ratio"]
    assert ends == pytest.approx(wilson(0.5, 19, t), abs=1e-4)


@pytest.mark.parametrize(("hit", "at"), [(0.0, 0), (1.0, 1)])
def test_a_share_that_all_clusters_agree_on_is_not_sure(hit: float, at: int) -> None:
    """Not [0, 0] nor [1, 1]: it is as of one draw a cluster, however many samples these have."""
    for samples in (1.0, 20.0):
        ends = made([hit * samples] * 12, [samples] * 12).ends["ratio"]
        assert ends == pytest.approx(wilson(hit, 12, 2.2010), abs=1e-4)
        assert ends[at] == hit
        assert abs(ends[1 - at] - hit) > 0.25
    few = made([hit] * 8 + [0] * 50, [1] * 8 + [0] * 50).ends[
        "ratio"
    ]  # 50 clusters have nothing to count
    assert few == pytest.approx(wilson(hit, 8, 2.3646), abs=1e-4)


def test_a_mean_from_0_on_has_an_interval_by_factors() -> None:
    low, high = made([1.0, 3.0] * 10).ends["ratio"]
    assert low * high == pytest.approx(2.0**2)
    assert math.log(high / 2) == pytest.approx(2.0930 * math.sqrt(1 / 19) / 2, abs=1e-4)


LEFT_OUT = f"(an accident and its twin are one); at least {LEAST_CLUSTERS} are needed"


@pytest.mark.parametrize(
    ("above", "below", "resampling", "ends", "notes"),
    [
        ([0, 1, 0, 1, 1], None, None, (), (f"no intervals: of 5 clusters {LEFT_OUT}",)),
        ([1], None, None, (), (f"no intervals: of 1 cluster {LEFT_OUT}",)),
        ([0, 1] * 3, None, None, ("ratio",), ()),
        (
            [0.3, 0.4, 0.5, 0.2, 0.1] + [0] * 20,
            [1] * 5 + [0] * 20,
            None,
            (),
            ("no interval of ratio: fewer than 6 clusters have such a number",),
        ),
        ([2.5] * 20, None, None, (), ("no interval of ratio: fewer than 6 clusters change it",)),
        (
            [0.1 * 3, 0.3] * 10,
            [0.1, 0.1] * 10,
            None,
            (),
            ("no interval of ratio: fewer than 6 clusters change it",),
        ),
        ([0, 1] * 10, None, None, ("ratio",), ()),  # of NaN and of medians there is none
        ([0, 1] * 10, None, Resampling(resamples=0), (), ()),
    ],
)
def test_which_numbers_have_an_interval(above, below, resampling, ends, notes) -> None:
    found = made(above, below, resampling)
    assert (tuple(found.ends), found.notes) == (ends, notes)


def test_many_clusters_are_joined() -> None:
    clusters = [[{"number": number}] for number in range(345)]
    parts = parts_of(clusters, Resampling())
    assert [len(part) for part in parts] == [4] * 45 + [3] * 55
    assert sorted(each["number"] for part in parts for each in part) == list(range(345))
    assert parts == parts_of(clusters, Resampling()) != parts_of(clusters, Resampling(seed=1))
    assert len(parts_of(clusters, Resampling(resamples=40))) == 40
    assert len(parts_of(clusters, Resampling(resamples=2))) == LEAST_CLUSTERS
    assert parts_of(clusters[:100], Resampling()) == clusters[:100]
    assert len(parts_of(clusters[:101], Resampling())) == 100


def plain_ends(
    value: float, left_out: list[float], limits: tuple[float, float], having: int, confidence: float
) -> tuple[float, float]:
    """By scipy's t and the formulas of docs/numbers.md, number by number."""
    count, apart, (least, most) = len(left_out), [each - value for each in left_out], limits
    squares, changing = sum(each**2 for each in apart), sum(each != 0 for each in apart)
    error = math.sqrt((count - 1) / count * squares)
    width = most - least if math.isfinite(most) else abs(value)
    same = error <= 1e-9 * width
    if (having if same else changing) < LEAST_CLUSTERS or (same and math.isinf(most)):
        return math.nan, math.nan
    likely = (1 + confidence) / 2
    unlike = math.nan if same else count * sum(each**4 for each in apart) / squares**2 - 1
    t = scipy.stats.t.ppf(likely, max(min(changing - 1, count / max(unlike, 1e-12)), 1))
    if math.isinf(most):
        factor = math.exp(t * error / value)
        return (
            (value / factor, value * factor)
            if least == 0
            else (value - t * error, value + t * error)
        )
    share, one_a_part = (value - least) / width, scipy.stats.t.ppf(likely, having - 1) ** 2 / having
    unsure = one_a_part
    if not same:
        variance = (error / width) ** 2 / (share * (1 - share))
        unsure = max(one_a_part * having * variance, min(t**2 * variance, one_a_part))
    middle, half = share + unsure / 2, math.sqrt(unsure * share * (1 - share) + unsure**2 / 4)
    low, high = ((middle + side * half) / (1 + unsure) for side in (-1, 1))
    return least + width * max(low, 0), least + width * min(high, 1)


@pytest.mark.parametrize("seed", range(40))
def test_ends_are_those_of_the_formulas_number_by_number(seed: int) -> None:
    """Of few and many parts, some of which do not change a number, or by much more than others."""
    source = np.random.default_rng(seed)
    count, confidence = int(source.integers(6, 25)), (0.9, 0.95)[seed % 2]
    limits = [(0.0, 1.0), (0.0, 100.0), (0.0, math.inf), (-math.inf, math.inf)]
    values = source.uniform(0.2, 0.8, 4) * [1, 100, 9, 9]
    apart = source.normal(0, source.choice([0.1, 0.01, 0.3]), (count, 4)) * (
        source.random((count, 4)) < 0.8
    )
    apart[0] *= source.choice([1, 5])
    apart *= [0.1, 10, 0.9, 0.9] * (source.random(4) < 0.9)
    having = source.integers(5, count + 1, 4)
    low, high = interval_ends(values, values + apart, np.array(limits), confidence, having)
    for at in range(4):
        left_out = (values + apart)[:, at].tolist()
        expected = plain_ends(float(values[at]), left_out, limits[at], int(having[at]), confidence)
        assert (low[at], high[at]) == pytest.approx(expected, nan_ok=True)


@pytest.mark.parametrize(("share", "end"), [(0.0, 0), (1.0, 1)])
def test_a_share_of_none_or_all_ends_there_exactly(share: float, end: int) -> None:
    for count in range(LEAST_CLUSTERS, 400):
        ends = interval_ends(
            np.array([share]), np.full((count, 1), share), np.array([[0, 1]]), 0.95
        )
        assert ends[end] == share
        assert ends[1 - end] != share


def test_settings_and_their_edges() -> None:
    assert Resampling() == Resampling(resamples=1000, confidence=0.95, seed=0)
    assert Resampling(resamples=100_000, confidence=0.001, seed=0).resamples == 100_000
    assert_refused(
        *(
            (
                partial(Resampling, **{name: value}),
                ConfigError,
                (f"{name}: expected", words, f"found {value!r}"),
            )
            for name, words, values in (
                ("resamples", "from 0 to 100,000", (100_001, -1, True, 10.0)),
                ("seed", "from 0", (-1, 1.0)),
                ("confidence", "such as 0.95", (0, 1, 95)),
            )
            for value in values
        )
    )


def test_the_difference_of_two_runs_has_its_own_interval() -> None:
    first, second = (
        [[{"above": hit, "below": 1.0}] for hit in run] for run in ([0.5] * 20, [-0.5, 3.5] * 10)
    )
    made = difference_intervals(
        Ratios(), (first, second), {"ratio": 1.0, "median_of_all": 0.0}, Resampling()
    )
    error = 2 / math.sqrt(19)
    assert_allclose(
        made,
        [[1 - 2.0930 * error, math.nan], [1 + 2.0930 * error, math.nan], [error, 0]],
        atol=1e-3,
    )


def test_a_share_that_hangs_on_one_part_is_no_less_sure_than_as_many_draws_as_parts() -> None:
    """With a degree of freedom t is 12.7, and the interval would be much wider."""
    left_out = np.array([0.55, *[0.5 + 1e-7, 0.5 - 1e-7] * 9, 0.5 + 1e-7])[:, None]
    ends = interval_ends(np.array([0.5]), left_out, np.array([[0, 1]]), 0.95)
    assert np.ravel(ends) == pytest.approx(wilson(0.5, 20, 2.0930), abs=1e-4)


def test_the_numbers_of_a_result() -> None:
    numbers = numbers_of(MotionEvaluator().compute())
    scales = [
        f"ranges/{name}/{each}"
        for name in ("30x30", "100x100")
        for each in ("iou", "pq", "sq", "rq")
    ]
    assert list(numbers) == [*scales, "min_ade", "min_fde", "miss_rate", "path_accuracy"]
    assert numbers_of({5.0: [Ratio(0.5)], "words": ("a", None, 3, 2.0)}) == pytest.approx(
        {"5/0/ratio": 0.5, "5/0/nothing": math.nan, "5/0/median_of_all": 0.5, "words/3": 2.0},
        nan_ok=True,
    )


OWN_ROWS = tuple(chain.from_iterable(each.result_class.rows for each in TASKS.values()))
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
    *(
        "apa",
        "average_precision",
        "false_alarm_rate",
        "id_error",
        "precision",
        "recall",
        "within/5/accuracy",
    ),
    *(
        "beside/sample_choice=mean_first/within/5/accuracy",
        "mean_errors/ASE",
        "miss_rate",
        "path_accuracy",
    ),
    *(
        "groups/all/auc_ahead",
        "groups/all/twin_wins",
        "groups/all/area_under_curve",
        "groups/all/operating/early_share",
    ),
    *(
        "groups/all/operating/time_in_alarm",
        "figures/drive all/recall_at_half",
        "precision_at_half",
        "precision_at_r80",
    ),
    *("shares/a", "warned", "extrapolated"),
)
SIGNED = (
    *(
        f"means/lead 2 s/given/{name}"
        for name in ("lost", "lost_way", "lost_twins", "lost_way_twins")
    ),
    *(
        "means/lead 0.5 s/full braking/lost",
        "beside/leads=1/means/bystander, lead 1 s/given/lost_way",
    ),
)
AMOUNTS = (
    *(
        "min_ade",
        "min_fde",
        "position_error",
        "time_error",
        "mean_errors/ATE",
        "mean_errors/AOE",
        "mean_errors/AVE",
    ),
    *("groups/all/mean_time", "operating/tta_hit", "operating/tta0", "groups/all/tta0_after/2"),
    "figures/dad all/time_at_r80",
    *(
        "time_at_half",
        "episodes_per_minute",
        "alarm_seconds_per_minute",
        "braking_seconds_per_minute",
    ),
)


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        *((path, (0, 100)) for path in PERCENTS),
        *((path, (0, 1)) for path in SHARES),
        *((path, (0, math.inf)) for path in AMOUNTS),
        *(
            (path, (-math.inf, math.inf))
            for path in ("lateness", "beside/time/lateness", "theirs", *SIGNED)
        ),
    ],
)
def test_a_unit_tells_what_a_number_can_be(path: str, expected: tuple[float, float]) -> None:
    assert range_of(path, np.array([-0.5, 0.5]), ROWS) == expected


@pytest.mark.parametrize(
    ("alone", "expected"),
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
def test_a_number_of_others_is_what_its_clusters_are(
    alone: list[float], expected: tuple[float, float]
) -> None:
    assert range_of("theirs", np.array(alone), ROWS) == expected


def test_a_number_that_is_larger_of_all_clusters_than_of_each_is_no_share() -> None:
    """One that adds up: its interval is by logarithms, and no note says that nothing changes it."""
    clusters = [[{"above": 0.2 + 0.01 * at, "below": 0.0}] for at in range(12)]
    found = intervals_of(Totals(), clusters, Totals().result_of([each for (each,) in clusters]))
    assert found.notes == ()
    assert (
        0
        < found.ends["ratio"][0]
        < sum(each["above"] for (each,) in clusters)
        < found.ends["ratio"][1]
    )


def test_totals_settings_and_medians_have_no_interval() -> None:
    without = (
        "false_recordings",
        "within/5/distance",
        "median_warning",
        "threshold",
        "at/best_f1",
        "quiet",
    )
    assert [has_interval(path) for path in (*without, "beside/a=b/within/5/distance")] == [
        False
    ] * 7
    assert all(has_interval(path.replace("*", "5")) for path in (row.path for row in ROWS))


@pytest.mark.parametrize("task", TASKS)
def test_every_number_of_the_devkits_own_has_a_unit(task: str) -> None:
    """Else it would be taken for what its clusters are, and change with them."""
    rows = TASKS[task].result_class.rows
    for protocol in TASKS[task].protocols:
        for path in numbers_of(EvaluationSetup(task=task, protocol=protocol).evaluator().compute()):
            guesses = {range_of(path, np.array(alone), rows) for alone in ([0.5], [2.0], [-1.0])}
            assert len(guesses) == 1 or not has_interval(path), path


def test_draws_of_no_numbers_are_rows_without_any() -> None:
    assert numbers_of_draws(Ratios(), [[]] * 6, np.eye(6, dtype=np.int64), []).shape == (6, 0)
