"""`forecasts_of`: forecasts of the actors that instances are at the present."""

from collections.abc import Mapping, Sequence

import numpy as np
import pytest
from numpy.testing import assert_allclose
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation import MotionOutput
from deepaccident_devkit.evaluation.forecasting import Forecast, forecasts_of
from deepaccident_devkit.geometry import BevGrid

GRID = BevGrid((-50, 50, 0.5), (-50, 50, 0.5), "devkit")
ACTOR_IDS = np.array([11, 12])
POSITIONS = np.array([[10.0, 0.0], [10.0, 10.0]])
Instances = Mapping[int, Sequence[tuple[float, float] | None]]


def make_output(*predictions: Instances) -> MotionOutput:
    """Draw instances of 2 × 2 cells around the places of each frame."""
    frames = max(len(path) for instances in predictions for path in instances.values())
    maps = np.zeros(
        (len(predictions), frames, 200, 200),
        dtype=np.int32,
    )
    for prediction_maps, instances in zip(maps, predictions, strict=True):
        for identity, path in instances.items():
            for frame_map, position in zip(prediction_maps, path, strict=False):
                if position is not None:
                    column, row = (round((metres + 50) / 0.5) for metres in position)
                    frame_map[row - 1 : row + 1, column - 1 : column + 1] = identity
    return MotionOutput(grid=GRID, instances=maps)


def make_forecasts(*predictions: Instances) -> dict[int, Forecast]:
    forecasts = forecasts_of(make_output(*predictions), ACTOR_IDS, POSITIONS, labels=None)
    return {forecast.actor_id: forecast for forecast in forecasts}


def test_an_instance_goes_on_as_the_actor_that_it_is_at_the_present() -> None:
    forecasts = make_forecasts(
        {
            5: [(11, 0), (16, 0), (21, 1)],
            3: [(10, 12), (10, 14), (10, 16)],
            4: [(-20, 0), (-20, 0), (-20, 0)],
        }
    )
    assert [*forecasts] == [11, 12]
    assert_allclose(forecasts[11].times, [0.5, 1.0])
    assert_allclose(
        forecasts[11].paths,
        [[(16, 0), (21, 1)]],
    )
    assert_allclose(
        forecasts[12].paths,
        [[(10, 14), (10, 16)]],
    )
    assert forecasts[11].probabilities.tolist() == [1.0]


def test_the_mean_comes_first_and_all_modes_are_equally_probable() -> None:
    forecasts = make_forecasts(
        {5: [(10, 0), (14, 0)]},
        {1: [(10, 1), (15, 0)]},
        {1: [(10, 0), (13, 0)]},
    )
    assert_allclose(
        forecasts[11].paths,
        [[(13, 0)], [(14, 0)], [(15, 0)]],
    )
    assert_allclose(
        forecasts[11].probabilities,
        [1 / 3] * 3,
    )


def test_a_path_ends_with_its_instance_and_shorter_modes_are_left_out() -> None:
    with_gap = {5: [(10, 0), (14, 0), None, (22, 0)]}
    forecast = make_forecasts(with_gap)[11]
    assert_allclose(forecast.times, [0.5])
    assert_allclose(forecast.paths[0, :, 0], [14])

    longer = {1: [(10, 0), (13, 0), (16, 0), None]}
    forecast = make_forecasts(with_gap, longer)[11]
    assert_allclose(
        forecast.paths,
        [[(13, 0), (16, 0)]],
    )
    assert forecast.probabilities.tolist() == [0.5]
    assert make_forecasts({5: [(10, 0), None]}) == {}


def test_without_a_matching_instance_there_is_no_forecast() -> None:
    assert make_forecasts({5: [(10, -5), (10, -5)]}) == {}
    output = make_output({5: [(10, 0), (10, 0)]})
    assert forecasts_of(output, ACTOR_IDS[:0], POSITIONS[:0]) == []
    empty = MotionOutput(
        grid=GRID,
        instances=np.zeros((1, 5, 200, 200), dtype=np.int32),
    )
    assert forecasts_of(empty, ACTOR_IDS, POSITIONS) == []


@pytest.mark.parametrize(("step", "labels"), [(0.5, "released"), (1.0, "clean")])
def test_steps_and_the_cells_of_labels(step: float, labels: str) -> None:
    [forecast] = forecasts_of(
        make_output({5: [(10, 0), (14, 0)]}),
        ACTOR_IDS,
        POSITIONS,
        step=step,
        labels=labels,
    )
    assert forecast.times.tolist() == [step]
    shift_m = 0.25 if labels == "released" else 0.0
    assert_allclose(
        np.abs(forecast.paths - [14, 0]),
        shift_m,
    )


def test_unknown_labels_are_refused() -> None:
    output = make_output({5: [(10, 0)]})
    assert_raises(
        (
            lambda: forecasts_of(output, ACTOR_IDS, POSITIONS, labels="mine"),
            ChoiceError,
            ("labels", "mine"),
        )
    )
