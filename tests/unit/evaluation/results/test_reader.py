"""Results with a wrong format are refused, and the message names token and field."""

import gzip
import io
import json
import os
import pickle
import re
import struct
import tracemalloc
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import handwritten_results as handwritten
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.evaluation.results import MotionForm, read_results
from deepaccident_devkit.geometry import BevGrid

FIRST, SECOND, THIRD = handwritten.TOKENS
Document = dict[str, Any]


def assert_refused(path: Path, *words: str) -> None:
    """Check that reading, or the check of all arrays, fails with these words in this order."""
    pattern = ".*".join(map(re.escape, words))
    assert_raises(
        (lambda: read_results(path).check(), ResultsError, f"(?s){pattern}"),
    )


def make_document(task: str, **changes: Any) -> Document:
    """Make results with changes to the second entry of the first sample; `...` removes a field."""
    document = {
        "accident": handwritten.accident_document,
        "detection": handwritten.detection_document,
        "planning": handwritten.planning_document,
        "forecasting": handwritten.forecasting_document,
    }[task]()
    entry = document["results"][FIRST][1]
    document["results"][FIRST][1] = change_fields(entry, changes)
    return document


def change_fields(fields: Document, changes: Document) -> Document:
    changed = {**fields, **changes}
    return {name: value for name, value in changed.items() if value is not ...}


HEADERS: dict[str, tuple[Document, str]] = {
    "another format": ({"format": "COCO"}, 'format: expected DeepAccident results, found "COCO"'),
    "no format": ({"format": ...}, 'has no "format" (a nuScenes results file?); put "format"'),
    "no version": ({"version": ...}, "required field `version`"),
    "a newer version": (
        {"version": 2},
        "version: a newer results format (2, this devkit's is 1); update the devkit",
    ),
    "an older version": (
        {"version": 0},
        "version: an older results format (0, this devkit's is 1); write it again",
    ),
    "a version that is a text": ({"version": "1"}, 'version: expected 1, found "1"'),
    "a version that is true": ({"version": True}, "version: expected 1, found true"),
    "no task": ({"task": ...}, "required field `task`"),
    "an unknown task": (
        {"task": "lanes"},
        (
            "task: expected one of motion, accident, detection, tracking, planning, "
            'forecasting, segmentation, found "lanes"'
        ),
    ),
    "a list of tasks": (
        {"task": ["accident"]},
        (
            "task: expected one of motion, accident, detection, tracking, planning, "
            'forecasting, segmentation, found ["accident"]'
        ),
    ),
    "another task": ({"task": "detection"}, f"results of '{FIRST}': [0]: "),
    "no meta": ({"meta": ...}, "required field `meta`"),
    "meta that is a text": ({"meta": "mine"}, "meta: expected a mapping"),
    "no results": ({"results": ...}, "required field `results`"),
    "an unknown field": (
        {"result": {}},
        "unknown field `result` (expected results, format, version, meta)",
    ),
    "results in a list": (
        {"results": []},
        "results: expected `object`, found [] (Sample token → predictions",
    ),
    "no sample": ({"results": {}}, "results: expected `object` of length >= 1"),
    "an empty token": ({"results": {"": []}}, "results: expected a sample token"),
    "a token of a parent": (
        {"results": {"a/../b": []}},
        "results: expected a sample token <scenario_type>",
    ),
    "null for no accident": ({"results": {FIRST: None}}, f"results of '{FIRST}': expected `array`"),
    "an object for a list": (
        {"results": {FIRST: handwritten.accident_entry()}},
        f"results of '{FIRST}': expected `array`",
    ),
    "an entry that is a number": (
        {"results": {FIRST: [], SECOND: [3]}},
        f"results of '{SECOND}': [0]: expected",
    ),
}


@pytest.mark.parametrize("kind", HEADERS)
def test_headers(tmp_path: Path, kind: str) -> None:
    changes, words = HEADERS[kind]
    path = handwritten.write_json(
        tmp_path / "accident.json",
        change_fields(handwritten.accident_document(), changes),
    )
    assert_refused(path, "accident.json: ", words)


TEXTS: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "cut off": ("]}}", "]}", ("is not JSON (",)),
    "a token twice": (f'"{SECOND}"', f'"{FIRST}"', (f"results: {FIRST}: appears twice",)),
    "a field twice": (
        '"time": 0',
        '"time": 0, "score": 1',
        (f"results: {FIRST}: entry 1: score: appears twice",),
    ),
    "results twice": (
        '"task": "accident"',
        '"task": "accident", "results": {}',
        ("results: appears twice",),
    ),
    "NaN": (
        '"time": 0',
        '"time": NaN',
        (f"results: {FIRST}: entry 1: time: expected a finite number, found NaN",),
    ),
    "Infinity": (
        "[13.0,",
        "[-Infinity,",
        (f"{FIRST}: entry 0: positions: entry 1: entry 0: ", "found Infinity"),
    ),
    "NaN in meta": (
        '"plain"',
        "[NaN]",
        ("meta: method: entry 0: expected a finite number, found NaN",),
    ),
    "beyond floats in meta": ('"plain"', "1e999", ("meta: cannot be written as JSON",)),
    "beyond floats": (
        '"time": 0',
        '"time": 1e999',
        (f"results of '{FIRST}': [1].time: number out of range",),
    ),
    "whole beyond floats": (
        '"time": 0',
        f'"time": 1{"0" * 400}',
        (f"results of '{FIRST}': [1].time: ",),
    ),
    "thousands of digits": ('"time": 0', f'"time": 1{"0" * 9000}', ("accident.json: ",)),
    "other bytes than UTF-8": ('"plain"', '"\udcff"', ("is not JSON (",)),
    "half a character in meta": (
        '"plain"',
        '["\\ud83d"]',
        ("meta: method: entry 0: expected whole characters, found half of",),
    ),
    "half a character in a name": (
        '"method"',
        '"\\uDC00"',
        ("meta: expected a name of whole characters, found half of a",),
    ),
    "nested deeper than reports show": (
        '"plain"',
        f"{'[' * 40}{']' * 40}",
        ("meta: is nested more than 30 levels",),
    ),
    "nested a million deep": ('"plain"', "[" * 10**6, ("is nested more than 64 levels deep",)),
}


@pytest.mark.parametrize("kind", TEXTS)
def test_texts_that_are_no_json(tmp_path: Path, kind: str) -> None:
    old, new, words = TEXTS[kind]
    text = json.dumps(handwritten.accident_document())
    assert old in text
    path = tmp_path / "accident.json"
    path.write_text(
        text.replace(old, new, 1),
        encoding="utf-8",
        errors="surrogateescape",
    )
    assert_refused(path, *words)


ACCIDENTS: dict[str, tuple[dict[str, Any], str]] = {
    "no positions": ({"positions": ...}, ": object missing required field `positions`"),
    "one position": (
        {"positions": [[1, 2]]},
        ".positions: expected `array` of length 2, found [[1, 2]] (Positions of the two",
    ),
    "positions in space": (
        {"positions": [[1, 2, 0], [3, 4, 0]]},
        ".positions[0]: expected `array` of length 2",
    ),
    "positions that are flat": ({"positions": [1, 2, 3, 4]}, ".positions[0]: expected `array`"),
    "a position that is a text": (
        {"positions": [[1, "2"], [3, 4]]},
        ".positions[0][1]: expected `float`",
    ),
    "a position that is true": (
        {"positions": [[1, True], [3, 4]]},
        ".positions[0][1]: expected `float`",
    ),
    "a time that is a text": ({"time": "soon"}, ".time: expected `float`"),
    "a time of the past": (
        {"time": -0.5},
        ".time: expected `float` >= 0.0, found -0.5 (Seconds after the present.)",
    ),
    "positions whose squares overflow": (
        {"positions": [[1e200, 0], [0, 0]]},
        ".positions[0][0]: expected `float` <=",
    ),
    "a time beyond all recordings": ({"time": 1.7e308}, ".time: expected `float` <= 1000000"),
    "no time": ({"time": ...}, ": object missing required field `time`"),
    "null for a score": ({"score": None}, ".score: expected `float`, found null (How sure"),
    "a score that is true": ({"score": True}, ".score: expected `float`"),
    "an id that is a float": ({"ids": [1236.0, 1240]}, ".ids[0]: expected `int`"),
    "an id that is true": ({"ids": [True, 1240]}, ".ids[0]: expected `int`"),
    "an id that is a text": ({"ids": ["1236", 1240]}, ".ids[0]: expected `int`"),
    "three ids": ({"ids": [1, 2, 3]}, ".ids: expected `array` of length 2"),
    "an id of 70 bits": ({"ids": [2**70, 1]}, ".ids[0]: expected `int` <="),
    "a misspelt field": (
        {"id": [1, 2]},
        ": object contains unknown field `id` (expected positions, time, score, ids)",
    ),
}


@pytest.mark.parametrize("kind", ACCIDENTS)
def test_accidents(tmp_path: Path, kind: str) -> None:
    changes, words = ACCIDENTS[kind]
    assert_entry_refused(tmp_path, "accident", changes, words)


def assert_entry_refused(folder: Path, task: str, changes: Document, words: str) -> None:
    path = handwritten.write_json(
        folder / f"{task}.json",
        make_document(task, **changes),
    )
    assert_refused(path, f"results of '{FIRST}': [1]{words}", "schema/results/README.md")


CLASSES = "expected one of car, cyclist, motorcycle, pedestrian, truck, van"
BOXES: dict[str, tuple[dict[str, Any], str]] = {
    "another sample's token": (
        {"sample_token": SECOND},
        f".sample_token: expected {FIRST}, the key of the entry, found '{SECOND}'",
    ),
    "no token": ({"sample_token": ...}, ": object missing required field `sample_token`"),
    "a translation on the ground": (
        {"translation": [1, 2]},
        ".translation: expected `array` of length 3",
    ),
    "a translation beyond the world": (
        {"translation": [1e9, 2, 3]},
        ".translation[0]: expected `float` <= 1000000",
    ),
    "a negative size": (
        {"size": [1, -2, 1]},
        ".size[1]: expected `float` >= 0.0, found -2 (WIDTH, LENGTH, HEIGHT, metres",
    ),
    "a yaw": (
        {"rotation": 0.3},
        ".rotation: expected `array`, found 0.3 (Unit quaternion w, x, y, z",
    ),
    "a quaternion of length 2": (
        {"rotation": [2, 0, 0, 0]},
        ".rotation: expected a unit quaternion [w, x, y, z]",
    ),
    "a quaternion beyond floats": (
        {"rotation": [1e300, 0, 0, 0]},
        ".rotation: expected a unit quaternion",
    ),
    "null in a velocity": ({"velocity": [None, None]}, ".velocity[0]: expected `float`"),
    "a velocity in space": ({"velocity": [1, 2, 0]}, ".velocity: expected `array` of length 2"),
    "an unknown category": ({"detection_name": "bus"}, f'.detection_name: {CLASSES}, found "bus"'),
    "a category's number": ({"detection_name": 0}, f".detection_name: {CLASSES}, found 0"),
    "a list of categories": (
        {"detection_name": ["car"]},
        f'.detection_name: {CLASSES}, found ["car"]',
    ),
    "a score that is a text": ({"detection_score": "0.9"}, ".detection_score: expected `float`"),
    "an unknown field": ({"tracking_id": "3"}, ": object contains unknown field `tracking_id`"),
}


@pytest.mark.parametrize("kind", BOXES)
def test_boxes(tmp_path: Path, kind: str) -> None:
    changes, words = BOXES[kind]
    assert_entry_refused(tmp_path, "detection", changes, words)


PATHS: dict[str, tuple[str, dict[str, Any], str]] = {
    "times that go back": (
        "planning",
        {"times": [1.0, 0.5]},
        ": times: expected ascending seconds after the present",
    ),
    "a time before the present": (
        "planning",
        {"times": [-1, 0.5]},
        ".times[0]: expected `float` >= 0.0",
    ),
    "fewer places than times": ("planning", {"path": [[1, 2]]}, ": path: "),
    "no place": ("planning", {"times": [], "path": []}, ".times: expected `array` of length >= 1"),
    "more headings than times": ("planning", {"yaw": [0, 0, 0]}, ": yaw: "),
    "no score": ("planning", {"score": ...}, ": object missing required field `score`"),
    "a place in space": (
        "planning",
        {"path": [[1, 2, 3], [1, 2, 3]]},
        ".path[0]: expected `array` of length 2",
    ),
    "an actor twice": ("forecasting", {"id": 1236}, ".id: actor 1236 appears twice"),
    "an actor's name": ("forecasting", {"id": "1240"}, ".id: expected `int`"),
    "a mode of another length": (
        "forecasting",
        {"paths": [[[1, 2]], [[1, 2], [3, 4]]]},
        ": paths: ",
    ),
    "fewer probabilities": ("forecasting", {"probabilities": [1]}, ": paths: "),
    "a probability above 1": (
        "forecasting",
        {"probabilities": [1.5, 0]},
        ".probabilities[0]: expected `float` <= 1.0",
    ),
    "no mode": (
        "forecasting",
        {"paths": [], "probabilities": []},
        ".paths: expected `array` of length >= 1",
    ),
    "an unknown field": ("forecasting", {"score": 1}, ": object contains unknown field `score`"),
}


@pytest.mark.parametrize("kind", PATHS)
def test_paths(tmp_path: Path, kind: str) -> None:
    task, changes, words = PATHS[kind]
    assert_entry_refused(tmp_path, task, changes, words)


IGNORED: dict[str, tuple[str, str]] = {
    "a name twice": ('{"a": 1, "a": 2}', "attribute_name: a: appears twice"),
    "NaN": ("[NaN]", "attribute_name: entry 0: expected a finite number, found NaN"),
    "half a character": ('"\\ud83d"', "attribute_name: expected whole characters, found half of a"),
    "nested deeply": ("[" * 70 + "]" * 70, "nested more than 64 levels deep"),
    "other bytes than UTF-8": ('"\udcff"', "is not JSON ("),
    "another field twice": ('1, "velocity": null', "velocity: appears twice"),
}


@pytest.mark.parametrize("kind", IGNORED)
def test_ignored_values_must_be_json_too(tmp_path: Path, kind: str) -> None:
    value, words = IGNORED[kind]
    document = handwritten.detection_document()
    document["results"][FIRST][1]["attribute_name"] = 12345
    path = handwritten.write_json(tmp_path / "detection.json", document)
    text = path.read_text(encoding="utf-8")
    assert len(read_results(path)) == 3
    path.write_text(text.replace("12345", '{"a:": [":"]}'), encoding="utf-8")
    assert len(read_results(path)) == 3
    path.write_text(text.replace("12345", value), encoding="utf-8", errors="surrogateescape")
    assert_refused(path, words)


def test_numbers_are_read_to_the_last_bit(tmp_path: Path) -> None:
    """Numbers are read as Python reads them, in all ways in which they can be written."""
    random = np.random.default_rng(0)
    bits = random.normal(0, 1e3, 1500), random.integers(0, 2**62, 1500).view(np.float64)
    numbers = [
        "-0",
        "-0.0",
        "1E+2",
        "5e-324",
        "2.2250738585072011e-308",
        "9007199254740993",
        "18446744073709551616",
    ]
    for value in np.concatenate(bits).tolist():
        for digits in (15, 17, 25):
            numbers += [f"{value:.{digits}e}", f"{value:.{digits}g}"]
    entries = [f'{{"positions": [[0, 0], [0, 0]], "time": 0, "score": {text}}}' for text in numbers]
    document = handwritten.results_document("accident", results={FIRST: 0})
    text = json.dumps(document).replace(": 0}", f": [{','.join(entries)}]}}")
    path = tmp_path / "accident.json"
    path.write_text(text, encoding="utf-8")

    accidents: Any = read_results(path).prediction(FIRST)

    scores = np.array([accident.score for accident in accidents])
    expected = np.array([float(json.loads(number)) for number in numbers])
    np.testing.assert_array_equal(scores.view(np.int64), expected.view(np.int64))


MANIFESTS: dict[str, tuple[Callable[[Document], object], tuple[str, ...]]] = {
    "no form": (lambda manifest: manifest.pop("form"), ("required field `form`",)),
    "a form that is a text": (
        lambda manifest: manifest.update(form="instances"),
        ("form: expected `object`",),
    ),
    "no step": (
        lambda manifest: manifest["form"].pop("step"),
        ("form: object missing required field `step`",),
    ),
    "a step of no frame": (
        lambda manifest: manifest["form"].update(step=0.25),
        ("form: step: expected seconds",),
    ),
    "a step that is a text": (
        lambda manifest: manifest["form"].update(step="0.5"),
        ("form.step: expected `float`",),
    ),
    "no prediction": (
        lambda manifest: manifest["form"].update(predictions=0),
        ("form.predictions: expected `int` >= 1",),
    ),
    "half a frame": (
        lambda manifest: manifest["form"].update(frames=2.5),
        ("form.frames: expected `int`",),
    ),
    "true frames": (
        lambda manifest: manifest["form"].update(frames=True),
        ("form.frames: expected `int`",),
    ),
    "more than memory": (
        lambda manifest: manifest["form"].update(predictions=10**9),
        (
            "form: ",
            "do not fit into memory",
        ),
    ),
    "an unknown store": (
        lambda manifest: manifest["form"].update(stored="logits"),
        ("form.stored: expected one of heads, inst",),
    ),
    "an unknown orientation": (
        lambda manifest: manifest["form"].update(orientation="north"),
        ("form.orientation: expected one of",),
    ),
    "unknown labels": (
        lambda manifest: manifest["form"].update(labels="mine"),
        ('released, found "mine"',),
    ),
    "an axis of two numbers": (
        lambda manifest: manifest["form"].update(x=[-2, 2]),
        ("form.x: expected `array` of length 3",),
    ),
    "an axis of texts": (
        lambda manifest: manifest["form"].update(y=["a", "b", "c"]),
        ("form.y[0]: expected `float`",),
    ),
    "an axis of half cells": (
        lambda manifest: manifest["form"].update(x=[-2, 2, 0.3]),
        ("form: x: ", "whole number of cells"),
    ),
    "an unknown field": (
        lambda manifest: manifest["form"].update(z=1),
        ("form: object contains unknown field `z` (expected x, y, orientation, stored,",),
    ),
    "no shards": (
        lambda manifest: manifest.update(shards=[]),
        ("shards: expected `array` of length >= 1",),
    ),
    "a shard that is a text": (
        lambda manifest: manifest["shards"].append("a.npz"),
        ("shards[2]: expected `object`",),
    ),
    "no checksum": (
        lambda manifest: manifest["shards"][1].pop("checksum"),
        ("shards[1]: object missing required field `checksum`",),
    ),
    "another checksum": (
        lambda manifest: manifest["shards"][1].update(checksum="00"),
        ("shards/00001.npz: ", "checksum"),
    ),
    "another size": (
        lambda manifest: manifest["shards"][0].update(bytes=7),
        ("shards[0]: bytes: shards/00000.npz should have 7",),
    ),
    "a size that is a text": (
        lambda manifest: manifest["shards"][0].update(bytes="7"),
        ("shards[0].bytes: expected `int`",),
    ),
    "a shard that is not there": (
        lambda manifest: manifest["shards"][1].update(file="b.npz"),
        ("shards[1]: file: b.npz cannot be",),
    ),
    "a shard outside": (
        lambda manifest: manifest["shards"][1].update(file="../b.npz"),
        ("file: expected a path inside",),
    ),
    "an absolute path": (
        lambda manifest: manifest["shards"][1].update(file="/etc/passwd"),
        ("file: expected a path inside",),
    ),
    "a shard that is a folder": (
        lambda manifest: manifest["shards"][1].update(file="shards"),
        ("shards[1]: file: shards is not",),
    ),
    "a shard twice": (
        lambda manifest: manifest["shards"].append(manifest["shards"][0]),
        ("shards[2]: file: shards/00000.npz is listed twice",),
    ),
    "a sample in two shards": (
        lambda manifest: manifest["shards"][1]["tokens"].append(FIRST),
        ("shards/00001.npz", FIRST, "also appears in shards/00000.npz"),
    ),
    "a sample twice in a shard": (
        lambda manifest: manifest["shards"][1]["tokens"].append(THIRD),
        ("shards/00001.npz", THIRD, "appears twice"),
    ),
    "a token that is a number": (
        lambda manifest: manifest["shards"][0]["tokens"].append(3),
        ("shards[0].tokens[2]: expected `str`",),
    ),
    "a token of a parent": (
        lambda manifest: manifest["shards"][0]["tokens"].append("a/.."),
        ("shards[0].tokens: expected a sample token <scenario_type>",),
    ),
    "no tokens": (
        lambda manifest: manifest["shards"][0].update(tokens=[]),
        ("shards[0].tokens: expected `array` of length >= 1",),
    ),
    "a sample without arrays": (
        lambda manifest: manifest["shards"][1]["tokens"].append("a/b/ego_vehicle/001"),
        ("shards/00001.npz: a/b/ego_vehicle/001: instance: is missing",),
    ),
}


@pytest.mark.parametrize("kind", MANIFESTS)
def test_manifests(tmp_path: Path, kind: str) -> None:
    change, words = MANIFESTS[kind]
    folder = handwritten.write_motion(tmp_path / "motion")
    manifest = handwritten.read_json(folder / "results.json")
    change(manifest)
    handwritten.write_json(folder / "results.json", manifest)
    assert_refused(folder, "results.json: ", *words)


def test_links_out_of_the_folder(tmp_path: Path) -> None:
    folder = handwritten.write_motion(tmp_path / "motion")
    shard = folder / "shards" / "00001.npz"
    shard.symlink_to(shard.rename(tmp_path / "outside.npz"))
    assert_refused(
        folder, "shards[1]: file: shards/00001.npz is a link to a file outside the folder"
    )


def replace_value(array: np.ndarray, value: float) -> np.ndarray:
    changed = array.copy()
    changed.flat[5] = value
    return changed


INSTANCES = handwritten.instance_arrays()["instance"]
HEADS = handwritten.head_arrays()
ARRAYS: dict[str, tuple[str, dict[str, np.ndarray], tuple[str, ...]]] = {
    "ids that are floats": (
        "instances",
        {"instance": INSTANCES.astype(float)},
        ("instance: expected unsigned whole numbers or whole numbers, found float64",),
    ),
    "ids that are true or false": (
        "instances",
        {"instance": INSTANCES > 0},
        ("instance: ", "found bool"),
    ),
    "a negative id": (
        "instances",
        {"instance": replace_value(INSTANCES.astype(np.int16), -1)},
        ("instance: expected ids from 0 to 2147483647, found -1 to 7",),
    ),
    "an id of 40 bits": (
        "instances",
        {"instance": replace_value(INSTANCES.astype(np.int64), 2**40)},
        ("instance: expected ids from 0 to 2147483647",),
    ),
    "no prediction": (
        "instances",
        {"instance": INSTANCES[:0]},
        ("instance: expected shape (1 to 2, 3, 6, 8)",),
    ),
    "more predictions than stated": (
        "instances",
        {"instance": np.tile(INSTANCES, (2, 1, 1, 1))},
        ("instance: expected shape (1 to 2, 3, 6, 8), found (4, 3, 6, 8)",),
    ),
    "other frames": (
        "instances",
        {"instance": INSTANCES[:, :2]},
        ("instance: expected shape", "(2, 2, 6, 8)"),
    ),
    "cells that lie otherwise": (
        "instances",
        {"instance": INSTANCES.swapaxes(2, 3)},
        ("instance: expected shape", "(2, 3, 8, 6)"),
    ),
    "no axis of predictions": (
        "instances",
        {"instance": INSTANCES[0]},
        ("instance: expected shape", "(3, 6, 8)"),
    ),
    "objects": (
        "instances",
        {"instance": INSTANCES.astype(object)},
        ("instance: cannot be read (expected numbers",),
    ),
    "complex ids": (
        "instances",
        {"instance": INSTANCES.astype(complex)},
        ("instance: ", "found complex128"),
    ),
    "heads among maps": (
        "instances",
        HEADS,
        ("segmentation.npy: belongs to no sample of the shard",),
    ),
    "NaN in a head": (
        "heads",
        HEADS | {"centerness": replace_value(HEADS["centerness"], np.nan)},
        ("centerness: nan at",),
    ),
    "an infinite flow": (
        "heads",
        HEADS | {"flow": replace_value(HEADS["flow"], np.inf)},
        ("flow: inf at",),
    ),
    "whole logits": (
        "heads",
        HEADS | {"segmentation": HEADS["segmentation"].astype(int)},
        ("segmentation: expected floats, found int64",),
    ),
    "three channels": (
        "heads",
        HEADS | {"offset": np.repeat(HEADS["offset"], 2, axis=2)},
        ("offset: expected shape (1 to 2, 3, 2, 6, 8), found (2, 3, 4, 6, 8)",),
    ),
    "fewer offsets than logits": (
        "heads",
        HEADS | {"offset": HEADS["offset"][:1]},
        ("offset: expected (K, T, channels, H, W)",),
    ),
}


@pytest.mark.parametrize("kind", ARRAYS)
def test_arrays(tmp_path: Path, kind: str) -> None:
    """The fault is in the second sample of the first shard."""
    stored, arrays, words = ARRAYS[kind]
    folder = handwritten.write_motion(tmp_path / "motion", stored)
    good_arrays = {"instance": INSTANCES} if stored == "instances" else HEADS
    handwritten.write_shard(
        folder / "shards" / "00000.npz",
        {FIRST: good_arrays, SECOND: arrays},
    )
    handwritten.refresh_shard_entry(folder)
    if "belongs to no sample" not in words[0]:
        words = (f"{SECOND}: ", *words)
    assert_refused(folder, "results.json: shards/00000.npz: ", *words)


def npy_bytes(array: np.ndarray, version: tuple[int, int] = (1, 0)) -> bytes:
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, array, version)
    return buffer.getvalue()


def npy_claiming(shape: tuple[int, ...]) -> bytes:
    """Return the header of a larger array before the bytes of a good one."""
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        buffer, {"descr": "|u1", "fortran_order": False, "shape": shape}
    )
    return buffer.getvalue() + INSTANCES.tobytes()


MEMBER = f"{FIRST}/instance.npy"
CONTENTS: dict[str, tuple[bytes, str]] = {
    "a pickle": (pickle.dumps([1, 2]), "instance: cannot be read"),
    "an empty member": (b"", "instance: cannot be read"),
    "a header that is cut": (
        npy_bytes(INSTANCES)[:40],
        "instance: cannot be read",
    ),
    "numbers that are cut": (
        npy_bytes(INSTANCES)[:-9],
        "instance: cannot be read (its array has 279",
    ),
    "more numbers": (
        npy_bytes(INSTANCES) + b"\0",
        "instance: cannot be read (its array has 289 bytes",
    ),
    "the claim of a giant": (
        npy_claiming((10**6, 3, 6, 8)),
        "instance: cannot be read (its array has 288 bytes",
    ),
    "a negative shape": (
        npy_claiming((-2, 3, 6, 8)),
        "instance: cannot be read (expected numbers or text, found shape (-2, 3, 6, 8)",
    ),
    "another format": (
        npy_bytes(INSTANCES, (2, 0)),
        "instance: expected npy format 1.0, as numpy.save writes numbers",
    ),
    "a header of 4 GB": (
        b"\x93NUMPY\x02\x00" + struct.pack("<I", 2**32 - 1),
        "instance: cannot be read (",
    ),
}


@pytest.mark.parametrize("kind", CONTENTS)
def test_members(tmp_path: Path, kind: str) -> None:
    content, words = CONTENTS[kind]
    folder = handwritten.write_motion(tmp_path / "motion")
    rewrite_members(folder, {MEMBER: content})
    assert_refused(folder, f"shards/00000.npz: {FIRST}: {words}")
    assert_raises(
        (lambda: read_results(folder).prediction(FIRST), ResultsError, re.escape(words)),
    )


def test_links_in_a_loop(tmp_path: Path) -> None:
    loop = tmp_path / "loop.json"
    loop.symlink_to("loop.json")
    assert_refused(loop, "loop.json: cannot be read (", "symbolic links")

    folder = handwritten.write_motion(tmp_path / "motion")
    for path, words in (
        (folder / "shards" / "00000.npz", "file: shards/00000.npz cannot be opened ("),
        (folder / "results.json", "cannot be read ("),
    ):
        path.unlink()
        path.symlink_to(path.name)
        assert_refused(folder, words, "symbolic links")


def test_files_above_the_limits(tmp_path: Path) -> None:
    giant = tmp_path / "giant.json"
    giant.touch()
    os.truncate(giant, 3 << 30)
    assert_refused(
        giant,
        "giant.json: has 3,221,225,472 bytes, more than 1,073,741,824, the limit for results",
    )
    folder = handwritten.write_motion(tmp_path / "motion")
    os.truncate(folder / "shards" / "00000.npz", 3 << 30)
    assert_refused(folder, "shards/00000.npz takes 3,221,225,472 bytes")


@pytest.mark.parametrize("compression", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_members_with_another_compression(tmp_path: Path, compression: int) -> None:
    folder = handwritten.write_motion(tmp_path / "motion")
    rewrite_members(folder, {}, compression)
    assert_refused(
        folder,
        "instance: cannot be read (a member is encrypted or compressed by an unknown method)",
    )


def test_a_bomb_is_not_unpacked(tmp_path: Path) -> None:
    folder = handwritten.write_motion(tmp_path / "motion")
    rewrite_members(folder, {MEMBER: npy_bytes(np.zeros(100_000_000, dtype=np.uint8))})
    tracemalloc.start()
    assert_refused(
        folder,
        "instance: expected shape (1 to 2, 3, 6, 8), which has at most",
        "found 100,000,128 bytes",
    )
    _, peak_bytes = tracemalloc.get_traced_memory()
    assert peak_bytes < 10 << 20
    tracemalloc.stop()


def test_a_superfluous_member(tmp_path: Path) -> None:
    folder = handwritten.write_motion(tmp_path / "motion")
    rewrite_members(folder, {"evil.pkl": pickle.dumps([1])})
    assert_refused(folder, "shards/00000.npz: evil.pkl: belongs to no sample of the shard")


def test_a_repeated_member(tmp_path: Path) -> None:
    folder = handwritten.write_motion(tmp_path / "motion")
    with (
        zipfile.ZipFile(folder / "shards" / "00000.npz", "a") as archive,
        pytest.warns(UserWarning, match="Duplicate name"),
    ):
        archive.writestr(MEMBER, npy_bytes(INSTANCES))
    handwritten.refresh_shard_entry(folder)
    assert_refused(folder, f"shards/00000.npz: {MEMBER}: appears 2 times")


def rewrite_members(
    folder: Path, members: dict[str, bytes], compression: int = zipfile.ZIP_DEFLATED
) -> None:
    """Write the first shard again, with other members."""
    path = folder / "shards" / "00000.npz"
    with zipfile.ZipFile(path) as archive:
        contents = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, content in {**contents, **members}.items():
            archive.writestr(name, content)
    handwritten.refresh_shard_entry(folder)


def test_shards_that_are_cut_or_changed(tmp_path: Path) -> None:
    folder = handwritten.write_motion(tmp_path / "motion")
    path = folder / "shards" / "00000.npz"
    content = path.read_bytes()
    path.write_bytes(content[:-1])
    assert_raises(
        (
            lambda: read_results(folder),
            ResultsError,
            r"bytes: shards/00000\.npz should have \d+, found \d+; copy it again",
        ),
    )
    handwritten.refresh_shard_entry(folder)
    assert_refused(folder, "shards/00000.npz: is not a readable npz archive")

    path.write_bytes(b"\0" + content[1:])
    manifest = handwritten.read_json(folder / "results.json")
    manifest["shards"][0]["bytes"] = len(content)
    handwritten.write_json(folder / "results.json", manifest)
    assert_refused(folder, "shards/00000.npz: its content does not match its checksum")


def test_no_bit_of_a_shard_is_read_wrongly(tmp_path: Path) -> None:
    """Where a checksum is made after the damage, the archive's own sums detect it, or no value
    changes.
    """
    folder = handwritten.write_motion(tmp_path / "motion")
    path = folder / "shards" / "00000.npz"
    content = path.read_bytes()
    outcomes = set()
    for position in range(0, len(content), 29):
        damaged = bytearray(content)
        damaged[position] ^= 0x5A
        path.write_bytes(damaged)
        handwritten.refresh_shard_entry(folder)
        try:
            output = read_results(folder).prediction(FIRST)
        except ResultsError:
            outcomes.add("refused")
        else:
            np.testing.assert_array_equal(output.instances, INSTANCES)
            outcomes.add("unharmed")
    assert outcomes == {"refused", "unharmed"}


def test_paths_without_results(tmp_path: Path) -> None:
    assert_refused(
        tmp_path / "none.json",
        "none.json: no such file or folder; give results written by `deepaccident predict`",
    )
    assert_refused(tmp_path, "contains no results.json")
    (tmp_path / "results.json").mkdir()
    assert_refused(tmp_path, "results.json: not a regular file (a folder)")
    np.save(tmp_path / "array.npy", np.arange(3))
    assert_refused(tmp_path / "array.npy", "array.npy: is not JSON")
    (tmp_path / "packed.json.gz").write_bytes(gzip.compress(b"{}"))
    assert_refused(
        tmp_path / "packed.json.gz", "packed.json.gz: is compressed with gzip; unpack it"
    )
    assert_refused(tmp_path / ("long" * 100), "cannot be read (", "File name too long")
    assert_refused(tmp_path / "a\0b", "expected a path, found ")
    renamed = tmp_path / "motion" / "manifest.json"
    (handwritten.write_motion(renamed.parent) / "results.json").rename(renamed)
    assert_refused(renamed, "is the manifest of motion results; rename it to results.json")
    assert_refused(
        handwritten.write_json(tmp_path / "list.json", [1]),
        "list.json: expected a JSON object, found [1]",
    )


ABOVE_LIMIT = float(np.nextafter(1e6, 2e6))


@pytest.mark.parametrize(
    ("task", "good", "wrong"),
    [
        (
            "accident",
            {"positions": [[1e6, -1e6], [0, 0]]},
            {"positions": [[ABOVE_LIMIT, 0], [0, 0]]},
        ),
        (
            "accident",
            {"positions": [[0, 0], [-1e6, 0]]},
            {"positions": [[0, 0], [-ABOVE_LIMIT, 0]]},
        ),
        ("accident", {"time": 1e6}, {"time": ABOVE_LIMIT}),
        ("accident", {"time": 0}, {"time": -5e-324}),
        ("accident", {"ids": [2**63 - 1, -(2**63)]}, {"ids": [2**63, 0]}),
        ("accident", {"ids": [0, -(2**63)]}, {"ids": [0, -(2**63) - 1]}),
        ("detection", {"size": [0, 1e6, 0]}, {"size": [0, ABOVE_LIMIT, 0]}),
        ("detection", {"rotation": [1.0009, 0, 0, 0]}, {"rotation": [1.0011, 0, 0, 0]}),
        ("detection", {"rotation": [0, 0.9991, 0, 0]}, {"rotation": [0, 0.9989, 0, 0]}),
        ("detection", {"velocity": [-1e6, 1e6]}, {"velocity": [0, ABOVE_LIMIT]}),
    ],
)
def test_ends_of_ranges(
    tmp_path: Path, task: str, good: dict[str, Any], wrong: dict[str, Any]
) -> None:
    path = tmp_path / f"{task}.json"
    handwritten.write_json(path, make_document(task, **good))
    assert len(read_results(path).prediction(FIRST)) == 2
    handwritten.write_json(path, make_document(task, **wrong))
    assert_refused(path, f"results of '{FIRST}': [1].")


@pytest.mark.parametrize(
    ("step", "is_valid"),
    [
        (0.1, True),
        (0.3, True),
        (10, True),
        (0.05, False),
        (0.1001, False),
        (0.19, False),
        (0.0, False),
        (-0.5, False),
    ],
)
def test_steps_are_whole_numbers_of_recorded_frames(step: float, *, is_valid: bool) -> None:
    make_form = partial(
        MotionForm,
        stored="heads",
        grid=BevGrid(),
        predictions=1,
        frames=1,
        step=step,
    )
    if is_valid:
        assert make_form().as_dict()["step"] == step
    else:
        assert_raises(
            (
                make_form,
                ResultsError,
                r"step: expected seconds that are a multiple of 0\.1 s \(one frame\), found",
            ),
        )


LONGEST_TOKEN = "a/" * 400 + "b" * 200


def test_the_longest_token_and_the_largest_form(tmp_path: Path) -> None:
    path = tmp_path / "accident.json"
    document = handwritten.results_document("accident", results={LONGEST_TOKEN: []})
    assert read_results(handwritten.write_json(path, document)).tokens == (LONGEST_TOKEN,)
    document["results"] = {f"{LONGEST_TOKEN}b": []}
    assert_refused(handwritten.write_json(path, document), "expected a sample token")

    grid = BevGrid((0, 512, 0.5), (0, 512, 0.5))  # of 2**20 cells
    make_form = partial(MotionForm, stored="heads", grid=grid)
    assert make_form(predictions=8, frames=8).predictions == 8
    assert_raises(
        (
            lambda: make_form(predictions=9, frames=8),
            ResultsError,
            "form: 9 predictions of 8 frames of 1048576 cells do not fit into memory",
        ),
        (
            lambda: make_form(predictions=0, frames=8),
            ResultsError,
            "predictions: expected a whole number from 1, found 0",
        ),
        (
            lambda: make_form(predictions=1, frames=0),
            ResultsError,
            "frames: expected a whole number from 1, found 0",
        ),
    )
