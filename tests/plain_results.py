"""Small results files made with numpy and json alone: what another program would write, for tests
that break them.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

SCENARIO = "type1_subtype1_accident/Town03_type001_subtype0001_scenario00024"
TOKENS = tuple(f"{SCENARIO}/ego_vehicle/{frame:03d}" for frame in (10, 15, 20))
AXES = {"x": [-2.0, 2.0, 0.5], "y": [-1.5, 1.5, 0.5]}
SHAPE = (6, 8)
"""Rows and columns of the maps: `AXES` in the devkit's orientation."""
FRAMES = 3
PREDICTIONS = 2


def document(task: str, **body: Any) -> dict[str, Any]:
    return {
        "format": "DeepAccident results",
        "version": 1,
        "task": task,
        "meta": {"method": "plain"},
        **body,
    }


def accident(**changes: Any) -> dict[str, Any]:
    return {
        "positions": [[12.5, 0.5], [13.0, -2.0]],
        "time": 1.5,
        "score": 0.75,
        "ids": [1236, 1240],
        **changes,
    }


def box(token: str, **changes: Any) -> dict[str, Any]:
    return {
        "sample_token": token,
        "translation": [105.25, -33.0, 0.75],
        "size": [1.9, 4.5, 1.6],
        "rotation": [0.6, 0.0, 0.0, 0.8],
        "velocity": [0.0, 8.25],
        "detection_name": "van",
        "detection_score": 0.9,
        **changes,
    }


def accidents() -> dict[str, Any]:
    """Two accidents, one and none."""
    lists = [[accident(), accident(ids=None, time=0)], [accident(score=2)], []]
    return document("accident", results=dict(zip(TOKENS, lists, strict=True)))


def detections() -> dict[str, Any]:
    """Two boxes, one and none."""
    first, second, third = TOKENS
    lists = [
        [box(first), box(first, velocity=None, attribute_name="")],
        [box(second, detection_name="pedestrian")],
        [],
    ]
    return document("detection", results=dict(zip((first, second, third), lists, strict=True)))


def plan(**changes: Any) -> dict[str, Any]:
    return {
        "times": [0.5, 1.0],
        "path": [[4.0, 0.0], [8.0, 0.5]],
        "score": 0.75,
        "yaw": [0.0, 0.1],
        **changes,
    }


def forecast(**changes: Any) -> dict[str, Any]:
    paths = [[[12.0, 3.5], [10.0, 3.5]], [[12.0, 3.5], [11.0, 4.0]]]
    return {
        "id": 1236,
        "times": [0.5, 1.0],
        "paths": paths,
        "probabilities": [0.75, 0.25],
        **changes,
    }


def plans() -> dict[str, Any]:
    """Two plans, one and one."""
    lists = [[plan(), plan(yaw=None, score=2)], [plan()], [plan(times=[0, 3])]]
    return document("planning", results=dict(zip(TOKENS, lists, strict=True)))


def forecasts() -> dict[str, Any]:
    """Of two actors, of one and of none."""
    lists = [[forecast(), forecast(id=1240, probabilities=[1, 0])], [forecast(times=[0, 3])], []]
    return document("forecasting", results=dict(zip(TOKENS, lists, strict=True)))


def instance_arrays(number: int = 0) -> dict[str, np.ndarray]:
    """Two predictions in which two instances go ahead."""
    maps = np.zeros((PREDICTIONS, FRAMES, *SHAPE), dtype=np.uint8)
    for t in range(FRAMES):
        maps[:, t, 1:3, t : t + 2] = 1
        maps[:, t, 4:5, 3 + t + number % 2] = 7
    return {"instance": maps}


def head_arrays() -> dict[str, np.ndarray]:
    source = np.random.default_rng(0)
    return {
        name: source.normal(size=(PREDICTIONS, FRAMES, channels, *SHAPE)).astype(np.float32)
        for name, channels in {"segmentation": 2, "centerness": 1, "offset": 2, "flow": 2}.items()
    }


def form(stored: str = "instances") -> dict[str, Any]:
    sizes = {"predictions": PREDICTIONS, "frames": FRAMES, "step": 0.5, "labels": "released"}
    return {"stored": stored, **AXES, "orientation": "devkit", **sizes}


def listed(folder: Path, file: str, tokens: Sequence[str]) -> dict[str, Any]:
    """A shard's entry in the manifest."""
    content = (folder / file).read_bytes()
    checksum = hashlib.blake2b(content, digest_size=16).hexdigest()
    return {"file": file, "tokens": list(tokens), "bytes": len(content), "checksum": checksum}


def write_shard(path: Path, samples: Mapping[str, Mapping[str, np.ndarray]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        path,
        **{f"{token}/{name}": a for token, arrays in samples.items() for name, a in arrays.items()},
    )


def write_json(path: Path, told: Mapping[str, Any]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(told), encoding="utf-8")
    return path


def write_motion(folder: Path, stored: str = "instances") -> Path:
    """Three samples in two shards."""
    samples = {
        token: instance_arrays(number) if stored == "instances" else head_arrays()
        for number, token in enumerate(TOKENS)
    }
    files = {"shards/00000.npz": TOKENS[:2], "shards/00001.npz": TOKENS[2:]}
    for file, tokens in files.items():
        write_shard(folder / file, {token: samples[token] for token in tokens})
    shards = [listed(folder, file, tokens) for file, tokens in files.items()]
    write_json(folder / "results.json", document("motion", form=form(stored), shards=shards))
    return folder


def relist(folder: Path) -> None:
    """State the sizes and checksums that shards have now, as one who writes such arrays would."""
    told = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    told["shards"] = [listed(folder, shard["file"], shard["tokens"]) for shard in told["shards"]]
    write_json(folder / "results.json", told)
