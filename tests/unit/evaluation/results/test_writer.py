"""Files of results: what is written is what is read, whole or absent; by copies, threads and other
processes.
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
import plain_results as plain
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import assert_refused

from deepaccident_devkit.errors import ChoiceError, ResultsError, TokenError
from deepaccident_devkit.evaluation import Accident, DetectedBoxes, instances_of
from deepaccident_devkit.evaluation.forecasting import Forecast
from deepaccident_devkit.evaluation.planning import Plan
from deepaccident_devkit.evaluation.results import Results, ResultsWriter, read_results, reader
from deepaccident_devkit.evaluation.results.writer import detection_entries
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.taxonomy import CATEGORIES

FIRST, SECOND, THIRD = plain.TOKENS
GRID = BevGrid((-2.0, 2.0, 0.5), (-1.5, 1.5, 0.5))
OTHER = "a/b/ego_vehicle/001"
PREDICTIONS: dict[str, Callable[[], Any]] = {
    "motion": lambda: instances_of(plain.instance_arrays()["instance"], GRID),
    "accident": lambda: [Accident(positions=np.ones((2, 2)), time=0.5)],
    "detection": lambda: DetectedBoxes.from_arrays(
        np.ones((2, 3)), np.ones((2, 3)), [0, 1], [0.5, 1], frame="world"
    ),
    "planning": lambda: [
        Plan(times=[1.0], path=[(5.0, 0.5)]),
        Plan(times=[0.5], path=[(3, 0)], yaw=[0.1]),
    ],
    "forecasting": lambda: [
        Forecast(actor_id=actor, times=[0.5], paths=[[(actor, 1.5)]], probabilities=[0.25])
        for actor in (7, 8)
    ],
}


def files_under(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def write(path: Path, task: Any, **options: Any) -> Results:
    with ResultsWriter(path, task, **options) as writer:
        for token in plain.TOKENS:
            writer.add(token, PREDICTIONS[task]())
    return read_results(path)


@pytest.mark.parametrize("task", PREDICTIONS)
class TestWriter:
    def test_the_same_predictions_are_the_same_bytes(self, tmp_path: Path, task: Any) -> None:
        one, other = (write(tmp_path / name / "x", task) for name in ("a", "b"))
        assert files_under(tmp_path / "a") == files_under(tmp_path / "b")
        assert (len(files_under(tmp_path / "a")), one.fingerprint) == (
            2 if task == "motion" else 1,
            other.fingerprint,
        )

    def test_an_exception_leaves_nothing(self, tmp_path: Path, task: Any) -> None:
        with pytest.raises(KeyboardInterrupt), ResultsWriter(tmp_path / "in" / "x", task) as writer:  # noqa: PT012
            writer.add(FIRST, PREDICTIONS[task]())
            assert list((tmp_path / "in").iterdir())
            assert not (tmp_path / "in" / "x").exists()
            raise KeyboardInterrupt
        assert list((tmp_path / "in").iterdir()) == []

    def test_a_full_disk_leaves_nothing(
        self, tmp_path: Path, task: Any, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def full(*arguments: object, **options: object) -> None:
            raise OSError(28, "No space left on device")

        where = "put_array" if task == "motion" else "EntryWriter.add"
        writer = ResultsWriter(tmp_path / "x", task)
        with (  # noqa: PT012
            pytest.raises(
                ResultsError, match="x: a prediction could not be written, so that none is kept"
            ),
            writer,
        ):
            writer.add(FIRST, PREDICTIONS[task]())
            monkeypatch.setattr(f"deepaccident_devkit.evaluation.results.writer.{where}", full)
            assert_refused(
                (
                    lambda: writer.add(SECOND, PREDICTIONS[task]()),
                    ResultsError,
                    r"x: results cannot be written \(.*No space left.*make room",
                ),
                (lambda: writer.add(SECOND, PREDICTIONS[task]()), ResultsError, "x: is not open"),
            )
        assert list(tmp_path.iterdir()) == []

    def test_nothing_is_replaced(self, tmp_path: Path, task: Any) -> None:
        (tmp_path / "file").write_text("mine", encoding="utf-8")
        (tmp_path / "folder").mkdir()
        (tmp_path / "folder" / "mine").touch()
        assert_refused(
            *[
                (
                    partial(ResultsWriter, tmp_path / name, task),
                    ResultsError,
                    f"{name}: is there already; choose another path, or remove it",
                )
                for name in ("file", "folder")
            ],
        )
        writer = ResultsWriter(tmp_path / "late", task)
        (tmp_path / "late").touch()
        with pytest.raises(ResultsError, match="late: is there already"), writer:
            pass
        assert (tmp_path / "file").read_text(encoding="utf-8") == "mine"
        assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder", "late"]

    def test_a_sample_is_written_once(self, tmp_path: Path, task: Any) -> None:
        with ResultsWriter(tmp_path / "x", task) as writer:
            writer.add(FIRST, PREDICTIONS[task]())
            assert_refused(
                (
                    lambda: writer.add(FIRST, PREDICTIONS[task]()),
                    ResultsError,
                    f"x: {FIRST}: was added before; give each sample one prediction",
                ),
            )
            for token in ("", "a/../b", "/a", "a\\b", "a\nb", "a/\ud800", 3, b"a"):
                with pytest.raises(ResultsError, match="expected a sample's token"):
                    writer.add(token, PREDICTIONS[task]())  # type: ignore[arg-type]
        assert read_results(tmp_path / "x").tokens == (FIRST,)

    def test_without_any_sample(self, tmp_path: Path, task: Any) -> None:
        with (
            pytest.raises(ResultsError, match="x: no prediction was added"),
            ResultsWriter(tmp_path / "x", task),
        ):
            pass
        assert list(tmp_path.iterdir()) == []
        assert_refused(
            (
                lambda: ResultsWriter(tmp_path / "x", task).add(FIRST, PREDICTIONS[task]()),
                ResultsError,
                r"is not open; add predictions inside `with ResultsWriter\(",
            ),
        )

    def test_predictions_of_another_kind(self, tmp_path: Path, task: Any) -> None:
        lidar = DetectedBoxes.from_arrays(
            np.zeros((1, 3)), np.ones((1, 3)), [0.0], [0.5], frame="lidar"
        )
        wrong: dict[str, list[tuple[Any, str]]] = {
            "motion": [([], "expected a MotionOutput, found list; make one with")],
            "accident": [
                (
                    PREDICTIONS["motion"](),
                    "expected a list of Accidents, found a MotionOutput; write that to results",
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
            "planning": [
                ([1], "expected a list of Plans, found int in it"),
                (PREDICTIONS["forecasting"](), "expected a list of Plans, found Forecast in it"),
                ([Plan(times=[1.0], path=[(1e7, 0)])], "[0].path[0][0]: expected `float` <="),
            ],
            "forecasting": [
                (PREDICTIONS["planning"](), "expected a list of Forecasts, found Plan in it"),
                (3, "expected a list of Forecasts, found int in it"),
            ],
        }
        with ResultsWriter(tmp_path / "x", task) as writer:
            assert_refused(
                *[
                    (
                        partial(writer.add, FIRST, prediction),
                        ResultsError,
                        f"x: {FIRST}: .*{re.escape(words)}",
                    )
                    for prediction, words in wrong[task]
                ],
            )
            writer.add(FIRST, PREDICTIONS[task]())
        assert len(read_results(tmp_path / "x")) == 1

    def test_the_method_of_what_is_there_is_told(self, tmp_path: Path, task: Any) -> None:
        write(tmp_path / "x", task, meta={"method": "m" * 5000})
        other = partial(ResultsWriter, tmp_path / "x", task, meta={"method": "yours"})
        assert_refused(
            (other, ResultsError, ("of method 'mmm", "not of 'yours'", "choose another path"))
        )

    def test_an_empty_folder_is_free_for_motion_alone(self, tmp_path: Path, task: Any) -> None:
        (tmp_path / "x").mkdir()
        if task == "motion":
            assert len(write(tmp_path / "x", task)) == 3
        else:
            assert_refused(
                (lambda: ResultsWriter(tmp_path / "x", task), ResultsError, "x: is there already"),
            )


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"meta": {"score": float("nan")}}, "meta: cannot be written as JSON"),
        ({"meta": {"model": object()}}, "meta: cannot be written as JSON"),
        ({"meta": {1: "a", "1": "b"}}, "meta: 1: stands there twice"),
        ({"meta": ["a"]}, "meta: expected a mapping"),
        ({"step": 0}, "step: expected seconds, a whole number of recorded frames"),
        ({"store": "logits"}, "stored: expected one of instances, heads"),
        ({"labels": "mine"}, "labels: expected one of"),
        ({"grid": (200, 200)}, "grid: expected a BevGrid, found tuple"),
    ],
)
def test_what_a_writer_refuses_at_once(tmp_path: Path, options: dict[str, Any], words: str) -> None:
    assert_refused(
        (lambda: ResultsWriter(tmp_path / "x", "motion", **options), ResultsError, words),
    )


def test_plans_and_forecasts_are_read_as_they_were_written(tmp_path: Path) -> None:
    for task in ("planning", "forecasting"):
        found: Any = write(tmp_path / task, task).prediction(SECOND)
        given = PREDICTIONS[task]()
        assert [type(each) for each in found] == [type(each) for each in given]
        for one, other in zip(found, given, strict=True):
            assert pickle.dumps(one) == pickle.dumps(other)


def test_tasks_without_results(tmp_path: Path) -> None:
    with pytest.raises(
        ChoiceError,
        match="task: expected one of motion, accident, detection, planning, "
        "forecasting, found 'warning'",
    ):
        ResultsWriter(tmp_path / "x", "warning")  # type: ignore[arg-type]


@pytest.fixture(params=PREDICTIONS)
def results(request: pytest.FixtureRequest, tmp_path: Path) -> Results:
    return write(tmp_path / ("m" if request.param == "motion" else "results.json"), request.param)


def test_results_are_by_token(results: Results) -> None:
    assert (len(results), results.tokens) == (3, plain.TOKENS)
    assert FIRST in results
    assert OTHER not in results
    assert_refused(
        (lambda: results.prediction(OTHER), TokenError, f"has no prediction of '{OTHER}'"),
    )


def test_a_copy_reads_again(results: Results) -> None:
    content = pickle.dumps(results)
    assert len(content) < 1000
    reader.cached_contents.clear()
    copy = pickle.loads(content)
    assert (copy.task, copy.path, copy.fingerprint) == (
        results.task,
        results.path,
        results.fingerprint,
    )
    assert (copy.tokens, copy.meta, copy.form) == (results.tokens, results.meta, results.form)
    assert len(copy.prediction(SECOND)) == len(results.prediction(SECOND))


def test_in_threads_and_forked_processes(results: Results) -> None:
    expected = [len(results.prediction(token)) for token in plain.TOKENS]
    with ThreadPoolExecutor(8) as pool:
        assert (
            list(pool.map(lambda number: length(results, plain.TOKENS[number % 3]), range(60)))
            == expected * 20
        )
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("fork")) as pool:
        assert list(pool.map(length, [results] * 6, plain.TOKENS * 2)) == expected * 2


def test_a_change_is_noticed(results: Results) -> None:
    file = results.path / "results.json" if results.task == "motion" else results.path
    copy = pickle.dumps(results)
    results.check()
    file.write_bytes(file.read_bytes().replace(b'"meta": {}', b'"meta": {"a": 1}'))
    assert_refused(
        (results.check, ResultsError, "was changed after it was opened; open it again"),
    )
    reader.cached_contents.clear()
    assert_refused(
        (
            lambda: pickle.loads(copy).prediction(FIRST),
            ResultsError,
            "was changed after it was opened; open it again",
        ),
    )
    assert read_results(results.path).fingerprint != results.fingerprint
    file.unlink()
    assert_refused(
        (results.check, ResultsError, r"results\.json: cannot be read \("),
    )


def length(results: Results, token: str) -> int:
    return len(results.prediction(token))


def test_the_fingerprint_changes_with_any_cell(tmp_path: Path) -> None:
    prints = []
    for number, value in enumerate((0, 3, 0)):
        maps = plain.instance_arrays()["instance"]
        maps[0, 0, 0, 0] = value
        with ResultsWriter(tmp_path / str(number), "motion") as writer:
            writer.add(FIRST, instances_of(maps, GRID))
        prints.append(read_results(tmp_path / str(number)).fingerprint)
    assert prints[0] == prints[2] != prints[1]


def test_a_check_with_workers(tmp_path: Path) -> None:
    results = read_results(plain.write_motion(tmp_path / "m"))
    path = tmp_path / "m" / "shards" / "00001.npz"
    path.write_bytes(path.read_bytes()[::-1])
    assert_refused(
        (
            lambda: results.check(workers=2),
            ResultsError,
            r"shards/00001\.npz: its bytes are not those that the checksum is of",
        ),
    )


FINITE = {"allow_nan": False, "allow_infinity": False}
numbers = st.floats(-1e6, 1e6, **FINITE)
accidents = st.builds(
    lambda points, time, score, ids: Accident(
        positions=np.reshape(points, (2, 2)), time=time, score=score, ids=ids
    ),
    st.lists(numbers, min_size=4, max_size=4),
    st.floats(0, 1e3, **FINITE),
    st.floats(**FINITE),
    st.none() | st.tuples(st.integers(-(2**63), 2**63 - 1), st.integers(-100, 10**6)),
)


@st.composite
def boxes(draw: Callable[[Any], Any]) -> DetectedBoxes:
    count, source = draw(st.integers(0, 5)), np.random.default_rng(draw(st.integers(0, 2**32)))
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
    return (
        tuple(map(tuple, accident.positions.tolist())),
        accident.time,
        accident.score,
        accident.ids,
    )


def written(path: Path, task: Any, predictions: dict[str, Any], **options: Any) -> Results:
    with ResultsWriter(path, task, **options) as writer:
        for token, prediction in predictions.items():
            writer.add(token, prediction)
    return read_results(path)


@settings(max_examples=25)
@given(st.lists(st.lists(accidents, max_size=4), min_size=1, max_size=4))
def test_accidents_come_back(
    tmp_path_factory: pytest.TempPathFactory, lists: list[list[Accident]]
) -> None:
    predictions = {f"a/b/ego_vehicle/{number:03d}": each for number, each in enumerate(lists)}
    results = written(
        tmp_path_factory.mktemp("accidents") / "accident.json", "accident", predictions
    )
    assert results.tokens == tuple(predictions)
    for token, given_ones in predictions.items():
        read = results.prediction(token)
        assert isinstance(read, list)
        assert list(map(as_plain, read)) == list(map(as_plain, given_ones))


@settings(max_examples=25)
@given(st.lists(boxes(), min_size=1, max_size=4))
def test_boxes_come_back(
    tmp_path_factory: pytest.TempPathFactory, lists: list[DetectedBoxes]
) -> None:
    predictions = {f"a/b/ego_vehicle/{number:03d}": each for number, each in enumerate(lists)}
    results = written(tmp_path_factory.mktemp("boxes") / "detection.json", "detection", predictions)
    for token, given_ones in predictions.items():
        read = results.prediction(token)
        assert isinstance(read, DetectedBoxes)
        np.testing.assert_array_equal(read.scores, given_ones.scores)
        assert read.boxes.frame == "world"
        for name in ("center", "size", "rotation", "velocity", "category", "actor_id", "row"):
            np.testing.assert_array_equal(
                getattr(read.boxes, name), getattr(given_ones.boxes, name)
            )


def test_the_plain_accidents(tmp_path: Path) -> None:
    results = read_results(plain.write_json(tmp_path / "accident.json", plain.accidents()))
    assert (results.task, results.meta, results.form) == ("accident", {"method": "plain"}, None)
    read = results.prediction(FIRST)
    assert isinstance(read, list)
    positions = ((12.5, 0.5), (13.0, -2.0))
    assert list(map(as_plain, read)) == [
        (positions, 1.5, 0.75, (1236, 1240)),
        (positions, 0.0, 0.75, None),
    ]
    assert results.prediction(THIRD) == []


def test_the_plain_boxes(tmp_path: Path) -> None:
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


def test_a_velocity_that_is_known_in_part_is_unknown() -> None:
    columns = {
        "center": np.zeros((2, 3)),
        "size": np.ones((2, 3)),
        "yaw": np.zeros(2),
        "frame": "world",
    }
    detected = DetectedBoxes.from_arrays(
        scores=np.ones(2), velocity=np.array([[1.0, np.nan, 0.0], [1.0, 2.0, 0.0]]), **columns
    )
    assert [each["velocity"] for each in detection_entries("s", detected)] == [None, [1.0, 2.0]]
