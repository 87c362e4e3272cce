"""Make the input of `argoverse.py`: `python -m tests.clients.make_argoverse FOLDER`.

FOLDER gets a small release, its export, and `expected.json`: our window of each sample.
"""

import json
import sys
from pathlib import Path
from typing import Any

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.export.av2 import Av2
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.plugins.synth import SynthConfig, make_release

AGENTS = ("ego_vehicle", "other_vehicle", "infrastructure")


def main(folder: Path) -> None:
    config = SynthConfig(scenarios=1, frames=32, seed=3, unplanned=0, designed=True, sensors=False)
    dataset = DeepAccident("v1", make_release(folder / "release", config), verbose=False)
    export_release(dataset, folder / "export", Av2(agents=AGENTS, past=2.0, future=3.0, every=0.7))
    windows = {}
    for path in sorted((folder / "export").rglob("*.parquet")):
        scenario, agent, number = path.relative_to(folder / "export").parts[:3]
        windows[str(path)] = describe_window(
            dataset, f"{scenario.replace('__', '/')}/{agent}/{number}"
        )
    (folder / "expected.json").write_text(json.dumps(windows))


def describe_window(dataset: DeepAccident, sample: str) -> dict[str, Any]:
    """Return what av2 should read: the valid states of each track, by its id."""
    window = dataset.window(sample, 2.0, 3.0, frame="world")
    tracks = {}
    for row, actor in enumerate(window.actor_id.tolist()):
        states = []
        for step in window.valid[row].nonzero()[0].tolist():
            x, y, _ = window.center[row, step].tolist()
            velocity = window.velocity[row, step, :2].tolist()
            states.append([step, x, y, window.yaw.item(row, step), *velocity])
        tracks[str(actor)] = states
    return {
        "sample": sample,
        "focal": str(window.own_actor_id),
        "steps": len(window.time),
        "tracks": tracks,
    }


if __name__ == "__main__":
    main(Path(sys.argv[1]))
