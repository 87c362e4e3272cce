"""What is exactly as near as allowed, or as another: the last bits of means of cells decide nothing."""

import math
from dataclasses import replace
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest
from accident_scenes import scene, standing

from deepaccident_devkit.evaluation import Accident, MotionOutput
from deepaccident_devkit.evaluation.metrics.accident import (
    AccidentContext,
    AccidentEvaluator,
    AccidentReading,
    BoxTruth,
    PaperAccidents,
)
from deepaccident_devkit.evaluation.metrics.accident.scoring import (
    DISTANCES,
    ERRORS_AT,
    actor_of,
    alarms_tally,
    exact_parts,
    foreseen,
    hit_of,
    named,
    tally_result,
    united,
)
from deepaccident_devkit.evaluation.metrics.alarms.reading import accident_of
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
    assert exact_parts([[1e16, 1.0], [], [-1e16]]) == [1.0]
    some = np.random.default_rng(0).normal(size=50).tolist()
    parts = exact_parts([some[:20], some[20:], [1e-30]])
    assert sum(map(Fraction, parts)) == sum(map(Fraction, some)) + Fraction(1e-30)
    assert parts[0] == math.fsum(some)
    assert len(parts) < 5
    assert exact_parts([]) == exact_parts([[0.0]]) == []
    assert exact_parts([[math.inf, 1.0]]) == [math.inf]


def test_a_tally_of_several_samples_by_hand() -> None:
    """A hit at 4 m, one at 12 m beside a false alarm, a missed one, and two false alarms where nothing happens."""
    calm = {"positive": False, "named": "none"}
    crash = {"positive": True, "named": "meta"}
    tallies = [
        alarms_tally(crash, [foreseen(4.0, -0.5, 1)]),
        alarms_tally(crash | {"named": "another"}, [foreseen(30.0, 1.0, 0), foreseen(12.0, 2.0, 0)]),
        alarms_tally(crash, []),
        alarms_tally(calm, [foreseen(), foreseen()]),
    ]
    made = tally_result(united(tallies), ERRORS_AT)
    assert (DISTANCES, ERRORS_AT) == ((5.0, 10.0, 15.0), 10.0)
    assert [(each.distance, each.tp, each.fp, each.fn) for each in made.within.values()] == [
        (5.0, 1, 4, 2),
        (10.0, 1, 4, 2),
        (15.0, 2, 3, 1),
    ]
    assert [each.accuracy for each in made.within.values()] == [1 / 4, 1 / 4, 2 / 4]
    assert made.apa == pytest.approx(1 / 3)
    assert (made.id_error, made.position_error, made.time_error) == (1, 4, 0.5)
    wide = made.within[15.0]
    assert (wide.id_error, wide.position_error, wide.time_error) == (0.5, 8, 1.25)
    assert (made.samples, made.positives, made.negatives) == (4, 3, 1)
    assert made.truths == {"meta": 2, "another": 1, "none": 1, "unknown": 0}


def test_an_alarm_hits_below_the_distance_and_not_at_it() -> None:
    alarms = [foreseen(), foreseen(10.0), foreseen(9.9), foreseen(1.0)]
    assert hit_of(alarms, 10.0) is alarms[2]
    assert hit_of(alarms, 10.1) is alarms[1]
    assert hit_of(alarms, 1.0) is None
    assert foreseen(2.0000000001, score=0.5) == {"position": 2.0, "time": None, "id": None, "score": 0.5}


def test_whom_a_truth_names() -> None:
    known = AccidentContext(pair=(1, 2), known=True)
    assert [named(pair, known) for pair in (None, (2, 1), (1, 3), (None, 1))] == ["none", "meta", "another", "unknown"]
    assert named((1, 2), AccidentContext(known=True)) == "another"
    assert named((1, 2), AccidentContext(pair=(1, 2))) == "unknown"
