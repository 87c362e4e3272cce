"""`Forecast`, and the errors of modes, actors and worlds, on paths whose errors are known."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusals import assert_refused

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.evaluation.forecasting import Forecast
from deepaccident_devkit.evaluation.forecasting.metrics import (
    actor_errors,
    collisions,
    displacement_errors,
    misses,
    world_errors,
)

STEPS = np.arange(1, 11) / 10
ALL = np.ones((1, 3), dtype=bool)
TRUTH = np.array([[[1.0, 0.0], [2.0, 0.0], [3.0, 0.0]]])


def forecast(times: Sequence[float] = (0.5, 1.0), modes: int = 1, **changes: Any) -> Forecast:
    """Ahead at 10 m/s, each mode 1 m further to the left."""
    paths = [[(10.0 * time, mode) for time in times] for mode in range(modes)]
    given = {
        "actor_id": 7,
        "times": times,
        "paths": paths,
        "probabilities": np.full(modes, 1 / modes),
        **changes,
    }
    return Forecast(**given)


def errors(
    offsets: Sequence[Sequence[float]], probabilities: Sequence[float], most: int = 6, **how: Any
) -> Any:
    """Of one actor, whose modes are so far to the side at each of three steps."""
    paths = np.stack(
        [TRUTH[0] + np.column_stack([np.zeros(3), each]) for each in np.array(offsets)]
    )[None]
    return actor_errors(paths, TRUTH, how.pop("valid", ALL), np.array([probabilities]), most, **how)


class TestForecast:
    def test_it_goes_straight_from_the_present_place_and_ends_with_its_times(self) -> None:
        found = forecast((0.5, 0.7), paths=[[(5.0, 1.0), (5.0, 2.0)]]).at(
            STEPS, np.array([1.0, 1.0])
        )
        x = [1.8, 2.6, 3.4, 4.2, 5.0, 5.0, 5.0, *[np.nan] * 3]
        assert_allclose(found, [np.column_stack([x, [*[1.0] * 5, 1.5, 2.0, *[np.nan] * 3]])])

    def test_a_stated_present_takes_the_place_of_the_label(self) -> None:
        found = forecast((0.0, 1.0), modes=2).at(STEPS, np.array([99.0, 99.0]))
        assert_allclose(
            found, [np.column_stack([10 * STEPS, np.full(10, mode)]) for mode in range(2)]
        )
        assert np.isnan(forecast((0.0,)).at(STEPS, np.zeros(2))).all()

    def test_decimal_times_compare_as_they_are_meant(self) -> None:
        end = forecast((0.1 + 0.2,)).at(np.array([0.3]), np.zeros(2))
        assert_allclose(end, [[[3.0, 0.0]]], atol=1e-9)
        summed = np.cumsum(np.full(300, 0.01, dtype=np.float32), dtype=np.float32).astype(
            np.float64
        )
        assert summed[-1] != 3
        assert_allclose(
            forecast(summed).at(np.array([3.0]), np.zeros(2)), [[[30.0, 0.0]]], atol=1e-2
        )

    def test_what_is_no_forecast(self) -> None:
        assert_refused(
            (lambda: forecast((1.0, 0.5)), GeometryError, ("times", "ascending")),
            (lambda: forecast((-0.5, 0.5)), GeometryError, ("times", "ascending")),
            (
                lambda: forecast(probabilities=[1.5]),
                GeometryError,
                ("probabilities", "from 0 to 1"),
            ),
            (lambda: forecast(probabilities=[0.5, 0.5]), GeometryError, "paths"),
            (
                lambda: forecast(paths=[[(np.nan, 0), (1, 0)]]),
                GeometryError,
                ("paths", "leave out"),
            ),
            (
                lambda: forecast(paths=np.zeros((0, 2, 2)), probabilities=[]),
                GeometryError,
                ("paths", "one mode or more"),
            ),
            (lambda: forecast(actor_id="x"), GeometryError, "actor id"),
        )


class TestActors:
    def test_the_best_mode_ends_nearest_and_its_ade_counts(self) -> None:
        found = errors([[0, 0, 3], [2, 2, 2], [0.3, 0.3, 3]], [0.2, 0.5, 0.3])
        told = {name: each.item() for name, each in found.items()}
        expected = {
            "min_fde": 2,
            "min_ade": 2,
            "miss": 0,
            "brier_min_fde": 2.25,
            "min_ade_any": 1,
            "cut_ade": 1,
        }
        assert told == pytest.approx(expected)
        assert errors([[0, 0, 2.001]], [1.0])["miss"].item() == 1
        assert errors([[0, 0, 2.001]], [1.0], miss_distance=3.0)["miss"].item() == 0

    def test_only_the_most_probable_modes_count_and_of_equal_ones_the_first(self) -> None:
        offsets = [[0, 0, 1], [0, 0, 2], [0, 0, 0.5]]
        cases = {
            (0.2, 0.5, 0.3): (2, 0.5),
            (1 / 3, 1 / 3, 1 / 3): (1, 1),
            (0.1, 0.1, np.nan): (1, 1),
        }
        for chances, expected in cases.items():
            assert [errors(offsets, chances, most)["min_fde"].item() for most in (1, 2)] == list(
                expected
            )
        tied = errors([[9, 9, 1], [0, 0, 1]], [0.5, 0.5])
        assert tied["min_ade"].item() == pytest.approx(19 / 3)

    @pytest.mark.parametrize(
        ("valid", "there"),
        [
            ((1, 1, 1), {"min_ade", "min_fde", "miss", "brier_min_fde", "min_ade_any", "cut_ade"}),
            ((0, 0, 1), {"min_fde", "miss", "brier_min_fde", "cut_ade"}),
            ((1, 1, 0), {"cut_ade"}),
            ((0, 0, 0), set()),
        ],
    )
    def test_what_needs_which_part_of_the_future(
        self, valid: Sequence[int], there: set[str]
    ) -> None:
        found = errors([[1, 2, 3]], [1.0], valid=np.array([valid], dtype=bool))
        assert {name for name, each in found.items() if np.isfinite(each).all()} == there
        if "cut_ade" in there:
            assert found["cut_ade"].item() == np.average([1, 2, 3], weights=valid)

    def test_a_forecast_that_ends_early_has_no_number_where_the_truth_goes_on(self) -> None:
        found = errors([[1, 2, np.nan], [1, 1, np.nan]], [0.5, 0.5])
        assert all(np.isnan(each).all() for each in found.values())
        cut = errors([[1, 2, np.nan], [1, 1, 3]], [0.5, 0.5], valid=np.array([[True, True, False]]))
        assert cut["cut_ade"].item() == 1
        cut = errors([[1, 1, np.nan]], [1.0], valid=np.array([[True, True, False]]))
        assert np.isnan(cut["cut_ade"].item())

    def test_of_no_actors_there_are_no_errors(self) -> None:
        none = np.zeros((0, 3), dtype=bool)
        found = actor_errors(np.zeros((0, 2, 3, 2)), np.zeros((0, 3, 2)), none, np.zeros((0, 2)), 6)
        assert {each.shape for each in found.values()} == {(0,)}
        assert [
            each.shape
            for each in displacement_errors(np.zeros((0, 2, 3, 2)), np.zeros((0, 3, 2)), none)
        ] == [(0, 2)] * 2


class TestWorlds:
    def test_errors_are_means_over_the_actors(self) -> None:
        aside = np.array([0.0, 1.0])
        truth = np.concatenate([TRUTH, TRUTH + 10 * aside])
        paths = np.stack([truth + aside, truth + 3 * aside], axis=1)
        paths[1, 0] += 2 * aside
        ade, fde, final_errors = world_errors(paths, truth)
        assert_allclose([ade, fde], [[2, 3], [2, 3]])
        assert_array_equal(misses(final_errors), [[0, 1], [1, 1]])

    def test_centres_nearer_than_a_metre_at_one_step_collide(self) -> None:
        paths = np.zeros((3, 2, 4, 2))
        paths[:, :, :, 0] = np.array([0, 10, 20])[:, None, None]
        paths[1, 1, 2, 0] = 0.99
        paths[2, 0, 3, 0] = 11.0
        assert_array_equal(collisions(paths), [[False, True], [False, True], [False, False]])
        assert_array_equal(collisions(paths, 1.1)[:, 0], [False, True, True])
