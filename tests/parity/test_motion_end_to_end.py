"""The golden run (tests/data/golden, d_accident): what the released loop printed of motion, of all
and by attribute.

`MotionEvaluator` gets the stored labels and predictions; the other side is d_accident_stdout.txt
(tests/data/golden/README.md; docs/released_code.md, IoU and VPQ, and Paths), which has a block an
attribute value, then one of everything. Counts equal, what is printed equal to its last digit. The
VPQ of the blocks is the released mistake (`selected_as_released`).
"""

import functools
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from parity.conftest import GoldenCase

from deepaccident_devkit.evaluation.motion import MotionEvaluator, MotionResult
from deepaccident_devkit.evaluation.predictions import MotionOutput
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import MotionHeads, MotionLabelConfig, MotionLabels

RELEASED = MotionLabelConfig(orientation="released")
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


class Sample:
    """One sample of d_accident: its labels, at the present already, and its six predictions."""

    def __init__(self, golden: GoldenCase) -> None:
        self.token, self.frames = str(golden.index), golden.entry["S"]
        self._inputs = GoldenCase(golden.folder, "d_accident_inputs", golden.key, golden.index)

    @property
    def label(self) -> MotionLabels:
        inputs, valid = (
            self._inputs,
            np.arange(RELEASED.frames) < RELEASED.receptive_field - 1 + self.frames,
        )
        return MotionLabels(
            config=RELEASED,
            segmentation=inputs["gt_seg"].astype(np.uint8),
            instance=inputs["gt_instance"].astype(np.int32),
            centerness=(inputs["gt_center_q"].astype(np.float32) / 65535)[:, None],
            offset=inputs["gt_offset"].astype(np.float32),
            flow=inputs["gt_flow"].astype(np.float32),
            future_egomotion=inputs["future_egomotions"],
            valid=valid,
            id_map={},
            at_present=True,
        )

    @property
    def prediction(self) -> MotionOutput:
        names = ("pred_seg_q", "pred_center_q", "pred_off_q", "pred_flow_q")
        heads = []
        for logit, center, offset, flow in zip(
            *(self._inputs[name] for name in names), strict=True
        ):
            quantised = logit.astype(np.float32) / 16
            heads.append(
                MotionHeads(
                    segmentation=np.stack([-quantised, quantised], axis=1),
                    centerness=center.astype(np.float32) / 255,
                    offset=offset.astype(np.float32) / 4,
                    flow=flow.astype(np.float32) / 4,
                    orientation="released",
                )
            )
        return MotionOutput(grid=BevGrid(orientation="released"), heads=tuple(heads))


@functools.cache
def evaluated(folder: Path, count: int) -> MotionEvaluator:
    evaluator = MotionEvaluator()
    for index in range(count):
        sample = Sample(GoldenCase(folder, "d_accident", "samples", index))
        evaluator.update(sample.token, sample.prediction, sample.label)
    return evaluator


def everything(golden: GoldenCase) -> tuple[MotionEvaluator, list[str]]:
    """All samples evaluated, and their tokens in order."""
    count = len(golden.whole["samples"])
    return evaluated(golden.folder, count), [str(index) for index in range(count)]


def blocks(folder: Path) -> Iterator[tuple[str, str, str]]:
    """Attribute, value and text of each block that the released loop printed; the last one has
    neither.
    """
    text = (folder / "d_accident_stdout.txt").read_text(encoding="utf-8")
    for block in _BLOCK.split(text)[1:]:
        attribute, value = block[: block.index("!")].split(": ")
        yield (ALL, ALL, block) if attribute == "all evaluated data" else (attribute, value, block)


def assert_as_printed(result: MotionResult, text: str) -> None:
    printed = _RANGE.findall(text)[: len(result.ranges)]
    assert [name for name, *_ in printed] == list(result.ranges)
    for name, *numbers in printed:
        each = result.ranges[name]
        denominator = each.true_positive + each.false_positive / 2 + each.false_negative / 2
        found = [each.iou, each.pq, each.sq, each.rq, 100 * max(denominator, 1)]
        np.testing.assert_allclose(
            found, [float(number) for number in numbers], rtol=0, atol=5.1e-4, err_msg=name
        )
    for name, pattern in _PATHS.items():
        match = re.search(pattern, text)
        assert match, f"{pattern} is not in the block"
        np.testing.assert_allclose(
            getattr(result, name), float(match[1]), rtol=0, atol=5.1e-5, err_msg=name
        )


@pytest.mark.golden_cases("d_accident", "samples")
def test_paths_of_a_sample(golden) -> None:
    evaluator, _ = everything(golden)
    out, counts = golden.entry["out"], evaluator.counts[str(golden.index)]["paths"]
    expected = out["eval_metrics"]
    found = [counts["ade"], counts["fde"], counts["missed"], counts["count"]]
    np.testing.assert_allclose(
        found, [expected[0], expected[3], expected[6], expected[8]], rtol=0, atol=1e-9
    )
    pairs, _, alarms, lost = out["traj_mapping_stable_sort"][-1]
    numbers = [counts[name] for name in ("true_positive", "false_positive", "false_negative")]
    assert numbers == [len(pairs), len(alarms), len(lost)]


@pytest.mark.golden_cases("d_accident", "attributes_counter")
def test_what_was_printed_by_attribute(golden) -> None:
    name, (evaluator, order) = (
        list(golden.whole["attributes_counter"])[golden.index],
        everything(golden),
    )
    values = golden.whole["attributes_counter"][name]
    texts = {value: text for attribute, value, text in blocks(golden.folder) if attribute == name}
    assert list(texts) == list(values)
    for value, text in texts.items():
        selected = [str(index) for index in values[value]]
        assert_as_printed(evaluator.selected_as_released(order, selected), text)


@pytest.mark.golden_cases("d_accident", "attributes_counter")
def test_the_correct_breakdown_adds_up_to_what_was_printed_of_everything(golden) -> None:
    """Each sample has one value, so that the values' instances are all of them: as released they
    are not.
    """
    name, (evaluator, _) = (
        list(golden.whole["attributes_counter"])[golden.index],
        everything(golden),
    )
    (text,) = [text for attribute, _, text in blocks(golden.folder) if attribute == ALL]
    result = evaluator.compute()
    assert_as_printed(result, text)
    groups = [
        evaluator.compute([str(index) for index in selected])
        for selected in golden.whole["attributes_counter"][name].values()
    ]
    for extent, each in result.ranges.items():
        for count in ("true_positive", "false_positive", "false_negative"):
            assert sum(getattr(group.ranges[extent], count) for group in groups) == getattr(
                each, count
            )
