"""Explicit accidents that were mirrored, turned, scaled, given in cells or shifted in time are named; good ones not."""

from collections.abc import Callable

import numpy as np
import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.baselines import predict_accidents
from deepaccident_devkit.evaluation.metrics.accident import BoxTruth, accident_context
from deepaccident_devkit.evaluation.metrics.predictions import Accident
from deepaccident_devkit.evaluation.runs.sanity.accidents import (
    AccidentMoment,
    accident_moment,
    accident_suspicions,
    accident_tallies,
)
from deepaccident_devkit.evaluation.runs.sanity.probes import SCALES, SYMMETRIES, candidates_of
from deepaccident_devkit.geometry import SE3

pytestmark = pytest.mark.slow

Change = Callable[[Accident], Accident]
WORLD = SE3.from_yaw(0.7, (250.0, -80.0, 0.0))
PRESENT = 3.4
MOMENT = AccidentMoment(present=PRESENT, frames={"world frame": WORLD, "left-handed world": WORLD})


def moved(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    return lambda each: Accident(positions=change(each.positions), time=each.time, score=each.score)


def timed(change: Callable[[float], float]) -> Change:
    return lambda each: Accident(positions=each.positions, time=max(0.0, change(each.time)), score=each.score)


def in_world(points: np.ndarray) -> np.ndarray:
    return WORLD.apply(np.column_stack([points, np.zeros(2)]))[:, :2]


TIMES: dict[str, Change] = {
    "0.5 s late": timed(lambda time: time + 0.5),
    "0.5 s early": timed(lambda time: time - 0.5),
    "times in milliseconds": timed(lambda time: time * 1000),
    "times in recorded frames": timed(lambda time: time * 10),
    "times in label frames": timed(lambda time: time * 2),
    "times backwards": timed(lambda time: 2 - time),
    "times of the recording": timed(lambda time: time + PRESENT),
}
MISTAKES: dict[str, Change] = {
    **{each.name: moved(each.apply) for each in SYMMETRIES},
    **{name: moved(lambda points, scale=scale: points * scale) for name, scale in SCALES.items()},
    "columns and rows": moved(lambda points: (points + 50) * 2),
    "rows and columns": moved(lambda points: (points[:, ::-1] + 50) * 2),
    "world frame": moved(in_world),
    "left-handed world": moved(lambda points: in_world(points) * (1, -1)),
    **TIMES,
}


def truths(seed: int, low: tuple[float, float] = (-30, -30), high: tuple[float, float] = (30, 30)) -> list[BoxTruth]:
    """Accidents 0.5 to 2 s ahead, anywhere in an area; every fifth sample has none."""
    source = np.random.default_rng(seed)
    return [
        BoxTruth(
            time=np.arange(21) / 10,
            actor_id=np.array([1, 2]),
            footprint=np.zeros((21, 2, 5)),
            accident=Accident(
                positions=source.uniform(low, high) + np.array([[0, 0], [3, 1]]), time=0.5 * (1 + number % 4)
            )
            if number % 5
            else None,
        )
        for number in range(60)
    ]


def foreseen(source: np.random.Generator, truth: BoxTruth, noise: float, wrong: float) -> list[Accident]:
    """The true accident, off by so many metres and an eighth as many seconds; a share is missed, and as many false."""
    alarms = []
    if truth.accident is not None and source.uniform() >= wrong:
        positions = truth.accident.positions + source.normal(0, noise, (2, 2))
        time = max(0.0, truth.accident.time + source.normal(0, noise / 8))
        alarms.append(Accident(positions=positions, time=time, score=source.uniform(0.4, 1)))
    if source.uniform() < wrong:
        false = source.uniform(-30, 30, 2) + np.array([[0, 0], [3, 1]])
        alarms.append(Accident(positions=false, time=source.uniform(0, 2), score=source.uniform(0, 0.7)))
    return alarms


def suspected(
    known: list[BoxTruth], change: Change = lambda each: each, noise: float = 1.0, wrong: float = 0.0, seed: int = 0
) -> list[str]:
    source = np.random.default_rng(seed + 100)
    tallies = [
        accident_tallies([change(each) for each in foreseen(source, truth, noise, wrong)], truth, MOMENT)
        for truth in known
    ]
    return [each.name for each in candidates_of(accident_suspicions(), tallies) if each.suspected]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("mistake", MISTAKES)
@pytest.mark.parametrize(("noise", "wrong"), [(0.0, 0.0), (1.0, 0.2)], ids=["perfect", "noisy"])
def test_each_mistake_is_named_as_exactly_that(mistake: str, noise: float, wrong: float, seed: int) -> None:
    assert suspected(truths(seed), MISTAKES[mistake], noise, wrong, seed) == [mistake]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("noise", "wrong"), [(0.0, 0.0), (1.0, 0.2)], ids=["perfect", "noisy"])
def test_mirrored_accidents_right_ahead_are_told_by_many_samples(noise: float, wrong: float, seed: int) -> None:
    """No more than 2 m to the side, which no sample alone tells from noise."""
    ahead = truths(seed, (5, -2), (30, 1))
    mirrored = next(each for each in SYMMETRIES if each.name == "mirrored y")
    assert suspected(ahead, moved(mirrored.apply), noise, wrong, seed) == ["mirrored y"]
    assert suspected(ahead, lambda each: each, noise, wrong, seed) == []


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize(("noise", "wrong"), [(1.0, 0.2), (3.0, 0.4)])
def test_good_accidents_are_not_suspected(noise: float, wrong: float, seed: int) -> None:
    assert suspected(truths(seed), noise=noise, wrong=wrong, seed=seed) == []


@pytest.mark.parametrize("seconds", [-0.3, -0.2, -0.1, 0.1, 0.2, 0.3])
def test_a_delay_of_less_than_a_step_is_not_suspected(seconds: float) -> None:
    delayed = timed(lambda time: time + seconds)
    assert suspected(truths(0), delayed, noise=0.0) == []
    assert suspected(truths(0), delayed, noise=0.6, wrong=0.2) == []


def said_always(x: float, time: float) -> Change:
    return lambda _: Accident(positions=np.array([[x, 0.0], [x + 3, 1.0]]), time=time)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("time", [0.0, 1.0, 2.0])
@pytest.mark.parametrize("x", [3.0, 10.0, 20.0])
def test_who_says_the_same_always_is_not_suspected(x: float, time: float, seed: int) -> None:
    assert suspected(truths(seed), said_always(x, time)) == []
    assert suspected(truths(seed, (5, -2), (30, 1)), said_always(x, time)) == []
    assert suspected(truths(seed), timed(lambda _: time)) == []


@pytest.mark.parametrize("seed", range(10))
def test_accidents_anywhere_are_not_suspected(seed: int) -> None:
    source = np.random.default_rng(seed)

    def elsewhere(_: Accident) -> Accident:
        return Accident(positions=source.uniform(-40, 40, (2, 2)), time=source.uniform(0, 2))

    assert suspected(truths(seed), elsewhere, seed=seed) == []


@pytest.mark.parametrize("name", ["perfect", "a single vehicle", "all agents", "wary"])
def test_baselines_are_not_suspected(da_motion: DeepAccident, name: str) -> None:
    tallies = []
    for token in da_motion.samples("train", "evaluate", "paper", scope="accident")[::2]:
        truth = accident_context(da_motion, token, 2.0).truth
        assert truth is not None
        alarms = {
            "perfect": lambda truth=truth: [truth.accident],
            "a single vehicle": lambda token=token: predict_accidents(da_motion, token),
            "all agents": lambda token=token: predict_accidents(da_motion, token, agents=None),
            "wary": lambda token=token: predict_accidents(da_motion, token, danger_distance=5.0),
        }[name]()
        tallies.append(accident_tallies(alarms, truth, accident_moment(da_motion, token, 2.0)))
    assert [each.name for each in candidates_of(accident_suspicions(), tallies) if each.suspected] == []


def test_moments_are_those_of_the_release(da_motion: DeepAccident) -> None:
    token = next(each["token"] for each in da_motion.sample[:] if each["token"].endswith("/ego_vehicle/011"))
    moment = accident_moment(da_motion, token, 2.0)
    assert moment.present == pytest.approx(1.0)
    assert set(moment.frames) == {"world frame", "left-handed world", "lidar frame"}
    np.testing.assert_allclose(moment.frames["world frame"].matrix, da_motion.world_from(token, "ego").matrix)


def test_the_surest_alarm_is_looked_at() -> None:
    truth = truths(0)[1]
    assert truth.accident is not None
    right = Accident(positions=truth.accident.positions, time=truth.accident.time, score=0.9)
    wrong = Accident(positions=-truth.accident.positions, time=0.0, score=0.1)
    assert accident_tallies([wrong, right], truth) == accident_tallies([right], truth)


def test_every_suspicion_is_tried() -> None:
    """Where LiDAR and ego frame differ too little to tell, nothing is said."""
    assert {each.name for each in accident_suspicions()} == {*MISTAKES, "lidar frame"}
