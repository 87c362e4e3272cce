"""`ForecastingEvaluator`, on actors whose errors are known."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import assert_refused

from deepaccident_devkit.errors import ChoiceError, ConfigError, EvaluationError
from deepaccident_devkit.evaluation.forecasting import (
    Forecast,
    ForecastingEvaluator,
    ForecastingProtocol,
    ForecastingResult,
    ForecastingTruth,
)

MAIN, ALONE = "3 s, K = 6", "3 s, K = 1"
SECONDS = (1.0, 2.0, 3.0)


def truth_of(*seconds: float, scenario: str = "a/b", collider: int = 0) -> ForecastingTruth:
    """Actors 1, 2, … go ahead at 10 m/s, 20 m apart from left to right; each is recorded for so
    long.
    """
    actors = np.arange(1, len(seconds) + 1)
    steps = np.arange(1, 51) / 10
    path = np.stack([np.column_stack([10 * steps, np.full(50, -20.0 * actor)]) for actor in actors])
    for row, end in enumerate(seconds):
        path[row, round(end * 10) :] = np.nan
    return ForecastingTruth(
        scenario=scenario,
        actor_id=actors,
        present=np.column_stack([np.zeros(len(actors)), -20.0 * actors]),
        path=path,
        groups=("all", "collider", "other"),
        members=np.stack([actors > 0, actors == collider, actors != collider]),
    )


def forecast(
    actor: int, aside: Sequence[float], seconds: Sequence[float] = SECONDS, chances: Any = None
) -> Forecast:
    """As the actor goes, but each mode so far to the side at its end."""
    paths = [
        [(10 * each, -20.0 * actor + shift * each / seconds[-1]) for each in seconds]
        for shift in aside
    ]
    given = np.full(len(aside), 1 / len(aside)) if chances is None else np.array(chances)
    return Forecast(
        actor_id=actor, times=np.array(seconds), paths=np.array(paths), probabilities=given
    )


def result_of(
    *samples: tuple[Sequence[Forecast], ForecastingTruth], **protocol: Any
) -> ForecastingResult:
    evaluator = ForecastingEvaluator(ForecastingProtocol(**protocol))
    for number, (forecasts, truth) in enumerate(samples):
        evaluator.update(f"{truth.scenario}/ego_vehicle/{number:03d}", forecasts, truth)
    return evaluator.compute()


def cells(result: ForecastingResult, table: str, row: str) -> dict[str, tuple[float, int]]:
    counted = result.counted[table][row]
    return {
        name: (round(value, 6), counted[name])
        for name, value in result.means[table][row].items()
        if counted[name]
    }


def test_errors_are_means_over_actors_at_each_horizon() -> None:
    result = result_of(([forecast(1, [3.0]), forecast(2, [1.0])], truth_of(5, 5)))
    assert cells(result, MAIN, "all") == {
        "min_fde": (2.0, 2),
        "min_ade": (round(2 * 15.5 / 30, 6), 2),
        "miss": (0.5, 2),
        "brier_min_fde": (2.0, 2),
        "min_ade_any": (round(2 * 15.5 / 30, 6), 2),
        "cut_ade": (round(2 * 15.5 / 30, 6), 2),
        "without": (0.0, 2),
    }
    assert result.means["1 s, K = 6"]["all"]["min_fde"] == pytest.approx(2 / 3)
    assert [*result.means] == [
        f"{seconds} s, K = {most}" for seconds in (3, 1, 2, 5) for most in (6, 1)
    ]


def test_beyond_a_forecast_there_is_no_number_and_it_is_counted() -> None:
    result = result_of(([forecast(1, [3.0]), forecast(2, [1.0], (1.0,))], truth_of(5, 5, 5)))
    assert cells(result, "5 s, K = 6", "all") == {"without": (1.0, 3)}
    main = cells(result, MAIN, "all")
    assert (main["min_fde"], main["without"]) == ((3.0, 1), (round(2 / 3, 6), 3))
    assert cells(result, "1 s, K = 6", "all")["min_fde"] == (1.0, 2)
    assert np.isnan(result.means["5 s, K = 6"]["all"]["min_fde"])
    assert [note.split(":")[0] for note in result.notes] == [
        "no forecast of 1 true actor",
        "no numbers at 3 s",
    ]
    assert result.notes[1].endswith(": 1 forecast ending earlier")


def test_forecasts_cut_short_improve_nothing() -> None:
    """Neither where the recording goes on, nor where it ends before the horizon."""
    truth = truth_of(5, 2.0, 0.5)
    cut = result_of(([forecast(actor, [0.01], (0.5,)) for actor in (1, 2, 3)], truth))
    assert cells(cut, MAIN, "all") == {"without": (1.0, 1)}
    assert "no numbers at 3 s: 3 forecasts ending earlier" in cut.notes
    whole = result_of(([forecast(actor, [3.0]) for actor in (1, 2, 3)], truth))
    assert cells(whole, MAIN, "all")["cut_ade"][1] == 3


def test_times_summed_in_float32_reach_the_horizon() -> None:
    seconds = (
        np.cumsum(np.full(60, 0.05, dtype=np.float32), dtype=np.float32).astype(np.float64).tolist()
    )
    assert seconds[-1] != 3
    result = result_of(([forecast(1, [3.0], seconds)], truth_of(5)))
    assert cells(result, MAIN, "all")["min_fde"] == (pytest.approx(3, abs=1e-4), 1)
    assert result.notes == ()


def test_a_short_future_counts_in_cut_ade_alone() -> None:
    result = result_of(([forecast(1, [3.0]), forecast(2, [3.0])], truth_of(5, 1.2)))
    main = cells(result, MAIN, "all")
    assert {name: count for name, (_, count) in main.items() if count == 2} == {"cut_ade": 2}
    assert main["min_ade"][1] == main["min_fde"][1] == main["without"][1] == 1


def test_of_several_modes_the_most_probable_count() -> None:
    one = forecast(1, [3.0, 1.0], chances=[0.6, 0.4])
    result = result_of(([one], truth_of(5)))
    assert (result.means[MAIN]["all"]["min_fde"], result.means[ALONE]["all"]["min_fde"]) == (
        1.0,
        3.0,
    )
    assert result.means[MAIN]["all"]["brier_min_fde"] == pytest.approx(1.36)
    assert "other" not in result.means[ALONE]


def test_groups_and_scenarios() -> None:
    first = ([forecast(1, [3.0]), forecast(2, [1.0])], truth_of(5, 5, collider=2))
    again = ([forecast(1, [5.0])], truth_of(5))
    other = ([forecast(1, [9.0])], truth_of(5, scenario="a/c"))
    result = result_of(first, again, other)
    assert cells(result, MAIN, "collider")["min_fde"] == (1.0, 1)
    assert cells(result, MAIN, "other")["min_fde"] == (round(17 / 3, 6), 3)
    assert cells(result, MAIN, "all")["min_fde"] == (4.5, 4)
    assert cells(result, MAIN, "mean of scenarios")["min_fde"] == (6.0, 2)
    assert "mean of scenarios" in result.means[ALONE]


def test_a_world_has_the_modes_of_all_its_actors() -> None:
    crossing = forecast(2, [-1.0, 20.4], chances=[0.9, 0.1])
    result = result_of(
        ([forecast(1, [3.0, 1.0]), crossing, forecast(3, [0.0])], truth_of(5, 5, 0.5))
    )
    together = cells(result, MAIN, "together")
    assert together == {
        "min_fde": (2.0, 1),
        "min_ade": (round(2 * 15.5 / 30, 6), 1),
        "miss": (0.5, 1),
        "collisions": (0.0, 1),
    }
    near = result_of(
        ([forecast(1, [1.0, 0.0]), forecast(2, [9.0, 19.5])], truth_of(5, 5)), modes=(1,)
    )
    assert near.means[ALONE]["together"]["collisions"] == 0.0
    near = result_of(([forecast(1, [1.0]), forecast(2, [20.4])], truth_of(5, 5)))
    assert near.means[MAIN]["together"]["collisions"] == 1.0
    none = result_of(([forecast(1, [1.0])], truth_of(2.9)))
    assert "together" not in none.means[MAIN]


def test_a_sample_without_other_actors() -> None:
    truth = truth_of(5)
    empty = replace(
        truth,
        actor_id=truth.actor_id[:0],
        present=truth.present[:0],
        path=truth.path[:0],
        members=truth.members[:, :0],
    )
    assert result_of(([], empty)).means == {}
    assert (
        result_of(([], empty), ([forecast(1, [3.0])], truth)).means[MAIN]["all"]["min_fde"] == 3.0
    )


def test_a_saved_evaluator_goes_on(tmp_path: Path) -> None:
    evaluator = ForecastingEvaluator()
    evaluator.update("a/b/ego_vehicle/001", [forecast(1, [3.0])], truth_of(5))
    assert (
        ForecastingEvaluator().resume(evaluator.save(tmp_path / "kept")).compute()
        == evaluator.compute()
    )
    assert json.loads(json.dumps(evaluator.settings)) == evaluator.settings


def test_what_cannot_be_evaluated() -> None:
    update, truth = ForecastingEvaluator().update, truth_of(5)
    twice = [forecast(1, [0.0]), forecast(1, [1.0])]
    assert_refused(
        (
            lambda: update("a/b/c/001", twice, truth),
            EvaluationError,
            ("a/b/c/001", "one of each actor"),
        ),
        (lambda: update("a/b/c/001", [7], truth), EvaluationError, ("expected Forecasts", "7")),
        (lambda: ForecastingEvaluator("released"), ChoiceError, ("protocol", "clean", "released")),
        (lambda: ForecastingProtocol(horizons=(6.0,)), ConfigError, ("horizons", "0.1 to 5")),
        (lambda: ForecastingProtocol(modes=()), ConfigError, "modes"),
        (lambda: ForecastingProtocol(modes=(0,)), ConfigError, "modes"),
        (lambda: ForecastingProtocol(miss_distance=-1.0), ConfigError, "miss_distance"),
    )
