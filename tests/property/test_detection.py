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

SIZE = (4.0, 2.0, 1.5)
Sample = tuple[DetectedBoxes, Boxes]


@st.composite
def samples(draw: st.DrawFn) -> list[Sample]:
    """A few samples of cars and vans, close together and with equal scores, some beyond the
    released range.
    """
    result = []
    for _ in range(draw(st.integers(1, 4))):
        truth, detections = (draw(st.integers(0, 6)) for _ in range(2))
        place = st.tuples(st.sampled_from([0.0, 84.0]), st.integers(0, 12), st.integers(0, 12))
        columns = []
        for count in (truth, detections):
            places = [draw(place) for _ in range(count)]
            center = np.array([(start + a / 3, b / 3, 0.75) for start, a, b in places]).reshape(
                count, 3
            )
            columns.append(
                Boxes.from_arrays(
                    center,
                    np.tile(SIZE, (count, 1)),
                    [draw(st.sampled_from([0.0, 0.3, 3.0, -3.0])) for _ in range(count)],
                    frame="lidar",
                    category=np.array(
                        [draw(st.integers(0, 1)) * 2 for _ in range(count)], dtype=int
                    ),
                    velocity=np.full((count, 3), 1.0),
                )
            )
        scores = [draw(st.integers(1, 5)) / 8 for _ in range(detections)]
        result.append((DetectedBoxes(boxes=columns[1], scores=np.array(scores)), columns[0]))
    return result


def evaluator_of(
    protocol: str, chosen: Sequence[tuple[int, Sample]], **switches
) -> DetectionEvaluator:
    evaluator = DetectionEvaluator(protocol, **switches)
    for number, (prediction, truth) in chosen:
        evaluator.update(f"{number:03d}", prediction, truth)
    return evaluator


@settings(max_examples=12)
@given(samples(), st.randoms())
@pytest.mark.parametrize("protocol", sorted(DETECTION_PROTOCOLS))
def test_any_order_and_any_workers_give_the_same_bits(
    protocol: str, drawn: list[Sample], random
) -> None:
    numbered = list(enumerate(drawn))
    whole = evaluator_of(protocol, numbered).compute()
    random.shuffle(numbered)
    cut = random.randint(0, len(numbered))
    parts = (
        evaluator_of(protocol, numbered[:cut])
        .merge(evaluator_of(protocol, numbered[cut:]))
        .compute()
    )
    for name in ("average_precision", "precision", "recall", "errors", "truths", "detections"):
        assert getattr(whole, name).tobytes() == getattr(parts, name).tobytes()


def reordered(sample: Sample, order: Callable[[Boxes], list[int]]) -> Sample:
    found, truth = sample
    rows, true_rows = (np.array(order(each), dtype=int) for each in (found.boxes, truth))
    return DetectedBoxes(boxes=found.boxes.select(rows), scores=found.scores[rows]), truth.select(
        true_rows
    )


def by_content(boxes: Boxes) -> list[int]:
    return sorted(
        range(len(boxes)), key=lambda row: (boxes.category[row], *boxes.center[row], boxes.yaw[row])
    )


def crowd(random: np.random.Generator, count: int) -> Boxes:
    center = np.column_stack([random.integers(-9, 9, (count, 2)) * 0.75, np.full(count, 0.75)])
    return Boxes.from_arrays(
        center, np.tile(SIZE, (count, 1)), random.uniform(-3, 3, count), frame="lidar"
    )


@pytest.mark.parametrize("protocol", ["paper", "opencood"])
def test_a_crowd_in_any_order_gives_the_same_bits(protocol: str) -> None:
    random = np.random.default_rng(5)
    drawn = [
        (
            DetectedBoxes(boxes=crowd(random, 40), scores=random.integers(1, 4, 40) / 4),
            crowd(random, 15),
        )
        for _ in range(5)
    ]
    found = set()
    for _ in range(8):
        mixed = [
            reordered(each, lambda boxes: random.permutation(len(boxes)).tolist()) for each in drawn
        ]
        result = evaluator_of(
            protocol, [(at, mixed[at]) for at in random.permutation(5).tolist()]
        ).compute()
        found.add(
            (
                result.average_precision.tobytes(),
                result.precision.tobytes(),
                result.errors.tobytes(),
            )
        )
    assert len(found) == 1


@settings(max_examples=40)
@given(samples(), st.randoms(use_true_random=False))
@pytest.mark.parametrize("protocol", ["paper", "opencood", "opencood by sample"])
def test_boxes_in_any_order_give_the_same_bits(protocol: str, drawn: list[Sample], random) -> None:
    """Many scores and distances are equal."""
    switches = {"global_sort": False} if protocol.endswith("by sample") else {}
    name = protocol.split(maxsplit=1)[0]
    mixed = [
        reordered(each, lambda boxes: random.sample(range(len(boxes)), len(boxes)))
        for each in drawn
    ]
    whole, other = (
        evaluator_of(name, list(enumerate(each)), **switches).compute() for each in (drawn, mixed)
    )
    for column in ("average_precision", "precision", "recall", "errors"):
        assert getattr(whole, column).tobytes() == getattr(other, column).tobytes()
    for (found, truth), (again, truth_again) in zip(drawn, mixed, strict=True):
        pairs = [detection_matches(*each, name) for each in ((found, truth), (again, truth_again))]
        met, met_again = (
            sorted(
                (*boxes.center[one], boxes.yaw[one], *true.center[two], true.yaw[two])
                for one, two in found_pairs
            )
            for boxes, true, found_pairs in (
                (found.boxes, truth, zip(pairs[0].detection, pairs[0].truth, strict=True)),
                (again.boxes, truth_again, zip(pairs[1].detection, pairs[1].truth, strict=True)),
            )
        )
        assert met == met_again


@settings(max_examples=12)
@given(samples(), st.lists(st.integers(0, 3), min_size=4, max_size=4), st.integers(0, 4))
@pytest.mark.parametrize("protocol", [*sorted(DETECTION_PROTOCOLS), "opencood by sample"])
def test_a_draw_is_the_result_of_that_many_copies(
    protocol: str, drawn: list[Sample], often: list[int], cut: int
) -> None:
    switches = {"global_sort": False} if protocol.endswith("by sample") else {}
    evaluator = evaluator_of(protocol.split(maxsplit=1)[0], list(enumerate(drawn)), **switches)
    parts = [[each] for each in evaluator.counts.values()]
    parts = [
        part for part in (*parts[cut:], [each for part in parts[:cut] for each in part]) if part
    ]
    times = np.array([often[: len(parts)], [1] * len(parts), [0] * len(parts)])
    made = list(evaluator.resampled(parts, times))
    for result, row in zip(made, times.tolist(), strict=True):
        taken = [
            each
            for part, number in zip(parts, row, strict=True)
            for _ in range(number)
            for each in part
        ]
        copied = evaluator.result_of(taken)
        assert result.samples == copied.samples == len(taken)
        for name in ("average_precision", "precision", "recall", "truths", "detections"):
            assert getattr(result, name).tobytes() == getattr(copied, name).tobytes()
        np.testing.assert_allclose(result.errors, copied.errors, rtol=1e-12)


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
    """After each arrival: what the rule gives over all that are there, truth by truth."""
    ranks = itertools.count()
    keyed = sorted(
        (not counts[candidate], distance, candidate, truth)
        for candidate, pairs in enumerate(drawn)
        for truth, distance in pairs
    )
    rank = {(candidate, truth): next(ranks) for _, _, candidate, truth in keyed}
    reach = {
        candidate: [(truth, rank[candidate, truth]) for truth, _ in pairs]
        for candidate, pairs in enumerate(drawn)
        if pairs
    }
    steps = nearest_by_truth(reach, dict(enumerate(counts)), truth_counts)
    for there in range(len(drawn) + 1):
        free, anew = set(range(there)), {}
        for truth in range(6):
            wanting = [(rank[one, truth], one) for one in free if (one, truth) in rank]
            if wanting:
                anew[truth] = min(wanting)[1]
                free.remove(anew[truth])
        pairs = [(truth_counts[truth], counts[one]) for truth, one in anew.items()]
        assert sum(one < there for one in steps.tp) == pairs.count((True, True))
        assert sum(one < there for one in steps.spent) == pairs.count((False, True))
        assert sum(change for one, change in steps.excused if one < there) == pairs.count(
            (True, False)
        )
        if there == len(drawn):
            assert steps.holder == anew


def in_score_order(drawn: Sequence[Sample], category: int) -> list[tuple[float, int, int]]:
    """Score, sample and row of a class's detections, falling; equal ones in the order given."""
    rows = [
        (-score, number, row)
        for number, (prediction, _) in enumerate(drawn)
        for row, score in enumerate(prediction.scores.tolist())
        if prediction.boxes.category[row] == category
        and abs(prediction.boxes.center[row, 0]) <= 51.2
    ]
    return sorted(rows)


@given(samples())
def test_the_papers_precision_is_nuscenes(drawn: list[Sample]) -> None:
    """Written out from the rules of nuScenes' accumulate and calc_ap, a loop a step."""
    result = evaluator_of("paper", list(enumerate(drawn))).compute()
    drawn = [reordered(each, by_content) for each in drawn]
    for position, category in ((0, 0), (2, 2)):
        truths = sum(
            int(((truth.category == category) & (np.abs(truth.center[:, 0]) <= 51.2)).sum())
            for _, truth in drawn
        )
        if not truths:
            assert np.isnan(result.average_precision[position]).all()
            continue
        for level, threshold in enumerate((1.0, 2.0, 4.0)):
            taken: set[tuple[int, int]] = set()
            hits = []
            for _, number, row in in_score_order(drawn, category):
                prediction, truth = drawn[number]
                distances = np.linalg.norm(
                    truth.center[:, :2] - prediction.boxes.center[row, :2], axis=1
                )
                free = [
                    (distances[one], one)
                    for one in range(len(truth))
                    if truth.category[one] == category
                    and (number, one) not in taken
                    and truth.center[one, 0] <= 51.2
                ]
                nearest = min(free, default=(np.inf, -1))
                hits.append(bool(nearest[0] < threshold))
                if hits[-1]:
                    taken.add((number, nearest[1]))
            expected = 0.0
            if any(hits):
                found = np.cumsum(hits)
                precision = np.interp(
                    np.linspace(0, 1, 101),
                    found / truths,
                    found / np.arange(1, len(hits) + 1),
                    right=0,
                )
                expected = np.clip(precision[11:] - 0.1, 0, None).mean() / 0.9
            assert result.average_precision[position, 0, level] == pytest.approx(
                100 * expected, abs=1e-9
            )


@given(samples(), st.booleans())
def test_opencoods_precision_is_vocs(drawn: list[Sample], everywhere: bool) -> None:
    """Detections by score take the truth they overlap most; the area under the envelope, over all
    rises of recall.
    """
    result = evaluator_of("opencood", list(enumerate(drawn)), global_sort=everywhere).compute()
    drawn = [reordered(each, by_content) for each in drawn]
    for level, threshold in enumerate((0.3, 0.5, 0.7)):
        rows, truths = [], 0
        for number, (prediction, truth) in enumerate(drawn):
            overlap = prediction.boxes.iou_bev(truth)
            free = list(range(len(truth)))
            truths += len(truth)
            for row in np.argsort(-prediction.scores, kind="stable").tolist():
                best = max(free, key=lambda one: overlap[row, one], default=None)
                hit = best is not None and overlap[row, best] >= threshold
                if hit:
                    free.remove(best)
                rows.append((-prediction.scores[row] if everywhere else 0.0, number, hit))
        if not truths:
            assert np.isnan(result.average_precision[0, 0, level])
            continue
        hits = [hit for _, _, hit in sorted(rows, key=lambda each: each[:1])]
        recall, precision, found = [0.0], [0.0], 0
        for seen, hit in enumerate(hits, start=1):
            found += hit
            recall.append(found / truths)
            precision.append(found / seen)
        recall.append(1.0)
        precision.append(0.0)
        envelope = np.maximum.accumulate(precision[::-1])[::-1]
        expected = float(np.sum(np.diff(recall) * envelope[1:]))
        assert result.average_precision[0, 0, level] == pytest.approx(100 * expected, abs=1e-9)


def plain_pass(
    sample: Sample, category: int, threshold: float, least: float | None
) -> tuple[int, int, int, list]:
    """TP, FP, FN, scores of TPs of a sample and class (docs/released_code.md, Detection); no
    `least`: score pass.
    """
    prediction, truth = sample
    center, true_center = (boxes.center.astype(np.float32) for boxes in (prediction.boxes, truth))
    beyond, true_beyond = (
        np.sqrt(2 * each[:, 0].astype(float) ** 2) >= 120 for each in (center, true_center)
    )
    taking_part = [
        row
        for row in range(len(prediction))
        if (beyond[row] or prediction.boxes.category[row] == category)
        and (least is None or prediction.scores[row] >= least)
    ]
    used: set[int] = set()
    missed, scores = 0, []
    for one in np.flatnonzero(truth.category == category).tolist():
        near = [
            (float(distance), row)
            for row in taking_part
            if row not in used
            and (distance := np.sqrt(((true_center[one] - center[row]) ** 2).sum(dtype=np.float32)))
            < threshold
        ]
        if not near:
            missed += not true_beyond[one]
            continue
        if least is None:
            row = max(near, key=lambda pair: (prediction.scores[pair[1]], -pair[1]))[1]
        else:
            row = min(
                near, key=lambda pair: (beyond[pair[1]], 0 if beyond[pair[1]] else pair[0], pair[1])
            )[1]
        used.add(row)
        if not (beyond[row] or true_beyond[one]):
            scores.append(float(prediction.scores[row]))
    in_vain = sum(not beyond[row] and row not in used for row in taking_part)
    return len(scores), in_vain, missed, scores


@given(samples())
def test_the_released_curves_are_those_of_matching_anew_at_each_score(drawn: list[Sample]) -> None:
    result = evaluator_of("released", list(enumerate(drawn))).compute()
    for position, (level, threshold) in itertools.product((0, 2), enumerate((0.5, 1.0, 2.0, 4.0))):
        scores = [
            score
            for sample in drawn
            for score in plain_pass(sample, position, threshold, least=None)[3]
        ]
        matches = recall_matches(result.truths[position], 40)[0]
        points = [
            sorted(scores, reverse=True)[match - 1] for match in matches if match <= len(scores)
        ]
        precision, recall = np.zeros(40), np.zeros(40)
        for point, least in enumerate(points):
            passes = [plain_pass(sample, position, threshold, least)[:3] for sample in drawn]
            found, in_vain, missed = (sum(column) for column in zip(*passes, strict=True))
            precision[point] = found / (found + in_vain) if found + in_vain else 0
            recall[point] = found / (found + missed) if found + missed else np.nan
        np.testing.assert_allclose(
            result.precision[position, 0, level], precision, rtol=0, atol=1e-12
        )
        np.testing.assert_allclose(result.recall[position, 0, level], recall, rtol=0, atol=1e-12)
