"""Small results files made with only numpy and json, as another program would write them."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

SCENARIO = "type1_subtype1_accident/Town03_type001_subtype0001_scenario00024"
TOKENS = tuple(f"{SCENARIO}/ego_vehicle/{frame:03d}" for frame in (10, 15, 20))
AXES = {"x": [-2.0, 2.0, 0.5], "y": [-1.5, 1.5, 0.5]}
# Rows and columns of the maps: `AXES` in the devkit's orientation.
GRID_SHAPE = (6, 8)
NUM_FRAMES = 3
NUM_PREDICTIONS = 2


def results_by_token(task: str, *entries: list[dict[str, Any]]) -> dict[str, Any]:
    """Make a document with the entries of each of `TOKENS`."""
    return results_document(task, results=dict(zip(TOKENS, entries, strict=True)))


def results_document(task: str, **body: Any) -> dict[str, Any]:
    return {
        "format": "DeepAccident results",
        "version": 1,
        "task": task,
        "meta": {"method": "plain"},
        **body,
    }


def accident_entry(**changes: Any) -> dict[str, Any]:
    return {
        "positions": [[12.5, 0.5], [13.0, -2.0]],
        "time": 1.5,
        "score": 0.75,
        "ids": [1236, 1240],
        **changes,
    }


def box_entry(token: str, **changes: Any) -> dict[str, Any]:
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


def accident_document() -> dict[str, Any]:
    """Make results with two accidents, one and none."""
    return results_by_token(
        "accident",
        [accident_entry(), accident_entry(ids=None, time=0)],
        [accident_entry(score=2)],
        [],
    )


def detection_document() -> dict[str, Any]:
    """Make results with two boxes, one and none."""
    first, second, _ = TOKENS
    return results_by_token(
        "detection",
        [box_entry(first), box_entry(first, velocity=None, attribute_name="")],
        [box_entry(second, detection_name="pedestrian")],
        [],
    )


def tracking_document() -> dict[str, Any]:
    """Make results with two tracks, the second of which goes on, and no box in the last sample."""
    first, second, _ = TOKENS
    names = {"detection_name": "tracking_name", "detection_score": "tracking_score"}
    tracks = []
    for token, ids in ((first, ("1", "b/2")), (second, ("b/2",))):
        entry = {names.get(name, name): value for name, value in box_entry(token).items()}
        tracks.append([entry | {"tracking_id": track} for track in ids])
    return results_by_token("tracking", *tracks, [])


def plan_entry(**changes: Any) -> dict[str, Any]:
    return {
        "times": [0.5, 1.0],
        "path": [[4.0, 0.0], [8.0, 0.5]],
        "score": 0.75,
        "yaw": [0.0, 0.1],
        **changes,
    }


def forecast_entry(**changes: Any) -> dict[str, Any]:
    return {
        "id": 1236,
        "times": [0.5, 1.0],
        "paths": [
            [[12.0, 3.5], [10.0, 3.5]],
            [[12.0, 3.5], [11.0, 4.0]],
        ],
        "probabilities": [0.75, 0.25],
        **changes,
    }


def planning_document() -> dict[str, Any]:
    """Make results with two plans, one and one."""
    return results_by_token(
        "planning",
        [plan_entry(), plan_entry(yaw=None, score=2)],
        [plan_entry()],
        [plan_entry(times=[0, 3])],
    )


def forecasting_document() -> dict[str, Any]:
    """Make forecasts of two actors, of one and of none."""
    return results_by_token(
        "forecasting",
        [forecast_entry(), forecast_entry(id=1240, probabilities=[1, 0])],
        [forecast_entry(times=[0, 3])],
        [],
    )


def instance_arrays(number: int = 0) -> dict[str, np.ndarray]:
    """Make two predictions in which two instances go ahead."""
    maps = np.zeros(
        (NUM_PREDICTIONS, NUM_FRAMES, *GRID_SHAPE),
        dtype=np.uint8,
    )
    for frame in range(NUM_FRAMES):
        start = 3 + frame + number % 2
        maps[:, frame, 1:3, frame : frame + 2] = 1
        maps[:, frame, 4:5, start] = 7
    return {"instance": maps}


def head_arrays() -> dict[str, np.ndarray]:
    random = np.random.default_rng(0)
    arrays = {}
    for name, channels in {"segmentation": 2, "centerness": 1, "offset": 2, "flow": 2}.items():
        shape = (NUM_PREDICTIONS, NUM_FRAMES, channels, *GRID_SHAPE)
        arrays[name] = random.normal(size=shape).astype(np.float32)
    return arrays


def manifest_form(stored: str = "instances") -> dict[str, Any]:
    return {
        "stored": stored,
        **AXES,
        "orientation": "devkit",
        "predictions": NUM_PREDICTIONS,
        "frames": NUM_FRAMES,
        "step": 0.5,
        "labels": "released",
    }


def shard_entry(folder: Path, file: str, tokens: Sequence[str]) -> dict[str, Any]:
    content = (folder / file).read_bytes()
    return {
        "file": file,
        "tokens": list(tokens),
        "bytes": len(content),
        "checksum": hashlib.blake2b(content, digest_size=16).hexdigest(),
    }


def write_shard(path: Path, samples: Mapping[str, Mapping[str, np.ndarray]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    members = {}
    for token, arrays in samples.items():
        for name, array in arrays.items():
            members[f"{token}/{name}"] = array
    np.savez_compressed(path, **members)


def read_json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def write_json(path: Path, document: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(document), encoding="utf-8")
    return path


def write_motion(folder: Path, stored: str = "instances") -> Path:
    """Write three samples in two shards."""
    shards = []
    for file, tokens in {"shards/00000.npz": TOKENS[:2], "shards/00001.npz": TOKENS[2:]}.items():
        samples = {}
        for token in tokens:
            is_heads = stored == "heads"
            samples[token] = head_arrays() if is_heads else instance_arrays(TOKENS.index(token))
        write_shard(folder / file, samples)
        shards.append(shard_entry(folder, file, tokens))
    write_json(
        folder / "results.json",
        results_document("motion", form=manifest_form(stored), shards=shards),
    )
    return folder


def refresh_shard_entry(folder: Path) -> None:
    """Update sizes and checksums of the shards, as a program that wrote such arrays would."""
    manifest = read_json(folder / "results.json")
    for shard in manifest["shards"]:
        shard.update(shard_entry(folder, shard["file"], shard["tokens"]))
    write_json(folder / "results.json", manifest)
