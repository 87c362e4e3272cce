"""Accidents and boxes: what is written is what is read, in the form that the page says."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import plain_results as plain
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deepaccident_devkit.evaluation import Accident, DetectedBoxes
from deepaccident_devkit.evaluation.results import Results, ResultsWriter, read_results
from deepaccident_devkit.evaluation.results.writer import detection_entries
from deepaccident_devkit.taxonomy import CATEGORIES

FIRST, SECOND, THIRD = plain.TOKENS
FINITE = {"allow_nan": False, "allow_infinity": False}
numbers = st.floats(-1e6, 1e6, **FINITE)
accidents = st.builds(
    lambda points, time, score, ids: Accident(positions=np.reshape(points, (2, 2)), time=time, score=score, ids=ids),
    st.lists(numbers, min_size=4, max_size=4),
    st.floats(0, 1e3, **FINITE),
    st.floats(**FINITE),
    st.none() | st.tuples(st.integers(-(2**63), 2**63 - 1), st.integers(-100, 10**6)),
)


@st.composite
def boxes(draw: Callable[[Any], Any]) -> DetectedBoxes:
    count = draw(st.integers(0, 5))
    source = np.random.default_rng(draw(st.integers(0, 2**32)))
    velocity = source.normal(0, 10, (count, 3)) * [1, 1, 0]
    velocity[source.random(count) < 0.3] = np.nan
    return DetectedBoxes.from_arrays(
        source.normal(0, 1e3, (count, 3)),
        source.exponential(3, (count, 3)),
        source.uniform(-9, 9, count),
        source.normal(0, 1, count),
        category=source.integers(0, len(CATEGORIES), count),
        velocity=velocity,
        frame="world",
    )


def as_plain(accident: Accident) -> tuple[Any, ...]:
    return tuple(map(tuple, accident.positions.tolist())), accident.time, accident.score, accident.ids


def written(path: Path, task: Any, predictions: dict[str, Any], **options: Any) -> Results:
    with ResultsWriter(path, task, **options) as writer:
        for token, prediction in predictions.items():
            writer.add(token, prediction)
    return read_results(path)


class TestEntries:
    @settings(max_examples=25)
    @given(st.lists(st.lists(accidents, max_size=4), min_size=1, max_size=4))
    def test_accidents_come_back(self, tmp_path_factory: pytest.TempPathFactory, lists: list[list[Accident]]) -> None:
        predictions = {f"a/b/ego_vehicle/{number:03d}": each for number, each in enumerate(lists)}
        results = written(tmp_path_factory.mktemp("accidents") / "accident.json", "accident", predictions)
        assert results.tokens == tuple(predictions)
        for token, given_ones in predictions.items():
            read = results.prediction(token)
            assert isinstance(read, list)
            assert list(map(as_plain, read)) == list(map(as_plain, given_ones))

    @settings(max_examples=25)
    @given(st.lists(boxes(), min_size=1, max_size=4))
    def test_boxes_come_back(self, tmp_path_factory: pytest.TempPathFactory, lists: list[DetectedBoxes]) -> None:
        predictions = {f"a/b/ego_vehicle/{number:03d}": each for number, each in enumerate(lists)}
        results = written(tmp_path_factory.mktemp("boxes") / "detection.json", "detection", predictions)
        for token, given_ones in predictions.items():
            read = results.prediction(token)
            assert isinstance(read, DetectedBoxes)
            np.testing.assert_array_equal(read.scores, given_ones.scores)
            assert read.boxes.frame == "world"
            for name in ("center", "size", "rotation", "velocity", "category", "actor_id", "row"):
                np.testing.assert_array_equal(getattr(read.boxes, name), getattr(given_ones.boxes, name))

    def test_the_plain_accidents(self, tmp_path: Path) -> None:
        results = read_results(plain.write_json(tmp_path / "accident.json", plain.accidents()))
        assert (results.task, results.meta, results.form) == ("accident", {"method": "plain"}, None)
        read = results.prediction(FIRST)
        assert isinstance(read, list)
        positions = ((12.5, 0.5), (13.0, -2.0))
        assert list(map(as_plain, read)) == [(positions, 1.5, 0.75, (1236, 1240)), (positions, 0.0, 0.75, None)]
        assert results.prediction(THIRD) == []

    def test_the_plain_boxes(self, tmp_path: Path) -> None:
        results = read_results(plain.write_json(tmp_path / "detection.json", plain.detections()))
        read = results.prediction(FIRST)
        assert isinstance(read, DetectedBoxes)
        assert read.boxes.frame == "world"
        np.testing.assert_array_equal(read.boxes.size, [[4.5, 1.9, 1.6]] * 2)  # length, width, height
        np.testing.assert_array_equal(read.boxes.center, [[105.25, -33.0, 0.75]] * 2)
        np.testing.assert_allclose(read.boxes.yaw, 2 * np.arctan2(0.8, 0.6), atol=1e-12)
        np.testing.assert_array_equal(read.boxes.velocity, [[0, 8.25, 0], [np.nan] * 3])
        np.testing.assert_array_equal(read.scores, [0.9, 0.9])
        assert (CATEGORIES[read.boxes.category[0]], len(results.prediction(THIRD))) == ("van", 0)

    def test_a_sample_a_line(self, tmp_path: Path) -> None:
        predictions = {FIRST: [Accident(positions=np.zeros((2, 2)), time=1.0)], SECOND: []}
        written(tmp_path / "accident.json", "accident", predictions, meta={"b": 1, "a": [None]})
        lines = (tmp_path / "accident.json").read_text(encoding="utf-8").splitlines()
        header = ['"format": "DeepAccident results",', '"version": 1,', '"task": "accident",']
        assert lines[:6] == ["{", *header, '"meta": {"b": 1, "a": [null]},', '"results": {']
        assert lines[7:] == [f'"{SECOND}": []', "}", "}"]


def test_a_velocity_that_is_known_in_part_is_unknown() -> None:
    columns = {"center": np.zeros((2, 3)), "size": np.ones((2, 3)), "yaw": np.zeros(2), "frame": "world"}
    velocity = np.array([[1.0, np.nan, 0.0], [1.0, 2.0, 0.0]])
    detected = DetectedBoxes.from_arrays(scores=np.ones(2), velocity=velocity, **columns)
    assert [each["velocity"] for each in detection_entries("s", detected)] == [None, [1.0, 2.0]]
