"""The golden run (tests/data/golden, d_accident): what the released loop printed about motion, in
total and by attribute.

`MotionEvaluator` gets the stored labels and predictions. Its results are compared with
d_accident_stdout.txt (tests/data/golden/README.md; docs/released_code.md, IoU and VPQ, and Paths),
which has one block for each attribute value, then one for everything. Counts are equal, printed
numbers equal to their last digit. The VPQ of the blocks repeats the released mistake
(`selected_as_released`).
"""

import functools
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from parity.conftest import GoldenCase
from parity.test_accident import read_heads, read_label

from deepaccident_devkit.evaluation.motion import MotionEvaluator, MotionResult
from deepaccident_devkit.evaluation.predictions import MotionOutput
from deepaccident_devkit.geometry import BevGrid

ALL = "all"
_RANGE = re.compile(
    r"grid = (\w+): iou = ([\d.]+), pq = ([\d.]+), sq = ([\d.]+), rq = "
    r"([\d.]+), denominator = ([\d.]+)"
)
_BLOCK = re.compile(r"Evaluation on (?=[^!]+!!!!!!!\n\n\[Validation)")
_PATHS = {
    "path_true_positive": r"motion total tp: (\d+)",
    "path_false_negative": r"total fn: (\d+), total_fp",
    "path_false_positive": r"total_fp: (\d+)",
    "path_accuracy": r"motion_accuracy: ([\d.]+)",
    "min_ade": r"avg_Ade_error: ([\d.]+)",
    "min_fde": r"avg_Fde_error: ([\d.]+)",
    "miss_rate": r"avg_MR_error: ([\d.]+)",
}


@functools.cache
def evaluate_samples(folder: Path, count: int) -> MotionEvaluator:
    evaluator = MotionEvaluator()
    for index in range(count):
        golden = GoldenCase(folder, "d_accident", "samples", index)
        heads = read_heads(golden, "released")
        prediction = MotionOutput(grid=BevGrid(orientation="released"), heads=heads)
        evaluator.update(str(index), prediction, read_label(golden, "released"))
    return evaluator


def evaluate_all(golden: GoldenCase) -> tuple[MotionEvaluator, list[str]]:
    """Evaluate all samples and return their tokens in order, too."""
    count = len(golden.whole["samples"])
    return evaluate_samples(golden.folder, count), [str(index) for index in range(count)]


def read_blocks(folder: Path) -> Iterator[tuple[str, str, str]]:
    """Yield attribute, value and text of each block that the released loop printed.

    The last block is about all samples: its attribute and value are `ALL`.
    """
    text = (folder / "d_accident_stdout.txt").read_text(encoding="utf-8")
    for block in _BLOCK.split(text)[1:]:
        attribute, value = block[: block.index("!")].split(": ")
        if attribute == "all evaluated data":
            yield ALL, ALL, block
        else:
            yield attribute, value, block


def assert_as_printed(result: MotionResult, text: str) -> None:
    printed = _RANGE.findall(text)[: len(result.ranges)]
    assert [name for name, *_ in printed] == list(result.ranges)
    for name, *numbers in printed:
        extent = result.ranges[name]
        num_errors = extent.false_positive + extent.false_negative
        denominator = extent.true_positive + num_errors / 2
        rates = [extent.iou, extent.pq, extent.sq, extent.rq, 100 * max(denominator, 1)]
        expected = [float(number) for number in numbers]
        np.testing.assert_allclose(rates, expected, rtol=0, atol=5.1e-4, err_msg=name)

    for name, pattern in _PATHS.items():
        match = re.search(pattern, text)
        assert match, f"{pattern} is not in the block"
        value = getattr(result, name)
        np.testing.assert_allclose(value, float(match[1]), rtol=0, atol=5.1e-5, err_msg=name)


@pytest.mark.golden_cases("d_accident", "samples")
def test_paths_of_a_sample(golden) -> None:
    evaluator, _ = evaluate_all(golden)
    counts = evaluator.counts[str(golden.index)]["paths"]
    out = golden.entry["out"]

    sums = [counts["ade"], counts["fde"], counts["missed"], counts["count"]]
    expected_sums = [out["eval_metrics"][index] for index in (0, 3, 6, 8)]
    np.testing.assert_allclose(sums, expected_sums, rtol=0, atol=1e-9)

    pairs, _, false_positives, false_negatives = out["traj_mapping_stable_sort"][-1]
    assert counts["true_positive"] == len(pairs)
    assert counts["false_positive"] == len(false_positives)
    assert counts["false_negative"] == len(false_negatives)


@pytest.mark.golden_cases("d_accident", "attributes_counter")
def test_results_by_attribute_equal_the_printed_ones(golden) -> None:
    name, indices_by_value = list(golden.whole["attributes_counter"].items())[golden.index]
    texts = {
        value: text for attribute, value, text in read_blocks(golden.folder) if attribute == name
    }
    assert list(texts) == list(indices_by_value)

    evaluator, tokens = evaluate_all(golden)
    for value, text in texts.items():
        selected = [str(index) for index in indices_by_value[value]]
        assert_as_printed(evaluator.selected_as_released(tokens, selected), text)


@pytest.mark.golden_cases("d_accident", "attributes_counter")
def test_the_correct_breakdown_adds_up_to_what_was_printed_of_everything(golden) -> None:
    """Each sample has one value, so the counts of all values add up to the total.

    In the released code they do not.
    """
    evaluator, _ = evaluate_all(golden)
    total = evaluator.compute()
    [text] = [text for attribute, _, text in read_blocks(golden.folder) if attribute == ALL]
    assert_as_printed(total, text)

    indices_by_value = list(golden.whole["attributes_counter"].values())[golden.index]
    results = [
        evaluator.compute([str(index) for index in indices])
        for indices in indices_by_value.values()
    ]
    for extent, expected in total.ranges.items():
        for count in ("true_positive", "false_positive", "false_negative"):
            sum_of_values = sum(getattr(result.ranges[extent], count) for result in results)
            assert sum_of_values == getattr(expected, count)
