"""Make weights that ship from a study: `python -m benchmarks.shipping STUDIES/RECIPE NAME SEED`.

The weights are rounded to half precision, scored on a small release with a seed of its own, and
written to where the package has the weights of their preset. Their notes hold how they were made
and what they score: `deepaccident predict` prints that next to what it measures, and a test makes
the release and scores the weights again.
"""

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import torch

from benchmarks.measure import temporary_folder
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.plugins.model import PredictConfig, load_model, read_weights
from deepaccident_devkit.plugins.model.checkpoint import write_weights
from deepaccident_devkit.plugins.model.training_run import one_thread
from deepaccident_devkit.plugins.model.training_step import validate_model
from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.release.layout import write_split_file
from deepaccident_devkit.selection.samples import samples
from deepaccident_devkit.support.version import __version__

WEIGHTS_FOLDER: Final = Path(__file__).parents[1] / "deepaccident_devkit" / "plugins" / "model"
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
"""Agents that cooperate for the scores, and the release, of other designs than the training's; a
test makes it again.
"""
_NOT_SHIPPED: Final = ("num_batches_tracked", "frustum")


def main(folder: Path, name: str, seed: str) -> None:
    """Round, score and write the weights of a study."""
    study = json.loads((folder / "study.json").read_text())
    cells = {(cell["kind"], cell["name"]): cell for cell in study["cells"]}
    key = cells["weights", f"{name}, seed {seed}"]["key"]
    weights = read_weights(folder.parent / "weights" / key)
    tensors = {
        tensor_name: tensor
        for tensor_name, tensor in weights.tensors.items()
        if not tensor_name.endswith(_NOT_SHIPPED)
    }
    meta = weights.meta
    recipe = study["recipe"]
    release = recipe["weights"][name]["release"]
    origin = {
        "study": f"deepaccident study {recipe['name']}",
        "weights": name,
        "seed": int(seed),
        "key": key,
        "training": {**meta["training"], "split": "all"},
        "release": cells["release", release]["fingerprint"],
        "devkit": __version__,
        "torch": torch.__version__,
    }
    notes = {field: meta[field] for field in ("preset", "fusion", "horizon")} | {"made": origin}
    path = WEIGHTS_FOLDER / f"{meta['preset']}.safetensors"
    write_weights(path, tensors, notes, half=True)
    measured = scores(path, SCORED)
    scored = {**SCORED, "scores": measured}
    write_weights(path, tensors, {**notes, "scored": scored}, half=True)
    print(f"{path}: {path.stat().st_size:,} bytes, {measured}")


def scores(path: Path, scored: Mapping[str, Any]) -> dict[str, float]:
    """Return what weights score with the agents and on the release of `scored`, which is like
    `SCORED`.
    """
    settings = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in scored["synth"].items()
    }
    with one_thread(), temporary_folder() as folder:
        root = make_release(folder / "release", SynthConfig(**settings))
        release = DeepAccident("v1", root, verbose=False)
        split = folder / "all.txt"
        write_split_file(split, [record["token"] for record in release.scenario])
        tokens = samples(release, split, "all")
        config = PredictConfig(agents=scored["agents"])
        return validate_model(load_model(path), release, tokens, config)


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
