"""`forecasts_of`: instances' paths, for the actors that they are at the present."""

from collections.abc import Mapping, Sequence

import numpy as np
import pytest
from numpy.testing import assert_allclose
from refusals import assert_refused

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation import MotionOutput
from deepaccident_devkit.evaluation.forecasting import Forecast, forecasts_of
from deepaccident_devkit.geometry import BevGrid

GRID = BevGrid((-50, 50, 0.5), (-50, 50, 0.5), "devkit")
ACTORS = np.array([11, 12])
PLACES = np.array([[10.0, 0.0], [10.0, 10.0]])
Instances = Mapping[int, Sequence[tuple[float, float] | None]]


def output(*predictions: Instances) -> MotionOutput:
    """Instances of 2 × 2 cells around the places of each frame."""
    frames = max(len(path) for each in predictions for path in each.values())
    maps = np.zeros((len(predictions), frames, 200, 200), dtype=np.int32)
    for k, each in enumerate(predictions):
        for identity, path in each.items():
            for frame, place in enumerate(path):
                if place is not None:
                    x, y = (round((along + 50) / 0.5) for along in place)
                    maps[k, frame, y - 1 : y + 1, x - 1 : x + 1] = identity
    return MotionOutput(grid=GRID, instances=maps)


def forecasts(*predictions: Instances) -> dict[int, Forecast]:
    return {
        each.actor_id: each
        for each in forecasts_of(output(*predictions), ACTORS, PLACES, labels=None)
    }


def test_an_instance_goes_on_as_the_actor_that_it_is_at_the_present() -> None:
    found = forecasts(
        {5: [(11, 0), (16, 0), (21, 1)], 3: [(10, 12), (10, 14), (10, 16)], 4: [(-20, 0)] * 3}
    )
    assert [*found] == [11, 12]
    assert_allclose(found[11].times, [0.5, 1.0])
    assert_allclose(found[11].paths, [[(16, 0), (21, 1)]])
    assert_allclose(found[12].paths, [[(10, 14), (10, 16)]])
    assert found[11].probabilities.tolist() == [1.0]


def test_the_mean_comes_first_and_all_are_equally_probable() -> None:
    found = forecasts({5: [(10, 0), (14, 0)]}, {1: [(10, 1), (15, 0)]}, {1: [(10, 0), (13, 0)]})
    assert_allclose(found[11].paths, [[(13, 0)], [(14, 0)], [(15, 0)]])
    assert_allclose(found[11].probabilities, [1 / 3] * 3)


def test_a_path_ends_with_its_instance_and_shorter_modes_are_left_out() -> None:
    gap = {5: [(10, 0), (14, 0), None, (22, 0)]}
    found = forecasts(gap)
    assert_allclose((found[11].times, found[11].paths[0, :, 0]), ([0.5], [14]))
    longer = {1: [(10, 0), (13, 0), (16, 0), None]}
    found = forecasts(gap, longer)
    assert_allclose(found[11].paths, [[(13, 0), (16, 0)]])
    assert found[11].probabilities.tolist() == [0.5]
    assert forecasts({5: [(10, 0), None]}) == {}


def test_without_a_match_there_is_none() -> None:
    assert forecasts({5: [(10, -5), (10, -5)]}) == {}
    empty = output({5: [(10, 0), (10, 0)]})
    assert forecasts_of(empty, ACTORS[:0], PLACES[:0]) == []
    nobody = MotionOutput(grid=GRID, instances=np.zeros((1, 5, 200, 200), dtype=np.int32))
    assert forecasts_of(nobody, ACTORS, PLACES) == []


@pytest.mark.parametrize(("step", "labels"), [(0.5, "released"), (1.0, "clean")])
def test_steps_and_the_cells_of_labels(step: float, labels: str) -> None:
    [found] = forecasts_of(
        output({5: [(10, 0), (14, 0)]}), ACTORS, PLACES, step=step, labels=labels
    )
    assert found.times.tolist() == [step]
    shifted = 0.25 if labels == "released" else 0.0
    assert_allclose(np.abs(found.paths - [14, 0]), shifted)


def test_no_such_labels() -> None:
    assert_refused(
        (
            lambda: forecasts_of(output({5: [(10, 0)]}), ACTORS, PLACES, labels="mine"),
            ChoiceError,
            ("labels", "mine"),
        )
    )
