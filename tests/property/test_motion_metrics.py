"""Laws of the motion metrics: the arrays do what the plain rules say, whatever ids are called and
samples' order.
"""

import math
from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.testing import assert_allclose, assert_array_equal

from deepaccident_devkit.evaluation.instances import (
    iou,
    longest,
    mask_counts,
    match_trajectories,
    padded,
    vpq_counts,
)
from deepaccident_devkit.evaluation.motion import MotionEvaluator, motion_counts
from deepaccident_devkit.evaluation.predictions import instances_of
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import MotionLabelConfig, MotionLabels

IDS = st.integers(0, 4)
SHAPES = st.tuples(st.integers(1, 4), st.integers(1, 5), st.integers(1, 5))
GRID = BevGrid((-20.0, 20.0, 5.0), (-15.0, 15.0, 5.0))
CONFIG = MotionLabelConfig(grid=GRID, future_frames=2)


@st.composite
def pairs(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    """Prediction and label; the prediction is the label with some cells changed, so that there are
    matches.
    """
    shape = draw(SHAPES)
    label = draw(hnp.arrays(np.int32, shape, elements=IDS, fill=st.just(1)))
    noise = draw(hnp.arrays(np.int32, shape, elements=st.integers(0, 9), fill=st.just(9)))
    return np.where(noise > 4, label, noise), label


@st.composite
def paths(draw: st.DrawFn) -> dict[int, np.ndarray]:
    count, quarters = draw(st.integers(0, 5)), st.integers(-40, 40).map(lambda number: number / 4)
    return {
        index + 1: draw(hnp.arrays(np.float64, (draw(st.integers(1, 4)), 2), elements=quarters))
        for index in range(count)
    }


def plain_vpq(
    prediction: np.ndarray, label: np.ndarray, *, temporally_consistent: bool
) -> list[list[float]]:
    """[iou, tp, fp, fn] of the instances in each frame, as docs/released_code.md, IoU and VPQ,
    tells it.
    """
    result, partner = [], {}
    for predicted, true in zip(prediction, label, strict=True):
        sums = [0.0, 0, 0, 0]
        mine, theirs = set(predicted[predicted > 0].tolist()), set(true[true > 0].tolist())
        for name in sorted(theirs):
            for other in sorted(mine):
                both, either = (
                    (true == name) & (predicted == other),
                    (true == name) | (predicted == other),
                )
                if both.sum() / either.sum() > 0.5:
                    changed = temporally_consistent and partner.get(name, other) != other
                    partner[name] = other
                    mine, theirs = mine - {other}, theirs - {name}
                    if changed:
                        sums[2], sums[3] = sums[2] + 1, sums[3] + 1
                    else:
                        sums[0], sums[1] = sums[0] + both.sum() / either.sum(), sums[1] + 1
        result.append([sums[0], sums[1], sums[2] + len(mine), sums[3] + len(theirs)])
    return result


@settings(max_examples=200)
@given(given_pair=pairs(), consistent=st.booleans())
def test_vpq_is_what_the_plain_rules_say(given_pair, consistent: bool) -> None:
    found = vpq_counts(*given_pair, temporally_consistent=consistent)
    columns = (found.iou, found.true_positive, found.false_positive, found.false_negative)
    expected = plain_vpq(*given_pair, temporally_consistent=consistent)
    assert_allclose(
        np.stack([values[:, 1] for values in columns], axis=1), expected, rtol=0, atol=1e-12
    )


@given(given_pair=pairs(), names=st.permutations(range(1, 5)), large=st.booleans())
def test_what_ids_are_called_makes_no_difference(given_pair, names: list[int], large: bool) -> None:
    prediction, label = given_pair
    renamed = np.array([0, *names], dtype=np.int64) * (10**15 if large else 1)
    expected, found = vpq_counts(prediction, label), vpq_counts(renamed[prediction], label)
    for name in ("iou", "true_positive", "false_positive", "false_negative"):
        assert_array_equal(getattr(found, name), getattr(expected, name))
    found = vpq_counts(prediction, renamed[label])
    assert_array_equal(found.iou, expected.iou)


@given(given_pair=pairs())
def test_frames_alone_treat_both_sides_alike(given_pair) -> None:
    prediction, label = given_pair
    there = vpq_counts(prediction, label, temporally_consistent=False)
    back = vpq_counts(label, prediction, temporally_consistent=False)
    assert_array_equal(there.iou, back.iou)
    assert_array_equal(there.false_positive, back.false_negative)
    assert (vpq_counts(prediction, label).true_positive <= there.true_positive).all()


@given(label=hnp.arrays(np.int32, SHAPES, elements=IDS))
def test_the_truth_itself_is_perfect(label: np.ndarray) -> None:
    found = vpq_counts(label, label)
    assert_array_equal(found.iou[:, 1], found.true_positive[:, 1])
    assert not found.false_positive.any()
    assert not found.false_negative.any()
    assert iou([mask_counts(label == 1, label == 1)], absent=1.0) == 1.0


@given(given_paths=paths(), length=st.integers(0, 6))
def test_paths_keep_their_points_and_go_on(given_paths, length: int) -> None:
    faster = padded(given_paths, length)
    for name, path in given_paths.items():
        assert_array_equal(faster[name][: len(path)], path)
        assert len(faster[name]) == max(len(path), length)
        step = path[-1] - path[-2] if len(path) > 1 else np.zeros(2)
        for number, (first, second) in enumerate(pairwise(faster[name][len(path) - 1 :]), start=1):
            assert_array_equal(second - first, number * step)


@given(prediction=paths(), truth=paths())
def test_everybody_is_matched_once_or_not_at_all(prediction, truth) -> None:
    length = longest(truth)
    found = match_trajectories(padded(prediction, length), padded(truth, length))
    mine, theirs = ([pair[side] for pair in found.pairs] for side in (0, 1))
    assert sorted([*mine, *found.unmatched_prediction]) == sorted(prediction)
    assert sorted([*theirs, *found.unmatched_truth]) == sorted(truth)
    assert list(found.costs) == sorted(found.costs)
    assert all(cost <= 4.0 * length for cost in found.costs)
    perfect = match_trajectories(padded(truth, length), padded(truth, length))
    assert perfect.costs == (0.0,) * len(truth)


@given(prediction=paths(), truth=paths())
def test_sides_in_another_order_have_the_same_partners_where_nothing_ties(
    prediction, truth
) -> None:
    length = longest(truth)
    mine, theirs = padded(prediction, length), padded(truth, length)
    found = match_trajectories(mine, theirs)
    costs = [
        np.linalg.norm(a[:length] - b, axis=1).sum() for a in mine.values() for b in theirs.values()
    ]
    if len(set(np.round(costs, 9))) == len(costs):
        backwards = match_trajectories(dict(reversed(mine.items())), dict(reversed(theirs.items())))
        assert backwards == found


def label_of(instance: np.ndarray) -> MotionLabels:
    vectors = np.full((3, 2, *GRID.shape), 255, dtype=np.float32)
    return MotionLabels(
        config=CONFIG,
        segmentation=(instance > 0).astype(np.uint8),
        instance=instance,
        centerness=np.zeros((3, 1, *GRID.shape), dtype=np.float32),
        offset=vectors,
        flow=vectors,
        future_egomotion=np.zeros((CONFIG.frames, 6), dtype=np.float32),
        valid=np.ones(CONFIG.frames, dtype=bool),
        id_map={},
        at_present=True,
    )


MAPS = hnp.arrays(np.int32, (3, *GRID.shape), elements=IDS)


@settings(max_examples=30)
@given(
    maps=st.lists(st.tuples(MAPS, MAPS), min_size=1, max_size=6),
    order=st.randoms(),
    parts=st.integers(1, 3),
)
def test_any_order_and_any_parts_give_the_same_bits(maps, order, parts: int) -> None:
    samples = {
        str(n): motion_counts(instances_of(mine, GRID), label_of(true))
        for n, (mine, true) in enumerate(maps)
    }
    expected = MotionEvaluator()
    for token, counts in samples.items():
        expected.add(token, counts)
    workers = [MotionEvaluator() for _ in range(parts)]
    tokens = list(samples)
    order.shuffle(tokens)
    for token in tokens:
        order.choice(workers).add(token, samples[token])
    order.shuffle(workers)
    merged = MotionEvaluator()
    for worker in workers:
        merged.merge(worker)
    found = merged.compute()
    assert str(found) == str(expected.compute())
    assert not math.isinf(found.min_ade)
