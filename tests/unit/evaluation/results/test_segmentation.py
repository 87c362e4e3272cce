"""Segmentation results: arrays are stored unchanged, and what the goldens refuse is refused."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import handwritten_results as handwritten
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.evaluation import Results, ResultsWriter, SegmentationOutput, read_results
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import BEV_CLASSES

FIRST, SECOND, _ = handwritten.TOKENS
GRID = BevGrid((-2.0, 2.0, 0.5), (-1.5, 1.5, 0.5))
SHAPE = (5, *GRID.shape)
FORM = {"stored": "masks", "classes": [*BEV_CLASSES], **handwritten.AXES, "orientation": "devkit"}
GOOD_MASKS = np.zeros(SHAPE, dtype=np.uint8)
REFUSED: dict[str, tuple[dict[str, Any], np.ndarray, tuple[str, ...]]] = {
    "2 in a mask": ({}, GOOD_MASKS + 2, ("mask", "uint8 from 0 to 2", "from_labels")),
    "a map of tags": ({}, GOOD_MASKS[0], ("mask", "expected shape (5, 6, 8), found (6, 8)")),
    "signed numbers": ({}, GOOD_MASKS.astype(np.int8), ("mask", "int8")),
    "scores of 16 bits": ({"stored": "scores"}, GOOD_MASKS.astype(np.uint16), ("score", "uint16")),
    "negative scores": ({"stored": "scores"}, GOOD_MASKS - np.float32(0.1), ("-0.1 to 0",)),
    "no classes": ({"classes": []}, GOOD_MASKS, ("classes: expected `array` of length >= 1",)),
    "a grid of no whole cells": ({"x": [-2, 2, 0.3]}, GOOD_MASKS, ("x: ", "whole number of cells")),
    "huge layers": ({"x": [-2e4, 2e4, 0.5], "y": [-2e4, 2e4, 0.5]}, GOOD_MASKS, ("memory",)),
}


def write_by_hand(folder: Path, form: dict[str, Any], array: np.ndarray) -> Path:
    name = form["stored"].removesuffix("s")
    handwritten.write_shard(folder / "shards" / "00000.npz", {FIRST: {name: array}})
    shards = [handwritten.shard_entry(folder, "shards/00000.npz", [FIRST])]
    document = handwritten.results_document("segmentation", form=form, shards=shards)
    handwritten.write_json(folder / "results.json", document)
    return folder


def read_all(folder: Path) -> Results:
    results = read_results(folder)
    results.check()
    return results


@pytest.mark.parametrize("kind", REFUSED)
def test_other_results_are_refused(tmp_path: Path, kind: str) -> None:
    changes, array, words = REFUSED[kind]
    folder = write_by_hand(tmp_path / "s", FORM | changes, array)
    assert_raises((lambda: read_all(folder), ResultsError, words))


def test_results_that_the_goldens_refuse(tmp_path: Path, pytestconfig: pytest.Config) -> None:
    path = pytestconfig.getoption("golden") / "segmentation" / "refused.json"
    cases = json.loads(path.read_text(encoding="utf-8"))["refused"]
    assert len(cases) == 7
    for case in cases:
        made = case["array"]
        array = np.full(made["shape"], made["fill"], dtype=made["dtype"])
        if made["nan_at"]:
            array[tuple(made["nan_at"])] = np.nan
        folder = write_by_hand(tmp_path / case["name"], case["form"], array)
        words = (str(folder), *case["message_has"])
        assert_raises((lambda folder=folder: read_all(folder), ResultsError, words))


@pytest.mark.parametrize("dtype", ["bool", "u1", "f2", "f4"])
@pytest.mark.parametrize("orientation", ["devkit", "fiery"])
def test_layers_are_read_as_they_were_written(tmp_path: Path, dtype: str, orientation: Any) -> None:
    random = np.random.default_rng(0)
    grid = GRID.with_orientation(orientation)
    values = random.integers(0, 2, (2, *grid.shape)).astype(dtype)
    name = "masks" if dtype == "bool" else "scores"
    output = SegmentationOutput(classes=("7", "road"), grid=grid, **{name: values})
    options: dict[str, Any] = {"grid": grid, "classes": ["7", "road"]}
    with ResultsWriter(tmp_path / "s", "segmentation", **options) as writer:
        writer.add(FIRST, output)
        writer.add(SECOND, output)
    prediction = read_all(tmp_path / "s").prediction(SECOND)
    assert isinstance(prediction, SegmentationOutput)
    assert (prediction.classes, prediction.grid) == (output.classes, grid)
    np.testing.assert_array_equal(getattr(prediction, name), getattr(output, name))


def test_predictions_of_other_forms_are_not_added(tmp_path: Path) -> None:
    scores = SegmentationOutput.from_arrays(scores=GOOD_MASKS, grid=GRID)
    other_classes = SegmentationOutput(classes=("7",), grid=GRID, masks=GOOD_MASKS[:1])
    with ResultsWriter(tmp_path / "s", "segmentation", classes=BEV_CLASSES) as writer:
        assert_raises(
            (lambda: writer.add(FIRST, other_classes), ResultsError, (FIRST, "of 7", "of road")),
            (lambda: writer.add(FIRST, []), ResultsError, ("SegmentationOutput, found list",)),
        )
        writer.add(FIRST, SegmentationOutput.from_arrays(masks=GOOD_MASKS, grid=GRID))
        assert_raises((lambda: writer.add(SECOND, scores), ResultsError, ("masks", "scores of")))
