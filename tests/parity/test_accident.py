"""The golden accidents (tests/data/golden: d_accident, d2_eval_accidents): equal counts, matches
and cells.

The released functions made them: d_accident with the whole evaluation loop over samples of six
predictions, d2_eval_accidents with `eval_accidents` only, under numpy 1.23.5, scikit-image 0.20.0,
shapely 2.0.1, OpenCV 4.7.0 and torch 2.13 on the CPU (tests/data/golden/README.md); the rules are
in docs/released_code.md, Accidents. Errors and rates agree to 1e-6. Distances of outlines agree as
far as golden numbers can pin them: one in a hundred moves with numpy's version and the processor,
by half a cell at most, and none across a threshold. Our results are compared with the released
code's under a stable sort. The golden maps have the released orientation; d_accident also runs
turned to the devkit's orientation and to FIERY's.
"""

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from parity.conftest import GoldenCase
from support.golden_motion import column_row_centers

from deepaccident_devkit.evaluation.accident import AccidentEvaluator
from deepaccident_devkit.evaluation.accident.released import (
    DrawnPaths,
    ReleasedAccidents,
    accident_counts,
    paths_of_heads,
)
from deepaccident_devkit.evaluation.predictions import MotionOutput, first_frames
from deepaccident_devkit.geometry.bev_grid import to_orientation
from deepaccident_devkit.motion import (
    POST_PROCESSING,
    MotionHeads,
    MotionLabelConfig,
    MotionLabels,
    predict_instances,
)
from deepaccident_devkit.motion.reference_arithmetic.outlines import pair_gaps

ACCIDENT = POST_PROCESSING["accident"]
RULES = ReleasedAccidents()
COUNTS = ("tp", "fp", "fn", "id", "position", "time")
"""The order of the golden results, each at 5, 10 and 15 m."""
PREDICTIONS = {"six_stable_sort": slice(None), "one_stable_sort": slice(-1, None)}
ORIENTATIONS = ("released", "devkit", "fiery")
CELL_M = 0.5
NOTHING_FOUND = (1, 20, 1)
"""The released code's errors without a true positive: share, metres, seconds."""
MAX_MOVED_SHARE = 0.01
"""The share of the distances that may move, by `MAX_MOVE_CELLS` at most."""
MAX_MOVE_CELLS = 0.5

samples = pytest.mark.golden_cases("d_accident", "samples")
oriented = pytest.mark.parametrize("orientation", ORIENTATIONS)


def label_config(orientation: str) -> MotionLabelConfig:
    return MotionLabelConfig(orientation=orientation)


def read_label(golden: GoldenCase, orientation: str) -> MotionLabels:
    """Return a sample's labels, which are stored at the present already."""
    stored = replace(golden, part="d_accident_inputs")
    maps = {
        "segmentation": stored["gt_seg"],
        "instance": stored["gt_instance"].astype(np.int32),
        "centerness": (stored["gt_center_q"].astype(np.float32) / 65535)[:, None],
        "offset": stored["gt_offset"].astype(np.float32),
        "flow": stored["gt_flow"].astype(np.float32),
    }
    turned = {
        name: to_orientation(
            values,
            vectors=name in {"offset", "flow"},
            source="released",
            target=orientation,
            ignore=255,
        )
        for name, values in maps.items()
    }
    config = label_config(orientation)
    return MotionLabels(
        config=config,
        future_egomotion=stored["future_egomotions"],
        valid=np.arange(config.frames) < config.receptive_field - 1 + golden.entry["S"],
        id_map={},
        at_present=True,
        **turned,
    )


def read_heads(golden: GoldenCase, orientation: str) -> tuple[MotionHeads, ...]:
    """Return the stored predictions, quantised as golden/README.md describes."""
    stored = replace(golden, part="d_accident_inputs")
    logit = stored["pred_seg_q"].astype(np.float32) / 16
    center = stored["pred_center_q"].astype(np.float32) / 255
    offset = stored["pred_off_q"].astype(np.float32) / 4
    flow = stored["pred_flow_q"].astype(np.float32) / 4
    return tuple(
        MotionHeads(
            segmentation=np.stack([-logit[k], logit[k]], axis=1),
            centerness=center[k],
            offset=offset[k],
            flow=flow[k],
            orientation="released",
        ).in_orientation(orientation)
        for k in range(len(logit))
    )


def truth_heads(golden: GoldenCase, orientation: str) -> MotionHeads:
    return first_frames(MotionHeads.from_labels(read_label(golden, orientation)), golden.entry["S"])


@functools.cache
def evaluate_sample(
    folder: Path, index: int, predictions: str, orientation: str
) -> AccidentEvaluator:
    """Return an evaluator that has counted one sample."""
    golden = GoldenCase(folder, "d_accident", "samples", index)
    heads = read_heads(golden, orientation)[PREDICTIONS[predictions]]
    output = MotionOutput(grid=label_config(orientation).grid, heads=heads)
    token = golden.entry["sample_idx"] + f" {golden.index}"

    evaluator = AccidentEvaluator(protocol="released")
    evaluator.update(token, output, read_label(golden, orientation))
    return evaluator


def evaluate_all_samples(folder: Path, predictions: str) -> AccidentEvaluator:
    """Return an evaluator that has counted all samples of a folder in their order."""
    merged = AccidentEvaluator(protocol="released")
    for index in range(len(read_part(folder)["samples"])):
        merged.merge(evaluate_sample(folder, index, predictions, "released"))
    return merged


def read_part(folder: Path) -> dict:
    part = GoldenCase(folder, "d_accident", "samples", None).whole
    assert part.get("samples"), f"{folder / 'd_accident'}.json: no samples; see pytest --golden DIR"
    return part


@samples
@oriented
def test_instances_of_the_truth(golden, orientation: str) -> None:
    expected = golden.entry["out"]
    drawn = replace(golden, part="d_accident_outputs")["gt_rendered"]

    linked = predict_instances(truth_heads(golden, orientation), ACCIDENT)

    redrawn = to_orientation(linked.redrawn, vectors=False, source=orientation, target="released")
    assert redrawn.shape == drawn.shape
    assert int((redrawn != drawn).sum()) == 0
    assert column_row_centers(linked) == expected["matched_centers_label"]
    counts = {str(name): path.cell_counts.tolist() for name, path in linked.paths.items()}
    assert counts == expected["pixel_counts_label"]


@samples
@oriented
def test_instances_of_the_predictions(golden, orientation: str) -> None:
    drawn = replace(golden, part="d_accident_outputs")["pred_rendered"]
    expected_centers = golden.entry["out"]["matched_centers_pred"]
    heads = read_heads(golden, orientation)
    assert len(heads) == len(drawn)

    differing = []
    for head, expected_drawn, centers in zip(heads, drawn, expected_centers, strict=True):
        linked = predict_instances(head, ACCIDENT)
        redrawn = to_orientation(
            linked.redrawn, vectors=False, source=orientation, target="released"
        )
        differing.append(int((redrawn != expected_drawn).sum()))
        assert column_row_centers(linked) == centers
    assert differing == [0] * len(heads)


@samples
@pytest.mark.parametrize(
    ("predictions", "orientation"),
    [
        *(("six_stable_sort", orientation) for orientation in ORIENTATIONS),
        ("one_stable_sort", "released"),
    ],
)
def test_counts_of_each_sample(golden, predictions: str, orientation: str) -> None:
    evaluator = evaluate_sample(golden.folder, golden.index, predictions, orientation)
    [counts] = evaluator.counts.values()
    assert_same_counts(counts, golden.entry["out"][predictions])


def assert_same_counts(counts: dict, expected: list) -> None:
    numbers = [counts[name] for name in COUNTS]
    assert_array_equal(numbers[:4], expected[:4])
    assert_allclose(numbers[4:], expected[4:], rtol=0, atol=1e-6)


@pytest.mark.parametrize("predictions", PREDICTIONS)
def test_counts_and_rates_of_all_samples(request: pytest.FixtureRequest, predictions: str) -> None:
    folder = request.config.getoption("golden")
    part = read_part(folder)
    expected = dict(part["counters"][predictions])
    expected_apa = expected.pop("APA")

    result = evaluate_all_samples(folder, predictions).compute()

    assert [f"{distance:g}" for distance in result.within] == list(expected)
    for rates, counters in zip(result.within.values(), expected.values(), strict=True):
        assert [rates.tp, rates.fp, rates.fn] == [counters["tp"], counters["fp"], counters["fn"]]
        errors = NOTHING_FOUND
        if rates.tp:
            errors = (rates.id_error, rates.position_error, rates.time_error)
        expected_rates = [counters[name] for name in ("acc", "id", "pos", "time")]
        assert_allclose([rates.accuracy, *errors], expected_rates, rtol=0, atol=1e-6)
    assert result.apa == pytest.approx(expected_apa, abs=1e-6)
    assert result.samples == len(part["samples"])
    assert result.positives + result.negatives == len(part["samples"])


def test_samples_foreseen_within_15_metres(request: pytest.FixtureRequest) -> None:
    folder = request.config.getoption("golden")
    lines = read_part(folder)["tp_list"]
    assert lines[-1] == ""
    expected = [int(line[:4]) - 1 for line in lines[:-1]]

    counts_by_sample = evaluate_all_samples(folder, "six_stable_sort").counts.values()

    hits = [counts["tp"][-1] for counts in counts_by_sample]
    assert np.flatnonzero(hits).tolist() == expected


def make_paths(entry: dict, drawn: np.ndarray) -> DrawnPaths:
    paths = {int(name): np.array(points) * CELL_M for name, points in entry.items()}
    return DrawnPaths(paths=paths, drawn=drawn)


@pytest.mark.golden_cases("d2_eval_accidents", "cases")
def test_accidents_among_drawn_boxes(golden) -> None:
    entry = golden.entry
    truth = make_paths(entry["gt_traj"], golden["gt"])
    predictions = [
        make_paths(points, drawn)
        for points, drawn in zip(entry["pred_traj"], golden["pred"], strict=True)
    ]
    matches = [[tuple(pair) for pair in pairs] for pairs in entry["matches"]]

    counts, _ = accident_counts(predictions, truth, matches)

    assert_same_counts(counts, entry["result"])


def test_distances_between_drawn_boxes(request: pytest.FixtureRequest) -> None:
    folder = request.config.getoption("golden")
    distances = distances_of_samples(folder) + distances_of_cases(folder)
    ours, theirs = np.array(distances).T
    difference = np.abs(ours - theirs)
    assert difference.max() <= MAX_MOVE_CELLS
    assert (difference > 1e-6).mean() <= MAX_MOVED_SHARE
    for limit in (RULES.truth_gap, RULES.prediction_gap):
        assert_array_equal(ours < limit, theirs < limit)


def distances_of_samples(folder: Path) -> list[tuple[float, float]]:
    """Return our and the released distances of d_accident.

    They are the distances of true pairs closer than 30 cells in the last frame.
    """
    distances = []
    for index in range(len(read_part(folder)["samples"])):
        golden = GoldenCase(folder, "d_accident", "samples", index)
        truth, _ = paths_of_heads(truth_heads(golden, "released"), label_config("released").grid)
        pairs, gaps = pair_gaps(truth.drawn[-1], np.array([*truth.paths], dtype=np.int64))
        ours = dict(zip(map(tuple, pairs.tolist()), gaps.tolist(), strict=True))

        theirs = {
            (first, second): gap
            for first, second, gap in golden.entry["out"]["gt_pair_distances_last"]
        }
        close_pairs = {pair for pair, gap in ours.items() if gap < 30 - MAX_MOVE_CELLS}
        assert close_pairs <= set(theirs)
        distances += [(ours[pair], gap) for pair, gap in theirs.items()]
    return distances


def distances_of_cases(folder: Path) -> list[tuple[float, float]]:
    """Return our and the released distances of d2_eval_accidents, in the order of its log."""
    cases = GoldenCase(folder, "d2_eval_accidents", "cases", None).whole.get("cases", [])
    assert cases, f"{folder / 'd2_eval_accidents'}.json: no cases; see pytest --golden DIR"
    distances = []
    for index, entry in enumerate(cases):
        golden = GoldenCase(folder, "d2_eval_accidents", "cases", index)
        frames = [(frame, entry["gt_traj"], image) for frame, image in enumerate(golden["gt"])]
        if entry["pred_traj"][0]:
            for paths, images in zip(entry["pred_traj"], golden["pred"], strict=True):
                frames.append((entry["S"] - 1, paths, images[-1]))

        our_log = []
        our_gaps = []
        for frame, paths, image in frames:
            pairs, gaps = pair_gaps(image, np.array([int(name) for name in paths], dtype=np.int64))
            our_log += [[frame, *pair] for pair in pairs.tolist()]
            our_gaps += gaps.tolist()
        their_log = [row[:3] for row in entry["distances"]]
        their_gaps = [row[3] for row in entry["distances"]]
        assert our_log == their_log
        distances += zip(our_gaps, their_gaps, strict=True)
    return distances
