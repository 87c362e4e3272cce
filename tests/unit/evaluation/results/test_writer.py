"""Files of results are read as they were written, also by copies, threads and other processes, and
a file that is not complete does not exist.
"""

import multiprocessing
import pickle
import re
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import handwritten_results as handwritten
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import ChoiceError, ResultsError, TokenError
from deepaccident_devkit.evaluation import (
    Accident,
    DetectedBoxes,
    SegmentationOutput,
    Tracks,
    instances_of,
)
from deepaccident_devkit.evaluation.forecasting import Forecast
from deepaccident_devkit.evaluation.planning import Plan
from deepaccident_devkit.evaluation.results import Results, ResultsWriter, read_results, reader
from deepaccident_devkit.evaluation.results.records import FOLDER_TASKS
from deepaccident_devkit.evaluation.results.writer import detection_entries
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.taxonomy import CATEGORIES

FIRST, SECOND, THIRD = handwritten.TOKENS
GRID = BevGrid((-2.0, 2.0, 0.5), (-1.5, 1.5, 0.5))
MISSING_SAMPLE = "a/b/ego_vehicle/001"
PREDICTIONS: dict[str, Callable[[], Any]] = {
    "motion": lambda: instances_of(handwritten.instance_arrays()["instance"], GRID),
    "accident": lambda: [Accident(positions=np.ones((2, 2)), time=0.5)],
    "detection": lambda: DetectedBoxes.from_arrays(
        np.ones((2, 3)), np.ones((2, 3)), [0, 1], [0.5, 1], frame="world"
    ),
    "tracking": lambda: Tracks.from_arrays(
        np.ones((2, 3)), np.ones((2, 3)), [0, 1], [0.5, 1], ids=[3, "a:b"], frame="world"
    ),
    "planning": lambda: [
        Plan(times=[1.0], path=[(5.0, 0.5)]),
        Plan(times=[0.5], path=[(3, 0)], yaw=[0.1]),
    ],
    "segmentation": lambda: SegmentationOutput.from_arrays(
        masks=np.ones((5, *GRID.shape), dtype=bool), grid=GRID
    ),
    "forecasting": lambda: [
        Forecast(actor_id=actor, times=[0.5], paths=[[(actor, 1.5)]], probabilities=[0.25])
        for actor in (7, 8)
    ],
}


def read_files(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def write_all_samples(path: Path, task: Any, **options: Any) -> Results:
    predictions = {token: PREDICTIONS[task]() for token in handwritten.TOKENS}
    return write_results(path, task, predictions, **options)


def write_results(path: Path, task: Any, predictions: dict[str, Any], **options: Any) -> Results:
    with ResultsWriter(path, task, **options) as writer:
        for token, prediction in predictions.items():
            writer.add(token, prediction)
    return read_results(path)


@pytest.mark.parametrize("task", PREDICTIONS)
class TestWriter:
    def test_the_same_predictions_are_the_same_bytes(self, tmp_path: Path, task: Any) -> None:
        first = write_all_samples(tmp_path / "a" / "x", task)
        second = write_all_samples(tmp_path / "b" / "x", task)
        files = read_files(tmp_path / "a")
        assert files == read_files(tmp_path / "b")
        assert len(files) == (2 if task in FOLDER_TASKS else 1)
        assert first.fingerprint == second.fingerprint

    def test_an_exception_leaves_nothing(self, tmp_path: Path, task: Any) -> None:
        folder = tmp_path / "in"
        with pytest.raises(KeyboardInterrupt), ResultsWriter(folder / "x", task) as writer:  # noqa: PT012
            writer.add(FIRST, PREDICTIONS[task]())
            assert list(folder.iterdir())
            assert not (folder / "x").exists()
            raise KeyboardInterrupt
        assert list(folder.iterdir()) == []

    def test_a_full_disk_leaves_nothing(
        self, tmp_path: Path, task: Any, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def raise_full_disk(*arguments: object, **options: object) -> None:
            raise OSError(28, "No space left on device")

        function = "put_array" if task in FOLDER_TASKS else "EntryWriter.add"
        writer = ResultsWriter(tmp_path / "x", task)
        add_second = partial(writer.add, SECOND, PREDICTIONS[task]())
        with (  # noqa: PT012
            pytest.raises(
                ResultsError, match="x: a prediction could not be written, so none was kept"
            ),
            writer,
        ):
            writer.add(FIRST, PREDICTIONS[task]())
            monkeypatch.setattr(
                f"deepaccident_devkit.evaluation.results.writer.{function}", raise_full_disk
            )
            assert_raises(
                (
                    add_second,
                    ResultsError,
                    r"x: results cannot be written \(.*No space left.*free space",
                ),
                (add_second, ResultsError, "x: is not open"),
            )
        assert list(tmp_path.iterdir()) == []

    def test_nothing_is_replaced(self, tmp_path: Path, task: Any) -> None:
        (tmp_path / "file").write_text("mine", encoding="utf-8")
        (tmp_path / "folder").mkdir()
        (tmp_path / "folder" / "mine").touch()
        assert_raises(
            *[
                (
                    partial(ResultsWriter, tmp_path / name, task),
                    ResultsError,
                    f"{name}: already exists; choose another path, or remove it",
                )
                for name in ("file", "folder")
            ],
        )
        writer = ResultsWriter(tmp_path / "late", task)
        (tmp_path / "late").touch()
        with pytest.raises(ResultsError, match="late: already exists"), writer:
            pass
        assert (tmp_path / "file").read_text(encoding="utf-8") == "mine"
        assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder", "late"]

    def test_a_sample_is_written_once(self, tmp_path: Path, task: Any) -> None:
        with ResultsWriter(tmp_path / "x", task) as writer:
            writer.add(FIRST, PREDICTIONS[task]())
            assert_raises(
                (
                    lambda: writer.add(FIRST, PREDICTIONS[task]()),
                    ResultsError,
                    f"x: {FIRST}: was already added; add one prediction per sample",
                ),
            )
            for token in ("", "a/../b", "/a", "a\\b", "a\nb", "a/\ud800", 3, b"a"):
                with pytest.raises(ResultsError, match="expected a sample token"):
                    writer.add(token, PREDICTIONS[task]())  # type: ignore[arg-type]
        assert read_results(tmp_path / "x").tokens == (FIRST,)

    def test_without_any_sample(self, tmp_path: Path, task: Any) -> None:
        path = tmp_path / "x"
        with (
            pytest.raises(ResultsError, match="x: no prediction was added"),
            ResultsWriter(path, task),
        ):
            pass
        assert list(tmp_path.iterdir()) == []
        assert_raises(
            (
                lambda: ResultsWriter(path, task).add(FIRST, PREDICTIONS[task]()),
                ResultsError,
                r"is not open; add predictions inside `with ResultsWriter\(",
            ),
        )

    def test_predictions_of_another_kind(self, tmp_path: Path, task: Any) -> None:
        lidar = DetectedBoxes.from_arrays(
            np.zeros((1, 3)), np.ones((1, 3)), [0.0], [0.5], frame="lidar"
        )
        cases: dict[str, list[tuple[Any, str]]] = {
            "motion": [([], "expected a MotionOutput, found list; make one with")],
            "accident": [
                (
                    PREDICTIONS["motion"](),
                    "expected a list of Accidents, found a MotionOutput; write it to results",
                ),
                ([1], "expected a MotionOutput or a list of Accidents, found list with int"),
                (
                    [Accident(positions=np.ones((2, 2)), time=0.5, ids=(2**70, 1))],
                    "[0].ids[0]: expected `int` <=",
                ),
            ],
            "detection": [
                (
                    [],
                    "expected DetectedBoxes, found list; make them with DetectedBoxes.from_arrays(",
                ),
                (
                    lidar,
                    (
                        "expected boxes in the world frame, found lidar; give "
                        "detected.transform(dataset."
                    ),
                ),
            ],
            "tracking": [
                (lidar, "expected Tracks, found DetectedBoxes; make them with Tracks.from_arrays("),
            ],
            "planning": [
                ([1], "expected a list of Plans, found int in the list"),
                (
                    PREDICTIONS["forecasting"](),
                    "expected a list of Plans, found Forecast in the list",
                ),
                ([Plan(times=[1.0], path=[(1e7, 0)])], "[0].path[0][0]: expected `float` <="),
            ],
            "forecasting": [
                (PREDICTIONS["planning"](), "expected a list of Forecasts, found Plan in the list"),
                (3, "expected a list of Forecasts, found int in the list"),
            ],
            "segmentation": [([], "expected a SegmentationOutput, found list; make one with")],
        }
        with ResultsWriter(tmp_path / "x", task) as writer:
            assert_raises(
                *[
                    (
                        partial(writer.add, FIRST, prediction),
                        ResultsError,
                        f"x: {FIRST}: .*{re.escape(words)}",
                    )
                    for prediction, words in cases[task]
                ],
            )
            writer.add(FIRST, PREDICTIONS[task]())
        assert len(read_results(tmp_path / "x")) == 1

    def test_the_method_of_existing_results_is_named(self, tmp_path: Path, task: Any) -> None:
        path = tmp_path / "x"
        write_all_samples(path, task, meta={"method": "m" * 5000})
        assert_raises(
            (
                lambda: ResultsWriter(path, task, meta={"method": "yours"}),
                ResultsError,
                ("with method 'mmm", "not 'yours'", "choose another path"),
            )
        )

    def test_an_empty_folder_is_free_only_for_shards(self, tmp_path: Path, task: Any) -> None:
        path = tmp_path / "x"
        path.mkdir()
        if task in FOLDER_TASKS:
            assert len(write_all_samples(path, task)) == 3
        else:
            assert_raises(
                (lambda: ResultsWriter(path, task), ResultsError, "x: already exists"),
            )


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"meta": {"score": float("nan")}}, "meta: cannot be written as JSON"),
        ({"meta": {"model": object()}}, "meta: cannot be written as JSON"),
        ({"meta": {1: "a", "1": "b"}}, "meta: 1: appears twice"),
        ({"meta": ["a"]}, "meta: expected a mapping"),
        ({"step": 0}, r"step: expected seconds that are a multiple of 0\.1 s \(one frame\)"),
        ({"store": "logits"}, "stored: expected one of instances, heads"),
        ({"labels": "mine"}, "labels: expected one of"),
        ({"grid": (200, 200)}, "grid: expected a BevGrid, found tuple"),
    ],
)
def test_what_a_writer_refuses_at_once(tmp_path: Path, options: dict[str, Any], words: str) -> None:
    assert_raises(
        (lambda: ResultsWriter(tmp_path / "x", "motion", **options), ResultsError, words),
    )


def test_plans_and_forecasts_are_read_as_they_were_written(tmp_path: Path) -> None:
    for task in ("planning", "forecasting"):
        entries: Any = write_all_samples(tmp_path / task, task).prediction(SECOND)
        for entry, expected in zip(entries, PREDICTIONS[task](), strict=True):
            assert type(entry) is type(expected)
            assert pickle.dumps(entry) == pickle.dumps(expected)


def test_tasks_without_results(tmp_path: Path) -> None:
    with pytest.raises(
        ChoiceError,
        match="task: expected one of motion, accident, detection, tracking, planning, "
        "forecasting, segmentation, found 'warning'",
    ):
        ResultsWriter(tmp_path / "x", "warning")  # type: ignore[arg-type]


@pytest.fixture(params=PREDICTIONS)
def results(request: pytest.FixtureRequest, tmp_path: Path) -> Results:
    name = "m" if request.param in FOLDER_TASKS else "results.json"
    return write_all_samples(tmp_path / name, request.param)


def test_results_are_by_token(results: Results) -> None:
    assert len(results) == 3
    assert results.tokens == handwritten.TOKENS
    assert FIRST in results
    assert MISSING_SAMPLE not in results
    assert_raises(
        (
            lambda: results.prediction(MISSING_SAMPLE),
            TokenError,
            f"has no prediction for '{MISSING_SAMPLE}'",
        ),
    )


def test_a_copy_reads_again(results: Results) -> None:
    content = pickle.dumps(results)
    assert len(content) < 1000
    reader.cached_contents.clear()
    copy = pickle.loads(content)
    for name in ("task", "path", "fingerprint", "tokens", "meta", "form"):
        assert getattr(copy, name) == getattr(results, name), name
    assert describe(copy, SECOND) == describe(results, SECOND)


def test_in_threads_and_forked_processes(results: Results) -> None:
    tokens = handwritten.TOKENS * 20
    expected = [describe(results, token) for token in tokens]
    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(describe, [results] * 60, tokens)) == expected
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("fork")) as pool:
        assert list(pool.map(describe, [results] * 6, tokens[:6])) == expected[:6]


def test_a_change_is_noticed(results: Results) -> None:
    file = results.path / "results.json" if results.task in FOLDER_TASKS else results.path
    copy = pickle.dumps(results)
    results.check()
    file.write_bytes(file.read_bytes().replace(b'"meta": {}', b'"meta": {"a": 1}'))
    assert_raises(
        (results.check, ResultsError, "was changed after it was opened; open it again"),
    )
    reader.cached_contents.clear()
    assert_raises(
        (
            lambda: pickle.loads(copy).prediction(FIRST),
            ResultsError,
            "was changed after it was opened; open it again",
        ),
    )
    assert read_results(results.path).fingerprint != results.fingerprint
    file.unlink()
    assert_raises(
        (results.check, ResultsError, r"results\.json: cannot be read \("),
    )


def describe(results: Results, token: str) -> str:
    return repr(results.prediction(token))


def test_the_fingerprint_changes_with_any_cell(tmp_path: Path) -> None:
    fingerprints = []
    for number, value in enumerate((0, 3, 0)):
        maps = handwritten.instance_arrays()["instance"]
        maps[0, 0, 0, 0] = value
        results = write_results(
            tmp_path / str(number),
            "motion",
            {FIRST: instances_of(maps, GRID)},
        )
        fingerprints.append(results.fingerprint)
    assert fingerprints[0] == fingerprints[2] != fingerprints[1]


def test_a_check_with_workers(tmp_path: Path) -> None:
    results = read_results(handwritten.write_motion(tmp_path / "m"))
    path = tmp_path / "m" / "shards" / "00001.npz"
    path.write_bytes(path.read_bytes()[::-1])
    assert_raises(
        (
            lambda: results.check(workers=2),
            ResultsError,
            r"shards/00001\.npz: its content does not match its checksum",
        ),
    )


FINITE_ONLY = {"allow_nan": False, "allow_infinity": False}
coordinates = st.floats(-1e6, 1e6, **FINITE_ONLY)
accidents = st.builds(
    lambda points, time, score, ids: Accident(
        positions=np.reshape(points, (2, 2)), time=time, score=score, ids=ids
    ),
    st.lists(coordinates, min_size=4, max_size=4),
    st.floats(0, 1e3, **FINITE_ONLY),
    st.floats(**FINITE_ONLY),
    st.none() | st.tuples(st.integers(-(2**63), 2**63 - 1), st.integers(-100, 10**6)),
)


@st.composite
def boxes(draw: Callable[[Any], Any]) -> DetectedBoxes:
    count = draw(st.integers(0, 5))
    random = np.random.default_rng(draw(st.integers(0, 2**32)))
    velocity = random.normal(0, 10, (count, 3)) * [1, 1, 0]
    velocity[random.random(count) < 0.3] = np.nan
    return DetectedBoxes.from_arrays(
        random.normal(0, 1e3, (count, 3)),
        random.exponential(3, (count, 3)),
        random.uniform(-9, 9, count),
        random.normal(0, 1, count),
        category=random.integers(0, len(CATEGORIES), count),
        velocity=velocity,
        frame="world",
    )


def accident_fields(accident: Accident) -> tuple[Any, ...]:
    return (
        tuple(map(tuple, accident.positions.tolist())),
        accident.time,
        accident.score,
        accident.ids,
    )


@settings(max_examples=25)
@given(st.lists(st.lists(accidents, max_size=4), min_size=1, max_size=4))
def test_accidents_are_read_as_they_were_written(
    tmp_path_factory: pytest.TempPathFactory, lists: list[list[Accident]]
) -> None:
    predictions = number_samples(lists)
    results = write_results(
        tmp_path_factory.mktemp("accidents") / "accident.json",
        "accident",
        predictions,
    )
    assert results.tokens == tuple(predictions)
    for token, expected in predictions.items():
        prediction = results.prediction(token)
        assert isinstance(prediction, list)
        assert list(map(accident_fields, prediction)) == list(map(accident_fields, expected))


def number_samples(predictions: list[Any]) -> dict[str, Any]:
    return {
        f"a/b/ego_vehicle/{number:03d}": prediction for number, prediction in enumerate(predictions)
    }


@settings(max_examples=25)
@given(st.lists(boxes(), min_size=1, max_size=4))
def test_boxes_are_read_as_they_were_written(
    tmp_path_factory: pytest.TempPathFactory, lists: list[DetectedBoxes]
) -> None:
    predictions = number_samples(lists)
    results = write_results(
        tmp_path_factory.mktemp("boxes") / "detection.json",
        "detection",
        predictions,
    )
    for token, expected in predictions.items():
        prediction = results.prediction(token)
        assert isinstance(prediction, DetectedBoxes)
        np.testing.assert_array_equal(prediction.scores, expected.scores)
        assert prediction.boxes.frame == "world"
        for name in ("center", "size", "rotation", "velocity", "category", "actor_id", "row"):
            np.testing.assert_array_equal(
                getattr(prediction.boxes, name), getattr(expected.boxes, name)
            )


def test_handwritten_accidents_are_read(tmp_path: Path) -> None:
    document = handwritten.accident_document()
    results = read_results(handwritten.write_json(tmp_path / "accident.json", document))
    assert (results.task, results.meta, results.form) == ("accident", {"method": "plain"}, None)
    prediction = results.prediction(FIRST)
    assert isinstance(prediction, list)
    positions = ((12.5, 0.5), (13.0, -2.0))
    assert list(map(accident_fields, prediction)) == [
        (positions, 1.5, 0.75, (1236, 1240)),
        (positions, 0.0, 0.75, None),
    ]
    assert results.prediction(THIRD) == []


def test_handwritten_boxes_are_read(tmp_path: Path) -> None:
    document = handwritten.detection_document()
    results = read_results(handwritten.write_json(tmp_path / "detection.json", document))
    prediction = results.prediction(FIRST)
    assert isinstance(prediction, DetectedBoxes)
    boxes = prediction.boxes
    assert boxes.frame == "world"
    np.testing.assert_array_equal(
        boxes.size,
        [[4.5, 1.9, 1.6]] * 2,
    )  # length, width, height
    np.testing.assert_array_equal(
        boxes.center,
        [[105.25, -33.0, 0.75]] * 2,
    )
    np.testing.assert_allclose(
        boxes.yaw,
        2 * np.arctan2(0.8, 0.6),
        atol=1e-12,
    )
    np.testing.assert_array_equal(
        boxes.velocity,
        [[0, 8.25, 0], [np.nan] * 3],
    )
    np.testing.assert_array_equal(prediction.scores, [0.9, 0.9])
    assert CATEGORIES[boxes.category[0]] == "van"
    assert len(results.prediction(THIRD)) == 0


def test_a_partly_known_velocity_is_unknown() -> None:
    detected = DetectedBoxes.from_arrays(
        center=np.zeros((2, 3)),
        size=np.ones((2, 3)),
        yaw=np.zeros(2),
        scores=np.ones(2),
        velocity=np.array([[1.0, np.nan, 0.0], [1.0, 2.0, 0.0]]),
        frame="world",
    )
    entries = detection_entries("s", detected)
    assert [entry["velocity"] for entry in entries] == [None, [1.0, 2.0]]
