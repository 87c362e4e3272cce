"""Make the input of `nuscenes_devkit.py`: `python -m tests.clients.make_nuscenes_devkit FOLDER`.

FOLDER gets a small release, its export, and `expected.json`: our boxes in every sensor's frame at
keyframes, and in the world at all frames.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.export.frames import keyframes
from deepaccident_devkit.export.nuscenes import NuScenes
from deepaccident_devkit.export.nuscenes.scenes import CHANNEL_NAMES
from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID

AGENTS = ("ego_vehicle", "infrastructure")


def main(folder: Path) -> None:
    config = SynthConfig(
        scenarios=2, frames=32, image_size=(320, 180), seed=3, unplanned=0, designed=True
    )
    dataset = DeepAccident("v1", make_release(folder / "release", config), verbose=False)
    export_release(dataset, folder / "export", NuScenes(agents=AGENTS))
    boxes = {}
    for record in dataset.sample:
        if record["agent"] in AGENTS:
            boxes[record["token"]] = list_boxes(dataset, record["token"])
    (folder / "expected.json").write_text(json.dumps(boxes))


def list_boxes(dataset: DeepAccident, sample: str) -> dict[str, Any]:
    """List boxes as [actor, x, y, z, width, length, height, and w, x, y, z of the quaternion], by
    nuScenes' channel and for `world`.
    """
    scenario = dataset.scenario.get(dataset.sample.get(sample)["scenario_token"])
    frames = {"world": "world"}
    if int(sample[-3:]) in keyframes(scenario["num_frames"]):
        frames |= {name: channel for channel, name in CHANNEL_NAMES.items()}
    boxes_by_frame = {}
    for name, frame in frames.items():
        boxes = dataset.boxes(sample, frame)
        boxes = boxes.select(boxes.actor_id != OWN_ACTOR_ID)
        columns = [
            boxes.actor_id,
            boxes.center,
            boxes.size[:, [1, 0, 2]],
            boxes.rotation,
        ]
        boxes_by_frame[name] = np.column_stack(columns).tolist()
    return boxes_by_frame


if __name__ == "__main__":
    main(Path(sys.argv[1]))
