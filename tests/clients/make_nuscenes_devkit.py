"""Make the input of `nuscenes_devkit.py`: `python -m tests.clients.make_nuscenes_devkit FOLDER`.

FOLDER gets a small release, its export, `expected.json`: our boxes in every sensor's frame at
keyframes, and in the world at all frames, `windows.json`: our windows of tracks at keyframes, and
`plans.json`: a plan of the ego from each last frame, in the world and drawn in cameras.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import Plan
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.export.frames import keyframes
from deepaccident_devkit.export.nuscenes import NuScenes
from deepaccident_devkit.export.nuscenes.scenes import CHANNEL_NAMES
from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.render import detached_figure
from deepaccident_devkit.render.outcomes import render_outcome_in_cameras
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID

AGENTS = ("ego_vehicle", "infrastructure")
# Cameras in the order of their panels.
PANELS = (
    "Camera_FrontLeft",
    "Camera_Front",
    "Camera_FrontRight",
    "Camera_BackLeft",
    "Camera_Back",
    "Camera_BackRight",
)
# A plan around an agent, x forward and y left, metres.
PATH = np.array([[12, 0], [9, 8], [0, 12], [-9, 8], [-12, 0], [-9, -8], [0, -12], [9, -8]])


def main(folder: Path) -> None:
    config = SynthConfig(
        scenarios=2, frames=32, image_size=(320, 180), seed=3, unplanned=0, designed=True
    )
    dataset = DeepAccident("v1", make_release(folder / "release", config), verbose=False)
    export_release(dataset, folder / "export", NuScenes(agents=AGENTS))
    boxes = {}
    windows = {}
    plans = {}
    for record in dataset.sample:
        if record["agent"] in AGENTS:
            boxes[record["token"]] = list_boxes(dataset, record["token"])
            windows[record["token"]] = list_states(dataset, record["token"])
            if record["agent"] == "ego_vehicle" and not record["next"]:
                plans[record["token"]] = draw_plan(dataset, record["token"])
    (folder / "expected.json").write_text(json.dumps(boxes))
    (folder / "windows.json").write_text(json.dumps(windows))
    (folder / "plans.json").write_text(json.dumps(plans))


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


def list_states(dataset: DeepAccident, sample: str) -> dict[str, Any]:
    """List the valid states of each actor but the agent's own vehicle as [step of 0.5 s, x, y, x in
    the actor's frame, y in that frame], by actor id.
    """
    times = {"past": 2.0, "future": 3.0, "step": 0.5}
    in_world, in_actor = (
        dataset.window(sample, **times, agents="single", frame=frame)
        for frame in ("world", "actor")
    )
    states_by_actor = {}
    for row, actor in enumerate(in_world.actor_id.tolist()):
        if actor != in_world.own_actor_id:
            steps = np.flatnonzero(in_world.valid[row])
            columns = [
                steps - in_world.present,
                in_world.center[row, steps, :2],
                in_actor.center[row, steps, :2],
            ]
            states_by_actor[actor] = np.column_stack(columns).tolist()
    return states_by_actor


def draw_plan(dataset: DeepAccident, sample: str) -> dict[str, Any]:
    """Return `PATH` in the world, and by camera the positions of drawn lines, as shares of the
    image's width.
    """
    plan = Plan(times=0.5 * np.arange(1, 1 + len(PATH)), path=PATH)
    figure = render_outcome_in_cameras(dataset, sample, [plan], fig=detached_figure((10, 6)))
    positions = {}
    for name, ax in zip(PANELS, figure.axes, strict=False):
        lines = [np.zeros((0, 2))]
        for collection in ax.collections:
            if isinstance(collection, LineCollection):
                lines += collection.get_segments()
        width = dataset.camera(sample, name).width
        positions[CHANNEL_NAMES[name]] = (np.concatenate(lines) / width).tolist()
    points = np.column_stack([PATH, np.zeros(len(PATH))])
    in_world = dataset.world_from(sample, "ego").apply(points)
    return {"points": in_world.tolist(), "drawn": positions}


if __name__ == "__main__":
    main(Path(sys.argv[1]))
