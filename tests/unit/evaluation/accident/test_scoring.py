"""Rounding errors in means of cells decide nothing at distances that are equal or just allowed."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.accident_scenes import motion_labels_of, parked_path, read_tallies

from deepaccident_devkit.evaluation import Accident, MotionOutput
from deepaccident_devkit.evaluation.accident import (
    AccidentContext,
    AccidentEvaluator,
    AccidentReading,
    BoxTruth,
    PaperAccidents,
)
from deepaccident_devkit.evaluation.accident.scoring import (
    actor_of,
    exact_parts,
    hit_of,
    make_alarm,
)
from deepaccident_devkit.evaluation.map_accidents import map_accident
from deepaccident_devkit.geometry import BevGrid

GRID = BevGrid()
# Rows and columns; at some of them means of three cells are off by the last bits.
CELLS = np.random.default_rng(0).integers(30, 95, (60, 2)).tolist()


def draw_pair(row: int, column: int, first_id: int = 1, frames: int = 1) -> np.ndarray:
    """Draw two instances of three cells each, 0.5 m apart, with centres at thirds of cells."""
    maps = np.zeros(
        (frames, *GRID.shape),
        dtype=np.int32,
    )
    for identity, start in ((first_id, column), (first_id + 1, column + 2)):
        maps[:, row, start : start + 2] = identity
        maps[:, row + 1, start] = identity
    return maps


def count_maps(predicted: np.ndarray, true: np.ndarray):
    """Count maps, (K, T, H, W) and (T, H, W), that are empty in all other frames."""
    protocol = PaperAccidents()
    label = motion_labels_of({1: parked_path(20, 10)})
    truth = np.zeros_like(label.instance)
    truth[: len(true)] = true
    instances = np.zeros((len(predicted), *truth.shape), dtype=np.int32)
    instances[:, : predicted.shape[1]] = predicted
    counts = protocol.counts(
        MotionOutput(grid=GRID, instances=instances),
        replace(label, instance=truth),
        AccidentContext(),
    )
    return counts, protocol.result([counts])


@pytest.mark.parametrize(
    ("drawn", "cells", "id_map", "actor"),
    [
        # 7 has most of its labelled cells
        ([0, 0, 0, 0, 7, 7, 9], [0, 1, 2, 3, 4, 5, 6], {70: 7, 90: 9}, 70),
        ([0, 0, 0, 0, 7, 7, 9], [6], {70: 7, 90: 9}, 90),
        ([0, 0, 0, 0, 7, 7, 9], [0, 1, 2, 3], {70: 7, 90: 9}, None),
        # 7 and 9 have equally many, and 7 is drawn first
        ([9, 7, 9, 7, 0, 0, 0], [0, 1, 2, 3], {90: 9, 70: 7, -101: 3}, 70),
        ([1, 1, 2, 0, 0, 0, 0], [0, 1, 2], {-101: 1, 70: 2}, 5),
    ],
)
def test_an_instance_is_the_actor_of_most_of_its_labelled_cells(
    drawn, cells, id_map, actor
) -> None:
    label = SimpleNamespace(
        instance=np.array([[[0] * 7], [drawn]]),
        id_map=id_map,
    )
    mask = np.isin(np.arange(7), cells)[None]
    assert actor_of(mask, 1, label, AccidentContext(own_actor_id=5)) == actor


def test_the_first_alarm_that_is_near_enough_hits() -> None:
    at_five, below_five, near = (make_alarm(position) for position in (5 - 1e-10, 5 - 1e-8, 1.0))
    alarms = [make_alarm(), at_five, below_five, near]
    assert hit_of(alarms, 1.0) is None
    assert hit_of(alarms, 1.1) == near
    assert hit_of(alarms, 5.0) == below_five
    assert hit_of(alarms, 5.1) == at_five
    assert make_alarm(1 / 3, 0.5, 1, score=2.0) == {
        "position": 0.333333333,
        "time": 0.5,
        "id": 1,
        "score": 2.0,
    }


def test_of_two_equal_pairs_the_one_with_the_lower_ids_collides() -> None:
    for row, column in CELLS:
        maps = draw_pair(row, column) + draw_pair(row + 90, 190 - column, first_id=3)
        assert map_accident(maps, GRID, None, AccidentReading()).contact.ids == (1, 2)


@pytest.mark.slow
def test_a_difference_of_exactly_the_distance_is_not_within_it_and_the_gate_is() -> None:
    for row, column in CELLS:
        truth = draw_pair(row, column)
        # both cars are 2.5 m off
        counts, result = count_maps(
            np.roll(truth, (3, 4), (1, 2))[None],
            truth,
        )
        assert counts["best"]["position"] == 5
        assert (result.within[5.0].tp, result.within[10.0].tp) == (0, 1)
        # both cars are 4 m off, the width of the gate
        counts, _ = count_maps(
            np.roll(truth, 8, 2)[None],
            truth,
        )
        assert counts["best"]["id"] == 0


def test_the_first_of_equally_near_predictions_is_compared() -> None:
    for row, column in CELLS[::4]:
        truth = draw_pair(row, column, frames=2)
        in_time = np.roll(truth, 2, 1)
        late = np.roll(truth, -2, 1)
        late[0] = 0
        counts, _ = count_maps(
            np.stack([in_time, late]),
            truth,
        )
        assert counts["best"]["time"] == 0


def test_alarms_exactly_at_the_distance_miss_and_their_order_does_not_matter() -> None:
    random = np.random.default_rng(1)
    evaluators = [AccidentEvaluator(protocol="boxes") for _ in range(3)]
    for number in range(60):
        pair = random.uniform(-50, 50, (2, 2))
        angle = random.uniform(0, 2 * math.pi)
        direction = np.array([math.cos(angle), math.sin(angle)])
        missing = Accident(positions=pair + 2.5 * direction, time=2.0)
        first, second = (
            Accident(positions=pair + shift, time=2.0, ids=(1, 9)) for shift in (0.5, 1.0)
        )
        truth = BoxTruth(
            time=np.arange(21) / 10,
            actor_id=np.zeros(0, dtype=np.int64),
            footprint=np.zeros((21, 0, 5)),
            accident=Accident(positions=pair, time=2.0, ids=(1, 2)),
        )
        orders = ([missing, first, second], [second, first, missing], [missing])
        for evaluator, alarms in zip(evaluators, orders, strict=True):
            evaluator.update(
                str(number),
                alarms,
                None,
                AccidentContext(truth=truth),
            )

    forwards, backwards, only_missing = (evaluator.compute() for evaluator in evaluators)
    assert forwards == backwards
    assert [tp for tp, _, _ in read_tallies(only_missing)] == [0, 60, 60]


def test_parts_have_the_exact_sum() -> None:
    assert exact_parts([[1e16, 1.0], [], [-1e16]]) == [1.0]
    assert exact_parts([[0.0]]) == []
    assert exact_parts([[math.inf, 1.0]]) == [math.inf]
    assert exact_parts([[1e16, 1.0]]) == [1e16, 1.0]
