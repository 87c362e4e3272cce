"""Explicit accidents that were mirrored, turned, scaled, given in cells or shifted in time are named; good ones not."""

from collections.abc import Callable

import numpy as np
import pytest

from deepaccident_devkit.evaluation.metrics.accident import BoxTruth
from deepaccident_devkit.evaluation.metrics.predictions import Accident
from deepaccident_devkit.evaluation.runs.sanity.accidents import accident_suspicions, accident_tallies
from deepaccident_devkit.evaluation.runs.sanity.probes import SCALES, SYMMETRIES, candidates_of

Change = Callable[[Accident], Accident]


def moved(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda each: Accident(positions=change(each.positions), time=each.time)


def delayed(seconds: float) -> Change:
    return lambda each: Accident(positions=each.positions, time=max(0.0, each.time + seconds))


MISTAKES: dict[str, Change] = {
    **{each.name: moved(each.apply) for each in SYMMETRIES},
    **{name: moved(lambda points, scale=scale: points * scale) for name, scale in SCALES.items()},
    "columns and rows": moved(lambda points: (points + 50) * 2),
    "rows and columns": moved(lambda points: (points[:, ::-1] + 50) * 2),
    "0.5 s late": delayed(0.5),
    "0.5 s early": delayed(-0.5),
}


def truths(seed: int) -> list[BoxTruth]:
    """Accidents 0.5 to 2 s ahead, anywhere within 30 m; every fourth sample has none."""
    source = np.random.default_rng(seed)
    return [
        BoxTruth(
            time=np.arange(21) / 10,
            actor_id=np.array([1, 2]),
            footprint=np.zeros((21, 2, 5)),
            accident=Accident(
                positions=source.uniform(-30, 30, 2) + np.array([[0, 0], [3, 1]]), time=0.5 * (1 + number % 4)
            )
            if number % 5
            else None,
        )
        for number in range(20)
    ]


def suspected(seed: int, change: Change, noise: float = 1.0) -> list[str]:
    source = np.random.default_rng(seed + 100)
    tallies = []
    for truth in truths(seed):
        alarms = []
        if truth.accident is not None:
            off = truth.accident.positions + source.normal(0, noise, (2, 2))
            alarms = [change(Accident(positions=off, time=truth.accident.time))]
        tallies.append(accident_tallies(alarms, truth))
    return [each.name for each in candidates_of(accident_suspicions(), tallies) if each.suspected]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("mistake", MISTAKES)
def test_each_mistake_is_named_as_exactly_that(mistake: str, seed: int) -> None:
    assert suspected(seed, MISTAKES[mistake]) == [mistake]


@pytest.mark.parametrize("seed", range(10))
def test_good_accidents_are_not_suspected(seed: int) -> None:
    assert suspected(seed, lambda each: each, noise=3.0) == []


@pytest.mark.parametrize("seed", range(10))
def test_accidents_anywhere_are_not_suspected(seed: int) -> None:
    source = np.random.default_rng(seed)

    def elsewhere(_: Accident) -> Accident:
        return Accident(positions=source.uniform(-40, 40, (2, 2)), time=source.uniform(0, 2))

    assert suspected(seed, elsewhere) == []


def test_the_surest_alarm_is_looked_at() -> None:
    truth = truths(0)[1]
    assert truth.accident is not None
    right = Accident(positions=truth.accident.positions, time=truth.accident.time, score=0.9)
    wrong = Accident(positions=-truth.accident.positions, time=0.0, score=0.1)
    assert accident_tallies([wrong, right], truth) == accident_tallies([right], truth)


def test_every_suspicion_is_tried() -> None:
    assert {each.name for each in accident_suspicions()} == set(MISTAKES)
