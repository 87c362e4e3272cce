"""Benchmarks: releases that anybody makes anew, and whether a release is as published (docs/benchmark.md).

Labels, meta, calib and split files are the same bytes wherever they are made: their numbers are rounded
(`SynthConfig.decimals`), and what processors compute differently in the last digits is gone. But what is counted by
rays, `num_lidar_pts`, and images and clouds are compared within a tolerance.
"""

from __future__ import annotations

import json
import lzma
from collections.abc import Iterator, Mapping
from dataclasses import fields
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.errors import SplitFileError
from deepaccident_devkit.parallel import run_batch
from deepaccident_devkit.release import ScenarioFolder, find_release, read_image, read_labels, read_lidar
from deepaccident_devkit.release.fingerprints import digest_of, folder_hashes
from deepaccident_devkit.release.layout import frame_numbers
from deepaccident_devkit.release.store import read_lines
from deepaccident_devkit.support.text import choice
from deepaccident_devkit.synth.plan import SynthConfig
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS, LIDAR

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.parallel import Engine

BENCHMARKS: Final[Mapping[str, SynthConfig]] = {
    "v1": SynthConfig(scenarios=240, image_size=(320, 180), seed=20261201, sensor_step=5, decimals=4)
}
"""Benchmark → what it is made of. Whatever the generator learns, these stay as they are, byte for byte."""
TOLERANCES: Final[Mapping[str, tuple[float, ...]]] = {
    "points": (0, 0.05),
    "images": (0, *[2.0] * 9),
    "clouds": (0, 20.0, 0.1, 0.1, 0.05, 0.01),
}
"""How much each number of `described` may differ."""
_NOTHING: Final = [0.0] * 9


def described(scenario: ScenarioFolder) -> dict[str, Any]:
    """What is compared of a scenario; JSON.

    - `meta`, `calib`: hashes of their bytes (`release.ScenarioHashes`).
    - `label`: a hash of the values of all labels, but of `num_lidar_pts`; `points`: for each agent, the number of its
      boxes, and the mean of that column.
    - `images`: for each agent and camera, their number, and the mean red, green and blue (0 to 255) of their left,
      middle and right thirds; None where there are none.
    - `clouds`: for each agent, their number, and the mean of their points' number, x, y, z (metres) and intensity.
    """
    hashes, points = zip(*_labels(scenario), strict=True)
    seen = {"images": list(_images(scenario)), "clouds": list(_clouds(scenario))}
    sensors = {kind: rows if any(row[0] for row in rows) else None for kind, rows in seen.items()}
    return {
        **folder_hashes(scenario, ["meta", "calib"]).as_dict(),
        "label": digest_of(hashes),
        "points": points,
        **sensors,
    }


def described_release(root: Path, **how: Unpack[Engine]) -> dict[str, Any]:
    """What is compared of a release: `splits`, a hash of its split files, and `scenarios` by token, as `described`."""
    layout = find_release(root)
    splits = {name: read_lines(path, "split", SplitFileError) for name, path in layout.split_files.items()}
    made = run_batch(described, layout.scenarios, label="comparing", **how)
    tokens = [each.token for each in layout.scenarios]
    return {"splits": digest_of(splits), "scenarios": dict(zip(tokens, made, strict=True))}


def published(name: str) -> dict[str, Any]:
    """What `described_release` says of a benchmark as it was published; raises ChoiceError for an unknown one."""
    choice("benchmark", name, BENCHMARKS)
    path = Path(__file__).parent / f"benchmark_{name}.json.xz"
    return dict(json.loads(lzma.decompress(path.read_bytes())))


def differences(found: Mapping[str, Any], wanted: Mapping[str, Any]) -> list[str]:
    """Where a release is not as published, a line each; sensors that it has no files of are not compared.

    Args:
        found: of `described_release`.
        wanted: of `published`.
    """
    lines = ["its split files differ"] if found["splits"] != wanted["splits"] else []
    for token in sorted({*found["scenarios"], *wanted["scenarios"]}):
        here, there = found["scenarios"].get(token), wanted["scenarios"].get(token)
        if here is None or there is None:
            lines.append(f"{token}: is {'missing' if here is None else 'not of the benchmark'}")
            continue
        lines += [f"{token}: {kind} files differ" for kind in ("label", "meta", "calib") if here[kind] != there[kind]]
        for kind, tolerance in TOLERANCES.items():
            if here[kind] is not None and (np.abs(np.subtract(here[kind], there[kind])) > tolerance).any():
                lines.append(f"{token}: {kind} differ by more than the tolerance")
    return lines


def _labels(scenario: ScenarioFolder) -> Iterator[tuple[str, list[float]]]:
    for agent in AGENTS:
        paths = [scenario.label_path(agent, frame) for frame in _frames(scenario, agent, "label", "txt")]
        labels = read_labels(paths, raw=True)
        names = [each.name for each in fields(labels) if each.name != "num_lidar_pts"]
        hashed = digest_of({name: np.asarray(getattr(labels, name)).tolist() for name in names})
        yield hashed, [len(labels), labels.num_lidar_pts.mean().round(3).item() if len(labels) else 0.0]


def _images(scenario: ScenarioFolder) -> Iterator[list[float]]:
    for agent, camera in product(AGENTS, CAMERAS):
        frames = _frames(scenario, agent, camera, "jpg")
        means = _NOTHING
        if frames:
            pictures = [read_image(scenario.channel_path(agent, camera, frame)) for frame in frames]
            of_columns = np.mean([picture.mean(0) for picture in pictures], axis=0)
            means = np.concatenate([third.mean(0) for third in np.array_split(of_columns, 3)]).round().tolist()
        yield [len(frames), *means]


def _clouds(scenario: ScenarioFolder) -> Iterator[list[float]]:
    for agent in AGENTS:
        frames = _frames(scenario, agent, LIDAR, "npz")
        clouds = [read_lidar(scenario.channel_path(agent, LIDAR, frame)) for frame in frames]
        means = [[len(each), *each.xyz.mean(0), each.intensity.mean()] for each in clouds] or [_NOTHING[:5]]
        yield [len(frames), *np.mean(means, axis=0).round(3).tolist()]


def _frames(scenario: ScenarioFolder, agent: str, kind: str, ending: str) -> list[int]:
    return frame_numbers(scenario.kind_folder(agent, kind), ending)[0]
