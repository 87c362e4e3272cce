"""`Forecast`, and the errors of modes, actors and worlds, on paths with known errors."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.evaluation.forecasting import Forecast
from deepaccident_devkit.evaluation.forecasting.metrics import (
    actor_errors,
    collisions,
    displacement_errors,
    misses,
    world_errors,
)

TIMES_S = np.arange(1, 11) / 10
TRUTH = np.array([[[1.0, 0.0], [2.0, 0.0], [3.0, 0.0]]])


def make_forecast(times: Sequence[float] = (0.5, 1.0), modes: int = 1, **changes: Any) -> Forecast:
    """Make modes that go ahead at 10 m/s, each 1 m farther to the left than the one before."""
    fields = {
        "actor_id": 7,
        "times": times,
        "paths": [[(10.0 * time, mode) for time in times] for mode in range(modes)],
        "probabilities": np.full(modes, 1 / modes),
        **changes,
    }
    return Forecast(**fields)


def evaluate_actor(
    offsets: Sequence[Sequence[float]],
    probabilities: Sequence[float],
    modes: int = 6,
    valid: Sequence[int] = (1, 1, 1),
    **options: Any,
) -> dict[str, float]:
    """Return the errors of one actor.

    Args:
        offsets: Distance of each mode to the left at each of three steps, metres.
        probabilities: Probabilities of the modes.
        modes: How many of the most probable modes count.
        valid: Whether each step is recorded.
        **options: Other arguments of `actor_errors`.
    """
    paths = np.repeat(TRUTH, len(offsets), axis=0)
    paths[:, :, 1] += offsets
    errors = actor_errors(
        paths[None],
        TRUTH,
        np.array([valid], dtype=bool),
        np.array([probabilities]),
        modes,
        **options,
    )
    return {name: values.item() for name, values in errors.items()}


class TestForecast:
    def test_it_goes_straight_from_the_present_place_and_ends_with_its_times(self) -> None:
        forecast = make_forecast(
            (0.5, 0.7),
            paths=[[(5.0, 1.0), (5.0, 2.0)]],
        )
        path = forecast.at(TIMES_S, np.array([1.0, 1.0]))
        x = [1.8, 2.6, 3.4, 4.2, 5.0, 5.0, 5.0, np.nan, np.nan, np.nan]
        y = [1.0, 1.0, 1.0, 1.0, 1.0, 1.5, 2.0, np.nan, np.nan, np.nan]
        assert_allclose(path, [np.column_stack([x, y])])

    def test_a_stated_present_replaces_the_place_of_the_label(self) -> None:
        paths = make_forecast((0.0, 1.0), modes=2).at(
            TIMES_S,
            np.array([99.0, 99.0]),
        )
        for mode, path in enumerate(paths):
            assert_allclose(
                path,
                np.column_stack([10 * TIMES_S, np.full(10, mode)]),
            )
        assert len(paths) == 2
        assert np.isnan(make_forecast((0.0,)).at(TIMES_S, np.zeros(2))).all()

    def test_decimal_times_compare_as_they_are_meant(self) -> None:
        end = make_forecast((0.1 + 0.2,)).at(
            np.array([0.3]),
            np.zeros(2),
        )
        assert_allclose(end, [[[3.0, 0.0]]], atol=1e-9)

        steps = np.full(300, 0.01, dtype=np.float32)
        times = np.cumsum(steps, dtype=np.float32).astype(np.float64)
        assert times[-1] != 3
        end = make_forecast(times).at(
            np.array([3.0]),
            np.zeros(2),
        )
        assert_allclose(end, [[[30.0, 0.0]]], atol=1e-2)

    def test_what_is_no_forecast(self) -> None:
        assert_raises(
            (lambda: make_forecast((1.0, 0.5)), GeometryError, ("times", "ascending")),
            (lambda: make_forecast((-0.5, 0.5)), GeometryError, ("times", "ascending")),
            (
                lambda: make_forecast(probabilities=[1.5]),
                GeometryError,
                ("probabilities", "from 0 to 1"),
            ),
            (lambda: make_forecast(probabilities=[0.5, 0.5]), GeometryError, "paths"),
            (
                lambda: make_forecast(paths=[[(np.nan, 0), (1, 0)]]),
                GeometryError,
                ("paths", "leave out"),
            ),
            (
                lambda: make_forecast(paths=np.zeros((0, 2, 2)), probabilities=[]),
                GeometryError,
                ("paths", "at least one mode"),
            ),
            (lambda: make_forecast(actor_id="x"), GeometryError, "actor id"),
        )


class TestActors:
    def test_the_best_mode_ends_nearest_and_its_ade_counts(self) -> None:
        errors = evaluate_actor([[0, 0, 3], [2, 2, 2], [0.3, 0.3, 3]], [0.2, 0.5, 0.3])
        expected = {
            "min_fde": 2,
            "min_ade": 2,
            "miss": 0,
            "brier_min_fde": 2.25,
            "min_ade_any": 1,
            "cut_ade": 1,
        }
        assert errors == pytest.approx(expected)
        assert evaluate_actor([[0, 0, 2.001]], [1.0])["miss"] == 1
        assert evaluate_actor([[0, 0, 2.001]], [1.0], miss_distance=3.0)["miss"] == 0

    def test_only_the_most_probable_modes_count_and_of_equal_ones_the_first(self) -> None:
        offsets = [[0, 0, 1], [0, 0, 2], [0, 0, 0.5]]
        for probabilities, fde_of_one, fde_of_two in (
            ((0.2, 0.5, 0.3), 2, 0.5),
            ((1 / 3, 1 / 3, 1 / 3), 1, 1),
            ((0.1, 0.1, np.nan), 1, 1),
        ):
            assert evaluate_actor(offsets, probabilities, modes=1)["min_fde"] == fde_of_one
            assert evaluate_actor(offsets, probabilities, modes=2)["min_fde"] == fde_of_two
        tied = evaluate_actor(
            [[9, 9, 1], [0, 0, 1]],
            [0.5, 0.5],
        )
        assert tied["min_ade"] == pytest.approx(19 / 3)

    @pytest.mark.parametrize(
        ("valid", "known"),
        [
            ((1, 1, 1), {"min_ade", "min_fde", "miss", "brier_min_fde", "min_ade_any", "cut_ade"}),
            ((0, 0, 1), {"min_fde", "miss", "brier_min_fde", "cut_ade"}),
            ((1, 1, 0), {"cut_ade"}),
            ((0, 0, 0), set()),
        ],
    )
    def test_errors_need_their_part_of_the_future(
        self, valid: Sequence[int], known: set[str]
    ) -> None:
        errors = evaluate_actor([[1, 2, 3]], [1.0], valid=valid)
        assert {name for name, error in errors.items() if np.isfinite(error)} == known
        if "cut_ade" in known:
            assert errors["cut_ade"] == np.average([1, 2, 3], weights=valid)

    def test_a_forecast_that_ends_early_has_no_number_where_the_truth_goes_on(self) -> None:
        errors = evaluate_actor(
            [[1, 2, np.nan], [1, 1, np.nan]],
            [0.5, 0.5],
        )
        assert np.isnan([*errors.values()]).all()
        errors = evaluate_actor(
            [[1, 2, np.nan], [1, 1, 3]],
            [0.5, 0.5],
            valid=(1, 1, 0),
        )
        assert errors["cut_ade"] == 1
        errors = evaluate_actor(
            [[1, 1, np.nan]],
            [1.0],
            valid=(1, 1, 0),
        )
        assert np.isnan(errors["cut_ade"])

    def test_of_no_actors_there_are_no_errors(self) -> None:
        paths = np.zeros((0, 2, 3, 2))
        truth = np.zeros((0, 3, 2))
        valid = np.zeros((0, 3), dtype=bool)
        errors = actor_errors(
            paths,
            truth,
            valid,
            np.zeros((0, 2)),
            6,
        )
        assert {values.shape for values in errors.values()} == {(0,)}
        ade, fde = displacement_errors(paths, truth, valid)
        assert ade.shape == fde.shape == (0, 2)


class TestWorlds:
    def test_errors_are_means_over_the_actors(self) -> None:
        left = np.array([0.0, 1.0])
        truth = np.concatenate([TRUTH, TRUTH + 10 * left])
        paths = np.stack(
            [truth + left, truth + 3 * left],
            axis=1,
        )
        paths[1, 0] += 2 * left
        ade, fde, final_errors = world_errors(paths, truth)
        assert_allclose(
            [ade, fde],
            [[2, 3], [2, 3]],
        )
        assert_array_equal(misses(final_errors), [[0, 1], [1, 1]])

    def test_centres_nearer_than_a_metre_at_one_step_collide(self) -> None:
        paths = np.zeros((3, 2, 4, 2))
        paths[:, :, :, 0] = np.array([0, 10, 20])[:, None, None]
        paths[1, 1, 2, 0] = 0.99
        paths[2, 0, 3, 0] = 11.0
        assert_array_equal(
            collisions(paths),
            [[False, True], [False, True], [False, False]],
        )
        assert_array_equal(
            collisions(paths, 1.1)[:, 0],
            [False, True, True],
        )
