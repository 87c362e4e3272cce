"""Make the input of `lerobot_clips.py`: `python -m tests.clients.make_lerobot_clips FOLDER`.

FOLDER gets a small release, its clips at half the size in `clips`, and `expected.json`: the rows,
the pictures and the cameras of every episode. One agent lacks an image, so that it has no clip.
"""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.export.clip_rows import CLIP_COLUMNS, clip_rows
from deepaccident_devkit.plugins.synth import SynthConfig, make_release

CHANNELS = ("Camera_Front", "Camera_BackLeft")
IMAGE_SIZE = (128, 72)
CLIP_SIZE = (64, 36)


def main(folder: Path) -> None:
    config = SynthConfig(
        scenarios=8,
        frames=13,
        image_size=IMAGE_SIZE,
        sensors="cameras",
        seed=3,
        unplanned=0,
        unlabelled_test=True,
        designed=True,
    )
    dataset = DeepAccident("v1", make_release(folder / "release", config), verbose=False)
    incomplete = dataset.agent[1]
    sample = f"{incomplete['token']}/007"
    dataset.get_sample_data_path(sample, "Camera_Front").unlink()
    words = ["export", "clips", folder / "release", "--out", folder / "clips"]
    words += ["--channels", ",".join(CHANNELS), "--size", "{}x{}".format(*CLIP_SIZE)]
    words += ["--quality", 12]
    command = [sys.executable, "-m", "deepaccident_devkit", *map(str, words)]
    subprocess.run(command, check=True)
    episodes = [
        describe_episode(dataset, record["token"])
        for record in dataset.agent
        if record["token"] != incomplete["token"]
    ]
    columns = {name: list(column.shape) for name, column in CLIP_COLUMNS.items()}
    expected = {
        "columns": columns,
        "channels": CHANNELS,
        "clip_size": CLIP_SIZE,
        "episodes": episodes,
    }
    (folder / "expected.json").write_text(json.dumps(expected))


def describe_episode(dataset: DeepAccident, agent: str) -> dict[str, Any]:
    """Describe what the client must read of an agent; paths are relative to the release."""
    rows = clip_rows(dataset, agent)
    pictures: dict[str, list[str]] = {}
    cameras = {}
    for channel in CHANNELS:
        pictures[channel] = []
        for token in rows.columns["token"].tolist():
            path = dataset.get_sample_data_path(token, channel)
            pictures[channel].append(str(path.relative_to(dataset.dataroot)))
        sample = dataset.agent.get(agent)["first_sample_token"]
        scale = np.diag([*np.divide(CLIP_SIZE, IMAGE_SIZE), 1.0])
        cameras[channel] = {
            "intrinsic": (scale @ dataset.camera(sample, channel).intrinsic).tolist(),
            "ego_from_camera": dataset.ego_from(sample, channel).matrix.tolist(),
        }
    return {
        "episode": {**rows.episode, "split": rows.episode["split"] or "unknown"},
        "rows": {name: values.tolist() for name, values in rows.columns.items()},
        "pictures": pictures,
        "cameras": cameras,
    }


if __name__ == "__main__":
    main(Path(sys.argv[1]))
