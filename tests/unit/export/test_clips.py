"""Clips hold the frames of recordings exactly, with a row for each, in the layout of LeRobot."""

import csv
import json
import math
import shutil
import sys
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow.parquet as pq
import pytest
from support.command_calls import invoke_command
from support.expected_errors import assert_raises
from support.zipped_releases import zip_release

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import (
    ChoiceError,
    ConfigError,
    ExportError,
    MissingExtraError,
    NotAvailableError,
    SomeFailedError,
)
from deepaccident_devkit.export.bulk import Exported, export_release
from deepaccident_devkit.export.clip_rows import CLIP_COLUMNS, clip_cameras, clip_rows
from deepaccident_devkit.export.clips import KEYFRAME_STEP, Clips
from deepaccident_devkit.release.images import write_image
from deepaccident_devkit.testing import SmallRelease, write_small_release

FRAMES = 23
SIZE = (96, 54)
CAMERAS = ("Camera_Front", "Camera_Back")


def make_picture(number: int, offset: int = 0) -> np.ndarray[Any, Any]:
    """Draw a picture whose brightness names the frame."""
    picture = np.full((SIZE[1], SIZE[0], 3), 40 + 8 * number, np.uint8)
    picture[:, : SIZE[0] // 2] = offset
    return picture


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A release of an accident, its twin and another accident; frames differ in brightness."""
    root = tmp_path_factory.mktemp("clips") / "release"
    content = SmallRelease(
        splits=("val", "train"),
        agents=("ego_vehicle", "infrastructure"),
        channels=CAMERAS,
        frames=FRAMES,
        image_size=SIZE,
    )
    write_small_release(root, content)
    for path in root.rglob("Camera_*/*/*.jpg"):
        offset = 100 if "Camera_Back" in path.parts else 0
        write_image(path, make_picture(int(path.stem.rsplit("_", 1)[1]), offset))
    DeepAccident(dataroot=root, verbose=False)
    return root


@pytest.fixture
def dataset(root: Path) -> DeepAccident:
    return DeepAccident(dataroot=root, verbose=False)


@pytest.fixture
def changing(root: Path, tmp_path: Path) -> Path:
    """A copy of the release that a test may change."""
    return shutil.copytree(root, tmp_path / "changing")


def export(dataset: DeepAccident, out: Path, **options: Any) -> Exported:
    return export_release(dataset, out, Clips(**options), workers=1)


def read_episodes(out: Path) -> list[dict[str, Any]]:
    return list(pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist())


def read_rows(out: Path) -> list[dict[str, Any]]:
    return list(pq.read_table(out / "data/chunk-000/file-000.parquet").to_pylist())


def read_info(out: Path) -> Any:
    return json.loads((out / "meta/info.json").read_text(encoding="utf-8"))


def find_video(out: Path, episode: dict[str, Any], channel: str) -> Path:
    """Return the path that LeRobot makes from info.json and the table of episodes."""
    key = f"observation.images.{channel}"
    numbers = {name: episode[f"videos/{key}/{name}"] for name in ("chunk_index", "file_index")}
    path = out / read_info(out)["video_path"].format(video_key=key, **numbers)
    assert path == out / episode[f"video.{channel}"]
    return path


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_picture_n_is_frame_n_with_a_keyframe_every_ten(
    dataset: DeepAccident, tmp_path: Path
) -> None:
    export(dataset, tmp_path, cameras=CAMERAS)

    episodes = read_episodes(tmp_path)
    assert len(episodes) == 6
    for episode in episodes:
        for channel, offset in (("Camera_Front", 0), ("Camera_Back", 100)):
            with av.open(str(find_video(tmp_path, episode, channel))) as video:
                stream = video.streams.video[0]
                assert stream.average_rate == 10
                pictures = list(video.decode(stream))
            assert len(pictures) == FRAMES
            for number, picture in enumerate(pictures):
                assert picture.time == pytest.approx(number / 10)
                assert picture.key_frame == (number % KEYFRAME_STEP == 0)
                pixels = picture.to_ndarray(format="rgb24").astype(int)
                assert pixels.shape == (SIZE[1], SIZE[0], 3)
                expected = make_picture(number + 1, offset).astype(int)
                assert abs(pixels - expected).mean() < 3


def test_rows_are_those_of_each_recording_in_the_order_of_splits(
    dataset: DeepAccident, tmp_path: Path
) -> None:
    export(dataset, tmp_path, cameras=CAMERAS, size=(32, 18))

    rows = read_rows(tmp_path)
    episodes = read_episodes(tmp_path)
    info = read_info(tmp_path)
    assert info["splits"] == {"train": "0:4", "val": "4:6"}
    assert (info["total_frames"], info["total_episodes"]) == (len(rows), len(episodes))
    assert [row["index"] for row in rows] == list(range(len(rows)))
    assert info["features"].keys() - rows[0].keys() == {
        f"observation.images.{channel}" for channel in CAMERAS
    }
    for number, episode in enumerate(episodes):
        own_rows = rows[episode["dataset_from_index"] : episode["dataset_to_index"]]
        token = f"{episode['scenario']}/{episode['agent']}"
        expected = clip_rows(dataset, token)
        assert {row["episode_index"] for row in own_rows} == {number}
        assert [row["frame_index"] for row in own_rows] == list(range(FRAMES))
        assert {row["split"] for row in own_rows} == {episode["split"]}
        for name in CLIP_COLUMNS:
            values = np.array([row[name] for row in own_rows], expected.columns[name].dtype)
            np.testing.assert_array_equal(values, expected.columns[name])
        cameras = clip_cameras(dataset, token, CAMERAS, (32, 18))
        for name, matrix in cameras.items():
            np.testing.assert_array_equal(np.array(episode[name]), matrix)


def test_csv_has_the_values_of_parquet(dataset: DeepAccident, tmp_path: Path) -> None:
    export(dataset, tmp_path)

    features = read_info(tmp_path)["features"]
    with (tmp_path / "frames.csv").open(encoding="utf-8", newline="") as file:
        lines = list(csv.DictReader(file))
    rows = read_rows(tmp_path)
    assert len(lines) == len(rows)
    for line, row in zip(lines, rows, strict=True):
        for name, value in row.items():
            names = features[name]["names"]
            values = value if names else [value]
            columns = [f"{name}.{part}" for part in names] if names else [name]
            for column, entry in zip(columns, values, strict=True):
                text = line[column]
                if isinstance(entry, bool):
                    assert text == str(entry).lower()
                elif isinstance(entry, float) and math.isnan(entry):
                    assert text == "nan"
                elif isinstance(entry, float):
                    assert np.float32(text) == np.float32(entry)
                else:
                    assert text == str(entry)


def test_statistics_leave_out_nan_and_cover_pictures(dataset: DeepAccident, tmp_path: Path) -> None:
    export(dataset, tmp_path)

    text = (tmp_path / "meta/stats.json").read_text(encoding="utf-8")
    statistics = json.loads(text, parse_constant=pytest.fail)
    times = np.array([row["time_to_impact"] for row in read_rows(tmp_path)])
    known = times[~np.isnan(times)]
    assert 0 < len(known) < len(times)
    assert statistics["time_to_impact"]["count"] == [len(known)]
    assert statistics["time_to_impact"]["mean"] == [pytest.approx(known.mean())]
    pixels = np.array([make_picture(number) for number in (1, 11, 21)]) / 255
    pictures = statistics["observation.images.Camera_Front"]
    np.testing.assert_allclose(np.ravel(pictures["mean"]), pixels.mean((0, 1, 2)), atol=0.01)
    np.testing.assert_allclose(np.ravel(pictures["std"]), pixels.std((0, 1, 2)), atol=0.01)
    assert np.shape(pictures["max"]) == (3, 1, 1)


def test_the_text_of_the_task_is_the_index_in_pandas(dataset: DeepAccident, tmp_path: Path) -> None:
    export(dataset, tmp_path, agents=("ego_vehicle",))

    schema = pq.read_schema(tmp_path / "meta/tasks.parquet")
    described = json.loads(schema.metadata[b"pandas"])
    assert described["index_columns"] == ["task"]
    # pandas fails if it finds an index that is not among the columns.
    assert "task" in [column["field_name"] for column in described["columns"]]


def test_a_recording_that_lacks_an_image_is_left_out_and_returns(
    changing: Path, root: Path, tmp_path: Path
) -> None:
    path = next(changing.rglob("infrastructure/Camera_Back/*/*_011.jpg"))
    path.unlink()
    partial = DeepAccident(dataroot=changing, verbose=False)
    exported = export(partial, tmp_path / "out", cameras=CAMERAS)

    assert exported.tally.left_out["recordings that lack images in this release"] == 1
    assert len(read_episodes(tmp_path / "out")) == 5
    shutil.copyfile(root / path.relative_to(changing), path)
    exported = export(partial, tmp_path / "out", cameras=CAMERAS)
    assert (exported.written, exported.kept) == (1, 2)
    whole = DeepAccident(dataroot=root, verbose=False)
    export(whole, tmp_path / "whole", cameras=CAMERAS)
    hidden = (".zip", ".manifest.json")
    for name, content in contents(tmp_path / "whole").items():
        if not name.endswith(hidden):
            assert (tmp_path / "out" / name).read_bytes() == content


def test_images_may_lie_in_archives(root: Path, dataset: DeepAccident, tmp_path: Path) -> None:
    zip_release(root, tmp_path / "zipped/release.zip")
    zipped = DeepAccident(dataroot=tmp_path / "zipped", verbose=False)
    for name, release in (("plain", dataset), ("out", zipped)):
        export(release, tmp_path / name)

    plain, out = contents(tmp_path / "plain"), contents(tmp_path / "out")
    assert {name for name in plain if name.endswith(("mp4", "parquet", "csv"))} <= out.keys()
    assert all(out[name] == plain[name] for name in plain if name.endswith(("mp4", "csv")))


def test_a_split_cannot_leak(changing: Path, tmp_path: Path) -> None:
    dataset = DeepAccident(dataroot=changing, verbose=False)
    export(dataset, tmp_path / "good")
    splits: dict[str, set[str]] = {}
    for episode in read_episodes(tmp_path / "good"):
        splits.setdefault(episode["group"], set()).add(episode["split"])
    assert set(map(len, splits.values())) == {1}

    train, val = changing / "train.txt", changing / "val.txt"
    lines = train.read_text(encoding="utf-8").splitlines(keepends=True)
    train.write_text("".join(lines[:1]), encoding="utf-8")
    val.write_text(val.read_text(encoding="utf-8") + "".join(lines[1:]), encoding="utf-8")
    leaking = DeepAccident(dataroot=changing, verbose=False)
    with pytest.raises(ConfigError, match=r"its twin is in \w+, so .*--split"):
        export(leaking, tmp_path / "leaking")
    own = tmp_path / "mine.txt"
    own.write_text("".join(lines), encoding="utf-8")
    export(leaking, tmp_path / "own", split=str(own))
    assert read_info(tmp_path / "own")["splits"] == {"mine": "0:4"}


def test_bad_input_is_refused_with_a_remedy(
    changing: Path, dataset: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = tmp_path / "full"
    full.mkdir()
    (full / "notes.txt").touch()
    out = tmp_path / "out"
    assert_raises(
        (
            lambda: export(dataset, out, size=(48, 36)),
            ConfigError,
            ("size: images of 96x54 cannot become 48x36", "choose a multiple of 16x9", "96x54"),
        ),
        (lambda: export(dataset, full), ExportError, ("is not empty", "choose a new folder")),
        (lambda: Clips(agents=("me",)), ChoiceError, ("agents: expected one of ego_vehicle",)),
        (
            lambda: export(dataset, out, agents=("other_vehicle",)),
            NotAvailableError,
            ("no chosen agent has all images", "unpack the images"),
        ),
    )
    path = next(changing.rglob("ego_vehicle/Camera_Front/*/*_011.jpg"))
    path.write_bytes(path.read_bytes()[:400])
    damaged = DeepAccident(dataroot=changing, verbose=False)
    with pytest.raises(SomeFailedError, match=r"_011\.jpg: not a readable image"):
        export(damaged, out)
    for path in changing.rglob("Camera_*/*/*.jpg"):
        write_image(path, np.zeros((27, 48, 3), np.uint8))
    with pytest.raises(ConfigError, match="found 48x27; choose another size"):
        export(damaged, tmp_path / "odd")
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(MissingExtraError, match=r"export clips needs PyAV; .*\[video\]"):
        export(dataset, tmp_path / "without")


def test_the_command_writes_what_python_does(root: Path, tmp_path: Path) -> None:
    dataset = DeepAccident(dataroot=root, verbose=False)
    export(dataset, tmp_path / "python", size=(32, 18))
    result = invoke_command(
        *("export", "clips", root, "--out", tmp_path / "command", "--workers", 1),
        *("--channels", "camera_front", "--size", "32x18", "--agents", "ego_vehicle"),
    )

    assert "3 scenarios new" in result.output
    python, command = read_episodes(tmp_path / "python"), read_episodes(tmp_path / "command")
    assert [episode["agent"] for episode in command] == ["ego_vehicle"] * 3
    for episode in command:
        (same,) = [
            other
            for other in python
            if (other["scenario"], other["agent"]) == (episode["scenario"], episode["agent"])
        ]
        paths = [
            find_video(tmp_path / "python", same, "Camera_Front"),
            find_video(tmp_path / "command", episode, "Camera_Front"),
        ]
        assert paths[0].read_bytes() == paths[1].read_bytes()
