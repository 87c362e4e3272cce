"""schema/results: the schemas are the code's, their examples are read, and the page's code writes valid files."""

import json
import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import jsonschema
import numpy as np
import plain_results as plain
import pytest
from refusals import assert_refused

from deepaccident_devkit.errors import ResultsError
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
STRANGE: tuple[Any, ...] = (None, True, "a", -1, 0.5, 10**30, [], {}, [[1, 2], [3, 4]], ...)
"""What stands in place of each value in turn; `...` takes it away."""


def validator(task: str) -> Any:
    return jsonschema.Draft202012Validator(
        json.loads((SCHEMA / "results" / f"{task}.json").read_text(encoding="utf-8"))
    )


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)


def document(task: str, folder: Path) -> dict[str, Any]:
    if task == "motion":
        told: dict[str, Any] = json.loads((plain.write_motion(folder) / "results.json").read_text(encoding="utf-8"))
        return told
    return DOCUMENTS[task]()


def places(value: Any, place: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The ways to everything in a JSON value, without meta's inside."""
    if place:
        yield place
    inside = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, each in inside if place != ("meta",) else ():
        yield from places(each, (*place, key))


def changed(told: dict[str, Any], place: tuple[Any, ...], value: Any) -> dict[str, Any]:
    copy = json.loads(json.dumps(told))
    inside = copy
    for key in place[:-1]:
        inside = inside[key]
    if value is ...:
        del inside[place[-1]]
    else:
        inside[place[-1]] = value
    return copy


def test_the_files_are_not_stale(schema_generator: ModuleType) -> None:
    files = schema_generator.generated_results_files()
    for name, content in files.items():
        assert (SCHEMA / "results" / name).read_text(encoding="utf-8") == content, "run python schema/generate.py"
    assert {path.name for path in (SCHEMA / "results").iterdir()} == {*files, "README.md"}


@pytest.mark.parametrize("task", TASKS)
def test_the_page_names_every_field(task: str) -> None:
    page = PAGE.read_text(encoding="utf-8")

    def names(schema: Any) -> Iterator[str]:
        if isinstance(schema, dict):
            yield from schema.get("properties", {})
            for each in schema.values():
                yield from names(each)

    named = set(names(RESULT_SCHEMAS[task])) - {"form", "shards"}
    assert len(named) > 7
    assert [name for name in named if f"`{name}`" not in page and f".{name}`" not in page] == []


@pytest.mark.parametrize("task", TASKS)
def test_good_results_are_valid(task: str, tmp_path: Path) -> None:
    jsonschema.Draft202012Validator.check_schema(dict(RESULT_SCHEMAS[task]))
    validator(task).validate(document(task, tmp_path / "m"))


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_what_the_schema_refuses_the_reader_refuses(task: str, tmp_path: Path) -> None:
    """Every value of good results in turn made another one; the reader may know better, never less."""
    folder = tmp_path / "m"
    told, schema = document(task, folder), validator(task)
    path, refused = folder / "results.json", 0
    for place in list(places(told)):
        for value in STRANGE:
            strange = changed(told, place, value)
            plain.write_json(path, strange)
            if schema.is_valid(strange):
                continue
            refused += 1
            assert_refused(
                (partial(read_results, path), ResultsError, r"(?s)results\.json: ."),
            )
    assert refused > 100


def test_the_examples_of_the_page(tmp_path: Path) -> None:
    found = [json.loads(block) for block in blocks("json")]
    assert [example["task"] for example in found] == ["accident", "detection", "planning", "forecasting", "motion"]
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
        "detections": {token: [(100.0, -20.0, 0.8, 4.5, 1.9, 1.6, 0.3, "car", 0.9)], plain.TOKENS[1]: []},
        "plans": {token: np.array([[4.0, 0.0], [8.0, 0.5]]), plain.TOKENS[1]: np.ones((1, 2))},
        "forecasts": {token: {1236: np.arange(12.0).reshape(2, 3, 2)}, plain.TOKENS[1]: {}},
        "maps": {token: ids, plain.TOKENS[1]: 0 * ids},
    }
    codes = blocks("python")
    assert len(codes) == 5
    for code in codes:
        exec(compile(code, str(PAGE), "exec"), dict(given))  # noqa: S102
    written = {task: read_results(tmp_path / name) for task, name in RESULTS_NAMES.items()}
    accidents, detections, motion = (written[task] for task in ("accident", "detection", "motion"))
    for results in written.values():
        results.check()
        assert results.tokens == plain.TOKENS[:2]
    (accident,) = accidents.prediction(token)  # type: ignore[misc]
    assert accident.ids == (1236, 1240)
    detected = detections.prediction(token)
    assert isinstance(detected, DetectedBoxes)
    np.testing.assert_array_equal(detected.boxes.size, [[4.5, 1.9, 1.6]])
    np.testing.assert_allclose(detected.boxes.yaw, [0.3])
    (plan,), (forecast,) = (written[task].prediction(token) for task in ("planning", "forecasting"))  # type: ignore[misc]
    np.testing.assert_array_equal(np.column_stack([plan.times, plan.path]), [[0.5, 4.0, 0.0], [1.0, 8.0, 0.5]])
    assert (forecast.actor_id, forecast.paths.shape, forecast.probabilities.tolist()) == (1236, (2, 3, 2), [0.5, 0.5])
    output = motion.prediction(token)
    assert isinstance(output, MotionOutput)
    np.testing.assert_array_equal(output.instances, ids)  # type: ignore[arg-type]
