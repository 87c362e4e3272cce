"""`ForecastingEvaluator`: how far actors' predicted paths are from the recorded ones."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from types import MappingProxyType
from typing import Any, ClassVar, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ConfigError, EvaluationError, shortened
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
from deepaccident_devkit.support.arrays import FloatArray, check_least
from deepaccident_devkit.taxonomy import FRAME_PERIOD

# The row of all actors of a sample together: means over samples.
TOGETHER: Final = "together"
_MISSING_NOTE: Final = "no forecast of {true actor}: without errors, counted in `without`"
_UNKNOWN_NOTE: Final = (
    "not counted: {forecast} of the agent itself, or of an actor that no label shows then"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class ForecastingProtocol:
    """Rules of forecasting metrics.

    Attributes:
        horizons: Seconds ahead, at most 5; the first is the main one.
        modes: Numbers of an actor's most probable modes that count; the first is the main one.
        miss_distance: Metres; a larger error of the best mode at the horizon is a miss.
    """

    horizons: tuple[float, ...] = (3.0, 1.0, 2.0, 5.0)
    modes: tuple[int, ...] = (6, 1)
    miss_distance: float = MISS_DISTANCE

    def __post_init__(self) -> None:
        """Check the values; raises ConfigError."""
        check_least(self, miss_distance=0)
        for name, low, high in (("horizons", FRAME_PERIOD, PATH_SECONDS), ("modes", 1, math.inf)):
            values = getattr(self, name)
            if not values or not all(low <= value <= high for value in values):
                raise ConfigError(
                    f"{name}: expected numbers from {low:g} to {high:g}, found {values!r}"
                )


FORECASTING_PROTOCOLS: Final[Mapping[str, ForecastingProtocol]] = MappingProxyType(
    {"clean": ForecastingProtocol()}
)


def table_name(horizon: float, modes: int) -> str:
    """Return the name of the table of a horizon and a number of modes: `3 s, K = 6`."""
    return f"{horizon:g} s, K = {modes}"


class ForecastingResult(MeansResult):
    """Tables by horizon and K, the number of modes that count; rows are groups of actors.

    The row `all` has all actors, `mean of scenarios` the mean of the scenarios' means of that row,
    and `together` takes the actors of a sample as one world.
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
    """Errors of the paths of other actors, for each actor's best mode.

    Actors are compared by their ids. An actor without a forecast at a horizon has no number there,
    and counts in `without`.

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
        """Return the recorded paths of all actors annotated at the present."""
        return (forecasting_truth(dataset, token),)

    def update(self, token: str, forecasts: Iterable[Forecast], truth: ForecastingTruth) -> None:
        """Count one sample.

        Args:
            token: Token of the sample.
            forecasts: At most one per actor; forecasts of actors that are not in the truth do not
                count.
            truth: Truth from `forecasting_truth(dataset, token)`.

        Raises:
            EvaluationError: an item is not a forecast, two forecasts are of one actor, or the
                sample came before with other counts.
        """
        self.add(token, _counts(token, forecasts, truth, self.protocol))


def _counts(
    token: str, forecasts: Iterable[Forecast], truth: ForecastingTruth, rules: ForecastingProtocol
) -> Counts:
    """Return what a sample adds."""
    items: list[object] = list(forecasts)
    of_actor = {item.actor_id: item for item in items if isinstance(item, Forecast)}
    if len(of_actor) < len(items):
        raise EvaluationError(
            f"{token}: expected Forecasts, one of each actor, found {shortened(repr(items))}"
        )
    sums = Sums()
    actors = set(truth.actor_id.tolist())
    ends = np.array([of_actor[actor].times[-1] for actor in of_actor.keys() & actors])
    sums.note(_MISSING_NOTE, len(actors) - len(ends))
    sums.note(_UNKNOWN_NOTE, len(of_actor) - len(ends))
    main = rules.horizons[0]
    ends_early = ends < main - SAME_TIME
    sums.note(f"no numbers at {main:g} s: {{forecast}} ending earlier", ends_early.sum())
    sums.note(LONG_PATHS, (ends > LONGEST_PATH).sum())
    if not actors:
        return sums.counts(truth.scenario)
    paths, probabilities = _arrays(of_actor, truth)
    recorded = np.isfinite(truth.path[..., 0])
    groups = {}
    for name, members in zip(truth.groups, truth.members, strict=True):
        if members.any():
            groups[name] = members
    for horizon, mode_count in product(rules.horizons, rules.modes):
        steps = slice(round(horizon / FRAME_PERIOD))
        table = table_name(horizon, mode_count)
        path = paths[:, :, steps]
        true = truth.path[:, steps]
        valid = recorded[:, steps]
        errors = actor_errors(path, true, valid, probabilities, mode_count, rules.miss_distance)
        errors["without"] = np.where(valid[:, -1], np.isnan(errors["min_fde"]), np.nan)
        if mode_count == rules.modes[0]:
            sums.add_rows(table, groups, errors)
        else:
            sums.add_rows(table, {EVERYBODY: groups[EVERYBODY]}, errors)
        together = _together(path, true, probabilities, mode_count, rules.miss_distance)
        for column, value in together.items():
            sums.add(table, TOGETHER, column, value)
    return sums.counts(truth.scenario)


def _arrays(
    of_actor: Mapping[int, Forecast], truth: ForecastingTruth
) -> tuple[FloatArray, FloatArray]:
    """Return the modes' paths at the truth's steps and their probabilities, NaN for missing ones.

    Returns:
        Paths (A, K, S, 2), and probabilities (A, K).
    """
    steps = np.arange(1, truth.path.shape[1] + 1) * FRAME_PERIOD
    mode_count = max((len(forecast.paths) for forecast in of_actor.values()), default=1)
    paths = np.full((len(truth.actor_id), mode_count, len(steps), 2), np.nan)
    probabilities = np.full(paths.shape[:2], np.nan)
    for row, actor in enumerate(truth.actor_id.tolist()):
        if actor in of_actor:
            forecast = of_actor[actor]
            positions = forecast.at(steps, truth.present[row])
            paths[row, : len(positions)] = positions
            probabilities[row, : len(positions)] = forecast.probabilities
    return paths, probabilities


def _together(
    paths: FloatArray,
    truth: FloatArray,
    probabilities: FloatArray,
    mode_count: int,
    miss_distance: float,
) -> dict[str, float]:
    """Return the numbers of the best world: the one with the least mean FDE.

    It is chosen among the `mode_count` worlds with the highest mean probability. Actors with a
    complete future and a forecast of it count, and the modes that all of these have.
    """
    is_complete = np.asarray(np.isfinite(paths).all(axis=(2, 3)))
    is_recorded = np.isfinite(truth).all(axis=(1, 2))
    actors = np.flatnonzero(is_recorded & is_complete.any(axis=1))
    modes = np.flatnonzero(is_complete[actors].all(axis=0))
    if not len(actors) or not len(modes):
        return {}
    mean_probability = probabilities[actors][:, modes].mean(axis=0)
    most_probable = np.argsort(-mean_probability, kind="stable")[:mode_count]
    worlds = paths[actors][:, modes[most_probable]]
    ade, fde, final_errors = world_errors(worlds, truth[actors])
    best = int(np.argmin(fde))
    colliding = collisions(worlds[:, best : best + 1])
    return {
        "min_fde": fde[best],
        "min_ade": ade[best],
        "miss": miss_rate(final_errors[:, best], miss_distance),
        "collisions": colliding.mean(),
    }
