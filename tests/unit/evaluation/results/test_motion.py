"""What is written is what is read, in the form that the page says, and small."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import plain_results as plain
import pytest
from refusals import assert_refused

from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.evaluation import MotionOutput, instances_of
from deepaccident_devkit.evaluation.results import MotionForm, Results, ResultsWriter, read_results
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import MotionHeads, predict_instances

FIRST, SECOND, THIRD = plain.TOKENS
GRID = BevGrid((-2.0, 2.0, 0.5), (-1.5, 1.5, 0.5))
LARGE = BevGrid()
FIRST_DATE = {(1980, 1, 1, 0, 0, 0)}
"""Of all files: so that the same predictions are the same bytes."""


def written(path: Path, task: Any, predictions: dict[str, Any], **options: Any) -> Results:
    with ResultsWriter(path, task, **options) as writer:
        for token, prediction in predictions.items():
            writer.add(token, prediction)
    return read_results(path)


def heads(
    seed: int = 0, count: int = 2, orientation: Any = "devkit", grid: BevGrid = GRID
) -> MotionOutput:
    source, laid = np.random.default_rng(seed), grid.with_orientation(orientation)
    maps = [
        source.normal(size=(count, 3, channels, *laid.shape)).astype(np.float32)
        for channels in (2, 1, 2, 2)
    ]
    return MotionOutput.from_arrays(*maps, grid=laid)


def labelled(ignore: int | None = None, frames: int = 3) -> MotionHeads:
    maps = [np.ones((frames, channels, *GRID.shape), dtype=np.float32) for channels in (2, 1, 2, 2)]
    return MotionHeads.from_arrays(*maps, ignore_index=ignore)


@pytest.mark.parametrize("orientation", ["devkit", "released", "fiery"])
def test_of_heads_their_instances_are_stored(tmp_path: Path, orientation: Any) -> None:
    outputs = {FIRST: heads(1, 2, orientation), SECOND: heads(2, 1, orientation)}
    results = written(tmp_path / "motion", "motion", outputs, step=0.3, labels="clean")
    assert results.form == MotionForm(
        stored="instances",
        grid=GRID.with_orientation(orientation),
        predictions=2,
        frames=3,
        step=0.3,
        labels="clean",
    )
    for token, output in outputs.items():
        linked = [predict_instances(each, "motion") for each in output.heads or ()]
        read = results.prediction(token)
        assert isinstance(read, MotionOutput)
        np.testing.assert_array_equal(read.instances, [each.instance for each in linked])  # type: ignore[arg-type]
        assert read.grid == output.grid
    results.check()


@pytest.mark.parametrize(
    ("highest", "dtype"), [(255, "u1"), (256, "u2"), (65535, "u2"), (65536, "i4")]
)
def test_instance_maps_are_stored_as_given(tmp_path: Path, highest: int, dtype: str) -> None:
    maps = plain.instance_arrays()["instance"].astype(np.int32)
    maps[maps == 7] = highest
    maps[-1, 2] = 0  # both instances are gone in the last frame
    results = written(tmp_path / "m", "motion", {FIRST: instances_of(maps, GRID)})
    read = results.prediction(FIRST)
    assert isinstance(read, MotionOutput)
    np.testing.assert_array_equal(read.instances, maps)  # type: ignore[arg-type]
    with np.load(tmp_path / "m" / "shards" / "00000.npz") as file:
        assert (
            file[f"{FIRST}/instance"].dtype,
            {entry.date_time for entry in file.zip.infolist()},
        ) == (
            dtype,
            FIRST_DATE,
        )
    results.check()


def test_heads_on_request(tmp_path: Path) -> None:
    output = heads(3)
    results = written(tmp_path / "motion", "motion", {FIRST: output}, store="heads", labels=None)
    read = results.prediction(FIRST)
    assert isinstance(read, MotionOutput)
    assert read.heads
    assert output.heads
    for one, other in zip(read.heads, output.heads, strict=True):
        for name in ("segmentation", "centerness", "offset", "flow"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    results.check()


def test_paths_that_earlier_files_have_are_not_read(tmp_path: Path) -> None:
    folder = plain.write_motion(tmp_path / "b")
    paths = {"trajectory_id": np.array([1, 7]), "trajectory": np.zeros((2, 3, 2))}
    plain.write_shard(
        folder / "shards" / "00000.npz",
        {token: plain.instance_arrays() | paths for token in (FIRST, SECOND)},
    )
    plain.relist(folder)
    read_results(folder).check()


def test_shards_of_64_samples(tmp_path: Path) -> None:
    maps = instances_of(plain.instance_arrays()["instance"], GRID)
    tokens = [f"a/b/ego_vehicle/{number:03d}" for number in range(130)]
    results = written(tmp_path / "m", "motion", dict.fromkeys(tokens, maps))
    told = json.loads((tmp_path / "m" / "results.json").read_text(encoding="utf-8"))
    assert [len(shard["tokens"]) for shard in told["shards"]] == [64, 64, 2]
    assert len(list((tmp_path / "m" / "shards").iterdir())) == 3
    results.check()
    assert results.tokens == tuple(tokens)


@pytest.mark.parametrize(
    ("output", "words"),
    [
        (heads(orientation="fiery"), "expected a prediction on BevGrid"),
        (heads(grid=BevGrid((-2.0, 2.0, 0.25), GRID.y)), "expected a prediction on BevGrid"),
        (
            instances_of(plain.instance_arrays()["instance"], GRID),
            "expected heads, found instance maps",
        ),
        (
            MotionOutput(grid=GRID, heads=(labelled(ignore=255),)),
            "found those of labels, which hold values to",
        ),
        (
            MotionOutput(grid=GRID, heads=(labelled(frames=2),)),
            "expected 3 frames as of the samples before, found",
        ),
    ],
)
def test_predictions_that_do_not_go_together(
    tmp_path: Path, output: MotionOutput, words: str
) -> None:
    with ResultsWriter(tmp_path / "m", "motion", store="heads") as writer:
        writer.add(FIRST, heads())
        assert_refused(
            (lambda: writer.add(SECOND, output), ResultsError, f"m: {SECOND}: .*{words}"),
        )
    assert read_results(tmp_path / "m").tokens == (FIRST,)


def test_the_grid_that_was_asked_for(tmp_path: Path) -> None:
    with ResultsWriter(tmp_path / "m", "motion", grid=LARGE) as writer:
        assert_refused(
            (lambda: writer.add(FIRST, heads()), ResultsError, "expected a prediction on BevGrid"),
        )
        writer.add(FIRST, instances_of(np.zeros((1, 2, 200, 200)), LARGE))


def test_negative_ids(tmp_path: Path) -> None:
    with ResultsWriter(tmp_path / "m", "motion") as writer:
        assert_refused(
            (
                lambda: writer.add(
                    FIRST, instances_of(-plain.instance_arrays()["instance"].astype(int), GRID)
                ),
                ResultsError,
                "instances: expected ids from 1, and 0 elsewhere, found -7",
            ),
        )
        writer.add(FIRST, heads())
