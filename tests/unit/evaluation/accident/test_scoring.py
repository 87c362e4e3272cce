"""What is exactly as near as allowed, or as another: the last bits of means of cells decide
nothing.
"""

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
from deepaccident_devkit.evaluation.accident.scoring import actor_of, exact_parts, foreseen, hit_of
from deepaccident_devkit.evaluation.map_accidents import map_accident
from deepaccident_devkit.geometry import BevGrid

GRID = BevGrid()
PLACES = [
    (int(row), int(column)) for row, column in np.random.default_rng(0).integers(30, 95, (60, 2))
]
"""At some of them means of three cells are off by the last bits."""


def pair_at(row: int, column: int, first: int = 1, frames: int = 1) -> np.ndarray:
    """Two instances of three cells each, 0.5 m apart, whose centres are thirds of cells."""
    maps = np.zeros((frames, *GRID.shape), dtype=np.int32)
    for name, start in ((first, column), (first + 1, column + 2)):
        maps[:, row, start : start + 2] = maps[:, row + 1, start] = name
    return maps


def counted(predicted: np.ndarray, truth: np.ndarray):
    label, protocol = scene({1: standing(20, 10)}), PaperAccidents()
    maps = np.zeros_like(label.instance)
    maps[: len(truth)] = truth
    given = np.zeros((len(predicted), *maps.shape), dtype=np.int32)
    given[:, : predicted.shape[1]] = predicted
    label = replace(label, instance=maps)
    counts = protocol.counts(MotionOutput(grid=GRID, instances=given), label, AccidentContext())
    return counts, protocol.result([counts])


@pytest.mark.parametrize(
    ("drawn", "cells", "ids", "actor"),
    [
        (
            [0, 0, 0, 0, 7, 7, 9],
            [0, 1, 2, 3, 4, 5, 6],
            {70: 7, 90: 9},
            70,
        ),  # most of its labelled cells
        ([0, 0, 0, 0, 7, 7, 9], [6], {70: 7, 90: 9}, 90),
        ([0, 0, 0, 0, 7, 7, 9], [0, 1, 2, 3], {70: 7, 90: 9}, None),
        (
            [9, 7, 9, 7, 0, 0, 0],
            [0, 1, 2, 3],
            {90: 9, 70: 7, -101: 3},
            70,
        ),  # of equally many the one drawn first
        ([1, 1, 2, 0, 0, 0, 0], [0, 1, 2], {-101: 1, 70: 2}, 5),
    ],
)
def test_an_instance_is_of_the_actor_that_most_of_its_labelled_cells_are(
    drawn, cells, ids, actor
) -> None:
    label = SimpleNamespace(instance=np.array([[[0] * 7], [drawn]]), id_map=ids)
    there = np.isin(np.arange(7), cells)[None]
    assert actor_of(there, 1, label, AccidentContext(own_actor_id=5)) == actor


def test_the_first_alarm_that_is_near_enough_hits() -> None:
    alarms = [foreseen(), *(foreseen(position) for position in (5 - 1e-10, 5 - 1e-8, 1.0))]
    assert [hit_of(alarms, distance) for distance in (1.0, 1.1, 5.0, 5.1)] == [
        None,
        alarms[3],
        alarms[2],
        alarms[1],
    ]
    assert foreseen(1 / 3, 0.5, 1, score=2.0) == {
        "position": 0.333333333,
        "time": 0.5,
        "id": 1,
        "score": 2.0,
    }


def test_of_two_pairs_alike_that_with_the_lower_ids_collides() -> None:
    for row, column in PLACES:
        maps = pair_at(row, column) + pair_at(row + 90, 190 - column, first=3)
        assert map_accident(maps, GRID, None, AccidentReading()).contact.ids == (1, 2)


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
    for row, column in PLACES[::4]:
        truth = pair_at(row, column, frames=2)
        late = np.roll(truth, -2, 1)
        late[0] = 0
        counts, _ = counted(np.stack([np.roll(truth, 2, 1), late]), truth)
        assert counts["best"]["time"] == 0


def test_alarms_exactly_at_the_distance_miss_and_their_order_counts_nothing() -> None:
    source = np.random.default_rng(1)
    evaluators = [AccidentEvaluator(protocol="boxes") for _ in range(3)]
    for number in range(60):
        pair, angle = source.uniform(-50, 50, (2, 2)), source.uniform(0, 2 * math.pi)
        off = Accident(
            positions=pair + 2.5 * np.array([math.cos(angle), math.sin(angle)]), time=2.0
        )
        right = [Accident(positions=pair + shift, time=2.0, ids=(1, 9)) for shift in (0.5, 1.0)]
        truth = BoxTruth(
            time=np.arange(21) / 10,
            actor_id=np.zeros(0, dtype=np.int64),
            footprint=np.zeros((21, 0, 5)),
            accident=Accident(positions=pair, time=2.0, ids=(1, 2)),
        )
        for evaluator, alarms in zip(
            evaluators, ([off, *right], [*right[::-1], off], [off]), strict=True
        ):
            evaluator.update(str(number), alarms, None, AccidentContext(truth=truth))
    forwards, backwards, alone = (evaluator.compute() for evaluator in evaluators)
    assert forwards == backwards
    assert [each.tp for each in alone.within.values()] == [0, 60, 60]


def test_parts_have_the_exact_sum() -> None:
    given = [[[1e16, 1.0], [], [-1e16]], [[0.0]], [[math.inf, 1.0]], [[1e16, 1.0]]]
    assert [exact_parts(each) for each in given] == [[1.0], [], [math.inf], [1e16, 1.0]]
