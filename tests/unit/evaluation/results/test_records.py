"""schema/results: the schemas are the code's, their examples are read, and the page's code writes
valid files.
"""

import json
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import jsonschema
import numpy as np
import plain_results as plain
import pytest

from deepaccident_devkit.evaluation import DetectedBoxes, MotionOutput
from deepaccident_devkit.evaluation.results import RESULT_SCHEMAS, RESULTS_NAMES, read_results

SCHEMA = Path(__file__).parents[4] / "schema"
PAGE = SCHEMA / "results" / "README.md"
DOCUMENTS = {
    "accident": plain.accidents,
    "detection": plain.detections,
    "planning": plain.plans,
    "forecasting": plain.forecasts,
}
TASKS = ("motion", *DOCUMENTS)


def validator(task: str) -> Any:
    return jsonschema.Draft202012Validator(
        json.loads((SCHEMA / "results" / f"{task}.json").read_text(encoding="utf-8"))
    )


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)


def document(task: str, folder: Path) -> dict[str, Any]:
    if task == "motion":
        told: dict[str, Any] = json.loads(
            (plain.write_motion(folder) / "results.json").read_text(encoding="utf-8")
        )
        return told
    return DOCUMENTS[task]()


def test_the_files_are_not_stale(schema_generator: ModuleType) -> None:
    files = schema_generator.generated_results_files()
    for name, content in files.items():
        assert (SCHEMA / "results" / name).read_text(encoding="utf-8") == content, (
            "run python schema/generate.py"
        )
    assert {path.name for path in (SCHEMA / "results").iterdir()} == {*files, "README.md"}


@pytest.mark.parametrize("task", TASKS)
def test_good_results_are_valid(task: str, tmp_path: Path) -> None:
    jsonschema.Draft202012Validator.check_schema(dict(RESULT_SCHEMAS[task]))
    validator(task).validate(document(task, tmp_path / "m"))


def test_the_examples_of_the_page(tmp_path: Path) -> None:
    found = [json.loads(block) for block in blocks("json")]
    assert [example["task"] for example in found] == [
        "accident",
        "detection",
        "planning",
        "forecasting",
        "motion",
    ]
    for example in found:
        validator(example["task"]).validate(example)
        if example["task"] != "motion":
            assert len(read_results(plain.write_json(tmp_path / "x.json", example))) == 2


def test_the_code_of_the_page_writes_valid_files(tmp_path: Path) -> None:
    token, ids = plain.TOKENS[0], np.zeros((6, 5, 200, 200), dtype=int)
    ids[:, :, 120:124, 90:99] = 3
    given = {
        "folder": str(tmp_path),
        "predictions": {token: [plain.accident()], plain.TOKENS[1]: []},
        "detections": {
            token: [(100.0, -20.0, 0.8, 4.5, 1.9, 1.6, 0.3, "car", 0.9)],
            plain.TOKENS[1]: [],
        },
        "plans": {token: np.array([[4.0, 0.0], [8.0, 0.5]]), plain.TOKENS[1]: np.ones((1, 2))},
        "forecasts": {token: {1236: np.arange(12.0).reshape(2, 3, 2)}, plain.TOKENS[1]: {}},
        "maps": {token: ids, plain.TOKENS[1]: 0 * ids},
    }
    for code in blocks("python"):
        exec(compile(code, str(PAGE), "exec"), dict(given))  # noqa: S102
    written = {task: read_results(tmp_path / name) for task, name in RESULTS_NAMES.items()}
    for results in written.values():
        results.check()
        assert results.tokens == plain.TOKENS[:2]
    detected = written["detection"].prediction(token)
    assert isinstance(detected, DetectedBoxes)
    np.testing.assert_array_equal(detected.boxes.size, [[4.5, 1.9, 1.6]])
    output = written["motion"].prediction(token)
    assert isinstance(output, MotionOutput)
    np.testing.assert_array_equal(output.instances, ids)  # type: ignore[arg-type]
