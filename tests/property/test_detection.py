"""Detection metrics against plain implementations of the rules, and laws of sums over samples."""

import itertools
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deepaccident_devkit.evaluation.detection import (
    DETECTION_PROTOCOLS,
    DetectedBoxes,
    DetectionEvaluator,
    detection_matches,
)
from deepaccident_devkit.evaluation.detection.curves import recall_matches
from deepaccident_devkit.evaluation.detection.matching import nearest_by_truth
from deepaccident_devkit.geometry import Boxes

BOX_SIZE_M = (4.0, 2.0, 1.5)
Sample = tuple[DetectedBoxes, Boxes]


@st.composite
def crowded_boxes(draw: st.DrawFn) -> Boxes:
    """Up to six cars and vans, close together, some beyond the released range."""
    count = draw(st.integers(0, 6))
    center = np.full((count, 3), 0.75)
    yaw = np.zeros(count)
    category = np.zeros(count, dtype=int)
    for row in range(count):
        start_x = draw(st.sampled_from([0.0, 84.0]))
        center[row, 0] = start_x + draw(st.integers(0, 12)) / 3
        center[row, 1] = draw(st.integers(0, 12)) / 3
        yaw[row] = draw(st.sampled_from([0.0, 0.3, 3.0, -3.0]))
        category[row] = draw(st.sampled_from([0, 2]))
    size = np.tile(BOX_SIZE_M, (count, 1))
    velocity = np.full((count, 3), 1.0)
    return Boxes.from_arrays(center, size, yaw, frame="lidar", category=category, velocity=velocity)


@st.composite
def samples(draw: st.DrawFn) -> list[Sample]:
    """A few samples of detections, many with equal scores, and true boxes."""
    drawn_samples = []
    for _ in range(draw(st.integers(1, 4))):
        truth = draw(crowded_boxes())
        boxes = draw(crowded_boxes())
        scores = np.array([draw(st.integers(1, 5)) / 8 for _ in range(len(boxes))])
        drawn_samples.append((DetectedBoxes(boxes=boxes, scores=scores), truth))
    return drawn_samples


def make_evaluator(
    protocol: str, numbered_samples: Sequence[tuple[int, Sample]], **options
) -> DetectionEvaluator:
    evaluator = DetectionEvaluator(protocol, **options)
    for number, (prediction, truth) in numbered_samples:
        evaluator.update(f"{number:03d}", prediction, truth)
    return evaluator


def assert_same_bits(result: object, expected: object, *names: str) -> None:
    for name in names:
        assert getattr(result, name).tobytes() == getattr(expected, name).tobytes(), name


@settings(max_examples=12)
@given(samples(), st.randoms())
@pytest.mark.parametrize("protocol", sorted(DETECTION_PROTOCOLS))
def test_any_order_and_any_workers_give_the_same_bits(
    protocol: str, drawn: list[Sample], random
) -> None:
    numbered_samples = list(enumerate(drawn))
    expected = make_evaluator(protocol, numbered_samples).compute()
    random.shuffle(numbered_samples)
    cut = random.randint(0, len(numbered_samples))
    evaluator = make_evaluator(protocol, numbered_samples[:cut])
    other_evaluator = make_evaluator(protocol, numbered_samples[cut:])
    result = evaluator.merge(other_evaluator).compute()
    assert_same_bits(
        result,
        expected,
        *("average_precision", "precision", "recall", "errors", "truths", "detections"),
    )


def reorder_sample(sample: Sample, order: Callable[[Boxes], list[int]]) -> Sample:
    prediction, truth = sample
    rows = np.array(order(prediction.boxes), dtype=int)
    true_rows = np.array(order(truth), dtype=int)
    reordered_boxes = prediction.boxes.select(rows)
    reordered = DetectedBoxes(boxes=reordered_boxes, scores=prediction.scores[rows])
    return reordered, truth.select(true_rows)


def order_by_content(boxes: Boxes) -> list[int]:
    def content(row: int) -> tuple[float, ...]:
        return (boxes.category[row], *boxes.center[row], boxes.yaw[row])

    return sorted(range(len(boxes)), key=content)


def make_crowd(random: np.random.Generator, count: int) -> Boxes:
    center = np.full((count, 3), 0.75)
    center[:, :2] = random.integers(-9, 9, (count, 2)) * 0.75
    size = np.tile(BOX_SIZE_M, (count, 1))
    return Boxes.from_arrays(center, size, random.uniform(-3, 3, count), frame="lidar")


@pytest.mark.parametrize("protocol", ["paper", "opencood"])
def test_a_crowd_in_any_order_gives_the_same_bits(protocol: str) -> None:
    random = np.random.default_rng(5)

    def shuffle_rows(boxes: Boxes) -> list[int]:
        return random.permutation(len(boxes)).tolist()

    crowds = []
    for _ in range(5):
        boxes = make_crowd(random, 40)
        prediction = DetectedBoxes(boxes=boxes, scores=random.integers(1, 4, 40) / 4)
        crowds.append((prediction, make_crowd(random, 15)))
    expected = make_evaluator(protocol, list(enumerate(crowds))).compute()
    for _ in range(8):
        shuffled = [reorder_sample(sample, shuffle_rows) for sample in crowds]
        numbers = random.permutation(5).tolist()
        numbered_samples = [(number, shuffled[number]) for number in numbers]
        result = make_evaluator(protocol, numbered_samples).compute()
        assert_same_bits(result, expected, "average_precision", "precision", "errors")


@settings(max_examples=40)
@given(samples(), st.randoms(use_true_random=False))
@pytest.mark.parametrize("protocol", ["paper", "opencood", "opencood by sample"])
def test_boxes_in_any_order_give_the_same_bits(protocol: str, drawn: list[Sample], random) -> None:
    """Many scores and distances are equal."""
    options = {"global_sort": False} if protocol.endswith("by sample") else {}
    name = protocol.split(maxsplit=1)[0]

    def shuffle_rows(boxes: Boxes) -> list[int]:
        return random.sample(range(len(boxes)), len(boxes))

    def list_matches(sample: Sample) -> list[tuple[float, ...]]:
        """Return the centres and yaws of matched boxes, in an order that rows do not decide."""
        prediction, truth = sample
        boxes = prediction.boxes
        matches = detection_matches(prediction, truth, name)
        contents = []
        for row, true_row in zip(matches.detection, matches.truth, strict=True):
            content = (*boxes.center[row], boxes.yaw[row])
            contents.append((*content, *truth.center[true_row], truth.yaw[true_row]))
        return sorted(contents)

    shuffled = [reorder_sample(sample, shuffle_rows) for sample in drawn]
    expected = make_evaluator(name, list(enumerate(drawn)), **options).compute()
    result = make_evaluator(name, list(enumerate(shuffled)), **options).compute()
    assert_same_bits(result, expected, "average_precision", "precision", "recall", "errors")
    for sample, shuffled_sample in zip(drawn, shuffled, strict=True):
        assert list_matches(sample) == list_matches(shuffled_sample)


@settings(max_examples=12)
@given(samples(), st.lists(st.integers(0, 3), min_size=4, max_size=4), st.integers(0, 4))
@pytest.mark.parametrize("protocol", [*sorted(DETECTION_PROTOCOLS), "opencood by sample"])
def test_a_draw_is_the_result_of_that_many_copies(
    protocol: str, drawn: list[Sample], copies: list[int], cut: int
) -> None:
    options = {"global_sort": False} if protocol.endswith("by sample") else {}
    evaluator = make_evaluator(protocol.split(maxsplit=1)[0], list(enumerate(drawn)), **options)
    counts = list(evaluator.counts.values())
    parts = [[sample_counts] for sample_counts in counts[cut:]]
    if counts[:cut]:
        parts.append(counts[:cut])
    draws = np.array([copies[: len(parts)], [1] * len(parts), [0] * len(parts)])
    results = list(evaluator.resampled(parts, draws))
    for result, draw in zip(results, draws.tolist(), strict=True):
        copied_counts = []
        for part, number in zip(parts, draw, strict=True):
            copied_counts += part * number
        expected = evaluator.result_of(copied_counts)
        assert result.samples == expected.samples == len(copied_counts)
        assert_same_bits(
            result,
            expected,
            *("average_precision", "precision", "recall", "truths", "detections"),
        )
        np.testing.assert_allclose(result.errors, expected.errors, rtol=1e-12)


reaches = st.lists(
    st.lists(
        st.tuples(st.integers(0, 5), st.integers(0, 9)), unique_by=lambda pair: pair[0], max_size=4
    ).map(sorted),
    max_size=7,
)


@given(
    reaches,
    st.lists(st.booleans(), min_size=7, max_size=7),
    st.lists(st.booleans(), min_size=6, max_size=6),
)
def test_arrivals_give_what_matching_anew_gives(drawn, counts, truth_counts) -> None:
    """The plain rule runs again, truth by truth, over all candidates that have arrived."""
    links = sorted(
        (not counts[candidate], distance, candidate, truth)
        for candidate, pairs in enumerate(drawn)
        for truth, distance in pairs
    )
    ranks = {(candidate, truth): rank for rank, (_, _, candidate, truth) in enumerate(links)}
    reach = {
        candidate: [(truth, ranks[candidate, truth]) for truth, _ in pairs]
        for candidate, pairs in enumerate(drawn)
        if pairs
    }
    steps = nearest_by_truth(reach, dict(enumerate(counts)), truth_counts)
    for num_arrived in range(len(drawn) + 1):
        free = set(range(num_arrived))
        holders = {}
        for truth in range(6):
            candidates = [candidate for candidate in free if (candidate, truth) in ranks]
            if candidates:
                holder = min(candidates, key=lambda candidate: ranks[candidate, truth])
                holders[truth] = holder
                free.remove(holder)
        pairs = [(truth_counts[truth], counts[holder]) for truth, holder in holders.items()]
        num_tp = sum(candidate < num_arrived for candidate in steps.tp)
        assert num_tp == pairs.count((True, True))
        num_spent = sum(candidate < num_arrived for candidate in steps.spent)
        assert num_spent == pairs.count((False, True))
        changes = [change for candidate, change in steps.excused if candidate < num_arrived]
        assert sum(changes) == pairs.count((True, False))
    assert steps.holder == holders


def sort_by_score(drawn: Sequence[Sample], category: int) -> list[tuple[float, int, int]]:
    """Return the negative score, sample and row of a class's detections, highest score first."""
    rows = []
    for number, (prediction, _) in enumerate(drawn):
        boxes = prediction.boxes
        is_chosen = (boxes.category == category) & (np.abs(boxes.center[:, 0]) <= 51.2)
        for row in np.flatnonzero(is_chosen).tolist():
            rows.append((-float(prediction.scores[row]), number, row))
    return sorted(rows)


def plain_hits(drawn: Sequence[Sample], category: int, max_distance: float) -> list[bool]:
    """Return which detections, by falling score, are near enough to a true box that is free."""
    hits = []
    matched: set[tuple[int, int]] = set()
    for _, number, row in sort_by_score(drawn, category):
        prediction, truth = drawn[number]
        offsets = truth.center[:, :2] - prediction.boxes.center[row, :2]
        distances = np.linalg.norm(offsets, axis=1)
        is_chosen = (truth.category == category) & (truth.center[:, 0] <= 51.2)
        free_rows = [
            true_row
            for true_row in np.flatnonzero(is_chosen).tolist()
            if (number, true_row) not in matched
        ]
        nearest = min(free_rows, key=lambda true_row: distances[true_row], default=None)
        is_hit = nearest is not None and bool(distances[nearest] < max_distance)
        hits.append(is_hit)
        if is_hit:
            matched.add((number, nearest))
    return hits


@given(samples())
def test_the_papers_precision_is_nuscenes(drawn: list[Sample]) -> None:
    """Compares with the rules of nuScenes' accumulate and calc_ap, one loop for each step."""
    result = make_evaluator("paper", list(enumerate(drawn))).compute()
    drawn = [reorder_sample(sample, order_by_content) for sample in drawn]
    for position, category in ((0, 0), (2, 2)):
        num_truths = 0
        for _, truth in drawn:
            is_in_range = np.abs(truth.center[:, 0]) <= 51.2
            num_truths += int(((truth.category == category) & is_in_range).sum())
        if not num_truths:
            assert np.isnan(result.average_precision[position]).all()
            continue
        for level, max_distance in enumerate((1.0, 2.0, 4.0)):
            hits = plain_hits(drawn, category, max_distance)
            expected = 0.0
            if any(hits):
                num_hits = np.cumsum(hits)
                recall = num_hits / num_truths
                precision = num_hits / np.arange(1, len(hits) + 1)
                precision = np.interp(np.linspace(0, 1, 101), recall, precision, right=0)
                expected = np.clip(precision[11:] - 0.1, 0, None).mean() / 0.9
            average_precision = result.average_precision[position, 0, level]
            assert average_precision == pytest.approx(100 * expected, abs=1e-9)


@given(samples(), st.booleans())
def test_opencoods_precision_is_vocs(drawn: list[Sample], global_sort: bool) -> None:
    """By falling score, a detection takes the truth that it overlaps most.

    The precision is the area under the envelope, over all rises of recall.
    """
    result = make_evaluator("opencood", list(enumerate(drawn)), global_sort=global_sort).compute()
    drawn = [reorder_sample(sample, order_by_content) for sample in drawn]
    for level, threshold in enumerate((0.3, 0.5, 0.7)):
        rows = []
        num_truths = 0
        for prediction, truth in drawn:
            overlap = prediction.boxes.iou_bev(truth)
            free = list(range(len(truth)))
            num_truths += len(truth)
            for row in np.argsort(-prediction.scores, kind="stable").tolist():
                best = max(free, key=lambda true_row: overlap[row, true_row], default=None)
                is_hit = best is not None and overlap[row, best] >= threshold
                if is_hit:
                    free.remove(best)
                rows.append((-prediction.scores[row], is_hit))
        if not num_truths:
            assert np.isnan(result.average_precision[0, 0, level])
            continue
        if global_sort:
            rows.sort(key=lambda score_and_hit: score_and_hit[0])
        recall, precision = [0.0], [0.0]
        num_hits = 0
        for num_detections, (_, is_hit) in enumerate(rows, start=1):
            num_hits += is_hit
            recall.append(num_hits / num_truths)
            precision.append(num_hits / num_detections)
        recall.append(1.0)
        precision.append(0.0)
        envelope = np.maximum.accumulate(precision[::-1])[::-1]
        expected = float(np.sum(np.diff(recall) * envelope[1:]))
        assert result.average_precision[0, 0, level] == pytest.approx(100 * expected, abs=1e-9)


def is_beyond_range(center: np.ndarray) -> np.ndarray:
    return np.sqrt(2 * center[:, 0].astype(float) ** 2) >= 120


def plain_pass(
    sample: Sample, category: int, threshold: float, min_score: float | None
) -> tuple[int, int, int, list]:
    """Return TP, FP, FN and the scores of the TPs of a sample and class.

    The rules are in docs/released_code.md, Detection; without a `min_score` it is the score pass.
    """
    prediction, truth = sample
    scores = prediction.scores
    center = prediction.boxes.center.astype(np.float32)
    true_center = truth.center.astype(np.float32)
    is_beyond = is_beyond_range(center)
    is_true_beyond = is_beyond_range(true_center)
    takes_part = is_beyond | (prediction.boxes.category == category)
    if min_score is not None:
        takes_part &= scores >= min_score
    candidates = np.flatnonzero(takes_part).tolist()
    used: set[int] = set()
    num_missed = 0
    hit_scores = []
    for true_row in np.flatnonzero(truth.category == category).tolist():
        squares = (true_center[true_row] - center) ** 2
        distances = np.sqrt(squares.sum(axis=1, dtype=np.float32))
        near = [row for row in candidates if row not in used and distances[row] < threshold]
        if not near:
            num_missed += not is_true_beyond[true_row]
            continue
        if min_score is None:
            chosen_row = max(near, key=lambda row: (scores[row], -row))
        else:
            order = {row: (1, 0) if is_beyond[row] else (0, distances[row]) for row in near}
            chosen_row = min(near, key=lambda row: (order[row], row))
        used.add(chosen_row)
        if not (is_beyond[chosen_row] or is_true_beyond[true_row]):
            hit_scores.append(float(scores[chosen_row]))
    num_false = sum(not is_beyond[row] and row not in used for row in candidates)
    return len(hit_scores), num_false, num_missed, hit_scores


@given(samples())
def test_the_released_curves_are_those_of_matching_anew_at_each_score(drawn: list[Sample]) -> None:
    result = make_evaluator("released", list(enumerate(drawn))).compute()
    for position, (level, threshold) in itertools.product((0, 2), enumerate((0.5, 1.0, 2.0, 4.0))):
        scores = []
        for sample in drawn:
            scores += plain_pass(sample, position, threshold, min_score=None)[3]
        scores.sort(reverse=True)
        matches = recall_matches(result.truths[position], 40)[0]
        min_scores = [scores[match - 1] for match in matches if match <= len(scores)]

        precision, recall = np.zeros(40), np.zeros(40)
        for point, min_score in enumerate(min_scores):
            passes = [plain_pass(sample, position, threshold, min_score)[:3] for sample in drawn]
            tp, fp, fn = np.sum(passes, axis=0).tolist()
            precision[point] = tp / (tp + fp) if tp + fp else 0
            recall[point] = tp / (tp + fn) if tp + fn else np.nan
        curve = (position, 0, level)
        np.testing.assert_allclose(result.precision[curve], precision, rtol=0, atol=1e-12)
        np.testing.assert_allclose(result.recall[curve], recall, rtol=0, atol=1e-12)
