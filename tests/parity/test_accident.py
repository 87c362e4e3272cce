"""The golden accidents (tests/data/golden: d_accident, d2_eval_accidents). Equal counts, matches
and cells.

Accidents as the released code evaluates them. Made by the released functions, d_accident by the
whole evaluation loop over samples of six predictions, d2_eval_accidents by `eval_accidents` alone,
under numpy 1.23.5, scikit-image 0.20.0, shapely 2.0.1, OpenCV 4.7.0 and torch 2.13 on the CPU
(tests/data/golden/README.md); the rules are docs/released_code.md, Accidents. Errors and rates to
1e-6. Distances of outlines as far as a golden can pin them: one in a hundred of them all moves with
numpy's version and the processor, by half a cell at most, and none across a threshold. Ours are
compared with what the released code gives with a stable sort. The golden's maps lie as the released
code has them; d_accident also runs turned to the devkit's orientation and to FIERY's.
"""

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from parity.conftest import GoldenCase

from deepaccident_devkit.evaluation.accident import AccidentEvaluator
from deepaccident_devkit.evaluation.accident.released import (
    DrawnPaths,
    ReleasedAccidents,
    accident_counts,
    paths_of_heads,
)
from deepaccident_devkit.evaluation.predictions import MotionOutput, first_frames
from deepaccident_devkit.geometry.bev_grid import cells_in, to_orientation
from deepaccident_devkit.motion import (
    POST_PROCESSING,
    MotionHeads,
    MotionLabelConfig,
    MotionLabels,
    predict_instances,
)
from deepaccident_devkit.motion.reference_arithmetic.outlines import pair_gaps

ACCIDENT, RULES = POST_PROCESSING["accident"], ReleasedAccidents()
COUNTS = ("tp", "fp", "fn", "id", "position", "time")
"""As the golden's results list them, each at 5, 10 and 15 m."""
PREDICTIONS = {"six_stable_sort": slice(None), "one_stable_sort": slice(-1, None)}
ORIENTATIONS = ("released", "devkit", "fiery")
CELL = 0.5
NOTHING_FOUND = (1, 20, 1)
"""The released code's errors without a true positive: share, metres, seconds."""
MOVED = 0.01
"""The share of the distances that may move, by `MOVED_BY` cells at most."""
MOVED_BY = 0.5

samples = pytest.mark.golden_cases("d_accident", "samples")
oriented = pytest.mark.parametrize("orientation", ORIENTATIONS)


def config(orientation: str) -> MotionLabelConfig:
    return MotionLabelConfig(orientation=orientation)


def label_of(golden: GoldenCase, orientation: str) -> MotionLabels:
    """The labels, which the golden has at the present already."""
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
    chosen = config(orientation)
    return MotionLabels(
        config=chosen,
        future_egomotion=stored["future_egomotions"],
        valid=np.arange(chosen.frames) < chosen.receptive_field - 1 + golden.entry["S"],
        id_map={},
        at_present=True,
        **turned,
    )


def heads_of(golden: GoldenCase, orientation: str) -> tuple[MotionHeads, ...]:
    """The stored predictions, as golden/README.md says that they are quantised."""
    stored = replace(golden, part="d_accident_inputs")
    logit = stored["pred_seg_q"].astype(np.float32) / 16
    center = stored["pred_center_q"].astype(np.float32) / 255
    offset, flow = (stored[name].astype(np.float32) / 4 for name in ("pred_off_q", "pred_flow_q"))
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
    return first_frames(MotionHeads.from_labels(label_of(golden, orientation)), golden.entry["S"])


@functools.cache
def evaluator_of(folder: Path, index: int, predictions: str, orientation: str) -> AccidentEvaluator:
    """What one sample is counted as."""
    golden = GoldenCase(folder, "d_accident", "samples", index)
    evaluator = AccidentEvaluator(protocol="released")
    heads = heads_of(golden, orientation)[PREDICTIONS[predictions]]
    output = MotionOutput(grid=config(orientation).grid, heads=heads)
    evaluator.update(
        golden.entry["sample_idx"] + f" {golden.index}", output, label_of(golden, orientation)
    )
    return evaluator


def evaluator_of_all(folder: Path, predictions: str) -> AccidentEvaluator:
    """All samples of a folder, in order."""
    merged = AccidentEvaluator(protocol="released")
    for index in range(len(whole(folder)["samples"])):
        merged.merge(evaluator_of(folder, index, predictions, "released"))
    return merged


def whole(folder: Path) -> dict:
    found = GoldenCase(folder, "d_accident", "samples", None).whole
    assert found.get("samples"), (
        f"{folder / 'd_accident'}.json: no samples; see pytest --golden DIR"
    )
    return found


def released_centers(linked) -> dict[str, list]:
    """Points column before row, as the released code counts them."""
    shape = linked.instance.shape[1:]
    return {
        str(name): np.stack(
            cells_in(*points.T, shape, linked.orientation, "released")[::-1], axis=-1
        ).tolist()
        for name, points in linked.centers.items()
    }


@samples
@oriented
def test_instances_of_the_truth(golden, orientation: str) -> None:
    expected, drawn = golden.entry["out"], replace(golden, part="d_accident_outputs")["gt_rendered"]
    linked = predict_instances(truth_heads(golden, orientation), ACCIDENT)
    redrawn = to_orientation(linked.redrawn, vectors=False, source=orientation, target="released")
    assert redrawn.shape == drawn.shape
    assert int((redrawn != drawn).sum()) == 0
    assert released_centers(linked) == expected["matched_centers_label"]
    counts = {str(name): path.cell_counts.tolist() for name, path in linked.paths.items()}
    assert counts == expected["pixel_counts_label"]


@samples
@oriented
def test_instances_of_the_predictions(golden, orientation: str) -> None:
    drawn = replace(golden, part="d_accident_outputs")["pred_rendered"]
    heads = heads_of(golden, orientation)
    assert len(heads) == len(drawn)
    differing = []
    for each, expected_drawn, centers in zip(
        heads, drawn, golden.entry["out"]["matched_centers_pred"], strict=True
    ):
        linked = predict_instances(each, ACCIDENT)
        redrawn = to_orientation(
            linked.redrawn, vectors=False, source=orientation, target="released"
        )
        differing.append(int((redrawn != expected_drawn).sum()))
        assert released_centers(linked) == centers
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
    [counts] = evaluator_of(golden.folder, golden.index, predictions, orientation).counts.values()
    expected = golden.entry["out"][predictions]
    assert_array_equal([counts[name] for name in COUNTS[:4]], expected[:4])
    assert_allclose([counts[name] for name in COUNTS[4:]], expected[4:], rtol=0, atol=1e-6)


@pytest.mark.parametrize("predictions", PREDICTIONS)
def test_counts_and_rates_of_all_samples(request: pytest.FixtureRequest, predictions: str) -> None:
    folder = request.config.getoption("golden")
    expected = whole(folder)["counters"][predictions]
    result = evaluator_of_all(folder, predictions).compute()
    assert [f"{distance:g}" for distance in result.within] == [
        name for name in expected if name != "APA"
    ]
    for distance, each in result.within.items():
        there = expected[f"{distance:g}"]
        assert [each.tp, each.fp, each.fn] == [there["tp"], there["fp"], there["fn"]]
        errors = [each.id_error, each.position_error, each.time_error] if each.tp else NOTHING_FOUND
        found = [each.accuracy, *errors]
        assert_allclose(
            found, [there[name] for name in ("acc", "id", "pos", "time")], rtol=0, atol=1e-6
        )
    assert result.apa == pytest.approx(expected["APA"], abs=1e-6)
    assert (result.samples, result.positives + result.negatives) == (
        len(whole(folder)["samples"]),
    ) * 2


def test_samples_foreseen_within_15_metres(request: pytest.FixtureRequest) -> None:
    folder = request.config.getoption("golden")
    lines = whole(folder)["tp_list"]
    assert lines[-1] == ""
    counts = evaluator_of_all(folder, "six_stable_sort").counts.values()
    assert [index for index, each in enumerate(counts) if each["tp"][-1]] == [
        int(line[:4]) - 1 for line in lines[:-1]
    ]


def paths_of(entry: dict, drawn: np.ndarray) -> DrawnPaths:
    return DrawnPaths(
        paths={int(name): np.array(points) * CELL for name, points in entry.items()}, drawn=drawn
    )


@pytest.mark.golden_cases("d2_eval_accidents", "cases")
def test_accidents_among_drawn_boxes(golden) -> None:
    entry = golden.entry
    truth = paths_of(entry["gt_traj"], golden["gt"])
    predictions = [paths_of(*each) for each in zip(entry["pred_traj"], golden["pred"], strict=True)]
    matches = [[tuple(pair) for pair in pairs] for pairs in entry["matches"]]
    counts, _ = accident_counts(predictions, truth, matches)
    assert_array_equal([counts[name] for name in COUNTS[:4]], entry["result"][:4])
    assert_allclose([counts[name] for name in COUNTS[4:]], entry["result"][4:], rtol=0, atol=1e-6)


def test_distances_between_drawn_boxes(request: pytest.FixtureRequest) -> None:
    folder = request.config.getoption("golden")
    ours, theirs = np.concatenate([distances_of_samples(folder), distances_of_cases(folder)]).T
    apart = np.abs(ours - theirs)
    assert apart.max() <= MOVED_BY
    assert (apart > 1e-6).mean() <= MOVED
    for limit in (RULES.truth_gap, RULES.prediction_gap):
        assert_array_equal(ours < limit, theirs < limit)


def distances_of_samples(folder: Path) -> list[tuple[float, float]]:
    """d_accident: ours and theirs, of true pairs nearer than 30 cells in the last frame."""
    result = []
    for index in range(len(whole(folder)["samples"])):
        golden = GoldenCase(folder, "d_accident", "samples", index)
        truth, _ = paths_of_heads(truth_heads(golden, "released"), config("released").grid)
        pairs, gaps = pair_gaps(truth.drawn[-1], np.array([*truth.paths], dtype=np.int64))
        found = dict(zip(map(tuple, pairs.tolist()), gaps.tolist(), strict=True))
        listed = {
            (first, second): gap
            for first, second, gap in golden.entry["out"]["gt_pair_distances_last"]
        }
        assert {pair for pair, gap in found.items() if gap < 30 - MOVED_BY} <= set(listed)
        result += [(found[pair], gap) for pair, gap in listed.items()]
    return result


def distances_of_cases(folder: Path) -> list[tuple[float, float]]:
    """d2_eval_accidents: ours and theirs, in the order of the golden's log."""
    cases = GoldenCase(folder, "d2_eval_accidents", "cases", None).whole.get("cases", [])
    assert cases, f"{folder / 'd2_eval_accidents'}.json: no cases; see pytest --golden DIR"
    result = []
    for index, entry in enumerate(cases):
        golden = GoldenCase(folder, "d2_eval_accidents", "cases", index)
        frames = [(frame, entry["gt_traj"], image) for frame, image in enumerate(golden["gt"])]
        if entry["pred_traj"][0]:
            last = [maps[-1] for maps in golden["pred"]]
            frames += [
                (entry["S"] - 1, *each) for each in zip(entry["pred_traj"], last, strict=True)
            ]
        log = []
        for frame, paths, image in frames:
            pairs, gaps = pair_gaps(image, np.array([int(name) for name in paths], dtype=np.int64))
            log += [
                (frame, *pair, gap) for pair, gap in zip(pairs.tolist(), gaps.tolist(), strict=True)
            ]
        assert [row[:3] for row in log] == [tuple(row[:3]) for row in entry["distances"]]
        result += [(our[3], their[3]) for our, their in zip(log, entry["distances"], strict=True)]
    return result
