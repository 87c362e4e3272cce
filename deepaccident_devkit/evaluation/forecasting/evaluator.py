"""`ForecastingEvaluator`: how far actors' predicted paths are from those that they took."""

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
    world_errors,
)
from deepaccident_devkit.evaluation.forecasting.truth import (
    CLASSES,
    EVERYBODY,
    LONGEST,
    MOTIONS,
    ROLES,
    SEEN,
    TO_IMPACT,
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


@dataclass(frozen=True, slots=True, kw_only=True)
class ForecastingProtocol:
    """Rules of forecasting metrics.

    Attributes:
        horizons: seconds ahead, at most 5; the first is the main one.
        modes: how many of an actor's most probable modes count; the first is the main number.
        miss_distance: metres; a larger error of the best mode at the horizon is a miss.
    """

    horizons: tuple[float, ...] = (3.0, 1.0, 2.0, 5.0)
    modes: tuple[int, ...] = (6, 1)
    miss_distance: float = MISS_DISTANCE

    def __post_init__(self) -> None:
        """Check the values; raises ConfigError."""
        check_least(self, miss_distance=0)
        for name, low, high in (("horizons", FRAME_PERIOD, LONGEST), ("modes", 1, math.inf)):
            given = getattr(self, name)
            if not given or not all(low <= each <= high for each in given):
                raise ConfigError(
                    f"{name}: expected numbers from {low:g} to {high:g}, found {given!r}"
                )


FORECASTING_PROTOCOLS: Final[Mapping[str, ForecastingProtocol]] = MappingProxyType(
    {"clean": ForecastingProtocol()}
)


def table_name(horizon: float, modes: int) -> str:
    """The name of the table of a horizon and a number of modes: `3 s, K = 6`."""
    return f"{horizon:g} s, K = {modes}"


class ForecastingResult(MeansResult):
    """Tables by horizon and K, the number of modes that count; rows are groups of actors.

    The row `all` is of all actors, `mean of scenarios` of the scenarios' means of that row, and `together` has the
    actors of a sample as one world.
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
    """Errors of the paths of other actors, of each actor's best mode.

    Actors are compared by their ids. One without a forecast at a horizon has no number there, and counts in `without`.

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
        *(*CLASSES, *ROLES, *SEEN, *TO_IMPACT, *MOTIONS),
    )

    def truth(self, dataset: Dataset, token: str, /, *_unused: Any) -> tuple[ForecastingTruth]:
        """Return the recorded paths of all actors that a label shows at the present."""
        return (forecasting_truth(dataset, token),)

    def update(self, token: str, forecasts: Iterable[Forecast], truth: ForecastingTruth) -> None:
        """Count one sample.

        Args:
            token: of the sample.
            forecasts: at most one an actor; those of actors that are not in the truth do not count.
            truth: from `forecasting_truth(dataset, token)`.

        Raises:
            EvaluationError: something else than forecasts is given, or two of an actor, or the sample came before with
                other counts.
        """
        self.add(token, _counts(token, forecasts, truth, self.protocol))


def _counts(
    token: str, forecasts: Iterable[Forecast], truth: ForecastingTruth, rules: ForecastingProtocol
) -> Counts:
    """What a sample adds."""
    given: list[object] = list(forecasts)
    of_actor = {each.actor_id: each for each in given if isinstance(each, Forecast)}
    if len(of_actor) < len(given):
        raise EvaluationError(
            f"{token}: expected Forecasts, one of each actor, found {shortened(repr(given))}"
        )
    sums, actors = Sums(), set(truth.actor_id.tolist())
    ends = np.array([of_actor[actor].times[-1] for actor in of_actor.keys() & actors])
    sums.note(_WITHOUT, len(actors) - len(ends))
    sums.note(_UNKNOWN, len(of_actor) - len(ends))
    main = rules.horizons[0]
    sums.note(
        f"no numbers at {main:g} s: {{forecast}} ending earlier", (ends < main - SAME_TIME).sum()
    )
    sums.note(LONG_PATHS, (ends > LONGEST_PATH).sum())
    if not actors:
        return sums.counts(truth.scenario)
    paths, chances = _arrays(of_actor, truth)
    recorded = np.isfinite(truth.path[..., 0])
    groups = {name: who for name, who in zip(truth.groups, truth.members, strict=True) if who.any()}
    for horizon, most in product(rules.horizons, rules.modes):
        there, table = slice(round(horizon / FRAME_PERIOD)), table_name(horizon, most)
        path, true, valid = paths[:, :, there], truth.path[:, there], recorded[:, there]
        errors = actor_errors(path, true, valid, chances, most, rules.miss_distance)
        errors["without"] = np.where(valid[:, -1], np.isnan(errors["min_fde"]), np.nan)
        sums.add_rows(
            table, groups if most == rules.modes[0] else {EVERYBODY: groups[EVERYBODY]}, errors
        )
        for column, value in _together(path, true, chances, most, rules.miss_distance).items():
            sums.add(table, TOGETHER, column, value)
    return sums.counts(truth.scenario)


def _arrays(
    of_actor: Mapping[int, Forecast], truth: ForecastingTruth
) -> tuple[FloatArray, FloatArray]:
    """(A, K, S, 2) the modes' paths at the truth's steps, and (A, K) probabilities; NaN of those that are not there."""
    steps = np.arange(1, truth.path.shape[1] + 1) * FRAME_PERIOD
    most = max((len(each.paths) for each in of_actor.values()), default=1)
    paths = np.full((len(truth.actor_id), most, len(steps), 2), np.nan)
    chances = np.full(paths.shape[:2], np.nan)
    for row, actor in enumerate(truth.actor_id.tolist()):
        if actor in of_actor:
            found = of_actor[actor].at(steps, truth.present[row])
            paths[row, : len(found)], chances[row, : len(found)] = (
                found,
                of_actor[actor].probabilities,
            )
    return paths, chances


def _together(
    paths: FloatArray, truth: FloatArray, chances: FloatArray, most: int, miss_distance: float
) -> dict[str, float]:
    """The numbers of the best world: of the first `most` by mean probability that with the least mean FDE.

    Counted are actors with a whole future and a forecast of it, and the modes that all of these have.
    """
    whole = np.asarray(np.isfinite(paths).all(axis=(2, 3)))
    actors = np.flatnonzero(np.isfinite(truth).all(axis=(1, 2)) & whole.any(axis=1))
    modes = np.flatnonzero(whole[actors].all(axis=0))
    if not len(actors) or not len(modes):
        return {}
    mean_chance = chances[actors][:, modes].mean(axis=0)
    worlds = paths[actors][:, modes[np.argsort(-mean_chance, kind="stable")[:most]]]
    ade, fde, missed = world_errors(worlds, truth[actors], miss_distance)
    best = int(np.argmin(fde))
    hits = collisions(worlds[:, best : best + 1])
    return {
        "min_fde": fde[best],
        "min_ade": ade[best],
        "miss": missed[:, best].mean(),
        "collisions": hits.mean(),
    }


_WITHOUT: Final = "no forecast of {true actor}: without errors, counted in `without`"
_UNKNOWN: Final = (
    "not counted: {forecast} of the agent itself, or of an actor that no label shows then"
)
