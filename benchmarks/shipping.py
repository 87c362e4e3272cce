"""Weights that ship, out of a study: `python -m benchmarks.shipping STUDIES/RECIPE NAME SEED`.

They are rounded to half precision, scored on a small release of a seed of its own, and go to where
the package has
those of their preset. Their notes say how they were made and what they score: `deepaccident
    predict` prints that beside
what it measures, and a test makes the release and scores them again.
"""

import json
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import torch

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.plugins.model import PredictConfig, load_model, read_weights
from deepaccident_devkit.plugins.model.checkpoint import write_weights
from deepaccident_devkit.plugins.model.training_run import one_thread
from deepaccident_devkit.plugins.model.training_step import validated
from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.release.layout import write_split_file
from deepaccident_devkit.selection.samples import samples
from deepaccident_devkit.support.version import __version__

HOMES: Final = Path(__file__).parents[1] / "deepaccident_devkit" / "plugins" / "model"
SCORED: Final[dict[str, Any]] = {
    "agents": "all",
    "synth": {
        "scenarios": 2,
        "frames": 40,
        "image_size": [160, 90],
        "seed": 208,
        "sensor_step": 5,
        "view": "hidden",
        "designs": [1, 2, 6, 7, 12],
    },
}
"""Who cooperates for the scores, and on which release, of other designs than the training's; a test
makes it again.
"""
_NOT_SHIPPED: Final = ("num_batches_tracked", "frustum")


def main(study: Path, name: str, seed: str) -> None:
    """Round, score, and write."""
    told = json.loads((study / "study.json").read_text())
    cells = {(each["kind"], each["name"]): each for each in told["cells"]}
    key = cells["weights", f"{name}, seed {seed}"]["key"]
    given = read_weights(study.parent / "weights" / key)
    tensors = {
        each: tensor for each, tensor in given.tensors.items() if not each.endswith(_NOT_SHIPPED)
    }
    preset, release = given.meta["preset"], told["recipe"]["weights"][name]["release"]
    made = {
        "study": f"deepaccident study {told['recipe']['name']}",
        "weights": name,
        "seed": int(seed),
        "key": key,
        "training": {**given.meta["training"], "split": "all"},
        "release": cells["release", release]["fingerprint"],
        "devkit": __version__,
        "torch": torch.__version__,
    }
    notes = {each: given.meta[each] for each in ("preset", "fusion", "horizon")} | {"made": made}
    path = HOMES / f"{preset}.safetensors"
    write_weights(path, tensors, notes, half=True)
    found = scores(path, SCORED)
    write_weights(path, tensors, {**notes, "scored": {**SCORED, "scores": found}}, half=True)
    print(f"{path}: {path.stat().st_size:,} bytes, {found}")


def scores(path: Path, scored: Mapping[str, Any]) -> dict[str, float]:
    """What weights score with some agents on a release, as `SCORED` says both."""
    with one_thread(), tempfile.TemporaryDirectory() as folder:
        synth = {
            name: tuple(each) if isinstance(each, list) else each
            for name, each in scored["synth"].items()
        }
        release = DeepAccident(
            "v1", make_release(Path(folder) / "release", SynthConfig(**synth)), verbose=False
        )
        split = Path(folder) / "all.txt"
        write_split_file(split, [record["token"] for record in release.scenario])
        config = PredictConfig(agents=scored["agents"])
        return validated(load_model(path), release, samples(release, split, "all"), config)


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
