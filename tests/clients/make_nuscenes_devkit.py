"""Make what `nuscenes_devkit.py` opens: `python -m tests.clients.make_nuscenes_devkit FOLDER`.

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
    content = {
        record["token"]: boxes_of(dataset, record["token"])
        for record in dataset.sample
        if record["agent"] in AGENTS
    }
    (folder / "expected.json").write_text(json.dumps(content))


def boxes_of(dataset: DeepAccident, sample: str) -> dict[str, Any]:
    """nuScenes' channel, or `world` → [actor, x, y, z, width, length, height, w, x, y, z of the
    quaternion] a box.
    """
    last = dataset.scenario.get(dataset.sample.get(sample)["scenario_token"])["num_frames"]
    frames = {"world": "world"}
    if int(sample[-3:]) in keyframes(last):
        frames |= {name: channel for channel, name in CHANNEL_NAMES.items()}
    result = {}
    for name, frame in frames.items():
        boxes = dataset.boxes(sample, frame)
        columns = [boxes.actor_id, boxes.center, boxes.size[:, [1, 0, 2]], boxes.rotation]
        result[name] = np.column_stack(columns)[boxes.actor_id != OWN_ACTOR_ID].tolist()
    return result


if __name__ == "__main__":
    main(Path(sys.argv[1]))
