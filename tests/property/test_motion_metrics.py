"""Laws of the motion metrics: they follow the plain rules for any ids and any order of samples."""

import math
from itertools import product

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
    """Prediction and label; the prediction is the label with some cells changed, so they match."""
    shape = draw(SHAPES)
    label = draw(hnp.arrays(np.int32, shape, elements=IDS, fill=st.just(1)))
    noise = draw(hnp.arrays(np.int32, shape, elements=st.integers(0, 9), fill=st.just(9)))
    return np.where(noise > 4, label, noise), label


@st.composite
def paths(draw: st.DrawFn) -> dict[int, np.ndarray]:
    count = draw(st.integers(0, 5))
    quarters = st.integers(-40, 40).map(lambda number: number / 4)
    shapes = st.tuples(st.integers(1, 4), st.just(2))
    points = hnp.arrays(np.float64, shapes, elements=quarters)
    return {name: draw(points) for name in range(1, count + 1)}


def plain_vpq(
    prediction: np.ndarray, label: np.ndarray, *, temporally_consistent: bool
) -> list[list[float]]:
    """Return [iou, tp, fp, fn] of the instances in each frame.

    The rules are in docs/released_code.md, IoU and VPQ.
    """
    rows = []
    partners = {}
    for predicted_map, true_map in zip(prediction, label, strict=True):
        iou_sum, tp, num_changed = 0.0, 0, 0
        predicted_ids = set(predicted_map[predicted_map > 0].tolist())
        true_ids = set(true_map[true_map > 0].tolist())
        for true_id, predicted_id in product(sorted(true_ids), sorted(predicted_ids)):
            is_true = true_map == true_id
            is_predicted = predicted_map == predicted_id
            pair_iou = (is_true & is_predicted).sum() / (is_true | is_predicted).sum()
            if pair_iou > 0.5:
                partner = partners.get(true_id, predicted_id)
                partners[true_id] = predicted_id
                predicted_ids.remove(predicted_id)
                true_ids.remove(true_id)
                if temporally_consistent and partner != predicted_id:
                    num_changed += 1
                else:
                    iou_sum += pair_iou
                    tp += 1
        fp = num_changed + len(predicted_ids)
        fn = num_changed + len(true_ids)
        rows.append([iou_sum, tp, fp, fn])
    return rows


@settings(max_examples=200)
@given(given_pair=pairs(), consistent=st.booleans())
def test_vpq_is_what_the_plain_rules_say(given_pair, consistent: bool) -> None:
    counts = vpq_counts(*given_pair, temporally_consistent=consistent)
    columns = (counts.iou, counts.true_positive, counts.false_positive, counts.false_negative)
    instance_counts = np.stack([values[:, 1] for values in columns], axis=1)
    expected = plain_vpq(*given_pair, temporally_consistent=consistent)
    assert_allclose(instance_counts, expected, rtol=0, atol=1e-12)


@given(given_pair=pairs(), names=st.permutations(range(1, 5)), large=st.booleans())
def test_what_ids_are_called_makes_no_difference(given_pair, names: list[int], large: bool) -> None:
    prediction, label = given_pair
    new_ids = np.array([0, *names], dtype=np.int64) * (10**15 if large else 1)
    expected = vpq_counts(prediction, label)
    counts = vpq_counts(new_ids[prediction], label)
    for name in ("iou", "true_positive", "false_positive", "false_negative"):
        assert_array_equal(getattr(counts, name), getattr(expected, name))
    assert_array_equal(vpq_counts(prediction, new_ids[label]).iou, expected.iou)


@given(given_pair=pairs())
def test_single_frames_treat_both_sides_alike(given_pair) -> None:
    prediction, label = given_pair
    counts = vpq_counts(prediction, label, temporally_consistent=False)
    swapped = vpq_counts(label, prediction, temporally_consistent=False)
    assert_array_equal(counts.iou, swapped.iou)
    assert_array_equal(counts.false_positive, swapped.false_negative)
    assert (vpq_counts(prediction, label).true_positive <= counts.true_positive).all()


@given(label=hnp.arrays(np.int32, SHAPES, elements=IDS))
def test_the_truth_itself_is_perfect(label: np.ndarray) -> None:
    counts = vpq_counts(label, label)
    assert_array_equal(counts.iou[:, 1], counts.true_positive[:, 1])
    assert not counts.false_positive.any()
    assert not counts.false_negative.any()
    assert iou([mask_counts(label == 1, label == 1)], absent=1.0) == 1.0


@given(given_paths=paths(), length=st.integers(0, 6))
def test_paths_keep_their_points_and_go_on(given_paths, length: int) -> None:
    padded_paths = padded(given_paths, length)
    for name, path in given_paths.items():
        padded_path = padded_paths[name]
        assert_array_equal(padded_path[: len(path)], path)
        assert len(padded_path) == max(len(path), length)
        last_step = path[-1] - path[-2] if len(path) > 1 else np.zeros(2)
        added_steps = np.diff(padded_path[len(path) - 1 :], axis=0)
        for number, step in enumerate(added_steps, start=1):
            assert_array_equal(step, number * last_step)


@given(prediction=paths(), truth=paths())
def test_everybody_is_matched_once_or_not_at_all(prediction, truth) -> None:
    length = longest(truth)
    matching = match_trajectories(padded(prediction, length), padded(truth, length))
    predicted_ids = [predicted_id for predicted_id, _ in matching.pairs]
    true_ids = [true_id for _, true_id in matching.pairs]
    assert sorted([*predicted_ids, *matching.unmatched_prediction]) == sorted(prediction)
    assert sorted([*true_ids, *matching.unmatched_truth]) == sorted(truth)
    assert list(matching.costs) == sorted(matching.costs)
    assert all(cost <= 4.0 * length for cost in matching.costs)
    perfect = match_trajectories(padded(truth, length), padded(truth, length))
    assert perfect.costs == (0.0,) * len(truth)


@given(prediction=paths(), truth=paths())
def test_sides_in_another_order_have_the_same_partners_where_nothing_ties(
    prediction, truth
) -> None:
    length = longest(truth)
    predicted_paths = padded(prediction, length)
    true_paths = padded(truth, length)
    costs = [
        np.linalg.norm(predicted_path[:length] - true_path, axis=1).sum()
        for predicted_path, true_path in product(predicted_paths.values(), true_paths.values())
    ]
    if len(set(np.round(costs, 9))) == len(costs):
        reversed_prediction = dict(reversed(predicted_paths.items()))
        reversed_truth = dict(reversed(true_paths.items()))
        expected = match_trajectories(predicted_paths, true_paths)
        assert match_trajectories(reversed_prediction, reversed_truth) == expected


def make_label(instance: np.ndarray) -> MotionLabels:
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
    evaluator = MotionEvaluator()
    samples = []
    for number, (predicted_map, true_map) in enumerate(maps):
        counts = motion_counts(instances_of(predicted_map, GRID), make_label(true_map))
        samples.append((str(number), counts))
        evaluator.add(str(number), counts)

    workers = [MotionEvaluator() for _ in range(parts)]
    order.shuffle(samples)
    for token, counts in samples:
        order.choice(workers).add(token, counts)
    order.shuffle(workers)
    merged = MotionEvaluator()
    for worker in workers:
        merged.merge(worker)
    result = merged.compute()
    assert str(result) == str(evaluator.compute())
    assert not math.isinf(result.min_ade)
