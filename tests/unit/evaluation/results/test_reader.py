"""Results that are not as their format says are refused, and the message names token and field."""

import gzip
import io
import json
import pickle
import re
import struct
import tracemalloc
import warnings
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import plain_results as plain
import pytest
from refusals import assert_refused

from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.evaluation.results import MotionForm, read_results
from deepaccident_devkit.geometry import BevGrid

FIRST, SECOND, THIRD = plain.TOKENS
Document = dict[str, Any]


def refused(path: Path, *words: str) -> None:
    """Reading fails, or else the check of all arrays, with a sentence that has these words in this
    order.
    """
    pattern = ".*".join(map(re.escape, words))
    assert_refused(
        (lambda: read_results(path).check(), ResultsError, f"(?s){pattern}"),
    )


def with_entry(kind: str, **changes: Any) -> Document:
    """Results whose second entry of the first sample is another; `...` takes the field away."""
    told = {
        "accident": plain.accidents,
        "detection": plain.detections,
        "planning": plain.plans,
        "forecasting": plain.forecasts,
    }[kind]()
    entry = {**told["results"][FIRST][1], **changes}
    told["results"][FIRST][1] = {name: value for name, value in entry.items() if value is not ...}
    return told


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
        {"task": "tracking"},
        (
            "task: expected one of motion, accident, detection, planning, "
            'forecasting, found "tracking"'
        ),
    ),
    "a list of tasks": (
        {"task": ["accident"]},
        (
            "task: expected one of motion, accident, detection, planning, "
            'forecasting, found ["accident"]'
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
        "results: expected `object`, found [] (Sample token to what",
    ),
    "no sample": ({"results": {}}, "results: expected `object` of length >= 1"),
    "an empty token": ({"results": {"": []}}, "results: expected a sample's token"),
    "a token of a parent": (
        {"results": {"a/../b": []}},
        "results: expected a sample's token, <scenario_type>",
    ),
    "null for no accident": ({"results": {FIRST: None}}, f"results of '{FIRST}': expected `array`"),
    "an object for a list": (
        {"results": {FIRST: plain.accident()}},
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
    told = {
        name: value for name, value in {**plain.accidents(), **changes}.items() if value is not ...
    }
    refused(plain.write_json(tmp_path / "accident.json", told), "accident.json: ", words)


TEXTS: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "cut off": ("]}}", "]}", ("is no JSON (",)),
    "a token twice": (f'"{SECOND}"', f'"{FIRST}"', (f"results: {FIRST}: stands there twice",)),
    "a field twice": (
        '"time": 0',
        '"time": 0, "score": 1',
        (f"results: {FIRST}: entry 1: score: stands there twice",),
    ),
    "results twice": (
        '"task": "accident"',
        '"task": "accident", "results": {}',
        ("results: stands there twice",),
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
    "other bytes than UTF-8": ('"plain"', '"\udcff"', ("is no JSON (",)),
    "half a character in meta": (
        '"plain"',
        '["\\ud83d"]',
        ("meta: method: entry 0: expected characters, found half of",),
    ),
    "half a character in a name": (
        '"method"',
        '"\\uDC00"',
        ("meta: expected a name of characters, found half of one",),
    ),
    "nested deeper than reports show": (
        '"plain"',
        f"{'[' * 40}{']' * 40}",
        ("meta: is nested more than 30 levels",),
    ),
    "nested a million deep": ('"plain"', "[" * 10**6, ("is nested more than 64 levels deep",)),
}


@pytest.mark.parametrize("kind", TEXTS)
def test_what_is_no_json(tmp_path: Path, kind: str) -> None:
    old, new, words = TEXTS[kind]
    text = json.dumps(plain.accidents())
    assert old in text
    path = tmp_path / "accident.json"
    path.write_text(text.replace(old, new, 1), encoding="utf-8", errors="surrogateescape")
    refused(path, *words)


ACCIDENTS: dict[str, tuple[dict[str, Any], str]] = {
    "no positions": ({"positions": ...}, ": object missing required field `positions`"),
    "one position": (
        {"positions": [[1, 2]]},
        ".positions: expected `array` of length 2, found [[1, 2]] (Of the two that",
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
    path = plain.write_json(tmp_path / "accident.json", with_entry("accident", **changes))
    refused(path, f"results of '{FIRST}': [1]{words}", "schema/results/README.md")


CLASSES = "expected one of car, cyclist, motorcycle, pedestrian, truck, van"
BOXES: dict[str, tuple[dict[str, Any], str]] = {
    "another sample's token": (
        {"sample_token": SECOND},
        f".sample_token: expected {FIRST}, under which it stands, found '{SECOND}'",
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
    path = plain.write_json(tmp_path / "detection.json", with_entry("detection", **changes))
    refused(path, f"results of '{FIRST}': [1]{words}", "schema/results/README.md")


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
    "an actor twice": ("forecasting", {"id": 1236}, ".id: actor 1236 comes twice"),
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
    path = plain.write_json(tmp_path / f"{task}.json", with_entry(task, **changes))
    refused(path, f"results of '{FIRST}': [1]{words}", "schema/results/README.md")


IGNORED: dict[str, tuple[str, str]] = {
    "a name twice": ('{"a": 1, "a": 2}', "attribute_name: a: stands there twice"),
    "NaN": ("[NaN]", "attribute_name: entry 0: expected a finite number, found NaN"),
    "half a character": ('"\\ud83d"', "attribute_name: expected characters, found half of one"),
    "nested deeply": ("[" * 70 + "]" * 70, "nested more than 64 levels deep"),
    "other bytes than UTF-8": ('"\udcff"', "is no JSON ("),
    "another field twice": ('1, "velocity": null', "velocity: stands there twice"),
}


@pytest.mark.parametrize("kind", IGNORED)
def test_what_is_ignored_is_json_too(tmp_path: Path, kind: str) -> None:
    value, words = IGNORED[kind]
    told, path = plain.detections(), tmp_path / "detection.json"
    told["results"][FIRST][1]["attribute_name"] = 12345
    text = json.dumps(told)
    assert len(read_results(plain.write_json(path, told))) == 3
    path.write_text(text.replace("12345", '{"a:": [":"]}'), encoding="utf-8")
    assert len(read_results(path)) == 3
    path.write_text(text.replace("12345", value), encoding="utf-8", errors="surrogateescape")
    refused(path, words)


def test_numbers_are_read_to_the_last_bit(tmp_path: Path) -> None:
    """As Python reads them, in every way in which they can be written."""
    source = np.random.default_rng(0)
    values = np.concatenate(
        [source.normal(0, 1e3, 1500), source.integers(0, 2**62, 1500).view(np.float64)]
    )
    texts = [
        f"{value:.{digits}{how}}"
        for value in values.tolist()
        for digits in (15, 17, 25)
        for how in "eg"
    ]
    texts += [
        "-0",
        "-0.0",
        "1E+2",
        "5e-324",
        "2.2250738585072011e-308",
        "9007199254740993",
        "18446744073709551616",
    ]
    entries = ",".join(
        f'{{"positions": [[0, 0], [0, 0]], "time": 0, "score": {text}}}' for text in texts
    )
    text = json.dumps(plain.document("accident", results={FIRST: 0})).replace(
        ": 0}", f": [{entries}]}}"
    )
    (tmp_path / "accident.json").write_text(text, encoding="utf-8")
    read: Any = read_results(tmp_path / "accident.json").prediction(FIRST)
    expected = np.array([float(json.loads(text)) for text in texts])
    np.testing.assert_array_equal(
        np.array([each.score for each in read]).view(np.int64), expected.view(np.int64)
    )


MANIFESTS: dict[str, tuple[Callable[[Document], object], tuple[str, ...]]] = {
    "no form": (lambda told: told.pop("form"), ("required field `form`",)),
    "a form that is a text": (
        lambda told: told.update(form="instances"),
        ("form: expected `object`",),
    ),
    "no step": (
        lambda told: told["form"].pop("step"),
        ("form: object missing required field `step`",),
    ),
    "a step of no frame": (
        lambda told: told["form"].update(step=0.25),
        ("form: step: expected seconds",),
    ),
    "a step that is a text": (
        lambda told: told["form"].update(step="0.5"),
        ("form.step: expected `float`",),
    ),
    "no prediction": (
        lambda told: told["form"].update(predictions=0),
        ("form.predictions: expected `int` >= 1",),
    ),
    "half a frame": (
        lambda told: told["form"].update(frames=2.5),
        ("form.frames: expected `int`",),
    ),
    "true frames": (
        lambda told: told["form"].update(frames=True),
        ("form.frames: expected `int`",),
    ),
    "more than memory": (
        lambda told: told["form"].update(predictions=10**9),
        (
            "form: ",
            "more than memory holds",
        ),
    ),
    "an unknown store": (
        lambda told: told["form"].update(stored="logits"),
        ("form.stored: expected one of heads, inst",),
    ),
    "an unknown orientation": (
        lambda told: told["form"].update(orientation="north"),
        ("form.orientation: expected one of",),
    ),
    "unknown labels": (
        lambda told: told["form"].update(labels="mine"),
        ('released, found "mine"',),
    ),
    "an axis of two numbers": (
        lambda told: told["form"].update(x=[-2, 2]),
        ("form.x: expected `array` of length 3",),
    ),
    "an axis of texts": (
        lambda told: told["form"].update(y=["a", "b", "c"]),
        ("form.y[0]: expected `float`",),
    ),
    "an axis of half cells": (
        lambda told: told["form"].update(x=[-2, 2, 0.3]),
        ("form: x: ", "whole number of cells"),
    ),
    "an unknown field": (
        lambda told: told["form"].update(z=1),
        ("form: object contains unknown field `z` (expected stored, x,",),
    ),
    "no shards": (
        lambda told: told.update(shards=[]),
        ("shards: expected `array` of length >= 1",),
    ),
    "a shard that is a text": (
        lambda told: told["shards"].append("a.npz"),
        ("shards[2]: expected `object`",),
    ),
    "no checksum": (
        lambda told: told["shards"][1].pop("checksum"),
        ("shards[1]: object missing required field `checksum`",),
    ),
    "another checksum": (
        lambda told: told["shards"][1].update(checksum="00"),
        ("shards/00001.npz: ", "checksum"),
    ),
    "another size": (
        lambda told: told["shards"][0].update(bytes=7),
        ("shards[0]: bytes: shards/00000.npz should have 7",),
    ),
    "a size that is a text": (
        lambda told: told["shards"][0].update(bytes="7"),
        ("shards[0].bytes: expected `int`",),
    ),
    "a shard that is not there": (
        lambda told: told["shards"][1].update(file="b.npz"),
        ("shards[1]: file: b.npz cannot be",),
    ),
    "a shard outside": (
        lambda told: told["shards"][1].update(file="../b.npz"),
        ("file: expected a path inside",),
    ),
    "an absolute path": (
        lambda told: told["shards"][1].update(file="/etc/passwd"),
        ("file: expected a path inside",),
    ),
    "a shard that is a folder": (
        lambda told: told["shards"][1].update(file="shards"),
        ("shards[1]: file: shards is not",),
    ),
    "a shard twice": (
        lambda told: told["shards"].append(told["shards"][0]),
        ("shards[2]: file: shards/00000.npz is another",),
    ),
    "a sample in two shards": (
        lambda told: told["shards"][1]["tokens"].append(FIRST),
        ("shards/00001.npz", FIRST, "stands there also in shards/00000.npz"),
    ),
    "a sample twice in a shard": (
        lambda told: told["shards"][1]["tokens"].append(THIRD),
        ("shards/00001.npz", THIRD, "stands there twice"),
    ),
    "a token that is a number": (
        lambda told: told["shards"][0]["tokens"].append(3),
        ("shards[0].tokens[2]: expected `str`",),
    ),
    "a token of a parent": (
        lambda told: told["shards"][0]["tokens"].append("a/.."),
        ("shards[0].tokens: expected a sample's token, <scenario_type>",),
    ),
    "no tokens": (
        lambda told: told["shards"][0].update(tokens=[]),
        ("shards[0].tokens: expected `array` of length >= 1",),
    ),
    "a sample without arrays": (
        lambda told: told["shards"][1]["tokens"].append("a/b/ego_vehicle/001"),
        ("shards/00001.npz: a/b/ego_vehicle/001: instance: is missing",),
    ),
}


@pytest.mark.parametrize("kind", MANIFESTS)
def test_manifests(tmp_path: Path, kind: str) -> None:
    change, words = MANIFESTS[kind]
    folder = plain.write_motion(tmp_path / "motion")
    told = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    change(told)
    plain.write_json(folder / "results.json", told)
    refused(folder, "results.json: ", *words)


def test_links_out_of_the_folder(tmp_path: Path) -> None:
    folder = plain.write_motion(tmp_path / "motion")
    shard = folder / "shards" / "00001.npz"
    shard.symlink_to(shard.rename(tmp_path / "outside.npz"))
    refused(folder, "shards[1]: file: shards/00001.npz is a link that leads out of the folder")


def heads(**changes: np.ndarray) -> dict[str, np.ndarray]:
    return {**plain.head_arrays(), **changes}


def maps(**changes: np.ndarray) -> dict[str, np.ndarray]:
    return {**plain.instance_arrays(), **changes}


def with_value(array: np.ndarray, value: float) -> np.ndarray:
    changed = array.copy()
    changed.flat[5] = value
    return changed


GOOD, GOOD_HEADS = plain.instance_arrays(), plain.head_arrays()
ARRAYS: dict[str, tuple[str, dict[str, np.ndarray], tuple[str, ...]]] = {
    "ids that are floats": (
        "instances",
        maps(instance=GOOD["instance"].astype(float)),
        ("instance: expected unsigned whole numbers or whole numbers, found float64",),
    ),
    "ids that are true or false": (
        "instances",
        maps(instance=GOOD["instance"] > 0),
        ("instance: ", "found bool"),
    ),
    "a negative id": (
        "instances",
        maps(instance=with_value(GOOD["instance"].astype(np.int16), -1)),
        ("instance: expected ids from 0 to 2147483647, found -1 to 7",),
    ),
    "an id of 40 bits": (
        "instances",
        maps(instance=with_value(GOOD["instance"].astype(np.int64), 2**40)),
        ("instance: expected ids from 0 to 2147483647",),
    ),
    "no prediction": (
        "instances",
        maps(instance=GOOD["instance"][:0]),
        ("instance: expected shape (1 to 2, 3, 6, 8)",),
    ),
    "more predictions than stated": (
        "instances",
        maps(instance=np.tile(GOOD["instance"], (2, 1, 1, 1))),
        ("instance: expected shape (1 to 2, 3, 6, 8), found (4, 3, 6, 8)",),
    ),
    "other frames": (
        "instances",
        maps(instance=GOOD["instance"][:, :2]),
        ("instance: expected shape", "(2, 2, 6, 8)"),
    ),
    "cells that lie otherwise": (
        "instances",
        maps(instance=GOOD["instance"].swapaxes(2, 3)),
        ("instance: expected shape", "(2, 3, 8, 6)"),
    ),
    "no axis of predictions": (
        "instances",
        maps(instance=GOOD["instance"][0]),
        ("instance: expected shape", "(3, 6, 8)"),
    ),
    "objects": (
        "instances",
        maps(instance=GOOD["instance"].astype(object)),
        ("instance: cannot be read (expected numbers",),
    ),
    "complex ids": (
        "instances",
        maps(instance=GOOD["instance"].astype(complex)),
        ("instance: ", "found complex128"),
    ),
    "heads among maps": (
        "instances",
        heads(),
        ("segmentation.npy: belongs to no sample of the shard",),
    ),
    "NaN in a head": (
        "heads",
        heads(centerness=with_value(GOOD_HEADS["centerness"], np.nan)),
        ("centerness: nan at",),
    ),
    "an infinite flow": (
        "heads",
        heads(flow=with_value(GOOD_HEADS["flow"], np.inf)),
        ("flow: inf at",),
    ),
    "whole logits": (
        "heads",
        heads(segmentation=GOOD_HEADS["segmentation"].astype(int)),
        ("segmentation: expected floats, found int64",),
    ),
    "three channels": (
        "heads",
        heads(offset=np.repeat(GOOD_HEADS["offset"], 2, axis=2)),
        ("offset: expected shape (1 to 2, 3, 2, 6, 8), found (2, 3, 4, 6, 8)",),
    ),
    "fewer offsets than logits": (
        "heads",
        heads(offset=GOOD_HEADS["offset"][:1]),
        ("offset: expected (K, T, channels, H, W)",),
    ),
}


@pytest.mark.parametrize("kind", ARRAYS)
def test_arrays(tmp_path: Path, kind: str) -> None:
    """The fault is in the second sample of the first shard."""
    stored, arrays, words = ARRAYS[kind]
    folder = plain.write_motion(tmp_path / "motion", stored)
    good = plain.instance_arrays() if stored == "instances" else plain.head_arrays()
    plain.write_shard(folder / "shards" / "00000.npz", {FIRST: good, SECOND: arrays})
    plain.relist(folder)
    refused(
        folder,
        "results.json: shards/00000.npz: ",
        *(() if "belongs to no sample" in words[0] else (f"{SECOND}: ",)),
        *words,
    )


def npy(array: np.ndarray, version: tuple[int, int] = (1, 0)) -> bytes:
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, array, version)
    return buffer.getvalue()


def claiming(shape: tuple[int, ...]) -> bytes:
    """The header of a larger array before the bytes of a good one."""
    good, buffer = plain.instance_arrays()["instance"], io.BytesIO()
    np.lib.format.write_array_header_1_0(
        buffer, {"descr": "|u1", "fortran_order": False, "shape": shape}
    )
    return buffer.getvalue() + good.tobytes()


MEMBER = f"{FIRST}/instance.npy"
CONTENTS: dict[str, tuple[bytes, str]] = {
    "a pickle": (pickle.dumps([1, 2]), "instance: cannot be read"),
    "an empty member": (b"", "instance: cannot be read"),
    "a header that is cut": (
        npy(plain.instance_arrays()["instance"])[:40],
        "instance: cannot be read",
    ),
    "numbers that are cut": (
        npy(plain.instance_arrays()["instance"])[:-9],
        "instance: cannot be read (its array has 279",
    ),
    "more numbers": (
        npy(plain.instance_arrays()["instance"]) + b"\0",
        "instance: cannot be read (its array has 289 bytes",
    ),
    "the claim of a giant": (
        claiming((10**6, 3, 6, 8)),
        "instance: cannot be read (its array has 288 bytes",
    ),
    "a negative shape": (
        claiming((-2, 3, 6, 8)),
        "instance: cannot be read (expected numbers or text, found shape (-2, 3, 6, 8)",
    ),
    "another format": (
        npy(plain.instance_arrays()["instance"], (2, 0)),
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
    folder = plain.write_motion(tmp_path / "motion")
    rewritten(folder, {MEMBER: content})
    refused(folder, f"shards/00000.npz: {FIRST}: {words}")
    assert_refused(
        (lambda: read_results(folder).prediction(FIRST), ResultsError, re.escape(words)),
    )


def test_links_in_a_loop(tmp_path: Path) -> None:
    (tmp_path / "loop.json").symlink_to("loop.json")
    refused(tmp_path / "loop.json", "loop.json: cannot be read (", "symbolic links")
    folder = plain.write_motion(tmp_path / "motion")
    shard = folder / "shards" / "00000.npz"
    shard.unlink()
    shard.symlink_to(shard.name)
    refused(folder, "file: shards/00000.npz cannot be opened (", "symbolic links")
    (folder / "results.json").unlink()
    (folder / "results.json").symlink_to("results.json")
    refused(folder, "cannot be read (", "symbolic links")


def test_giants(tmp_path: Path) -> None:
    with (tmp_path / "giant.json").open("wb") as file:
        file.truncate(3 << 30)
    refused(
        tmp_path / "giant.json",
        "giant.json: has 3,221,225,472 bytes, more than 1,073,741,824, the limit for results",
    )
    folder = plain.write_motion(tmp_path / "motion")
    with (folder / "shards" / "00000.npz").open("r+b") as file:
        file.truncate(3 << 30)
    refused(folder, "shards/00000.npz takes 3,221,225,472 bytes")


@pytest.mark.parametrize("way", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_members_that_are_packed_otherwise(tmp_path: Path, way: int) -> None:
    folder = plain.write_motion(tmp_path / "motion")
    path = folder / "shards" / "00000.npz"
    with zipfile.ZipFile(path) as archive:
        contents = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", way) as archive:
        for name, content in contents.items():
            archive.writestr(name, content)
    plain.relist(folder)
    refused(
        folder,
        "instance: cannot be read (a member is encrypted or compressed by an unknown method)",
    )


def test_a_bomb_is_not_unpacked(tmp_path: Path) -> None:
    folder = plain.write_motion(tmp_path / "motion")
    rewritten(folder, {MEMBER: npy(np.zeros(100_000_000, dtype=np.uint8))})
    tracemalloc.start()
    refused(
        folder,
        "instance: expected shape (1 to 2, 3, 6, 8), which has at most",
        "found 100,000,128 bytes",
    )
    assert tracemalloc.get_traced_memory()[1] < 10 << 20
    tracemalloc.stop()


def test_a_member_that_is_too_much(tmp_path: Path) -> None:
    folder = plain.write_motion(tmp_path / "motion")
    rewritten(folder, {"evil.pkl": pickle.dumps([1])})
    refused(folder, "shards/00000.npz: evil.pkl: belongs to no sample of the shard")


def test_a_member_twice(tmp_path: Path) -> None:
    folder = plain.write_motion(tmp_path / "motion")
    with (
        warnings.catch_warnings(),
        zipfile.ZipFile(folder / "shards" / "00000.npz", "a") as archive,
    ):
        warnings.simplefilter("ignore")
        archive.writestr(MEMBER, npy(plain.instance_arrays()["instance"]))
    plain.relist(folder)
    refused(folder, f"shards/00000.npz: {MEMBER}: stands there 2 times")


def rewritten(folder: Path, members: dict[str, bytes]) -> None:
    """Put other members into the first shard."""
    path = folder / "shards" / "00000.npz"
    with zipfile.ZipFile(path) as archive:
        contents = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in {**contents, **members}.items():
            archive.writestr(name, content)
    plain.relist(folder)


def test_shards_that_are_cut_or_changed(tmp_path: Path) -> None:
    folder = plain.write_motion(tmp_path / "motion")
    path = folder / "shards" / "00000.npz"
    content = path.read_bytes()
    path.write_bytes(content[:-1])
    assert_refused(
        (
            lambda: read_results(folder),
            ResultsError,
            r"bytes: shards/00000\.npz should have \d+, found \d+; copy it again",
        ),
    )
    plain.relist(folder)
    refused(folder, "shards/00000.npz: is no npz archive that can be read")
    path.write_bytes(b"\0" + content[1:])
    told = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    told["shards"][0]["bytes"] = len(content)
    plain.write_json(folder / "results.json", told)
    refused(folder, "shards/00000.npz: its bytes are not those that the checksum is of")


def test_no_bit_of_a_shard_is_read_wrongly(tmp_path: Path) -> None:
    """A shard whose checksum was made after the damage: the archive's own sums say it, or nothing
    is changed.
    """
    folder = plain.write_motion(tmp_path / "motion")
    path, expected = folder / "shards" / "00000.npz", plain.instance_arrays()["instance"]
    content, outcomes = path.read_bytes(), set()
    for position in range(0, len(content), 29):
        path.write_bytes(
            content[:position] + bytes([content[position] ^ 0x5A]) + content[position + 1 :]
        )
        plain.relist(folder)
        try:
            read = read_results(folder).prediction(FIRST)
        except ResultsError:
            outcomes.add("refused")
        else:
            np.testing.assert_array_equal(read.instances, expected)
            outcomes.add("unharmed")
    assert outcomes == {"refused", "unharmed"}


def test_what_is_no_results_file(tmp_path: Path) -> None:
    refused(
        tmp_path / "none.json",
        "none.json: no such file or folder; give the results that ResultsWriter made",
    )
    refused(tmp_path, "holds no results.json")
    (tmp_path / "results.json").mkdir()
    refused(tmp_path, "results.json: not a regular file (a folder)")
    np.save(tmp_path / "array.npy", np.arange(3))
    refused(tmp_path / "array.npy", "array.npy: is no JSON")
    (tmp_path / "packed.json.gz").write_bytes(gzip.compress(b"{}"))
    refused(tmp_path / "packed.json.gz", "packed.json.gz: is compressed with gzip; unpack it")
    refused(tmp_path / ("long" * 100), "cannot be read (", "File name too long")
    refused(tmp_path / "a\0b", "expected a path, found ")
    folder = plain.write_motion(tmp_path / "motion")
    (folder / "results.json").rename(folder / "manifest.json")
    refused(folder / "manifest.json", "is the manifest of motion results; call it results.json")
    refused(
        plain.write_json(tmp_path / "list.json", [1]),
        "list.json: expected a JSON object, found [1]",
    )  # type: ignore[arg-type]


UP = float(np.nextafter(1e6, 2e6))


@pytest.mark.parametrize(
    ("kind", "good", "wrong"),
    [
        ("accident", {"positions": [[1e6, -1e6], [0, 0]]}, {"positions": [[UP, 0], [0, 0]]}),
        ("accident", {"positions": [[0, 0], [-1e6, 0]]}, {"positions": [[0, 0], [-UP, 0]]}),
        ("accident", {"time": 1e6}, {"time": UP}),
        ("accident", {"time": 0}, {"time": -5e-324}),
        ("accident", {"ids": [2**63 - 1, -(2**63)]}, {"ids": [2**63, 0]}),
        ("accident", {"ids": [0, -(2**63)]}, {"ids": [0, -(2**63) - 1]}),
        ("detection", {"size": [0, 1e6, 0]}, {"size": [0, UP, 0]}),
        ("detection", {"rotation": [1.0009, 0, 0, 0]}, {"rotation": [1.0011, 0, 0, 0]}),
        ("detection", {"rotation": [0, 0.9991, 0, 0]}, {"rotation": [0, 0.9989, 0, 0]}),
        ("detection", {"velocity": [-1e6, 1e6]}, {"velocity": [0, UP]}),
    ],
)
def test_ends_of_ranges(
    tmp_path: Path, kind: str, good: dict[str, Any], wrong: dict[str, Any]
) -> None:
    path = tmp_path / f"{kind}.json"
    assert (
        len(read_results(plain.write_json(path, with_entry(kind, **good))).prediction(FIRST)) == 2
    )
    refused(plain.write_json(path, with_entry(kind, **wrong)), f"results of '{FIRST}': [1].")


@pytest.mark.parametrize(
    ("step", "good"),
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
def test_steps_are_of_recorded_frames(step: float, *, good: bool) -> None:
    made: dict[str, Any] = {
        "stored": "heads",
        "grid": BevGrid(),
        "predictions": 1,
        "frames": 1,
        "step": step,
    }
    if good:
        assert MotionForm(**made).as_dict()["step"] == step
    else:
        assert_refused(
            (
                lambda: MotionForm(**made),
                ResultsError,
                "step: expected seconds, a whole number of recorded frames of",
            ),
        )


TOKEN = "a/" * 400 + "b" * 200


def test_the_longest_token_and_the_largest_form(tmp_path: Path) -> None:
    path = tmp_path / "accident.json"
    assert read_results(
        plain.write_json(path, plain.document("accident", results={TOKEN: []}))
    ).tokens == (TOKEN,)
    refused(
        plain.write_json(path, plain.document("accident", results={f"{TOKEN}b": []})),
        "expected a sample's token",
    )
    form: dict[str, Any] = {
        "stored": "heads",
        "grid": BevGrid((0, 512, 0.5), (0, 512, 0.5)),
        "frames": 8,
    }
    assert MotionForm(predictions=8, **form).predictions == 8  # of 2**20 cells
    assert_refused(
        (
            lambda: MotionForm(predictions=9, **form),
            ResultsError,
            "form: 9 predictions of 8 frames of 1048576 cells are more than memory",
        ),
        *[
            (
                partial(MotionForm, **{"predictions": 1, **form, name: 0}),
                ResultsError,
                f"{name}: expected a whole number from 1, found 0",
            )
            for name in ("predictions", "frames")
        ],
    )
