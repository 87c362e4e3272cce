"""`ForecastingEvaluator`: how far the predicted paths of actors are from their recorded paths."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from types import MappingProxyType
from typing import Any, ClassVar, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ConfigError, EvaluationError, shortened
from deepaccident_devkit.evaluation.drawing import Drawing, drawn_paths, joined_drawing
from deepaccident_devkit.evaluation.evaluator import Counts
from deepaccident_devkit.evaluation.forecasting.metrics import (
    MISS_DISTANCE,
    SAME_TIME,
    Forecast,
    actor_errors,
    collisions,
    miss_rate,
    world_errors,
)
from deepaccident_devkit.evaluation.forecasting.truth import (
    CLASS_LABELS,
    EVERYBODY,
    MOTIONS,
    PATH_SECONDS,
    ROLES,
    TO_IMPACT,
    VIEWERS,
    ForecastingTruth,
    forecasting_truth,
)
from deepaccident_devkit.evaluation.means import (
    MEAN_OF_SCENARIOS,
    MeansEvaluator,
    MeansResult,
    Sums,
    table_rows,
)
from deepaccident_devkit.evaluation.predictions import LONG_PATHS, LONGEST_PATH
from deepaccident_devkit.evaluation.task import Row
from deepaccident_devkit.evaluation.truth import recorded_past
from deepaccident_devkit.support.arrays import FloatArray, check_minima
from deepaccident_devkit.taxonomy import FRAME_PERIOD

# Name of the row of joint errors of all actors of a sample, averaged over samples.
TOGETHER: Final = "together"
_MISSING_NOTE = "{true actor} without a forecast: no errors, but counted in `no forecast`"
_UNKNOWN_NOTE = (
    "not counted: {forecast} of the agent itself, or of an actor that no label of the frame shows"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class ForecastingProtocol:
    """Rules of forecasting metrics.

    Attributes:
        horizons: Seconds ahead, at most 5; the first horizon is the main one.
        modes: How many of an actor's most probable modes count (K); the first value is the main
            one.
        miss_distance: If the best mode's error at the horizon is larger, it is a miss; metres.
    """

    horizons: tuple[float, ...] = (3.0, 1.0, 2.0, 5.0)
    modes: tuple[int, ...] = (6, 1)
    miss_distance: float = MISS_DISTANCE

    def __post_init__(self) -> None:
        """Check the fields.

        Raises:
            ConfigError: If a value is out of range.
        """
        check_minima(self, miss_distance=0)
        _check_range("horizons", self.horizons, FRAME_PERIOD, PATH_SECONDS)
        _check_range("modes", self.modes, 1, math.inf)


def _check_range(name: str, values: Sequence[float], low: float, high: float) -> None:
    """Raise ConfigError if there are no values, or if one is outside the range `low` to `high`."""
    is_in_range = [low <= value <= high for value in values]
    if not values or not all(is_in_range):
        raise ConfigError(f"{name}: expected numbers from {low:g} to {high:g}, found {values!r}")


FORECASTING_PROTOCOLS: Final[Mapping[str, ForecastingProtocol]] = MappingProxyType(
    {"clean": ForecastingProtocol()}
)


def table_name(horizon: float, modes: int) -> str:
    """Return the name of the table for a horizon and a number of modes, such as `3 s, K = 6`."""
    return f"{horizon:g} s, K = {modes}"


class ForecastingResult(MeansResult):
    """Tables by horizon and K, the number of modes that count; rows are groups of actors.

    The row `all` contains all actors. `mean of scenarios` first averages them within each scenario,
    then over scenarios. `together` contains the joint errors of all actors of a sample.
    """

    __slots__ = ()
    rows: ClassVar[tuple[Row, ...]] = table_rows(
        columns=(
            Row("min_fde", "m"),
            Row("min_ade", "m"),
            Row("miss", "share"),
            Row("brier_min_fde", "m"),
            Row("min_ade_any", "m", is_headline=False),
            Row("cut_ade", "m", is_headline=False),
            Row("without", "share", is_headline=False),
            Row("collisions", "share", is_headline=False),
        ),
        main_tables=(table_name(3, 6), table_name(3, 1)),
        main_row=EVERYBODY,
    )


class ForecastingEvaluator(MeansEvaluator[ForecastingResult]):
    """Evaluator of the predicted paths of other actors; it uses each actor's best mode.

    Actors are matched by their ids. An actor whose forecast does not reach a horizon has no errors
    at that horizon, and is counted in `without`.

    >>> ForecastingEvaluator().compute().samples
    0
    """

    task = "forecasting"
    description = "Evaluate actors' predicted paths: minADE, minFDE, misses."
    result_kinds: ClassVar[tuple[str, ...]] = ("forecasting",)
    protocols = FORECASTING_PROTOCOLS
    result_class = ForecastingResult
    main_numbers: ClassVar[tuple[str, ...]] = ("means/3 s, K = 6/all/min_fde",)
    needs_whole_recordings = True
    has_horizon = False

    protocol: ForecastingProtocol
    main_row = EVERYBODY
    order: ClassVar[Sequence[str]] = (
        *(table_name(horizon, modes) for horizon in (3, 1, 2, 5) for modes in (6, 1)),
        *(EVERYBODY, MEAN_OF_SCENARIOS, TOGETHER),
        *(*CLASS_LABELS, *ROLES, *VIEWERS, *TO_IMPACT, *MOTIONS),
    )

    def truth(self, dataset: Dataset, token: str, /, *_unused: Any) -> tuple[ForecastingTruth]:
        """Return the recorded paths of all actors that are annotated in the current frame."""
        return (forecasting_truth(dataset, token),)

    def update(self, token: str, forecasts: Iterable[Forecast], truth: ForecastingTruth) -> None:
        """Count one sample.

        Args:
            token: Token of the sample.
            forecasts: At most one per actor; forecasts of actors that are not in the truth are
                ignored.
            truth: Truth from `forecasting_truth(dataset, token)`.

        Raises:
            EvaluationError: If an item is not a forecast, an actor has two forecasts, or the sample
                was counted before with other counts.
        """
        items: list[object] = list(forecasts)
        forecast_by_actor = {item.actor_id: item for item in items if isinstance(item, Forecast)}
        if len(forecast_by_actor) < len(items):
            raise EvaluationError(
                f"{token}: expected a list of Forecasts, one per actor, found "
                f"{shortened(repr(items))}"
            )
        self.add(token, _sample_counts(forecast_by_actor, truth, self.protocol))

    def drawing(self, dataset: Dataset, token: str, prediction: Any, /, *truth: Any) -> Drawing:
        """Describe the modes of all actors, and where the actors were and will be."""
        (recorded,) = truth
        predicted = joined_drawing(prediction).paths
        past = recorded_past(dataset, token, recorded.actor_id)
        future_times = np.arange(recorded.path.shape[1] + 1) * FRAME_PERIOD
        past_times = np.arange(1 - past.shape[1], 1) * FRAME_PERIOD
        future = np.concatenate([recorded.present[:, None], recorded.path], axis=1)
        past_paths = drawn_paths(past, past_times, "past", "last second")
        future_paths = drawn_paths(future, future_times, "truth", "recorded path")
        return Drawing(paths=(*past_paths, *predicted, *future_paths))


def _sample_counts(
    forecasts: Mapping[int, Forecast], truth: ForecastingTruth, rules: ForecastingProtocol
) -> Counts:
    """Count one sample: errors of each actor, and joint errors.

    Args:
        forecasts: Actor id → forecast.
        truth: Recorded paths of the sample.
        rules: Horizons, numbers of modes and miss distance.
    """
    sums = Sums()
    actors = set(truth.actor_id.tolist())
    forecast_ends = np.array([forecasts[actor].times[-1] for actor in forecasts.keys() & actors])
    sums.note(_MISSING_NOTE, len(actors) - len(forecast_ends))
    sums.note(_UNKNOWN_NOTE, len(forecasts) - len(forecast_ends))
    main_horizon = rules.horizons[0]
    ends_early = forecast_ends < main_horizon - SAME_TIME
    sums.note(f"no numbers at {main_horizon:g} s: {{forecast}} ending earlier", ends_early.sum())
    sums.note(LONG_PATHS, (forecast_ends > LONGEST_PATH).sum())
    if not actors:
        return sums.counts(truth.scenario)
    all_paths, probabilities = _mode_arrays(forecasts, truth)
    is_recorded = np.isfinite(truth.path[..., 0])
    groups = {}
    for name, members in zip(truth.groups, truth.members, strict=True):
        if members.any():
            groups[name] = members
    everybody = {EVERYBODY: groups[EVERYBODY]}
    for horizon, mode_count in product(rules.horizons, rules.modes):
        steps = slice(round(horizon / FRAME_PERIOD))
        paths = all_paths[:, :, steps]
        true_paths = truth.path[:, steps]
        valid = is_recorded[:, steps]
        errors = actor_errors(
            paths, true_paths, valid, probabilities, mode_count, rules.miss_distance
        )
        errors["without"] = np.where(valid[:, -1], np.isnan(errors["min_fde"]), np.nan)
        table = table_name(horizon, mode_count)
        sums.add_rows(table, groups if mode_count == rules.modes[0] else everybody, errors)
        joint_errors = _joint_errors(
            paths, true_paths, probabilities, mode_count, rules.miss_distance
        )
        for column, value in joint_errors.items():
            sums.add(table, TOGETHER, column, value)
    return sums.counts(truth.scenario)


def _mode_arrays(
    forecasts: Mapping[int, Forecast], truth: ForecastingTruth
) -> tuple[FloatArray, FloatArray]:
    """Interpolate the forecasts at the truth's steps; missing modes and steps are NaN.

    Returns:
        Paths (A, K, S, 2), metres, and probabilities (A, K).
    """
    times = np.arange(1, truth.path.shape[1] + 1) * FRAME_PERIOD
    mode_count = max((len(forecast.paths) for forecast in forecasts.values()), default=1)
    paths = np.full((len(truth.actor_id), mode_count, len(times), 2), np.nan)
    probabilities = np.full(paths.shape[:2], np.nan)
    for row, actor in enumerate(truth.actor_id.tolist()):
        if actor in forecasts:
            forecast = forecasts[actor]
            positions = forecast.at(times, truth.present[row])
            paths[row, : len(positions)] = positions
            probabilities[row, : len(positions)] = forecast.probabilities
    return paths, probabilities


def _joint_errors(
    paths: FloatArray,
    truth: FloatArray,
    probabilities: FloatArray,
    mode_count: int,
    miss_distance: float,
) -> dict[str, float]:
    """Return the joint errors of the best world: the one with the lowest mean FDE.

    It is chosen among the `mode_count` worlds with the highest mean probability. An actor counts
    if its future is completely recorded and its forecast covers it. A world counts if all of these
    actors have its mode.
    """
    is_complete = np.asarray(np.isfinite(paths).all(axis=(2, 3)))
    is_recorded = np.isfinite(truth).all(axis=(1, 2))
    actors = np.flatnonzero(is_recorded & is_complete.any(axis=1))
    modes = np.flatnonzero(is_complete[actors].all(axis=0))
    if not len(actors) or not len(modes):
        return {}
    mean_probabilities = probabilities[actors][:, modes].mean(axis=0)
    most_probable = np.argsort(-mean_probabilities, kind="stable")[:mode_count]
    worlds = paths[actors][:, modes[most_probable]]
    ade, fde, final_errors = world_errors(worlds, truth[actors])
    best_mode = int(np.argmin(fde))
    is_colliding = collisions(worlds[:, best_mode : best_mode + 1])
    return {
        "min_fde": fde[best_mode],
        "min_ade": ade[best_mode],
        "miss": miss_rate(final_errors[:, best_mode], miss_distance),
        "collisions": is_colliding.mean(),
    }
