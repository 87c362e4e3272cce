"""schema/results: the code generates the schemas, and the examples and code of the page work."""

import json
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import jsonschema
import numpy as np
import pytest
from support import handwritten_results as handwritten

from deepaccident_devkit.evaluation import DetectedBoxes, MotionOutput, SegmentationOutput
from deepaccident_devkit.evaluation.results import RESULT_SCHEMAS, RESULTS_NAMES, read_results

SCHEMA = Path(__file__).parents[4] / "schema"
PAGE = SCHEMA / "results" / "README.md"
DOCUMENTS = {
    "accident": handwritten.accident_document,
    "detection": handwritten.detection_document,
    "tracking": handwritten.tracking_document,
    "planning": handwritten.planning_document,
    "forecasting": handwritten.forecasting_document,
}
TASKS = ("motion", *DOCUMENTS)


def read_schema(task: str) -> Any:
    schema = handwritten.read_json(SCHEMA / "results" / f"{task}.json")
    return jsonschema.Draft202012Validator(schema)


def read_code_blocks(language: str) -> list[str]:
    return re.findall(
        rf"```{language}\n(.*?)```",
        PAGE.read_text(encoding="utf-8"),
        re.DOTALL,
    )


def make_document(task: str, folder: Path) -> Any:
    if task == "motion":
        return handwritten.read_json(handwritten.write_motion(folder) / "results.json")
    return DOCUMENTS[task]()


def test_the_files_are_not_stale(schema_generator: ModuleType) -> None:
    contents = schema_generator.generated_results_files()
    for name, content in contents.items():
        text = (SCHEMA / "results" / name).read_text(encoding="utf-8")
        assert text == content, "run python schema/generate.py"
    assert {path.name for path in (SCHEMA / "results").iterdir()} == {*contents, "README.md"}


@pytest.mark.parametrize("task", TASKS)
def test_good_results_are_valid(task: str, tmp_path: Path) -> None:
    jsonschema.Draft202012Validator.check_schema(dict(RESULT_SCHEMAS[task]))
    read_schema(task).validate(make_document(task, tmp_path / "m"))


def test_the_examples_of_the_page(tmp_path: Path) -> None:
    examples = [json.loads(block) for block in read_code_blocks("json")]
    assert [example["task"] for example in examples] == [
        "accident",
        "detection",
        "planning",
        "forecasting",
        "motion",
    ]
    for example in examples:
        read_schema(example["task"]).validate(example)
        if example["task"] != "motion":
            assert len(read_results(handwritten.write_json(tmp_path / "x.json", example))) == 2


def test_the_code_of_the_page_writes_valid_files(tmp_path: Path) -> None:
    first, second, _ = handwritten.TOKENS
    instances = np.zeros((6, 5, 200, 200), dtype=int)
    instances[:, :, 120:124, 90:99] = 3
    variables = {
        "folder": str(tmp_path),
        "predictions": {first: [handwritten.accident_entry()], second: []},
        "detections": {
            first: [(100.0, -20.0, 0.8, 4.5, 1.9, 1.6, 0.3, "car", 0.9)],
            second: [],
        },
        "tracks": {first: [(100.0, -20.0, 0.8, 4.5, 1.9, 1.6, 0.3, "car", 0.9, "7")], second: []},
        "plans": {first: np.array([[4.0, 0.0], [8.0, 0.5]]), second: np.ones((1, 2))},
        "forecasts": {first: {1236: np.arange(12.0).reshape(2, 3, 2)}, second: {}},
        "maps": {first: instances, second: 0 * instances},
        "masks": {first: instances[0] == 3, second: instances[0] > 3},
    }

    for code in read_code_blocks("python"):
        exec(compile(code, str(PAGE), "exec"), dict(variables))  # noqa: S102

    results_by_task = {task: read_results(tmp_path / name) for task, name in RESULTS_NAMES.items()}
    for results in results_by_task.values():
        results.check()
        assert results.tokens == (first, second)
    detected = results_by_task["detection"].prediction(first)
    assert isinstance(detected, DetectedBoxes)
    np.testing.assert_array_equal(detected.boxes.size, [[4.5, 1.9, 1.6]])
    output = results_by_task["motion"].prediction(first)
    assert isinstance(output, MotionOutput)
    np.testing.assert_array_equal(output.instances, instances)  # type: ignore[arg-type]
    segmentation = results_by_task["segmentation"].prediction(first)
    assert isinstance(segmentation, SegmentationOutput)
    np.testing.assert_array_equal(segmentation.masks_at(0.5), instances[0] == 3)
