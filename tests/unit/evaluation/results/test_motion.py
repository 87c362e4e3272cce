"""Motion results: predictions are read as they were written, in the form that the page states."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import handwritten_results as handwritten
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.evaluation import MotionOutput, instances_of
from deepaccident_devkit.evaluation.results import MotionForm, Results, ResultsWriter, read_results
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import MotionHeads, predict_instances

FIRST, SECOND, THIRD = handwritten.TOKENS
GRID = BevGrid((-2.0, 2.0, 0.5), (-1.5, 1.5, 0.5))
LARGE_GRID = BevGrid()
INSTANCES = handwritten.instance_arrays()["instance"]
# The date of all members, so that the same predictions are the same bytes.
ZIP_DATE = (1980, 1, 1, 0, 0, 0)
HEAD_CHANNELS = (2, 1, 2, 2)


def write_results(path: Path, task: Any, predictions: dict[str, Any], **options: Any) -> Results:
    with ResultsWriter(path, task, **options) as writer:
        for token, prediction in predictions.items():
            writer.add(token, prediction)
    return read_results(path)


def make_heads_output(
    seed: int = 0, predictions: int = 2, orientation: Any = "devkit", grid: BevGrid = GRID
) -> MotionOutput:
    random = np.random.default_rng(seed)
    turned_grid = grid.with_orientation(orientation)
    arrays = []
    for channels in HEAD_CHANNELS:
        shape = (predictions, 3, channels, *turned_grid.shape)
        arrays.append(random.normal(size=shape).astype(np.float32))
    return MotionOutput.from_arrays(*arrays, grid=turned_grid)


def make_label_heads(ignore_index: int | None = None, frames: int = 3) -> MotionHeads:
    arrays = [
        np.ones((frames, channels, *GRID.shape), dtype=np.float32) for channels in HEAD_CHANNELS
    ]
    return MotionHeads.from_arrays(*arrays, ignore_index=ignore_index)


@pytest.mark.parametrize("orientation", ["devkit", "released", "fiery"])
def test_heads_are_stored_as_instances(tmp_path: Path, orientation: Any) -> None:
    outputs = {
        FIRST: make_heads_output(1, 2, orientation),
        SECOND: make_heads_output(2, 1, orientation),
    }
    results = write_results(tmp_path / "motion", "motion", outputs, step=0.3, labels="clean")
    assert results.form == MotionForm(
        stored="instances",
        grid=GRID.with_orientation(orientation),
        predictions=2,
        frames=3,
        step=0.3,
        labels="clean",
    )
    for token, output in outputs.items():
        expected = [predict_instances(heads, "motion").instance for heads in output.heads or ()]
        prediction = results.prediction(token)
        assert isinstance(prediction, MotionOutput)
        np.testing.assert_array_equal(prediction.instances, expected)  # type: ignore[arg-type]
        assert prediction.grid == output.grid
    results.check()


@pytest.mark.parametrize(
    ("highest", "dtype"), [(255, "u1"), (256, "u2"), (65535, "u2"), (65536, "i4")]
)
def test_instance_maps_are_stored_as_given(tmp_path: Path, highest: int, dtype: str) -> None:
    maps = INSTANCES.astype(np.int32)
    maps[maps == 7] = highest
    maps[-1, 2] = 0  # both instances are gone in the last frame
    results = write_results(
        tmp_path / "m",
        "motion",
        {FIRST: instances_of(maps, GRID)},
    )
    prediction = results.prediction(FIRST)
    assert isinstance(prediction, MotionOutput)
    np.testing.assert_array_equal(prediction.instances, maps)  # type: ignore[arg-type]
    with np.load(tmp_path / "m" / "shards" / "00000.npz") as file:
        assert file[f"{FIRST}/instance"].dtype == dtype
        assert {member.date_time for member in file.zip.infolist()} == {ZIP_DATE}
    results.check()


def test_heads_on_request(tmp_path: Path) -> None:
    output = make_heads_output(3)
    results = write_results(
        tmp_path / "motion", "motion", {FIRST: output}, store="heads", labels=None
    )
    prediction = results.prediction(FIRST)
    assert isinstance(prediction, MotionOutput)
    assert prediction.heads
    assert output.heads
    for heads, expected in zip(prediction.heads, output.heads, strict=True):
        for name in ("segmentation", "centerness", "offset", "flow"):
            np.testing.assert_array_equal(getattr(heads, name), getattr(expected, name))
    results.check()


def test_paths_in_earlier_files_are_not_read(tmp_path: Path) -> None:
    folder = handwritten.write_motion(tmp_path / "b")
    arrays = {
        "instance": INSTANCES,
        "trajectory_id": np.array([1, 7]),
        "trajectory": np.zeros((2, 3, 2)),
    }
    handwritten.write_shard(
        folder / "shards" / "00000.npz",
        {FIRST: arrays, SECOND: arrays},
    )
    handwritten.refresh_shard_entry(folder)
    read_results(folder).check()


def test_shards_of_64_samples(tmp_path: Path) -> None:
    tokens = [f"a/b/ego_vehicle/{number:03d}" for number in range(130)]
    results = write_results(
        tmp_path / "m",
        "motion",
        dict.fromkeys(tokens, instances_of(INSTANCES, GRID)),
    )
    manifest = handwritten.read_json(tmp_path / "m" / "results.json")
    assert [len(shard["tokens"]) for shard in manifest["shards"]] == [64, 64, 2]
    assert len(list((tmp_path / "m" / "shards").iterdir())) == 3
    results.check()
    assert results.tokens == tuple(tokens)


@pytest.mark.parametrize(
    ("output", "words"),
    [
        (make_heads_output(orientation="fiery"), "expected a prediction on BevGrid"),
        (
            make_heads_output(grid=BevGrid((-2.0, 2.0, 0.25), GRID.y)),
            "expected a prediction on BevGrid",
        ),
        (
            instances_of(INSTANCES, GRID),
            "expected heads, found instance maps",
        ),
        (
            MotionOutput(grid=GRID, heads=(make_label_heads(ignore_index=255),)),
            "found heads made from labels, which contain values to ignore",
        ),
        (
            MotionOutput(grid=GRID, heads=(make_label_heads(frames=2),)),
            "expected 3 frames, as in earlier samples, found",
        ),
    ],
)
def test_predictions_of_different_forms_are_refused(
    tmp_path: Path, output: MotionOutput, words: str
) -> None:
    with ResultsWriter(tmp_path / "m", "motion", store="heads") as writer:
        writer.add(FIRST, make_heads_output())
        assert_raises(
            (lambda: writer.add(SECOND, output), ResultsError, f"m: {SECOND}: .*{words}"),
        )
    assert read_results(tmp_path / "m").tokens == (FIRST,)


def test_predictions_on_another_grid_are_refused(tmp_path: Path) -> None:
    with ResultsWriter(tmp_path / "m", "motion", grid=LARGE_GRID) as writer:
        assert_raises(
            (
                lambda: writer.add(FIRST, make_heads_output()),
                ResultsError,
                "expected a prediction on BevGrid",
            ),
        )
        writer.add(FIRST, instances_of(np.zeros((1, 2, 200, 200)), LARGE_GRID))


def test_negative_ids_are_refused(tmp_path: Path) -> None:
    negative = instances_of(-INSTANCES.astype(int), GRID)
    with ResultsWriter(tmp_path / "m", "motion") as writer:
        assert_raises(
            (
                lambda: writer.add(FIRST, negative),
                ResultsError,
                "instances: expected ids from 1, and 0 elsewhere, found -7",
            ),
        )
        writer.add(FIRST, make_heads_output())
