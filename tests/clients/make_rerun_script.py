"""Make the input of `rerun_script.py`: `python -m tests.clients.make_rerun_script FOLDER`.

FOLDER gets a small release, `plans.mcap` with a plan for each of three frames, its script for
rerun, and `expected.json`: the waypoints of each frame's plan in the world.
"""

import json
import sys
from pathlib import Path

import numpy as np

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import Plan
from deepaccident_devkit.export.mcap import export_mcap
from deepaccident_devkit.plugins.synth import SynthConfig, make_release

FRAMES = (1, 2, 3)
# Height of drawn paths above the ground.
HEIGHT_M = 0.1


def main(folder: Path) -> None:
    config = SynthConfig(scenarios=1, frames=12, seed=3, unplanned=0, designed=True, sensors=False)
    dataset = DeepAccident("v1", make_release(folder / "release", config), verbose=False)
    scenario = dataset.scenario[0]["token"]
    times = np.arange(1, 7) * 0.5
    plans = {}
    waypoints = []
    for number in FRAMES:
        sample = f"{scenario}/ego_vehicle/{number:03d}"
        # the plans leave the road, so no other path is near
        path = np.column_stack([(3 + number) * times, number * times**2])
        plans[sample] = [Plan(times=times, path=path)]
        points = np.column_stack([path, np.full(len(path), HEIGHT_M)])
        waypoints.append(dataset.world_from(sample, "ego").apply(points).tolist())
    choices = {"agents": ["ego_vehicle"], "channels": [], "frames": FRAMES}
    export_mcap(dataset, scenario, folder / "plans.mcap", prediction=plans, **choices)
    (folder / "expected.json").write_text(json.dumps(waypoints))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
