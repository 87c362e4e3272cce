"""`ForecastingEvaluator`, on actors with known errors."""

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import ChoiceError, ConfigError, EvaluationError
from deepaccident_devkit.evaluation.forecasting import (
    Forecast,
    ForecastingEvaluator,
    ForecastingProtocol,
    ForecastingResult,
    ForecastingTruth,
)

MAIN = "3 s, K = 6"
SINGLE_MODE = "3 s, K = 1"
SECONDS = (1.0, 2.0, 3.0)


def make_truth(*seconds: float, scenario: str = "a/b", collider: int = 0) -> ForecastingTruth:
    """Make actors 1, 2, … that go ahead at 10 m/s, 20 m apart from left to right, and that are
    recorded for these seconds.
    """
    actors = np.arange(1, len(seconds) + 1)
    times = np.arange(1, 51) / 10
    path = np.empty((len(actors), 50, 2))
    path[:, :, 0] = 10 * times
    path[:, :, 1] = -20.0 * actors[:, None]
    path[times > np.array(seconds)[:, None]] = np.nan
    return ForecastingTruth(
        scenario=scenario,
        actor_id=actors,
        present=np.column_stack([np.zeros(len(actors)), -20.0 * actors]),
        path=path,
        groups=("all", "collider", "other"),
        members=np.stack([actors > 0, actors == collider, actors != collider]),
    )


def make_forecast(
    actor: int,
    shifts: Sequence[float],
    seconds: Sequence[float] = SECONDS,
    probabilities: Sequence[float] | None = None,
) -> Forecast:
    """Make modes that go as the actor goes, but each is shifted to the side at its end, metres."""
    times = np.array(seconds)
    paths = np.empty((len(shifts), len(times), 2))
    paths[:, :, 0] = 10 * times
    paths[:, :, 1] = np.outer(shifts, times / times[-1]) - 20.0 * actor
    if probabilities is None:
        probabilities = [1 / len(shifts)] * len(shifts)
    return Forecast(
        actor_id=actor,
        times=times,
        paths=paths,
        probabilities=probabilities,
    )


def evaluate(
    *samples: tuple[Sequence[Forecast], ForecastingTruth], **protocol: Any
) -> ForecastingResult:
    evaluator = ForecastingEvaluator(ForecastingProtocol(**protocol))
    for number, (forecasts, truth) in enumerate(samples):
        evaluator.update(
            f"{truth.scenario}/ego_vehicle/{number:03d}",
            forecasts,
            truth,
        )
    return evaluator.compute()


def read_row(result: ForecastingResult, table: str, row: str) -> dict[str, tuple[float, int]]:
    """Return the numbers of one row and how many actors they are of."""
    counts = result.counted[table][row]
    return {
        name: (round(value, 6), counts[name])
        for name, value in result.means[table][row].items()
        if counts[name]
    }


def test_errors_are_means_over_actors_at_each_horizon() -> None:
    forecasts = [make_forecast(1, [3.0]), make_forecast(2, [1.0])]
    result = evaluate((forecasts, make_truth(5, 5)))
    mean_ade = round(2 * 15.5 / 30, 6)
    assert read_row(result, MAIN, "all") == {
        "min_fde": (2.0, 2),
        "min_ade": (mean_ade, 2),
        "miss": (0.5, 2),
        "brier_min_fde": (2.0, 2),
        "min_ade_any": (mean_ade, 2),
        "cut_ade": (mean_ade, 2),
        "without": (0.0, 2),
    }
    assert result.means["1 s, K = 6"]["all"]["min_fde"] == pytest.approx(2 / 3)
    assert [*result.means] == [
        f"{horizon} s, K = {modes}" for horizon in (3, 1, 2, 5) for modes in (6, 1)
    ]


def test_beyond_a_forecast_there_is_no_number_and_it_is_counted() -> None:
    forecasts = [make_forecast(1, [3.0]), make_forecast(2, [1.0], (1.0,))]
    result = evaluate((forecasts, make_truth(5, 5, 5)))
    assert read_row(result, "5 s, K = 6", "all") == {"without": (1.0, 3)}
    row = read_row(result, MAIN, "all")
    assert row["min_fde"] == (3.0, 1)
    assert row["without"] == (round(2 / 3, 6), 3)
    assert read_row(result, "1 s, K = 6", "all")["min_fde"] == (1.0, 2)
    assert np.isnan(result.means["5 s, K = 6"]["all"]["min_fde"])
    without_numbers, without_forecast = result.notes
    assert without_forecast.startswith("1 true actor without a forecast:")
    assert without_numbers.startswith("no numbers at 3 s:")
    assert without_numbers.endswith(": 1 forecast ending earlier")


def test_forecasts_cut_short_improve_nothing() -> None:
    """This holds where the recording goes on and where it ends before the horizon."""
    actors = (1, 2, 3)
    truth = make_truth(5, 2.0, 0.5)
    short = evaluate(([make_forecast(actor, [0.01], (0.5,)) for actor in actors], truth))
    assert read_row(short, MAIN, "all") == {"without": (1.0, 1)}
    assert "no numbers at 3 s: 3 forecasts ending earlier" in short.notes
    whole = evaluate(([make_forecast(actor, [3.0]) for actor in actors], truth))
    assert read_row(whole, MAIN, "all")["cut_ade"][1] == 3


def test_times_summed_in_float32_reach_the_horizon() -> None:
    steps = np.full(60, 0.05, dtype=np.float32)
    seconds = np.cumsum(steps, dtype=np.float32).astype(np.float64)
    assert seconds[-1] != 3
    result = evaluate(([make_forecast(1, [3.0], seconds)], make_truth(5)))
    assert read_row(result, MAIN, "all")["min_fde"] == (pytest.approx(3, abs=1e-4), 1)
    assert result.notes == ()


def test_a_short_future_counts_only_in_cut_ade() -> None:
    forecasts = [make_forecast(1, [3.0]), make_forecast(2, [3.0])]
    result = evaluate((forecasts, make_truth(5, 1.2)))
    counts = {name: count for name, (_, count) in read_row(result, MAIN, "all").items()}
    assert counts == {**dict.fromkeys(counts, 1), "cut_ade": 2}
    assert {"min_ade", "min_fde", "without"} <= counts.keys()


def test_the_most_probable_modes_count() -> None:
    forecast = make_forecast(1, [3.0, 1.0], probabilities=[0.6, 0.4])
    result = evaluate(([forecast], make_truth(5)))
    assert result.means[MAIN]["all"]["min_fde"] == 1.0
    assert result.means[SINGLE_MODE]["all"]["min_fde"] == 3.0
    assert result.means[MAIN]["all"]["brier_min_fde"] == pytest.approx(1.36)
    assert "other" not in result.means[SINGLE_MODE]


def test_groups_and_scenarios() -> None:
    result = evaluate(
        ([make_forecast(1, [3.0]), make_forecast(2, [1.0])], make_truth(5, 5, collider=2)),
        ([make_forecast(1, [5.0])], make_truth(5)),
        ([make_forecast(1, [9.0])], make_truth(5, scenario="a/c")),
    )
    assert read_row(result, MAIN, "collider")["min_fde"] == (1.0, 1)
    assert read_row(result, MAIN, "other")["min_fde"] == (round(17 / 3, 6), 3)
    assert read_row(result, MAIN, "all")["min_fde"] == (4.5, 4)
    assert read_row(result, MAIN, "mean of scenarios")["min_fde"] == (6.0, 2)
    assert "mean of scenarios" in result.means[SINGLE_MODE]


def test_a_world_has_the_modes_of_all_its_actors() -> None:
    forecasts = [
        make_forecast(1, [3.0, 1.0]),
        make_forecast(2, [-1.0, 20.4], probabilities=[0.9, 0.1]),
        make_forecast(3, [0.0]),
    ]
    result = evaluate((forecasts, make_truth(5, 5, 0.5)))
    assert read_row(result, MAIN, "together") == {
        "min_fde": (2.0, 1),
        "min_ade": (round(2 * 15.5 / 30, 6), 1),
        "miss": (0.5, 1),
        "collisions": (0.0, 1),
    }

    forecasts = [make_forecast(1, [1.0, 0.0]), make_forecast(2, [9.0, 19.5])]
    result = evaluate((forecasts, make_truth(5, 5)), modes=(1,))
    assert result.means[SINGLE_MODE]["together"]["collisions"] == 0.0

    forecasts = [make_forecast(1, [1.0]), make_forecast(2, [20.4])]
    result = evaluate((forecasts, make_truth(5, 5)))
    assert result.means[MAIN]["together"]["collisions"] == 1.0

    result = evaluate((forecasts[:1], make_truth(2.9)))
    assert "together" not in result.means[MAIN]


def test_a_sample_without_other_actors() -> None:
    truth = make_truth(5)
    empty = replace(
        truth,
        actor_id=truth.actor_id[:0],
        present=truth.present[:0],
        path=truth.path[:0],
        members=truth.members[:, :0],
    )
    assert evaluate(([], empty)).means == {}
    result = evaluate(([], empty), ([make_forecast(1, [3.0])], truth))
    assert result.means[MAIN]["all"]["min_fde"] == 3.0


def test_a_saved_evaluator_goes_on(tmp_path: Path) -> None:
    evaluator = ForecastingEvaluator()
    evaluator.update(
        "a/b/ego_vehicle/001",
        [make_forecast(1, [3.0])],
        make_truth(5),
    )
    resumed = ForecastingEvaluator().resume(evaluator.save(tmp_path / "evaluator"))
    assert resumed.compute() == evaluator.compute()
    assert json.loads(json.dumps(evaluator.settings)) == evaluator.settings


def test_what_cannot_be_evaluated() -> None:
    update = partial(ForecastingEvaluator().update, "a/b/c/001")
    truth = make_truth(5)
    same_actor = [make_forecast(1, [0.0]), make_forecast(1, [1.0])]
    assert_raises(
        (
            lambda: update(same_actor, truth),
            EvaluationError,
            ("a/b/c/001", "one per actor"),
        ),
        (lambda: update([7], truth), EvaluationError, ("expected a list of Forecasts", "7")),
        (lambda: ForecastingEvaluator("released"), ChoiceError, ("protocol", "clean", "released")),
        (lambda: ForecastingProtocol(horizons=(6.0,)), ConfigError, ("horizons", "0.1 to 5")),
        (lambda: ForecastingProtocol(modes=()), ConfigError, "modes"),
        (lambda: ForecastingProtocol(modes=(0,)), ConfigError, "modes"),
        (lambda: ForecastingProtocol(miss_distance=-1.0), ConfigError, "miss_distance"),
    )
