"""Open exported clips with lerobot 0.6: `python tests/clients/lerobot_clips.py FOLDER`, in an
environment without the devkit.

FOLDER is the output of `make_lerobot_clips.py`. Videos are decoded by PyAV, because torchcodec
needs a system-wide FFmpeg.
"""

import json
import math
import os
import sys
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

_CACHE = tempfile.TemporaryDirectory()
os.environ.update(HF_HOME=_CACHE.name, HF_HUB_OFFLINE="1", HF_DATASETS_DISABLE_PROGRESS_BARS="1")

import numpy as np  # noqa: E402 - lerobot reads the variables once
import torch  # noqa: E402
from lerobot.datasets.lerobot_dataset import LeRobotDataset  # noqa: E402
from PIL import Image  # noqa: E402

MIN_PSNR_DB = 30.0
"""Smallest similarity of a decoded picture and its source."""
MIN_DIFFERENCE_DB = 30.0
"""Sources that are less similar than this must be told apart in the clips."""


def main(folder: Path) -> None:
    expected = json.loads((folder / "expected.json").read_text())
    dataset = open_clips(folder)
    described = check_episodes(dataset, expected)
    check_features(dataset, expected)
    worst = min(check_frames(dataset, expected, described, folder), key=float)
    chosen = [1, dataset.num_episodes - 1]
    check_chosen(folder, expected, described, chosen)
    check_batches(dataset)
    print(
        f"lerobot: {dataset.num_episodes} episodes, {dataset.num_frames} frames with all columns, "
        f"pictures of {len(expected['channels'])} cameras in place (worst {worst:.1f} dB), also "
        f"of the chosen episodes {chosen}: good"
    )


def open_clips(folder: Path, **options: Any) -> LeRobotDataset:
    root = folder / "clips"
    return LeRobotDataset("deepaccident/clips", root=root, video_backend="pyav", **options)


def check_episodes(dataset: LeRobotDataset, expected: dict[str, Any]) -> list[dict[str, Any]]:
    """Check the table of episodes; return the expected episodes in its order."""
    by_agent = {
        (facts["episode"]["scenario"], facts["episode"]["agent"]): facts
        for facts in expected["episodes"]
    }
    assert dataset.num_episodes == len(by_agent)
    assert dataset.fps == 10
    described = []
    first_frame = 0
    for number, episode in enumerate(dataset.meta.episodes):
        facts = by_agent.pop((episode["scenario"], episode["agent"]))
        length = len(facts["rows"]["token"])
        assert episode["episode_index"] == number
        assert episode["length"] == length
        assert episode["dataset_from_index"] == first_frame
        assert {name: episode[name] for name in facts["episode"]} == facts["episode"]
        for channel, camera in facts["cameras"].items():
            for name, matrix in camera.items():
                assert np.allclose(episode[f"{name}.{channel}"], matrix, atol=1e-6)
        described.append(facts)
        first_frame += length
    assert not by_agent
    assert dataset.num_frames == first_frame
    check_splits(dataset, described)
    return described


def check_splits(dataset: LeRobotDataset, described: Sequence[dict[str, Any]]) -> None:
    """Check that the ranges of the splits are those of the episodes, and hold whole groups."""
    groups: dict[str, set[str]] = {}
    splits = dataset.meta.info.splits
    for split, text in splits.items():
        start, stop = map(int, text.split(":"))
        assert {facts["episode"]["split"] for facts in described[start:stop]} == {split}
        groups[split] = {facts["episode"]["group"] for facts in described[start:stop]}
    assert sum(map(len, groups.values())) == len(set().union(*groups.values()))
    assert set(splits) == {facts["episode"]["split"] for facts in described}


def check_features(dataset: LeRobotDataset, expected: dict[str, Any]) -> None:
    for name, shape in expected["columns"].items():
        assert list(dataset.features[name]["shape"]) == shape
    width, height = expected["clip_size"]
    assert sorted(dataset.meta.video_keys) == sorted(map(video_key, expected["channels"]))
    for key in dataset.meta.video_keys:
        assert list(dataset.features[key]["shape"]) == [height, width, 3]
    for name, feature in dataset.features.items():
        if feature["dtype"] != "string":
            statistics = dataset.meta.stats[name]
            assert np.isfinite(statistics["mean"]).all()
            assert (statistics["min"] <= statistics["max"]).all()


def video_key(channel: str) -> str:
    return f"observation.images.{channel}"


def check_frames(
    dataset: LeRobotDataset,
    expected: dict[str, Any],
    described: Sequence[dict[str, Any]],
    folder: Path,
) -> list[float]:
    """Check every frame of the episodes; return the similarities of the pictures in dB."""
    similarities = []
    position = 0
    for facts in described:
        for frame in range(len(facts["rows"]["token"])):
            item = dataset[position]
            check_row(item, facts, expected["columns"], frame)
            for channel in expected["channels"]:
                picture = item[video_key(channel)].numpy().transpose(1, 2, 0) * 255
                paths = [folder / "release" / path for path in facts["pictures"][channel]]
                similarities.append(check_picture(picture, paths, frame, expected["clip_size"]))
            position += 1
    assert position == len(dataset)
    assert min(similarities) > MIN_PSNR_DB, min(similarities)
    return similarities


def check_row(
    item: dict[str, Any], facts: dict[str, Any], columns: dict[str, Any], frame: int
) -> None:
    """Compare the columns of a frame; NaN equals NaN."""
    for name in columns:
        value = item[name]
        truth = facts["rows"][name][frame]
        if isinstance(truth, str):
            assert value == truth, (name, value, truth)
        else:
            assert torch.equal(value.isnan(), torch.tensor(truth).isnan()), (name, value, truth)
            assert np.allclose(value.numpy(), truth, atol=1e-6, equal_nan=True), (name, value)
    assert math.isclose(item["timestamp"].item(), frame / 10, abs_tol=1e-6)
    assert item["frame_index"].item() == frame
    assert isinstance(item["task"], str)
    assert item["task"]


def check_picture(
    picture: np.ndarray, paths: Sequence[Path], frame: int, size: Sequence[int]
) -> float:
    """Return the similarity to the source, which must be larger than to its neighbours.

    Neighbours that look like the source do not count.
    """
    source = read_source(paths[frame], *size)
    similarity = compute_psnr(picture, source)
    for neighbour in (frame - 1, frame + 1):
        if 0 <= neighbour < len(paths):
            other = read_source(paths[neighbour], *size)
            if compute_psnr(other, source) < MIN_DIFFERENCE_DB:
                assert compute_psnr(picture, other) < similarity, paths[frame]
    return similarity


@cache
def read_source(path: Path, width: int, height: int) -> np.ndarray:
    """Read an image, resampled by area."""
    with Image.open(path) as image:
        resized = image.convert("RGB").resize((width, height), Image.Resampling.BOX)
    return np.asarray(resized, dtype=np.float64)


def compute_psnr(picture: np.ndarray, other: np.ndarray) -> float:
    """Return the peak signal-to-noise ratio of two pictures in dB."""
    error = np.mean((picture - other) ** 2)
    return float(20 * np.log10(255) - 10 * np.log10(max(error, 1e-9)))


def check_chosen(
    folder: Path,
    expected: dict[str, Any],
    described: Sequence[dict[str, Any]],
    chosen: Sequence[int],
) -> None:
    """Check a dataset of some episodes."""
    dataset = open_clips(folder, episodes=list(chosen))
    assert dataset.num_episodes == len(chosen)
    check_frames(dataset, expected, [described[number] for number in chosen], folder)


def check_batches(dataset: LeRobotDataset) -> None:
    """Check that a data loader collates the frames."""
    loader = torch.utils.data.DataLoader(dataset, batch_size=8, shuffle=True)
    batch = next(iter(loader))
    assert batch["observation.state"].shape == (8, 4)
    assert batch["action"].shape == (8, 3)
    assert len(batch["token"]) == 8


if __name__ == "__main__":
    main(Path(sys.argv[1]))
