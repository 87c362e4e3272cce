"""What is exactly as near as allowed, or as another: the last bits of means of cells decide nothing."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from accident_scenes import scene, standing

from deepaccident_devkit.evaluation import Accident, MotionOutput
from deepaccident_devkit.evaluation.accident import (
    AccidentContext,
    AccidentEvaluator,
    AccidentReading,
    BoxTruth,
    PaperAccidents,
)
from deepaccident_devkit.evaluation.accident.scoring import actor_of, exact_parts
from deepaccident_devkit.evaluation.map_accidents import accident_of
from deepaccident_devkit.geometry import BevGrid

GRID = BevGrid()
PLACES = [(int(row), int(column)) for row, column in np.random.default_rng(0).integers(30, 95, (60, 2))]
"""At some of them means of three cells are off by the last bits."""


def pair_at(row: int, column: int, first: int = 1, frames: int = 1) -> np.ndarray:
    """Two instances of three cells each, 0.5 m apart, whose centres are thirds of cells."""
    maps = np.zeros((frames, *GRID.shape), dtype=np.int32)
    for name, start in ((first, column), (first + 1, column + 2)):
        maps[:, row, start : start + 2] = maps[:, row + 1, start] = name
    return maps


def counted(predicted: np.ndarray, truth: np.ndarray):
    label = scene({1: standing(20, 10)})
    protocol = PaperAccidents()
    maps = np.zeros_like(label.instance)
    maps[: len(truth)] = truth
    given = np.zeros((len(predicted), *maps.shape), dtype=np.int32)
    given[:, : predicted.shape[1]] = predicted
    label = replace(label, instance=maps)
    counts = protocol.counts(MotionOutput(grid=GRID, instances=given), label, AccidentContext())
    return counts, protocol.result([counts])


def test_an_instance_is_of_the_actor_that_most_of_its_labelled_cells_are() -> None:
    drawn = np.array([[[0, 0, 0, 0, 7, 7, 9]]])
    label = SimpleNamespace(instance=drawn, id_map={70: 7, 90: 9})
    assert actor_of(np.ones((1, 7), dtype=bool), 0, label, AccidentContext()) == 70
    assert actor_of(drawn[0] == 9, 0, label, AccidentContext()) == 90
    assert actor_of(drawn[0] == 0, 0, label, AccidentContext()) is None


def test_of_two_pairs_alike_that_with_the_lower_ids_collides() -> None:
    for row, column in PLACES:
        maps = pair_at(row, column) + pair_at(row + 90, 190 - column, first=3)
        assert accident_of(maps, GRID, None, AccidentReading()).contact.ids == (1, 2)


@pytest.mark.slow
def test_a_difference_of_exactly_the_distance_is_not_within_it_and_the_gate_is() -> None:
    for row, column in PLACES:
        truth = pair_at(row, column)
        counts, result = counted(np.roll(truth, (3, 4), (1, 2))[None], truth)  # each is 2.5 m off
        assert counts["best"]["position"] == 5
        assert (result.within[5.0].tp, result.within[10.0].tp) == (0, 1)
        counts, _ = counted(np.roll(truth, 8, 2)[None], truth)  # 4 m off
        assert counts["best"]["id"] == 0


def test_the_first_of_equally_near_predictions_is_compared() -> None:
    for row, column in PLACES:
        truth = pair_at(row, column, frames=2)
        late = np.roll(truth, -2, 1)
        late[0] = 0
        counts, _ = counted(np.stack([np.roll(truth, 2, 1), late]), truth)
        assert counts["best"]["time"] == 0


def test_alarms_exactly_at_the_distance_miss_and_their_order_counts_nothing() -> None:
    rng = np.random.default_rng(1)
    for _ in range(60):
        pair = rng.uniform(-50, 50, (2, 2))
        truth = BoxTruth(
            time=np.arange(21) / 10,
            actor_id=np.zeros(0, dtype=np.int64),
            footprint=np.zeros((21, 0, 5)),
            accident=Accident(positions=pair, time=2.0, ids=(1, 2)),
        )
        angle = rng.uniform(0, 2 * math.pi)
        off = Accident(positions=pair + 2.5 * np.array([math.cos(angle), math.sin(angle)]), time=2.0)
        right = [Accident(positions=pair + shift, time=2.0, ids=(1, 9)) for shift in (0.5, 1.0)]
        results = []
        for alarms in ([off, *right], [*right[::-1], off]):
            evaluator = AccidentEvaluator(protocol="boxes")
            evaluator.update("one", alarms, None, AccidentContext(truth=truth))
            results.append(evaluator.compute())
        assert results[0] == results[1]
        alone = AccidentEvaluator(protocol="boxes")
        alone.update("one", [off], None, AccidentContext(truth=truth))
        assert [each.tp for each in alone.compute().within.values()] == [0, 1, 1]


def test_of_equally_many_cells_the_actor_drawn_first_counts() -> None:
    drawn = np.array([[[9, 7, 9, 7, 0, 0, 0]]])
    label = SimpleNamespace(instance=drawn, id_map={90: 9, 70: 7, -101: 3})
    assert actor_of(np.ones((1, 7), dtype=bool), 0, label, AccidentContext()) == 70


def test_parts_have_the_exact_sum() -> None:
    given = [[[1e16, 1.0], [], [-1e16]], [[0.0]], [[math.inf, 1.0]]]
    assert [exact_parts(each) for each in given] == [[1.0], [], [math.inf]]
