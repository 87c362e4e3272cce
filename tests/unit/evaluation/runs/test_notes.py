"""Notes that keep a reader from comparing numbers that cannot be compared."""

from typing import Any

import pytest

from deepaccident_devkit.evaluation.runs.text import reading_notes

FORM = {
    "stored": "heads",
    "x": [-50.0, 50.0, 0.5],
    "y": [-50.0, 50.0, 0.5],
    "orientation": "devkit",
    "predictions": 6,
    "frames": 5,
    "step": 0.5,
    "labels": None,
}
PATHS = {"path_true_positive": 9, "path_false_negative": 1, "ranges": {"30x30": {}, "100x100": {}}}


def notes(
    task: str = "motion", protocol: str = "released", *, metrics: dict[str, Any] | None = None, **form: Any
) -> list[str]:
    told = None if task == "detection" else FORM | form
    return reading_notes(
        {"task": task, "protocol": protocol, "horizon": 2.0, "metrics": metrics or PATHS, "results": {"form": told}}
    )


@pytest.mark.parametrize("task", ["motion", "accident"])
def test_the_published_form_has_none(task: str) -> None:
    assert notes(task) == []


def test_other_cells() -> None:
    small = [-25.0, 25.0, 0.5]
    cells, wide = notes(x=small, y=small)
    assert cells.startswith(
        "the maps have cells of 0.5 m, x from -25 to 25 m, y from -25 to 25 m, and so have the labels"
    )
    assert wide == "100x100: the maps end before this range does; only their cells count"
    [coarse] = notes(x=[-50.0, 50.0, 1.0])
    assert coarse.startswith("the maps have cells of 1 m, x from -50 to 50 m")


def test_past_frames() -> None:
    [note] = notes(frames=7)
    assert note.startswith("predictions have 7 frames; the first 5 are evaluated")


def test_published_accidents_are_of_six_heads() -> None:
    maps, single = notes("accident", stored="instances", predictions=1)
    assert maps.startswith("instance maps: cannot be compared with published APA")
    assert single.startswith("predictions of a sample: 1; published numbers are of 6")
    assert notes("accident", "paper", stored="instances", predictions=1) == []


def test_few_paths() -> None:
    [note] = notes(metrics=PATHS | {"path_true_positive": 31, "path_false_negative": 193})
    assert note == "31 of 224 true paths have a match; min_ade, min_fde and miss_rate are of these alone"


def test_detection_of_the_released_code() -> None:
    [note] = notes("detection")
    assert note.startswith("released: hidden boxes are truth")
    assert notes("detection", "paper") == []


@pytest.mark.parametrize("field", ["x", "y"])
def test_each_axis_is_that_of_published_numbers(field: str) -> None:
    assert len(notes(**{field: [-50.0, 50.0, 0.25]})) == 1
    [_, wide] = notes(**{field: [-50.0, 49.5, 0.5]})
    assert wide.startswith("100x100: the maps end before")
    ranges = PATHS | {"ranges": {"30x120": {}, "100x100": {}, "102x30": {}}}
    assert [note.split(":")[0] for note in notes(metrics=ranges, **{field: [-51.0, 51.0, 0.5]})[1:]] == [
        "30x120",
        "102x30",
    ]


def test_up_to_where_numbers_are_as_published() -> None:
    assert notes(frames=5) == notes(frames=1) == []
    assert notes(frames=6)[0].startswith("predictions have 6 frames; the first 5 are evaluated")
    assert notes(frames=3, step=1.0) == notes(frames=8, step=0.3) == []
    assert notes(frames=4, step=1.0)[0].startswith("predictions have 4 frames; the first 3 are evaluated")
    [note] = notes("accident", predictions=5)
    assert note == "predictions of a sample: 5; published numbers are of 6, five samples and then their mean"
    assert notes("accident", predictions=7) == []
    [note] = notes(metrics=PATHS | {"path_true_positive": 89, "path_false_negative": 11})
    assert note.startswith("89 of 100 true paths")
    assert notes("warning", "clean", metrics={}) == []
